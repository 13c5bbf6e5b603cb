"""Write episodes as a LeRobot data set of version 3.0: states of the robot, tasks and subtasks, and images on request.

`states` makes the frames of an episode, `images` draws the scene of each frame, `statistics` computes the values with
which LeRobot normalises, and the section "dataset" writes the files.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from contextvars import Context
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged
from pycrorm_async.export.formats import Format, Job, Written
from pycrorm_async.export.scenes import ExportedEpisode, Frames, frames_of, read_episode
from pycrorm_async.query.again import world_of
from pycrorm_async.query.frames import needed_pyarrow
from pycrorm_async.query.observed_images import png_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment, moments
from pycrorm_async.query.text import parameters_text
from pycrorm_async.world.pose import Vector
from pycrorm_async.world.queries import Camera, photograph
from pycrorm_async.writer.drain import run_to_completion

# === dataset ==================================================================================================
#
# Write the files of a LeRobot data set: `meta/` and `data/`, in version 3.0, with pyarrow alone.
#
# Each frame has `observation.state` and `action`, the state of the next frame (the last one repeats its own), the event
# and the time behind it, and the subtask. `meta/plan.parquet` is ours: every node of the plans, with its first and last
# frame. LeRobot ignores it.

FPS = 10
"""Frames per second; nominal if there is one frame for each event, because LeRobot requires a value."""
_CHUNK_FILES = 1000
"""Bounds the files of one folder (`chunk`), the default of LeRobot."""
_FILE_MEGABYTES = 100
"""The size in MiB above which the next episode begins a new file, the default of LeRobot."""
_VECTORS = ("observation.state", "action")
_PICTURE = "observation.images.scene"


async def write_lerobot(job: Job, folder: Path) -> Written:
    """Write the episodes into an empty folder.

    An episode that cannot be read is left out, unless it is the only one. Raises `CallerError` for episodes that the
    format cannot hold, and `MissingExtra`.
    """
    dataset = LeRobotFolder(folder, fps=job.options["fps"])
    episodes, unreadable, before = job.selection.episodes, dict[int, str](), 0
    for each in episodes:
        try:
            episode = await read_episode(ExportedEpisode, job.reading, each, job.reporter("reading", before))
        except (LogDamaged, DatabaseForeign) as error:
            unreadable[each.number] = str(error)
            if len(unreadable) == len(episodes):
                raise
            continue
        # A thread does each long step, and a cancelled task waits for its end: to delete a file to which a thread still
        # writes would leave a part of it.
        frames = await run_to_completion(
            asyncio.to_thread(frames_of, episode, job.options["clock"], job.options["fps"])
        )
        pictures = None
        if job.options["images"] is not None:
            drawn = await draw_frames(
                job.reading, episode, frames, job.options["images"], job.reporter("drawing", before)
            )
            pictures = np.stack(drawn)
        await run_to_completion(asyncio.to_thread(dataset.add, episode, frames, pictures))
        job.reporter("writing", before)(each.events)
        before += each.events
    await run_to_completion(asyncio.to_thread(dataset.finish))
    return Written(dataset.frames, unreadable=unreadable)


class LeRobotFolder:
    """Writes a data set into an empty folder: `add` for each episode, then `finish`."""

    def __init__(self, folder: Path, *, fps: int) -> None:
        needed_pyarrow()
        self._folder = folder
        self._fps = fps
        self._first: tuple[int, Frames] | None = None
        self.frames = 0
        """The number of frames added so far."""
        self._tasks: dict[str, int] = {}
        self._subtasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._statistics: list[dict[str, Statistics]] = []
        self._plan: list[dict[str, Any]] = []
        self._file = 0
        self._file_bytes = 0
        self._picture_shape: tuple[int, ...] = ()
        self._dtypes: dict[str, str] = {}
        self._writer: Any = None

    def add(self, episode: ExportedEpisode, frames: Frames, pictures: NDArray[np.uint8] | None = None) -> None:
        """Write the frames of an episode, with their pictures; either all episodes have pictures or none has.

        Raises `CallerError` if its robot has other joints than that of the first.
        """
        self._check_channels(episode, frames)
        number, count = len(self._episodes), len(frames.at)
        task = episode.started.description or f"episode {episode.number}"
        columns = self._columns(frames, number, task)
        self._dtypes = {name: str(values.dtype) for name, values in columns.items()}
        statistics = {name: statistics_of(values) for name, values in columns.items()}
        if pictures is not None:
            self._picture_shape = pictures.shape[1:]
            statistics[_PICTURE] = statistics_of_images(pictures)
        chunk, file = self._write(columns, len(frames.channels), pictures)
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [task],
                "length": count,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                **{
                    f"stats/{name}/{key}": values.tolist()
                    for name, each in statistics.items()
                    for key, values in each.items()
                },
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self._statistics.append(statistics)
        self._add_plan(episode, frames, number)
        self.frames += count

    def finish(self) -> None:
        """Write the files in `meta/`, which describe the episodes."""
        if self._writer is not None:
            self._writer.close()
        assert self._first is not None, "an episode was added"
        _, frames = self._first
        meta = self._folder / "meta"
        (meta / "episodes" / "chunk-000").mkdir(parents=True)
        _write_json(meta / "info.json", self._info(frames))
        totals = {name: joined([each[name] for each in self._statistics]) for name in self._statistics[0]}
        _write_json(
            meta / "stats.json",
            {name: {key: values.tolist() for key, values in each.items()} for name, each in totals.items()},
        )
        _write_names(meta / "tasks.parquet", "task", self._tasks)
        _write_names(meta / "subtasks.parquet", "subtask", self._subtasks)
        _write_rows(meta / "episodes" / "chunk-000" / "file-000.parquet", self._episodes)
        _write_rows(meta / "plan.parquet", self._plan)

    def _check_channels(self, episode: ExportedEpisode, frames: Frames) -> None:
        if self._first is None:
            self._first = episode.number, frames
        first, (robot, channels, *_) = self._first
        if channels == frames.channels:
            return
        differing = sorted(set(channels) ^ set(frames.channels))
        raise CallerError(
            f"episode {episode.number} has the robot {frames.robot} with other joints than {robot} of episode {first}"
            f" ({', '.join(differing[:3])}{' …' if len(differing) > 3 else ''}): export them into two data sets"
        )

    def _columns(self, frames: Frames, number: int, task: str) -> dict[str, NDArray[Any]]:
        count = len(frames.at)
        index = np.arange(count, dtype=np.int64)
        task_index = self._tasks.setdefault(task, len(self._tasks))
        subtasks = [self._subtasks.setdefault(each, len(self._subtasks)) for each in frames.subtasks]
        return {
            "observation.state": frames.states,
            "action": np.concatenate([frames.states[1:], frames.states[-1:]]),
            "timestamp": (index / self._fps).astype(np.float32),
            "time_s": np.array([each.since_ns / 1e9 for each in frames.at]),
            "event": np.array([each.sequence for each in frames.at], dtype=np.int64),
            "frame_index": index,
            "episode_index": np.full(count, number, dtype=np.int64),
            "index": index + self.frames,
            "task_index": np.full(count, task_index, dtype=np.int64),
            "subtask_index": np.array(subtasks, dtype=np.int64),
        }

    def _write(
        self, columns: dict[str, NDArray[Any]], width: int, pictures: NDArray[np.uint8] | None
    ) -> tuple[int, int]:
        """Write the frames of an episode as one row group; return the numbers of the chunk and the file."""
        pa = needed_pyarrow()
        from pyarrow import parquet

        arrays = {
            name: pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), pa.float32()), width)
            if name in _VECTORS
            else pa.array(values)
            for name, values in columns.items()
        }
        if pictures is not None:
            encoded = [{"bytes": png_of(each, 9), "path": None} for each in pictures]
            arrays[_PICTURE] = pa.array(encoded, pa.struct({"bytes": pa.binary(), "path": pa.string()}))
        table = pa.table(arrays)
        if self._writer is not None and self._file_bytes > _FILE_MEGABYTES * 2**20:
            self._writer.close()
            self._writer, self._file, self._file_bytes = None, self._file + 1, 0
        chunk, file = divmod(self._file, _CHUNK_FILES)
        if self._writer is None:
            path = self._folder / "data" / f"chunk-{chunk:03d}" / f"file-{file:03d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = parquet.ParquetWriter(path, table.schema)
        self._writer.write_table(table)
        self._file_bytes += table.nbytes
        return chunk, file

    def _add_plan(self, episode: ExportedEpisode, frames: Frames, number: int) -> None:
        """Note every node with the frames from its start to its end; `to_index` is behind the last one."""
        sequences = np.array([each.sequence for each in frames.at])
        for node in episode.nodes.values():
            begin = int(np.searchsorted(sequences, node.start.sequence, side="left"))
            end = len(sequences)
            if node.end is not None:
                end = int(np.searchsorted(sequences, node.end.sequence, side="left"))
            self._plan.append(
                {
                    "episode_index": number,
                    "node": node.start.sequence,
                    "parent": node.parent,
                    "kind": node.kind,
                    "dtype": episode.type_of(node),
                    "label": episode.label(node),
                    "parameters": parameters_text(episode.parameters(node)),
                    "status": node.status,
                    "reason": node.reason,
                    "message": node.message,
                    "dataset_from_index": self.frames + begin,
                    "dataset_to_index": self.frames + end,
                }
            )

    def _info(self, frames: Frames) -> dict[str, Any]:
        vector = {"dtype": "float32", "shape": [len(frames.channels)], "names": list(frames.channels)}
        features: dict[str, Any] = dict.fromkeys(_VECTORS, vector)
        for name, dtype in self._dtypes.items():
            features.setdefault(name, {"dtype": dtype, "shape": [1], "names": None})
        if self._picture_shape:
            names = ["height", "width", "channels"]
            features[_PICTURE] = {"dtype": "image", "shape": list(self._picture_shape), "names": names}
        return {
            "codebase_version": "v3.0",
            "robot_type": frames.robot,
            "total_episodes": len(self._episodes),
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK_FILES,
            "data_files_size_in_mb": _FILE_MEGABYTES,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": features,
        }


def _write_json(path: Path, document: Any) -> None:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(document), indent=4) + b"\n")


def _write_names(path: Path, name: str, numbers: dict[str, int]) -> None:
    """Write names and their numbers as pandas does, with the names as index, because LeRobot reads them so."""
    pa = needed_pyarrow()
    from pyarrow import parquet

    columns = [
        {"name": each, "field_name": each, "pandas_type": type_, "numpy_type": numpy_type, "metadata": None}
        for each, type_, numpy_type in ((f"{name}_index", "int64", "int64"), (name, "unicode", "object"))
    ]
    table = pa.table({f"{name}_index": pa.array(numbers.values(), pa.int64()), name: pa.array(numbers, pa.string())})
    index = msgspec.json.encode({"index_columns": [name], "column_indexes": [], "columns": columns})
    parquet.write_table(table.replace_schema_metadata({"pandas": index}), path)


def _write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    pa = needed_pyarrow()
    from pyarrow import parquet

    table = pa.Table.from_pylist(rows)
    missing = [each for each in table.schema if pa.types.is_null(each.type)]  # such as the reasons without a failure
    for each in missing:
        at, type_ = table.column_names.index(each.name), pa.int64() if each.name == "parent" else pa.string()
        table = table.set_column(at, each.name, table.column(each.name).cast(type_))
    parquet.write_table(table, path)


# === images ===================================================================================================
#
# Draw the scene at each frame of an episode, from the recorded geometry, with one fixed camera.
#
# The camera looks from the side at all places where the robot is. A picture of 320 x 240 takes about 0.1 s of CPU time.

ImageSize = tuple[int, int]
"""Width and height in pixels."""

_SIDE_LEAST, _SIDE_MOST = 16, 2000
"""Bounds the width and the height of an image, in pixels."""
_REACH_M = 1.2
"""The camera shows this much around the places of the robot's base: what its arms reach."""
_HEIGHT_M = 0.8
"""Height of the point that the camera looks at."""
_YAW_DEG, _VIEW_DEG = 215.0, 40.0
_EVENTS_AT_ONCE = 64
"""Bounds the snapshots that wait to be drawn."""


