"""Import LeRobot data sets of the versions 2.0, 2.1 and 3.0: a folder with `meta/info.json` and `data/`.

An episode of the set is an episode. Its task is the description; a span of frames with one subtask is a node below the
root. States and actions are samples, named as the features: `observation.state`, `action`. How it ended is that of the
column `next.success`, or of `success` of the episode; without one it is UNKNOWN. A data set has no dates: its episodes
begin on 1970-01-01, one behind the other, unless `start` of the map file says when the first one began.

Of a data set that `pycrorm export` wrote, `meta/plan.parquet` has the nodes, with their parents and statuses. Images
and videos are left out.

Only the rows of one episode are in memory at a time. Source: the description of the format in LeRobot's documentation.
"""

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from pycrorm_async.errors import CallerError
from pycrorm_async.imports import intake as intakes
from pycrorm_async.imports.intake import Intake, IntakeEpisode
from pycrorm_async.imports.spans import NodeSpan, failure_in, give_spans, status_in
from pycrorm_async.query.frames import needed_pyarrow

_SECOND_NS = 10**9
_INDEX = frozenset(
    {"timestamp", "frame_index", "episode_index", "index", "task_index", "subtask_index", "time_s", "event"}
)
"""Columns that place a frame, and are no samples."""
_SUCCESS = ("next.success", "success")
_VIDEOS = ("video", "image")
_PLAN_COLUMNS = frozenset(
    "episode_index node parent kind dtype parameters status reason message dataset_from_index dataset_to_index".split()
)
_FPS_MIN, _FPS_MAX = 1e-3, 1e6
_LENGTH_MAX = 2**53
_TRAVERSAL = re.compile(r"{[^}:]*[.\[]")
"""Finds an attribute or an item in a template, which those of LeRobot do not have."""
_BATCH = 10_000
"""Bounds the rows that are read at once."""


