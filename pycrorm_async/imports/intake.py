"""An `Intake` takes the episodes of one import: a format gives it what its files hold, and it records or only counts.

Theory of operation. A format reads its files in order and calls the methods of `IntakeEpisode`, which are those of
`RecordedEpisode` with the time of each call. The intake leaves out what would record nothing, such as a pose that has
not changed, before it counts, so the counts of a dry run are those of the import. An episode has the id of its name
(`recording.episode(id=...)`), so an episode that the memory holds already is not recorded again.

Whatever comes from a file is data: names become types and columns only through `Recording.type`, and a file with very
many different names gets few types (`TYPES_MAX`, `FIELDS_MAX`).
"""

from __future__ import annotations

import hashlib
import math
import re
import sqlite3
from collections import Counter, deque
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, Self, TypeAlias, cast, get_args

import msgspec

from pycrorm_async.clock import microseconds_of
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import episode_text, named_episode_id
from pycrorm_async.events.types import EpisodeStatus, FieldDeclared, NodeStatus, ObjectValue, PoseValue, is_missing
from pycrorm_async.progress_bar import ProgressCallback
from pycrorm_async.record.declarations import FieldSpec
from pycrorm_async.record.plan_types import built_in_declaration
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import json_text

TYPES_MAX: Final = 200
"""Bounds the types of nodes that one import declares, because each has a table. Further names share one type."""
FIELDS_MAX: Final = 24
"""Bounds the fields of a type that an import declares, so that a declaration has room for them and for those that a
built-in type has; further parameters are JSON in the field `further`."""
_IDENTITY_BYTES = 2**20
"""The bytes at both ends of a file that identify it, so that a large bag is not read twice."""

_ENDED_MAX = 20
"""Bounds the nodes that can still have observations after their end; the recording knows the last 1,000."""
_WORDS = re.compile(r"[A-Za-z0-9]+")
_NAME_MAX = 50
"""Bounds the characters of the name of a type or a field: PostgreSQL cuts names of tables at 63 bytes."""
_REAL_MAX = 2**53
"""Real numbers have every whole number up to this one, and miss some of the larger ones."""
_WHOLE = range(-(2**63), 2**63)
"""The numbers that a column of integers holds."""
_END_STATUSES = frozenset(get_args(EpisodeStatus)) - {"RUNNING"}

TIMES: Final = range(-(2**63), 2**63)
"""The times that can be recorded, in ns since 1970: from 1677 to 2262."""

DATABASE_ERRORS: Final = (sqlite3.DatabaseError, UnicodeDecodeError)
"""What reading a damaged file of SQLite raises; Python decodes the text of the error."""
JSON_ERRORS: Final = (msgspec.DecodeError, UnicodeDecodeError)
"""What decoding JSON with msgspec raises."""

Numbers: TypeAlias = Sequence[float]
Rate: TypeAlias = Annotated[float, msgspec.Meta(ge=1e-6)]
"""A rate of a map file in Hz."""


class ObjectKey(NamedTuple):
    """A parameter that is an object, by the key with which it was added."""

    key: Hashable


class WrongFormat(CallerError):
    """A file is not of the format that the caller named."""


class MapFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of an import, from its map file. Each format has a subclass with the keys of its own.

    Attributes:
        name: distinguishes imports of the same files: another name makes other episodes.
        description: of the episodes, instead of the one in the file.
        tags: of the episodes.
    """

    name: str = ""
    description: str = ""
    tags: tuple[str, ...] = ()


class ImportFormat(NamedTuple):
    """A format of files that can be imported.

    Attributes:
        read: gives the episodes of a file or folder to the intake. Raises `WrongFormat`; of a file that is cut, it
            gives what stands before.
        describes: the files, in one line.
        map_file: the class of its settings.
    """

    read: Callable[[Path, Any, Intake], None]
    describes: str
    map_file: type[MapFile] = MapFile


@dataclass
class EpisodeReport:
    """An episode of an import.

    Attributes:
        id: made from its name.
        state: `imported`, or `already stored`; of a dry run `would be imported`.
        refusal: why the memory has not recorded all of it: it holds another beginning of this episode.
        nodes, objects: the number of nodes and of objects.
        changes: the number of moves of objects and of joints.
        removals: the number of objects that left the world.
        samples: the number of samples of streams, such as joint states.
        observations: the number of observations.
        statuses: how many nodes ended with each status.
    """

    id: str
    description: str
    state: Literal["imported", "would be imported", "already stored"]
    nodes: int = 0
    objects: int = 0
    changes: int = 0
    removals: int = 0
    samples: int = 0
    observations: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    refusal: str | None = None


@dataclass
class ImportReport:
    """The outcome of an import.

    Attributes:
        left_out: the number of parts of the files that are not recorded, by what they are and the reason.
        cut: the reason why reading a file ended before its end, one line for each file.
    """

    format: str
    episodes: list[EpisodeReport] = field(default_factory=list)
    left_out: Counter[tuple[str, str]] = field(default_factory=Counter)
    cut: list[str] = field(default_factory=list)


class Intake:
    """Takes the episodes of one import.

    Args:
        recording: of the memory; None only counts.
        stored: the ids of the episodes that the memory holds already, for a dry run.
        report_progress: gets what is done and the total, in a unit of the format's choice.
    """

    def __init__(
        self,
        format_name: str,
        settings: MapFile,
        recording: Recording | None = None,
        stored: Container[str] = (),
        report_progress: ProgressCallback | None = None,
    ) -> None:
        self.report: Final = ImportReport(format_name)
        self.settings = settings
        self.recording = recording
        self._stored = stored
        self._report_progress = report_progress
        self._types: dict[str, set[str]] = {}

    def episode(
        self,
        name: str,
        at: int,
        *,
        description: str,
        plan: str | None = None,
        tags: Sequence[str] = (),
        metadata: Mapping[str, Any] = {},
        created_by: str | None = None,
    ) -> IntakeEpisode:
        """Open an episode; use it with `with`.

        Args:
            name: the same for the same content (`identity_of`), so that it is imported once. Without a name it is a
                new episode, which ends LOST if the process dies.
            at: when it began, in ns since 1970.
            metadata: JSON values; the name of the format is added as `import`.
        """
        settings, format_name = self.settings, self.report.format
        at = self.in_range(at)
        full_name = "/".join(filter(None, ("import", format_name, settings.name, name)))
        full_name = full_name.encode(errors="backslashreplace").decode()
        identity, text = episode_text(named_episode_id(full_name)), settings.description or description
        report = EpisodeReport(identity, text, "imported" if self.recording is not None else "would be imported")
        self.report.episodes.append(report)
        recorded = None
        if self.recording is not None:
            recorded = self.recording.episode(
                id=full_name if name else None,
                at=at,
                description=text,
                plan=plan,
                tags=(*settings.tags, *(each for each in tags if each not in settings.tags)),
                metadata={"import": format_name, **metadata},
                created_by=created_by,
            )
            report.id = str(recorded)
        if identity in self._stored or (recorded is not None and recorded.is_recorded):
            report.state = "already stored"
        return IntakeEpisode(self, report, recorded, at)

    def left_out(self, what: str, why: str, count: int = 1) -> None:
        """Count parts of a file that are not recorded."""
        self.report.left_out[what, why] += count

    def in_range(self, at: int) -> int:
        """Return a time that 64 bits hold; of another one, count it and return the nearest."""
        if at in TIMES:
            return at
        self.left_out("times", "they are before 1677 or after 2262; the nearest moment takes their place")
        return max(TIMES.start, min(at, TIMES.stop - 1))

    def cut(self, path: Path, reason: str) -> None:
        """Note that the rest of a file cannot be read."""
        self.report.cut.append(f"{path} {reason}")

    def progress(self, done: int, total: int) -> None:
        """Report the progress of reading."""
        if self._report_progress is not None:
            self._report_progress(done, total)

    def typed(self, dtype: str, parameters: Mapping[str, Any]) -> tuple[str, dict[str, FieldSpec], dict[str, Any]]:
        """Return the dtype, the fields and the parameters of a node, as the types of this import allow them.

        A name with other signs than ASCII letters, digits and `_` becomes one of these, and the first parameter.
        """
        if (name_of_type := _name_of(dtype, "Step")) != dtype:
            dtype, parameters = name_of_type, {"name": dtype, **parameters}
        if dtype not in self._types and len(self._types) >= TYPES_MAX:
            self.left_out("types", f"a file has at most {TYPES_MAX} of its own; these nodes are of the type Step")
            dtype, parameters = "Step", {"name": dtype, **parameters}
        declared = self._types.setdefault(dtype, set())
        built_in = built_in_declaration(dtype)
        known = {each.name: each for each in built_in.fields} if built_in is not None else {}
        fields: dict[str, FieldSpec] = {}
        values: dict[str, Any] = {}
        further: dict[str, Any] = {}
        for given, value in parameters.items():
            if value is None:
                continue
            if is_missing(value):
                self.left_out("values", "the memory that wrote the file could not record them")
                continue
            name = _name_of(given, "value")
            if name in values or (name not in declared and len(declared) >= FIELDS_MAX):
                further[given] = value
                continue
            declared.add(name)
            fields[name], values[name] = _recorded(value, known.get(name))
        if further:
            fields["further"], values["further"] = "text", json_text(further)
        return dtype, fields, values


class IntakeEpisode:
    """An episode of an import. Times are in ns since 1970; one before that of the call before is recorded as it is.

    Attributes:
        is_stored: whether the memory holds the episode already, so that its calls record nothing.
    """

    def __init__(self, intake: Intake, report: EpisodeReport, recorded: RecordedEpisode | None, at: int) -> None:
        self.is_stored: Final = report.state == "already stored"
        self._intake = intake
        self._report = report
        self._recorded = recorded
        self._last = at
        self._open: dict[Hashable, None] = {}
        self._ended: deque[Hashable] = deque(maxlen=_ENDED_MAX)
        self._poses: dict[Hashable, tuple[float, ...]] = {}
        self._joints: dict[Hashable, dict[str, float]] = {}
        self._status: EpisodeStatus = "UNKNOWN"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """End the episode and what is open in it; if reading failed, leave it open, so that it can be continued."""
        if error is None:
            self._end_all()

    def start(
        self,
        key: Hashable,
        kind: Literal["action", "motion", "language"],
        dtype: str,
        parameters: Mapping[str, Any],
        at: int,
        *,
        parent: Hashable | None = None,
        robot: Hashable | None = None,
    ) -> None:
        """Record that a node started. Its fields have the types of the values: texts, numbers, booleans, poses."""
        at = self._timed(at)
        if self.is_stored:
            return
        self._report.nodes += 1
        self._open[key] = None
        dtype, fields, values = self._intake.typed(dtype, parameters)
        if self._recorded is not None and self._intake.recording is not None:
            declared = self._intake.recording.type(kind, dtype, fields)
            self._recorded.start(key, declared, values, parent=parent, robot=robot, at=at)

    def end(
        self,
        key: Hashable,
        status: NodeStatus,
        at: int,
        *,
        failure: tuple[str, str] | str | None = None,
        result: Any = None,
        untimed: bool = False,
    ) -> None:
        """Record that a node ended, `untimed` if it is not known when; nothing if it is not open."""
        at = self._timed(at)
        if key not in self._open:
            return
        del self._open[key]
        self._ended.append(key)
        self._report.statuses[status] += 1
        if self._recorded is not None:
            self._recorded.end(key, status, failure, result, at=at, untimed=untimed)

    def is_open(self, key: Hashable) -> bool:
        """Return whether a node with this key has started and not ended."""
        return key in self._open

    def object_added(
        self,
        key: Hashable,
        name: str,
        object_type: str,
        pose: PoseValue,
        at: int,
        *,
        joints: Mapping[str, float] = {},
        urdf: str | None = None,
    ) -> None:
        """Record that an object is in the world from now on."""
        at = self._timed(at)
        if self.is_stored:
            return
        self._report.objects += 1
        self._poses[key] = (*pose.position, *pose.orientation)
        self._joints[key] = dict(joints)
        if self._recorded is not None:
            self._recorded.object_added(key, name, object_type, pose, joints, urdf=urdf, at=at)

    def has_object(self, key: Hashable) -> bool:
        """Return whether an object of this key was added."""
        return key in self._poses

    def object_moved(self, key: Hashable, pose: PoseValue, at: int) -> None:
        """Record the pose of an object that was added, unless it is the same as before."""
        at = self._timed(at)
        numbers = (*pose.position, *pose.orientation)
        if self.is_stored or self._poses.get(key, numbers) == numbers:
            return
        self._poses[key] = numbers
        self._report.changes += 1
        if self._recorded is not None:
            self._recorded.object_moved(key, pose, at=at)

    def object_removed(self, key: Hashable, at: int) -> None:
        """Record that an object left the world; nothing if it is not there."""
        at = self._timed(at)
        if self._poses.pop(key, None) is None:
            return
        del self._joints[key]
        self._report.removals += 1
        if self._recorded is not None:
            self._recorded.object_removed(key, at=at)

    def joints_moved(self, key: Hashable, joints: Mapping[str, float], at: int) -> None:
        """Record the positions of joints (rad or m) that have changed and are finite."""
        at = self._timed(at)
        before = self._joints.get(key)
        if self.is_stored or before is None:
            return
        changed = {name: each for name, each in joints.items() if before.get(name) != each and math.isfinite(each)}
        if not changed:
            return
        before.update(changed)
        self._report.changes += 1
        if self._recorded is not None:
            self._recorded.joints_moved(key, changed, at=at)

    def sampled(self, stream: str, channels: Sequence[str], values: Any, at: Sequence[int]) -> None:
        """Record samples of a stream: a row of numbers, one for each channel, for each time."""
        if len(at) == 0:
            return
        self._timed(int(max(at)))
        if self.is_stored:
            return
        self._report.samples += len(at)
        if self._recorded is not None:
            self._recorded.sampled(stream, channels, values, at)

    def observe(self, name: str, values: object, at: int, *, node: Hashable | None = None) -> None:
        """Record an observation, of the node if that is open or ended a short time ago, else of the episode."""
        at = self._timed(at)
        if self.is_stored:
            return
        self._report.observations += 1
        if self._recorded is not None:
            known = node if node in self._open or node in self._ended else None
            self._recorded.observe(name, values, node=known, at=at)

    def ended(self, status: object, at: int | None = None) -> None:
        """Set how the episode ended, and when, if that is after its last event; by default UNKNOWN."""
        is_known = isinstance(status, str) and status in _END_STATUSES
        self._status = cast("EpisodeStatus", status) if is_known else "UNKNOWN"
        self._timed(at or 0)

    def _timed(self, at: int) -> int:
        """Return a time as it can be recorded, and note that the episode lasts until then."""
        at = self._intake.in_range(at)
        self._last = max(self._last, at)
        return at

    def _end_all(self) -> None:
        """End the nodes that never ended, the innermost first, and the episode."""
        for key in reversed(list(self._open)):
            self.end(key, "UNKNOWN", self._last, untimed=True)
        if self._recorded is not None:
            self._recorded.close(status=self._status, at=self._last)
            self._report.refusal = self._recorded.refusal


def _name_of(text: str, otherwise: str) -> str:
    """Return the name of a type or a field that is most like a text of a file."""
    name = "_".join(_WORDS.findall(text))[:_NAME_MAX].strip("_")
    return name if name and not name[0].isdigit() else "_".join(filter(None, (otherwise, name)))


def _recorded(value: Any, known: FieldDeclared | None) -> tuple[FieldSpec, Any]:
    """Return the type of the field of a value from a file, and the value to record.

    `known` is the field of the built-in type, whose type is taken if the value fits.
    """
    match value:
        case str() if known is not None and known.type in ("enum", "text"):
            return known.type, value
        case int() if known is not None and known.type == "integer" and not isinstance(value, bool):
            return "integer", value
        case bool():
            return "boolean", value
        case int() | float():
            kind = _number_type([value])
            return kind, value if kind != "text" else str(value)
        case str():
            return "text", value
        case ObjectKey():
            return "object", value.key
        case ObjectValue():
            return "object", value
        case PoseValue():
            return "pose", value
        case {"position": _, "orientation": _} if (pose := pose_in(value)) is not None:
            return "pose", pose
        case list() | tuple() if (item := _item_type(value)) is not None:
            return ("list", item), list(value)
        case dict() if (item := _item_type(value.values())) is not None:
            return ("dict", item), value
    return "text", json_text(value)


def _item_type(values: Iterable[Any]) -> Literal["real", "integer", "text"] | None:
    """Return the type of the items of a list or dict; None if it is empty, or they are of several types."""
    items = list(values)
    types = {type(each) for each in items}
    if types and types <= {int, float}:
        kind = _number_type(items)
        return kind if kind != "text" else None
    return "text" if types == {str} else None


def _number_type(numbers: Iterable[int | float]) -> Literal["real", "integer", "text"]:
    """Return the type in which none of these numbers loses a digit."""
    if all(isinstance(each, float) or abs(each) <= _REAL_MAX for each in numbers):
        return "real"
    return "integer" if all(isinstance(each, int) and each in _WHOLE for each in numbers) else "text"


def pose_in(value: Any) -> PoseValue | None:
    """Return the pose that a dict of position, orientation (xyzw) and frame describes; None for another value."""
    match value:
        case {"position": [_, _, _] as position, "orientation": [_, _, _, _] as orientation, **rest} if (
            _item_type([*position, *orientation]) == "real"
        ):
            return pose_at(position, orientation, 0, str(rest.get("frame", "map")))
    return None


def pose_at(position: Numbers, orientation: Numbers, at: int, frame: str = "map") -> PoseValue:
    """Return a pose from a position (m) and a quaternion xyzw; `at` is its time in ns since 1970."""
    x, y, z = map(float, position)
    qx, qy, qz, qw = map(float, orientation)
    return PoseValue((x, y, z), (qx, qy, qz, qw), frame, at)


def tags_in(given: Any) -> list[str]:
    """Return the texts of a list as tags, at most 100 characters of each; none for another value."""
    return [each[:100] for each in given if isinstance(each, str) and each.strip()] if isinstance(given, list) else []


def ns_of(moment: datetime) -> int:
    """Return a time of a map file; one without a zone is in UTC. Raises `CallerError`."""
    aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    if (at := microseconds_of(aware) * 1000) not in TIMES:
        raise CallerError(f"the time {moment} of the map file must be after 1677 and before 2262")
    return at


@contextmanager
def opened_database(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a file of SQLite to read it. Texts in another encoding than UTF-8 have `�` for what that does not have."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
        database.text_factory = partial(str, encoding="utf-8", errors="replace")
        yield database


def identity_of(path: Path, *further: Path) -> str:
    """Return what identifies files by their content: a digest of their sizes and of the bytes at both ends of each."""
    digest = hashlib.sha256()
    for each in (path, *further):
        size = each.stat().st_size
        digest.update(size.to_bytes(8))
        with each.open("rb") as file:
            digest.update(file.read(_IDENTITY_BYTES))
            file.seek(max(_IDENTITY_BYTES, size - _IDENTITY_BYTES))
            digest.update(file.read(_IDENTITY_BYTES))
    return digest.hexdigest()[:32]