def check_size(size: ImageSize) -> None:
    """Raise `CallerError` for a size outside the range that a picture can have."""
    if not all(_SIDE_LEAST <= each <= _SIDE_MOST for each in size):
        raise CallerError(f"images must be {_SIDE_LEAST} to {_SIDE_MOST} pixels wide and high, got {size!r}")


async def draw_frames(
    reading: Reading,
    episode: ExportedEpisode,
    frames: Frames,
    size: ImageSize,
    report_events: Callable[[int], object],
) -> list[NDArray[np.uint8]]:
    """Return the picture of each frame, of shape (height, width, 3). Frames of one event share theirs.

    `report_events` gets the event up to which the frames are drawn.

    Raises `EngineMissing` without the extra `world`.
    """
    camera = _camera(frames, size)
    sequences = sorted({each.sequence for each in frames.at})
    drawn: dict[int, NDArray[np.uint8]] = {}
    waiting: list[Moment] = []
    async for moment in moments(await reading.log(), episode.number, set(sequences)):
        waiting.append(moment)
        if len(waiting) == _EVENTS_AT_ONCE or moment.sequence == sequences[-1]:
            # In a thread with an empty context the world belongs to no open episode and is not recorded.
            pictures = await asyncio.to_thread(Context().run, _drawn, waiting, camera, size)
            drawn.update(zip((each.sequence for each in waiting), pictures, strict=True))
            report_events(moment.sequence)
            waiting = []
    return [drawn[each.sequence] for each in frames.at]


