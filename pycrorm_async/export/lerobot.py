"""Write episodes as a LeRobot data set of version 3.0: states of the robot, images, tasks and subtasks.

The files are `meta/`, `data/` and `videos/`, written with pyarrow and PyAV alone.

Each frame has `observation.state` and `action`, the state of the next frame (the last one repeats its own), the last
event up to it, its time, the subtask, and the images of `lerobot_images`. `meta/plan.parquet` is ours: every node of
the plans, with its frames from `dataset_from_index` up to, and without, `dataset_to_index`. LeRobot ignores it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged
from pycrorm_async.export import lerobot_images
from pycrorm_async.export.formats import Format, Job, Written
from pycrorm_async.export.lerobot_images import Pixels, Statistics, statistics_of
from pycrorm_async.export.scenes import ExportedEpisode, Frames, frames_of, read_episode
from pycrorm_async.query.frames import needed_pyarrow
from pycrorm_async.query.text import parameters_text
from pycrorm_async.writer.drain import run_to_completion

FPS = 10
"""Frames per second. With a frame for each change of the state (clock `event`) it says nothing: LeRobot needs it."""
_FILE_MEGABYTES = 100
"""The size in MiB above which the next episode begins a new file, the default of LeRobot."""
_VECTORS = ("observation.state", "action")
_IMAGES_AT_ONCE = 128
"""Bounds the frames of a row group that has images, because they are in memory until it is written."""


async def write_lerobot(job: Job, folder: Path) -> Written:
    """Write the episodes into an empty folder.

    An episode that cannot be read is left out; if none can be read, the error of the last one is raised. Raises
    `CallerError` for episodes that the format cannot hold, and `MissingExtra`.
    """
    size, fps, episodes = job.options["images"], job.options["fps"], job.selection.episodes
    observed = [] if size == "none" else await lerobot_images.observed_cameras(job.reading, episodes)
    cameras = lerobot_images.features_of(observed, folder, fps)
    if size not in (None, "none"):
        if any(each.feature == lerobot_images.DRAWN for each in observed):
            raise CallerError("a recorded camera has the name of the drawn images, scene: export without drawn ones")
        cameras.append(lerobot_images.Camera(lerobot_images.DRAWN, tuple(size), folder, fps, is_video=False))
    dataset = LeRobotFolder(folder, cameras, fps=fps)
    try:
        unreadable = await _add_episodes(job, dataset, observed)
        await run_to_completion(asyncio.to_thread(dataset.finish))
    finally:
        dataset.close()
    for camera in observed:
        camera.note()
    return Written(dataset.frames, unreadable=unreadable)


async def _add_episodes(
    job: Job, dataset: LeRobotFolder, observed: Sequence[lerobot_images.ObservedCamera]
) -> dict[int, str]:
    """Add the episodes; return the reasons why some of them are left out, by number."""
    log, loop, size = await job.reading.log(), asyncio.get_running_loop(), job.options["images"]

    def read_blob(name: str) -> bytes | None:  # in the thread that writes
        return asyncio.run_coroutine_threadsafe(log.blobs.read_blob(name), loop).result()

    episodes, unreadable, before = job.selection.episodes, dict[int, str](), 0
    for each in episodes:
        try:
            episode = await read_episode(ExportedEpisode, job.reading, each, job.reporter("reading", before))
        except (LogDamaged, DatabaseForeign) as error:
            unreadable[each.number] = str(error)
            if len(unreadable) == len(episodes):
                raise
            continue
        # Long steps run in threads. A cancelled export waits for its thread, which may still write to a file, before
        # the files are deleted.
        frames = await run_to_completion(
            asyncio.to_thread(frames_of, episode, job.options["clock"], job.options["fps"])
        )
        sequences = [frame.sequence for frame in frames.at]
        images = {camera.feature: camera.frames(episode, sequences, read_blob) for camera in observed}
        if size not in (None, "none"):
            report_drawn = job.reporter("drawing", before)
            drawn = await lerobot_images.draw_frames(job.reading, episode, frames, size, report_drawn)
            images[lerobot_images.DRAWN] = iter(drawn)
        report = job.reporter("writing", before)
        with log.translated():
            await run_to_completion(asyncio.to_thread(dataset.add, episode, frames, images, report))
        report(each.events)
        before += each.events
    return unreadable


class LeRobotFolder:
    """Writes a data set into an empty folder: `add` for each episode, then `finish`, and `close` also after a fault."""

    def __init__(self, folder: Path, cameras: Sequence[lerobot_images.Camera], *, fps: int) -> None:
        needed_pyarrow()
        self._folder = folder
        self._cameras = cameras
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
        self._dtypes: dict[str, str] = {}
        self._writer: Any = None

    def add(
        self,
        episode: ExportedEpisode,
        frames: Frames,
        images: Mapping[str, Iterator[Pixels]],
        report_events: Callable[[int], object],
    ) -> None:
        """Write the frames of an episode; `images` has those of each camera by feature, one for each frame.

        Raises `CallerError` if its robot has other joints than that of the first.
        """
        self._check_channels(episode, frames)
        number, count = len(self._episodes), len(frames.at)
        task = episode.started.description or f"episode {episode.number}"
        columns = self._columns(frames, number, task)
        self._dtypes = {name: str(values.dtype) for name, values in columns.items()}
        statistics = {name: statistics_of(values) for name, values in columns.items()}
        for camera in self._cameras:
            camera.begin(count)
        self._begin_file()
        at_once = _IMAGES_AT_ONCE if self._cameras else count
        for begin in range(0, count, at_once):
            part = {name: values[begin : begin + at_once] for name, values in columns.items()}
            self._write(part, len(frames.channels), images)
            report_events(frames.at[min(begin + at_once, count) - 1].sequence)
        places: dict[str, Any] = {}
        for camera in self._cameras:
            statistics[camera.feature], place = camera.end()
            places |= place
        chunk, file = divmod(self._file, lerobot_images.FILES_IN_CHUNK)
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [task],
                "length": count,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                **places,
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
        """Complete the files, and write those in `meta/`, which describe the episodes."""
        self.close()
        assert self._first is not None, "no episode was added"
        _, frames = self._first
        meta = self._folder / "meta"
        (meta / "episodes" / "chunk-000").mkdir(parents=True)
        _write_json(meta / "info.json", self._info(frames))
        totals = {
            name: lerobot_images.joined([each[name] for each in self._statistics]) for name in self._statistics[0]
        }
        _write_json(
            meta / "stats.json",
            {name: {key: values.tolist() for key, values in each.items()} for name, each in totals.items()},
        )
        _write_names(meta / "tasks.parquet", "task", self._tasks)
        _write_names(meta / "subtasks.parquet", "subtask", self._subtasks)
        _write_rows(meta / "episodes" / "chunk-000" / "file-000.parquet", self._episodes)
        _write_rows(meta / "plan.parquet", self._plan)

    def close(self) -> None:
        """Close the files that are open."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
        for camera in self._cameras:
            camera.close()

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

    def _begin_file(self) -> None:
        """Begin a new file if the present one is large."""
        if self._writer is not None and self._file_bytes > _FILE_MEGABYTES * 2**20:
            self._writer.close()
            self._writer, self._file, self._file_bytes = None, self._file + 1, 0

    def _write(self, columns: Mapping[str, NDArray[Any]], width: int, images: Mapping[str, Iterator[Pixels]]) -> None:
        """Write frames as one row group, and their images."""
        pa = needed_pyarrow()
        from pyarrow import parquet

        arrays = {
            name: pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), pa.float32()), width)
            if name in _VECTORS
            else pa.array(values)
            for name, values in columns.items()
        }
        count = len(columns["index"])
        for camera in self._cameras:
            values = [camera.put(each) for each in islice(images[camera.feature], count)]
            if not camera.is_video:
                arrays[camera.feature] = pa.array(values, pa.struct({"bytes": pa.binary(), "path": pa.string()}))
        table = pa.table(arrays)
        if self._writer is None:
            chunk, file = divmod(self._file, lerobot_images.FILES_IN_CHUNK)
            path = self._folder / "data" / f"chunk-{chunk:03d}" / f"file-{file:03d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = parquet.ParquetWriter(path, table.schema)
        self._writer.write_table(table)
        self._file_bytes += table.nbytes

    def _add_plan(self, episode: ExportedEpisode, frames: Frames, number: int) -> None:
        """Note every node with the frames from its start to its end; of one without an end, to the last frame."""
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
        features |= {each.feature: each.info() for each in self._cameras}
        return {
            "codebase_version": "v3.0",
            "robot_type": frames.robot,
            "total_episodes": len(self._episodes),
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": lerobot_images.FILES_IN_CHUNK,
            "data_files_size_in_mb": _FILE_MEGABYTES,
            "video_files_size_in_mb": lerobot_images.VIDEO_MEGABYTES,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": lerobot_images.VIDEO_PATH if any(each.is_video for each in self._cameras) else None,
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


LEROBOT = Format(
    write_lerobot,
    noun="frame",
    holds="episodes",
    options={"clock": "event", "fps": FPS, "images": None},
    packages=("pyarrow", "av", "pillow"),
    marker="meta/info.json",
)
