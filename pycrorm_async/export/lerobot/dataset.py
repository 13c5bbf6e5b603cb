"""Write the files of a LeRobot data set: `meta/` and `data/`, in version 3.0, with pyarrow alone.

Each frame has `observation.state` and `action`, the state of the next frame (the last one repeats its own), the event
and the time behind it, and the subtask. `meta/plan.parquet` is ours: every node of the plans, with its first and last
frame. LeRobot ignores it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.export.lerobot.states import Frames
from pycrorm_async.export.lerobot.statistics import Statistics, joined, statistics_of, statistics_of_images
from pycrorm_async.export.recorded_episode import RecordedEpisode
from pycrorm_async.query.frames.arrow_batches import needed_pyarrow
from pycrorm_async.query.scene.picture import png

MARKER = "meta/info.json"
DEFAULT_FPS = 10
"""Frames per second; nominal if there is one frame for each event, because LeRobot requires a value."""
_CHUNK_FILES = 1000
"""Bounds the files of one folder (`chunk`), the default of LeRobot."""
_FILE_MEGABYTES = 100
"""The size in MiB above which the next episode begins a new file, the default of LeRobot."""
_VECTORS = ("observation.state", "action")
_PICTURE = "observation.images.scene"
_NUMBERS = {
    "timestamp": "float32",
    "time_s": "float64",
    "event": "int64",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
    "subtask_index": "int64",
}
"""The columns of one number; the first and those from `frame_index` to `task_index` are LeRobot's own."""


class LeRobotFolder:
    """Writes a data set into an empty folder: `add` for each episode, then `finish`."""

    def __init__(self, folder: Path, *, fps: int) -> None:
        needed_pyarrow()
        self._folder = folder
        self._fps = fps
        self._first: tuple[int, Frames] | None = None
        self._frames = 0
        self._tasks: dict[str, int] = {}
        self._subtasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._statistics: list[dict[str, Statistics]] = []
        self._plan: list[dict[str, Any]] = []
        self._file = 0
        self._file_bytes = 0
        self._picture_shape: tuple[int, ...] = ()
        self._writer: Any = None

    @property
    def frames(self) -> int:
        """The number of frames added so far."""
        return self._frames

    def add(self, episode: RecordedEpisode, frames: Frames, pictures: NDArray[np.uint8] | None = None) -> None:
        """Write the frames of an episode, with their pictures; either all episodes have pictures or none has.

        Raises `CallerError` if its robot has other joints than that of the first.
        """
        self._check_channels(episode, frames)
        number, count = len(self._episodes), len(frames.at)
        task = episode.description or f"episode {episode.number}"
        columns = self._columns(frames, number, task)
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
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + count,
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
        self._frames += count

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

    def _check_channels(self, episode: RecordedEpisode, frames: Frames) -> None:
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
            "index": index + self._frames,
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
            encoded = [{"bytes": png(each), "path": None} for each in pictures]
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

    def _add_plan(self, episode: RecordedEpisode, frames: Frames, number: int) -> None:
        """Note every node with the frames from its start to its end; `to_index` is behind the last one."""
        sequences = np.array([each.sequence for each in frames.at])
        for node in episode.nodes:
            begin = int(np.searchsorted(sequences, node.sequence, side="left"))
            end = len(sequences)
            if node.end is not None:
                end = int(np.searchsorted(sequences, node.end.sequence, side="left"))
            self._plan.append(
                {
                    "episode_index": number,
                    "node": node.sequence,
                    "parent": node.parent,
                    "kind": node.kind,
                    "dtype": node.dtype,
                    "label": node.label,
                    "parameters": node.parameters,
                    "status": node.status,
                    "reason": node.reason,
                    "message": node.message,
                    "dataset_from_index": self._frames + begin,
                    "dataset_to_index": self._frames + end,
                }
            )

    def _info(self, frames: Frames) -> dict[str, Any]:
        vector = {"dtype": "float32", "shape": [len(frames.channels)], "names": list(frames.channels)}
        features: dict[str, Any] = dict.fromkeys(_VECTORS, vector)
        features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in _NUMBERS.items()}
        if self._picture_shape:
            names = ["height", "width", "channels"]
            features[_PICTURE] = {"dtype": "image", "shape": list(self._picture_shape), "names": names}
        return {
            "codebase_version": "v3.0",
            "robot_type": frames.robot,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
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