def _camera(frames: Frames, size: ImageSize) -> Camera:
    low, high = frames.states[:, :2].min(axis=0), frames.states[:, :2].max(axis=0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2 + _REACH_M
    narrow = math.atan(math.tan(math.radians(_VIEW_DEG / 2)) * min(1.0, size[0] / size[1]))
    target = Vector(float(middle[0]), float(middle[1]), _HEIGHT_M)
    return Camera(target, radius / math.sin(narrow), _YAW_DEG, view_deg=_VIEW_DEG)


def _drawn(moments: Sequence[Moment], camera: Camera, size: ImageSize) -> list[NDArray[np.uint8]]:
    pictures: list[NDArray[np.uint8]] = []
    done = 0
    while done < len(moments):
        objects = [each.identity_id for each in moments[done].world.objects]
        with world_of(moments[done]) as world:
            while done < len(moments) and [each.identity_id for each in moments[done].world.objects] == objects:
                world.restore_state(moments[done].world.state)
                pictures.append(photograph(world, camera, *size, smooth=False).pixels)
                done += 1
    return pictures


# === statistics ===============================================================================================
#
# Compute the statistics that LeRobot normalises with, of one episode and of many.

Statistics: TypeAlias = dict[str, NDArray[Any]]
"""The numbers of each statistic by its name: one for each channel of a feature, or a single one for `count`."""

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def statistics_of(values: NDArray[Any]) -> Statistics:
    """Return the statistics of a feature over the frames of an episode."""
    columns = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    return {
        "min": columns.min(axis=0),
        "max": columns.max(axis=0),
        "mean": columns.mean(axis=0),
        "std": columns.std(axis=0),
        "count": np.array([len(columns)]),
        **{name: np.quantile(columns, share, axis=0) for name, share in _QUANTILES.items()},
    }


def statistics_of_images(pictures: NDArray[np.uint8]) -> Statistics:
    """Return the statistics of each colour over all pixels, from 0 to 1, in the shape (3, 1, 1) that LeRobot has."""
    pixels = statistics_of(pictures.reshape(-1, 3) / 255)
    shaped = {name: each.reshape(3, 1, 1) for name, each in pixels.items() if name != "count"}
    return {**shaped, "count": np.array([len(pictures)])}


def joined(parts: Sequence[Statistics]) -> Statistics:
    """Return the statistics over several episodes; quantiles are the weighted means of theirs, as LeRobot has them."""
    counts = np.array([each["count"][0] for each in parts], dtype=np.float64)
    shares = (counts / counts.sum()).reshape(-1, *[1] * parts[0]["mean"].ndim)
    means = np.stack([each["mean"] for each in parts])
    mean = (means * shares).sum(axis=0)
    variances = np.stack([each["std"] for each in parts]) ** 2
    return {
        "min": np.stack([each["min"] for each in parts]).min(axis=0),
        "max": np.stack([each["max"] for each in parts]).max(axis=0),
        "mean": mean,
        "std": np.sqrt(((variances + (means - mean) ** 2) * shares).sum(axis=0)),
        "count": np.array([int(counts.sum())]),
        **{name: (np.stack([each[name] for each in parts]) * shares).sum(axis=0) for name in _QUANTILES},
    }


LEROBOT = Format(
    write_lerobot,
    noun="frame",
    holds="episodes",
    options={"clock": "event", "fps": FPS, "images": None},
    marker="meta/info.json",
)