class LeRobotMap(intakes.MapFile, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of an import of LeRobot data sets.

    Attributes:
        start: when the first episode began.
        pause_s: the time between the end of an episode and the start of the next one.
        subtask: the type of the nodes of subtasks.
    """

    start: datetime | None = None
    pause_s: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 60.0
    subtask: str = "Subtask"


class _Info(msgspec.Struct):
    """What is needed of `meta/info.json`."""

    codebase_version: str
    fps: float
    features: dict[str, dict[str, Any]]
    data_path: str
    robot_type: str | None = None
    chunks_size: Annotated[int, msgspec.Meta(gt=0)] = 1000


class _Row(NamedTuple):
    """An episode of the set."""

    number: int
    tasks: list[str]
    length: int
    file: Path
    success: bool | None


def read_lerobot(path: Path, settings: LeRobotMap, intake: Intake) -> None:
    """Give the episodes of a data set to the intake. Raises `WrongFormat` and `MissingExtra`."""
    needed_pyarrow()
    dataset = _DataSet(path)
    for name, feature in dataset.info.features.items():
        if feature.get("dtype") in _VIDEOS:
            intake.left_out(f"the feature {name}", "images and videos are not imported")
    begin = 0 if settings.start is None else intakes.ns_of(settings.start)
    if settings.start is None:
        intake.left_out("the dates", "a LeRobot data set has none: give `start` in the map file")
    rows = list(dataset.episodes())
    for row in rows:
        intake.progress(row.number, len(rows))
        end = begin + round(row.length / dataset.info.fps * _SECOND_NS)
        if end not in intakes.TIMES:
            raise CallerError(f"episode {row.number} would end after 2262: `start` or `pause_s` is too large")
        try:
            _give(dataset, row, begin, end, settings, intake)
        except _Unreadable as error:
            intake.cut(row.file, f"cannot be read, so episode {row.number} is left out: {error}")
        begin = end + round(settings.pause_s * _SECOND_NS)


FORMAT = intakes.ImportFormat(read_lerobot, "LeRobot data sets of the versions 2.0 to 3.0", LeRobotMap)


class _Unreadable(Exception):
    """A file of a data set is damaged or missing."""


class _DataSet:
    """The files of a data set. Raises `WrongFormat` where they are not those of one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        file = path / "meta" / "info.json"
        try:
            content = file.read_bytes()
            self.info = msgspec.json.decode(content, type=_Info)
        except OSError:
            raise intakes.WrongFormat(f"{path} is no LeRobot data set: it has no meta/info.json") from None
        except intakes.JSON_ERRORS as error:
            raise intakes.WrongFormat(f"{file} is not that of a LeRobot data set: {error}") from None
        if not _FPS_MIN <= self.info.fps < _FPS_MAX or _TRAVERSAL.search(self.info.data_path):
            raise intakes.WrongFormat(f"{file} is not that of a LeRobot data set: its fps or its data_path cannot be")
        self.is_v3 = self.info.codebase_version.startswith("v3")
        if not self.is_v3 and self.info.codebase_version not in ("v2.0", "v2.1"):
            version = self.info.codebase_version
            raise intakes.WrongFormat(f"{path} has the version {version:.20}, and 2.0, 2.1 and 3.0 can be read")
        self.identity = hashlib.sha256(content)
        self.plan = self._plan()
        self.subtasks = self._subtask_names()

    def episodes(self) -> Iterator[_Row]:
        """Yield the episodes in their order."""
        for raw in self._raw_episodes():
            try:
                index, length = int(raw["episode_index"]), int(raw["length"])
                places = {
                    "episode_index": index,
                    "episode_chunk": index // self.info.chunks_size,
                    "chunk_index": raw.get("data/chunk_index", 0),
                    "file_index": raw.get("data/file_index", 0),
                }
                file = self.path / self.info.data_path.format(**places)
                tasks = [str(each) for each in raw.get("tasks") or ()]
                if length > _LENGTH_MAX:
                    raise ValueError(f"an episode of {length:.0e} frames")  # noqa: TRY301
                is_inside = self.path.resolve() in file.resolve().parents
            except (LookupError, TypeError, ValueError, AttributeError, MemoryError, ArithmeticError) as error:
                raise intakes.WrongFormat(f"{self.path} describes its episodes otherwise: {error!r:.200}") from None
            if not is_inside:
                raise intakes.WrongFormat(f"{self.path} names data outside of its folder")
            success = raw.get("success")
            yield _Row(index, tasks, length, file, success)

    def rows(self, row: _Row) -> dict[str, np.ndarray[Any, Any]]:
        """Return the columns of an episode, in the order of its frames. Raises `_Unreadable`."""
        pa = needed_pyarrow()
        from pyarrow import parquet

        wanted = [name for name, each in self.info.features.items() if each.get("dtype") not in _VIDEOS]
        try:
            filters = [("episode_index", "=", row.number)]
            present = set(parquet.read_schema(row.file).names)
            table = parquet.read_table(row.file, columns=[each for each in wanted if each in present], filters=filters)
        except (OSError, pa.ArrowException, KeyError, UnicodeDecodeError) as error:
            raise _Unreadable(str(error).splitlines()[0] if str(error) else type(error).__name__) from None
        return {name: _array(table.column(name)) for name in table.column_names}

    def _raw_episodes(self) -> Iterator[Mapping[str, Any]]:
        meta = self.path / "meta"
        if not self.is_v3:
            yield from _lines(meta / "episodes.jsonl")
            return
        files = sorted((meta / "episodes").rglob("*.parquet"))
        if not files:
            raise intakes.WrongFormat(f"{self.path} has no meta/episodes")
        columns = ["episode_index", "tasks", "length", "data/chunk_index", "data/file_index", "success"]
        for file in files:
            yield from self._parquet(file, columns)

    def _plan(self) -> dict[int, list[Mapping[str, Any]]]:
        """Return the nodes of each episode, of an export of ours."""
        file = self.path / "meta" / "plan.parquet"
        nodes: dict[int, list[Mapping[str, Any]]] = {}
        for each in self._parquet(file, None) if file.exists() else ():
            if not each.keys() >= _PLAN_COLUMNS:  # a file of this name of another program
                return {}
            nodes.setdefault(int(each["episode_index"]), []).append(each)
        return nodes

    def _subtask_names(self) -> dict[int, str]:
        lines, table = self.path / "meta" / "subtasks.jsonl", self.path / "meta" / "subtasks.parquet"
        names = {}
        for each in self._parquet(table, None) if table.exists() else _lines(lines) if lines.exists() else ():
            index = each.get("subtask_index")
            if isinstance(index, int):
                names[index] = next((value for value in each.values() if isinstance(value, str)), str(index))
        return names

    def _parquet(self, file: Path, columns: Sequence[str] | None) -> Iterator[Mapping[str, Any]]:
        pa = needed_pyarrow()
        from pyarrow import parquet

        try:
            opened = parquet.ParquetFile(file)
            present = [each for each in columns if each in opened.schema_arrow.names] if columns is not None else None
            for batch in opened.iter_batches(_BATCH, columns=present):
                yield from batch.to_pylist()
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            raise intakes.WrongFormat(f"{file} cannot be read: {str(error).splitlines()[0]}") from None


def _lines(file: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the objects of a file of JSON lines."""
    try:
        for line in file.read_bytes().splitlines():
            if line.strip():
                yield msgspec.json.decode(line, type=dict[str, Any])
    except OSError:
        raise intakes.WrongFormat(f"{file.parent.parent} has no meta/{file.name}") from None
    except intakes.JSON_ERRORS as error:
        raise intakes.WrongFormat(f"{file} has a line that is no JSON object: {error}") from None


def _array(column: Any) -> np.ndarray[Any, Any]:
    """Return a column as an array: a row of numbers for each frame where it has lists of one length."""
    values = column.to_pylist()
    try:
        return np.array(values)
    except ValueError:  # lists of different lengths
        return np.array(values, dtype=object)


# === episodes =================================================================================================


def _give(dataset: _DataSet, row: _Row, begin: int, end: int, settings: LeRobotMap, intake: Intake) -> None:
    digest = dataset.identity.copy()
    columns = dataset.rows(row)
    frames = len(next(iter(columns.values()), ()))
    if frames != row.length:
        reason = f"the file has {frames:,} of its {row.length:,} frames"
        raise _Unreadable(reason)
    for values in columns.values():
        digest.update(values.tobytes() if values.dtype != object else repr(values.tolist()).encode())
    at = begin + np.round(_seconds(columns, dataset.info.fps) * _SECOND_NS).astype(np.int64)
    name = f"{digest.hexdigest()[:32]}-{row.number}"
    metadata = {"dataset": dataset.path.resolve().name, "episode_index": row.number, "robot": dataset.info.robot_type}
    description = "; ".join(row.tasks) or f"{dataset.path.resolve().name} episode {row.number}"
    with intake.episode(name, begin, description=description, metadata=metadata) as episode:
        nodes = dataset.plan.get(row.number)
        spans = _plan_spans(nodes, at, end) if nodes else _subtask_spans(dataset, columns, at, end, settings)
        give_spans(episode, spans)
        _sample(dataset, columns, at, episode, intake)  # behind the nodes, whose times must not go back
        episode.ended(_status(row, columns, nodes), end)


def _seconds(columns: Mapping[str, np.ndarray[Any, Any]], fps: float) -> np.ndarray[Any, Any]:
    """Return the time of each frame since the first one."""
    seconds = columns.get("time_s", columns.get("timestamp"))
    if seconds is None or seconds.dtype.kind != "f" or not np.isfinite(seconds).all():
        return np.arange(len(next(iter(columns.values())))) / fps
    since: np.ndarray[Any, Any] = np.round((seconds - seconds[0]).astype(np.float64), 6)  # of single precision
    return since


def _sample(
    dataset: _DataSet,
    columns: Mapping[str, np.ndarray[Any, Any]],
    at: np.ndarray[Any, Any],
    episode: IntakeEpisode,
    intake: Intake,
) -> None:
    for name, values in columns.items():
        if name in _INDEX:
            continue
        if values.dtype.kind not in "fiub" or values.ndim > 2:
            intake.left_out(f"the feature {name}", "it has other values than numbers")
            continue
        numbers = values.reshape(len(values), -1)
        names = dataset.info.features[name].get("names")
        while isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}, as version 2 has them
            names = next(iter(names.values()))
        if not isinstance(names, list) or len(names) != numbers.shape[1]:
            names = range(numbers.shape[1])
        episode.sampled(name, [str(each) for each in names], numbers, at.tolist())


def _subtask_spans(
    dataset: _DataSet,
    columns: Mapping[str, np.ndarray[Any, Any]],
    at: np.ndarray[Any, Any],
    end: int,
    settings: LeRobotMap,
) -> list[NodeSpan]:
    """Return a node for each run of frames with one subtask."""
    indices = columns.get("subtask_index")
    if indices is None or not len(indices):
        return []
    borders = [0, *(np.flatnonzero(np.diff(indices.ravel())) + 1).tolist(), len(indices)]
    spans = []
    for number, (first, behind) in enumerate(pairwise(borders)):
        stop = int(at[behind]) if behind < len(at) else end
        name = dataset.subtasks.get(int(indices.ravel()[first]), str(indices.ravel()[first]))
        spans.append(NodeSpan(number, settings.subtask, {"name": name}, int(at[first]), stop))
    return spans


def _plan_spans(nodes: Sequence[Mapping[str, Any]], at: np.ndarray[Any, Any], end: int) -> list[NodeSpan]:
    """Return the nodes of an export of ours; each starts and ends with a frame."""
    first = min(int(each["dataset_from_index"]) for each in nodes)

    def time_of(index: Any) -> int:
        frame = int(index) - first
        return int(at[frame]) if 0 <= frame < len(at) else end

    spans = []
    for each in nodes:
        if each["kind"] == "root":
            continue
        begin = time_of(each["dataset_from_index"])
        spans.append(
            NodeSpan(
                each["node"],
                str(each["dtype"]),
                {"parameters": each["parameters"]} if each.get("parameters") else {},
                begin,
                max(begin, time_of(each["dataset_to_index"])),
                parent=each["parent"],
                kind=each["kind"],
                status=status_in(each["status"]),
                failure=failure_in([each["reason"], each["message"] or ""]) if each["reason"] else None,
            )
        )
    return spans


def _status(row: _Row, columns: Mapping[str, np.ndarray[Any, Any]], nodes: Sequence[Mapping[str, Any]] | None) -> str:
    """Return how an episode ended: by the plan, the last frame, or its row."""
    root = next((each for each in nodes or () if each["kind"] == "root"), None)
    if root is not None:
        return str(root["status"])
    column = next((columns[each] for each in _SUCCESS if each in columns), None)
    success = row.success if column is None or not len(column) else bool(np.asarray(column[-1]).ravel()[-1])
    return "UNKNOWN" if success is None else "SUCCEEDED" if success else "FAILED"
