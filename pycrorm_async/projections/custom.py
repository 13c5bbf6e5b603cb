"""Fold the log into tables of the user's own.

**Discovery.** Discover custom projections: those given by the caller, those installed as entry points, and those of
this package.

A package declares a projection in its `pyproject.toml`:

    [project.entry-points."pycrorm.projections"]
    grasp_rate = "lab.projections:GraspRate"

**Projection.** Define custom projections: tables that a pure fold makes from the log, kept live, rebuilt and verified
like built-in ones.

>>> class GraspRate(Projection):
...     name, version = "grasp_rate", 1
...     tables = {"grasp_try": {"arm": "text", "grasp": "text", "status": "text"}}
...
...     def fold(self, event, rows):
...         match event.happening:
...             case NodeStarted(parameters=values) if event.dtype == "PickUpAction":
...                 rows.insert("grasp_try", event.id, arm=values["arm"], grasp=values["grasp"], status="RUNNING")
...             case NodeEnded(node=node, status=status):
...                 rows.update("grasp_try", event.row(node), status=status)
"""

from __future__ import annotations

import importlib
import logging
import re
import sys
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NamedTuple, TypeAlias, final, get_args

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import unwritable
from pycrorm_async.events.fields import is_reserved
from pycrorm_async.events.ids import row_key
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    EpisodeEnded,
    Happening,
    NodeEnded,
    NodeStarted,
    is_missing,
)
from pycrorm_async.projections.columns import OWN, Storage, column_type, physical_name
from pycrorm_async.projections.fold import Batch, decode_events, stored_rows
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.named_values import NamedValues
from pycrorm_async.projections.row_batch import CannotFold, Row, in_slot, json_text, microseconds, row_of
from pycrorm_async.store.dialect import Insertion
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent, consecutive

if TYPE_CHECKING:
    from pycrorm_async.projections.findings import TableCheck, VerifyResult


# === discovery ================================================================================================

GROUP = "pycrorm.projections"
_OF_THIS_PACKAGE = ("pycrorm_async.recall.cases:CaseProjection",)
"""The projections of every memory. They are loaded by name, because their folders are above this one."""

_log = logging.getLogger("pycrorm_async.projections")


def validate_projections(projections: Sequence[Projection]) -> tuple[Projection, ...]:
    """Validate projections and return them. Raises `CallerError` for an invalid one, and for two of one name."""
    names: set[str] = set()
    for each in projections:
        if not isinstance(each, Projection):
            raise CallerError(f"{each!r} is not a projection: pass an instance of a class that derives from Projection")
        columns_of(each)
        if each.name in names:
            raise CallerError(f"two projections have the name {each.name!r}: rename one")
        names.add(each.name)
    return tuple(projections)


def load_projections(references: Sequence[str]) -> tuple[Projection, ...]:
    """Import projections by `module:Class`, also from the working directory. Raises `CallerError`."""
    if references and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    return validate_projections([_load_projection(each) for each in references])


def _load_projection(reference: str) -> Projection:
    module_name, _, class_name = reference.partition(":")
    if not module_name or not class_name:
        raise CallerError(f"{reference!r} does not name a projection: write module:Class")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise CallerError(f"{module_name} cannot be imported: {type(error).__name__}: {error}") from error
    if not hasattr(module, class_name):
        raise CallerError(f"{module_name} has no {class_name!r}")
    return _instance(getattr(module, class_name), reference)


def _instance(kind: Any, reference: str) -> Projection:
    """Create and validate an instance of this class. Raises `CallerError`."""
    if not isinstance(kind, type) or not issubclass(kind, Projection):
        raise CallerError(f"{reference} is not a projection: derive from pycrorm_async.Projection")
    try:
        projection = kind()
    except Exception as error:
        raise CallerError(f"{reference} cannot be instantiated: {type(error).__name__}: {error}") from error
    columns_of(projection)
    return projection


def installed_projections(projections: Sequence[Projection], *, own: bool = True) -> tuple[Projection, ...]:
    """Return the installed projections whose names these do not have, with those of this package if `own` is true.

    A faulty one is logged and left out. A package that is installed while the process runs is not found.
    """
    names = {each.name for each in projections}
    installed = [each for each in own_projections() if own and each.name not in names]
    names.update(each.name for each in installed)
    for entry in _entries():
        try:
            projection = _instance(entry.load(), entry.value)
        except Exception as error:  # noqa: BLE001 - a fault in one package must not disable the others
            reason = error if isinstance(error, CallerError) else f"{type(error).__name__}: {error}"
            _log.warning("the projection %s of an installed package is left out: %s", entry.name, reason)
            continue
        if projection.name not in names:
            names.add(projection.name)
            installed.append(projection)
    return tuple(installed)


@cache
def own_projections() -> tuple[Projection, ...]:
    """Return the projections of this package, which every memory has."""
    return tuple(map(_load_projection, _OF_THIS_PACKAGE))


@cache
def _entries() -> tuple[EntryPoint, ...]:
    """Return the entry points. Each memory that is opened needs them; those of a hundred packages take 3 ms to read."""
    return tuple(sorted(entry_points(group=GROUP), key=lambda each: (each.name, each.value)))


# === projection ===============================================================================================

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
Column: TypeAlias = Literal["row", "integer", "real", "text", "boolean", "time", "json"]
"""The storage of a column: the id of a row, a scalar, µs since 1970, JSON."""
OF_EVERY_TABLE: dict[str, Storage] = {"id": "key", "process_metadata_id": "row"}


class Event(NamedTuple):
    """One event of the log, as a fold receives it.

    Attributes:
        number: of its episode, in this database.
        sequence: of the event in its episode.
        time: µs since 1970.
        monotonic_ns: reading of the monotonic clock.
        happening: the payload, one of `pycrorm_async.events.types`.
        dtype: of a NodeStarted, its designator's type; None for others.
        parameters: of a NodeStarted, by field, as `NodeStarted.parameters`; None for one that could not be recorded.
        declaration: of a NodeStarted, that of its designator's type; None for others.
    """

    number: int
    sequence: int
    time: int
    monotonic_ns: int
    happening: Happening
    dtype: str | None
    parameters: Mapping[str, Any]
    declaration: DesignatorTypeDeclared | None = None

    @property
    def id(self) -> int:
        """The id of this event's row, in any table: for a NodeStarted that of its node and designator."""
        return row_of(self.number, self.sequence)

    def row(self, sequence: int, slot: int = 0) -> int:
        """Return the id of a row of another event in the same episode; each event may have 32, by slot."""
        return in_slot(row_of(self.number, sequence), slot)


Changed: TypeAlias = list[tuple[bool, str, int, dict[str, Any]]]
"""Changes of rows: whether one is inserted, table, id, columns."""


class Changes:
    """The row changes of one event. An event may change rows of its own episode only."""

    def __init__(self) -> None:
        self.all: Changed = []

    def insert(self, table: str, id: int, /, **columns: Any) -> None:  # noqa: A002
        """Insert a new row; omitted columns are null."""
        self.all.append((True, table, id, columns))

    def update(self, table: str, id: int, /, **columns: Any) -> None:  # noqa: A002
        """Set columns of a row; no effect if no row has this id."""
        self.all.append((False, table, id, columns))


class Projection(ABC):
    """The base class of custom projections: subclasses define tables and a fold.

    Attributes:
        name: in the database: lower-case letters, digits and underscores.
        version: of the fold. After a change of it, `pycrorm rebuild NAME` rebuilds the tables.
        tables: columns and their storage (`row` for the id of one, `integer`, `real`, `text`, `boolean`, `time` in µs
            since 1970, `json`). Every table also has `id`, and `process_metadata_id` for its episode.
        views: named queries over these tables, created beside them.
        reads: the types of events that the fold gets. Events of other types cost it nothing; None: all types.
        is_packed: whether it is a `PackedProjection`, whose columns and names are checked less strictly.
    """

    name: ClassVar[str]
    version: ClassVar[int] = 1
    tables: ClassVar[Mapping[str, Mapping[str, Column]]]
    views: ClassVar[Sequence[UserView]] = ()
    reads: ClassVar[Collection[type[Happening]] | None] = None
    is_packed: ClassVar[bool] = False

    @abstractmethod
    def fold(self, event: Event, rows: Changes) -> None:
        """Add the changes of this event to `rows`. Must be pure: no lookups, no state, the same event gives the same.

        An exception parks the episode in this projection until a rebuild; `pycrorm status` shows the reason.
        """


EpisodeFold: TypeAlias = Callable[[Event, Changes], None]
"""Folds the events of one episode, in order. It may have state."""


class EpisodeProjection(Projection):
    """The base class of custom projections whose fold has a state, that of the event's own episode.

    >>> class Attempts(EpisodeProjection):
    ...     name, version = "attempts", 1
    ...     tables = {"attempt": {"dtype": "text", "number": "integer"}}
    ...
    ...     def episode(self):
    ...         counts = Counter()
    ...
    ...         def fold(event, rows):
    ...             if event.dtype is not None:
    ...                 counts[event.dtype] += 1
    ...                 rows.insert("attempt", event.id, dtype=event.dtype, number=counts[event.dtype])
    ...
    ...         return fold
    """

    @abstractmethod
    def episode(self) -> EpisodeFold:
        """Return a function that folds the events of one episode from its first, as `Projection.fold` folds an event.

        It gets every event once and in order. After a restart, and where a batch could not be written, a new function
        gets the episode's events from the first again, and the rows of those that are in the tables are discarded. So
        its state must depend on the events alone. It is dropped at the end of the episode.
        """

    @final
    def fold(self, event: Event, rows: Changes) -> None:  # noqa: ARG002 - of the base class
        raise TypeError(f"{self.name} folds events with what `episode()` returns")


def columns_of(projection: Projection) -> dict[str, dict[str, Storage]]:
    """Return the projection's tables with all their columns. Raises `CallerError` for an invalid projection."""
    fault = _fault_in(projection)
    if fault is not None:
        raise CallerError(f"the projection {type(projection).__qualname__}: {fault}")
    return {name: {**OF_EVERY_TABLE, **columns} for name, columns in projection.tables.items()}


def _fault_in(projection: Projection) -> str | None:
    name: Any = getattr(projection, "name", None)
    version: Any = projection.version
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name == "tables":
        return f"its name is {name!r}, and must be lower-case letters, digits and underscores, 40 at most, not 'tables'"
    if not isinstance(version, int) or not 0 < version < 2**31:
        return f"its version is {version!r}, and must be an integer > 0"
    if not getattr(projection, "tables", None):
        return "it has no tables: set `tables`"
    storages = get_args(Storage if projection.is_packed else Column)
    for table, columns in projection.tables.items():
        if not _NAME.fullmatch(table):
            return f"the table name {table!r} must be lower-case letters, digits and underscores, 40 at most"
        if is_reserved(table) and not projection.is_packed:
            return f"the table name {table!r} is used by the memory itself"
        for column, storage in columns.items():
            if not _NAME.fullmatch(column) or column in OF_EVERY_TABLE:
                return f"the column name {table}.{column} is reserved, or has other characters than a-z, 0-9 and _"
            if storage not in storages:
                return f"the column {table}.{column} is {storage!r}, and must be one of {', '.join(storages)}"
    if any(each.materialised for each in projection.views):
        return "a view of a projection cannot be materialised: its tables are stored already"
    names = [*projection.tables, *(each.name for each in projection.views)]
    duplicate = next((each for each in names if [*map(str.lower, names)].count(each.lower()) > 1), None)
    return f"two of its tables and views have the name {duplicate!r}" if duplicate else None


# === episode folds ============================================================================================
#
# Keep the folds of open episodes between batches, so that each event of an episode is folded with its state.
#
# Theory of operation. An `EpisodeProjection` has one fold for each episode, and its state is a function of the
# episode's events up to one sequence. That sequence is kept beside it. A batch takes the folds of its episodes out of
# the cache and gives them back when it is folded, before it is written. If the batch is then not written, because
# another process folded its events first or the database refused a row, the kept sequence is ahead of the checkpoint,
# and if another process folded events in the meantime it is behind. So nothing relies on the cache: a batch compares
# the sequence with the checkpoint that it continues. A fold that is behind reads the events in between, and one that is
# ahead or missing, as after a restart, is replaced by a new one that reads the episode from its start. The rows of
# events that are read in this way are discarded, because the transaction that moved the checkpoint wrote them.
#
# Two batches may be folded at a time, one while the other is written in parts. They never share a fold, because a fold
# is in the cache or in one batch.
#
# Projections without a state have a cache too, of the sequences alone. It shows which events of a batch of the tables
# a projection can fold in the same pass (`pipeline`): those of episodes that it left where the batch begins.

_EPISODES_MAX: Final = 1_000
"""Bounds the folds of open episodes that are kept, and with it the memory. It is above the episodes of one batch of a
projection (400). With more open episodes than this, those that were not folded for the longest time are read from their
start again."""
_PAGE_EVENTS: Final = 2_000
"""Bounds the events that are read at once to restore a fold."""
_ENDED: Final = EpisodeEnded.__name__
_TYPE: Final = attrgetter("type")
Refused: TypeAlias = tuple[int, Exception]
"""The first event that a fold cannot read, by its sequence, with the exception."""


@dataclass(slots=True)
class _OpenFold:
    """The fold of one episode after its event `reached`; `fault` is the reason why it could not be restored."""

    fold: EpisodeFold
    reached: int = 0
    has_ended: bool = False
    fault: str | None = None

    def advance(self, events: Sequence[StoredEvent]) -> None:
        """Note that the fold has read these events."""
        self.reached = events[-1].sequence
        self.has_ended = self.has_ended or _ENDED in map(_TYPE, events)


class EpisodeFolds:
    """The folds of the open episodes of one projection in this process."""

    def __init__(self, projection: Projection) -> None:
        self._projection = projection
        self._open: OrderedDict[int, _OpenFold] = OrderedDict()

    def has(self, span: Span) -> bool:
        """Return whether the fold of the episode has come to the beginning of this span."""
        fold = self._open.get(span.number)
        return span.after == (fold.reached if fold is not None else 0)

    def take(self, number: int, after: int) -> _OpenFold:
        """Return the fold of this episode, which is not beyond event `after`, and remove it.

        A fold without a state has always read the events up to `after`.
        """
        fold = self._open.pop(number, None)
        if not isinstance(self._projection, EpisodeProjection):
            return _OpenFold(self._projection.fold, after)
        return fold if fold is not None and fold.reached <= after else _OpenFold(self._projection.episode())

    def keep(self, number: int, fold: _OpenFold) -> None:
        """Keep the fold of an episode that has not ended, and drop the one that was not folded for the longest time.

        After its end an episode can only be tagged, for which its fold is restored.
        """
        if fold.has_ended or fold.fault is not None:
            return
        self._open[number] = fold
        self._open.move_to_end(number)
        if len(self._open) > _EPISODES_MAX:
            self._open.popitem(last=False)


# === packed projection ========================================================================================
#
# Define projections that pack many rows of a fold into one row of a table.


class PackedProjection(EpisodeProjection):
    """The base class of projections of this package that pack rows into other rows, as cases into blocks.

    Its tables may have columns of every storage, and names that are reserved for it. Its batch reads the stored events,
    collects the results of the fold, and packs them.
    """

    is_packed: ClassVar[bool] = True

    @abstractmethod
    def episode(self) -> Any:
        """Return the fold of one episode, as the batch needs it."""

    @abstractmethod
    def batch(self, declared: Mapping[str, DesignatorTypeDeclared], folds: EpisodeFolds) -> ProjectedBatch:
        """Return an empty batch."""

    @abstractmethod
    def check(self, result: VerifyResult) -> TableCheck:
        """Return the check that compares the tables with the log."""


# === projected batch ==========================================================================================
#
# Fold a batch of events with a custom projection; subclasses collect the results of the fold, and store them.


class ProjectedBatch(Batch):
    """A batch of a custom projection.

    Args:
        projection: to fold with.
        declared: designator types by their short names.
        folds: those of the episodes that earlier batches began.

    Attributes:
        reads: the names of the types of events that the projection reads; None: all types.
    """

    def __init__(
        self,
        projection: Projection,
        declared: Mapping[str, DesignatorTypeDeclared],
        folds: EpisodeFolds | None = None,
    ) -> None:
        self._projection = projection
        self._declared = declared
        reads = projection.reads
        self.reads = None if reads is None else frozenset(each.__name__ for each in reads)
        self._folds = EpisodeFolds(projection) if folds is None else folds
        self._taken: dict[int, _OpenFold] = {}
        self._named: NamedValues | None = None

    def continued(self, spans: Sequence[Span]) -> Sequence[Span]:
        return [each for each in spans if self._folds.has(each)]

    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Bring the fold of each episode to the event before its span."""
        for span in spans:
            fold = self._taken[span.number] = self._folds.take(span.number, span.after)
            while fold.reached < span.after and fold.fault is None:
                page = Span(span.number, fold.reached, min(fold.reached + _PAGE_EVENTS, span.after))
                events = await log.spans([page])
                await self.look_up(log, events)
                fold.fault = self._read_again(fold, events, page.last)

    async def look_up(self, log: EventLog, events: Sequence[StoredEvent]) -> None:
        """Read the events that these name, for a fold of single events."""
        if self._named is not None:
            await self._named.look_up(log, events)

    def fold(self, events: Sequence[StoredEvent], happenings: Sequence[Happening | None]) -> tuple[int, str] | None:
        """Give the next events of an episode to its fold, which is dropped if it cannot fold one; see `Batch.fold`."""
        first = events[0]
        if self._named is not None:
            self._named.note(events)
        fold = self._taken.get(first.number)
        if fold is None:
            assert first.sequence == 1, "a batch that continues an episode restores its fold first"
            fold = self._taken[first.number] = self._folds.take(first.number, 0)
        refused = (
            self._read(fold.fold, events, happenings)
            if fold.fault is None
            else (first.sequence, CannotFold(fold.fault))
        )
        if refused is None:
            fold.advance(events)
            return None
        del self._taken[first.number]
        sequence, fault = refused
        raised = "" if isinstance(fault, CannotFold) else f"{self._projection.name} raised {type(fault).__name__}: "
        return sequence, f"{raised}{fault}"

    def _read_again(self, fold: _OpenFold, events: Sequence[StoredEvent], last: int) -> str | None:
        """Fold events up to `last` whose rows are written already; return the reason if that is not possible."""
        whole = consecutive(events, fold.reached)
        happenings, undecodable = decode_events(whole, self.reads)
        refused = self._read(fold.fold, whole[: len(happenings)], happenings, kept=False)
        if refused is None and undecodable is not None:
            refused = whole[len(happenings)].sequence, undecodable
        if refused is not None:
            sequence, fault = refused
            raised = "" if isinstance(fault, CannotFold) else f"{type(fault).__name__}: "
            return f"event {sequence}, read again: {raised}{fault}"
        if whole:
            fold.advance(whole)
        return None if fold.reached == last else f"event {fold.reached + 1} is missing in the log"

    def _read(
        self, fold: Any, events: Sequence[StoredEvent], happenings: Sequence[Happening | None], *, kept: bool = True
    ) -> Refused | None:
        reads, decoded = self.reads, zip(events, happenings, strict=True)
        read = [(e, each) for e, each in decoded if each is not None and (reads is None or e.type in reads)]
        return self.add(fold, read, kept=kept)

    @abstractmethod
    def add(self, fold: Any, events: Iterable[tuple[StoredEvent, Happening]], *, kept: bool) -> Refused | None:
        """Fold events of an episode, and add the results to the batch, or discard them if `kept` is False.

        Returns the sequence of the first event that cannot be folded, with the exception; its results are not added.
        """

    async def ready(self, engine: AsyncEngine, generation: int) -> None:  # noqa: ARG002 - for subclasses
        """Leave the folds of the episodes to the next batch. Subclasses prepare their statements, too."""
        while self._taken:
            self._folds.keep(*self._taken.popitem())


# === projection rows ==========================================================================================
#
# Collect the rows of a custom projection for one batch, checked so that every database stores the same values.
#
# `ProjectedBatch`, the base class, gives the events of each episode to the right fold and adds the projection's name to
# its faults. `CustomRows` executes the fold of one event at a time, checks the changes of rows, and writes them.

_INTEGER_MAX = 2**63 - 1
"""The largest integer that both databases store."""


class CustomRows(ProjectedBatch):
    """Rows to insert, and changes of rows that an earlier batch inserted, by table and id. Implements `Batch`."""

    def __init__(
        self,
        projection: Projection,
        declared: Mapping[str, DesignatorTypeDeclared],
        folds: EpisodeFolds | None = None,
    ) -> None:
        super().__init__(projection, declared, folds)
        self._columns = columns_of(projection)
        self._inserts: dict[str, dict[int, dict[str, Any]]] = {name: {} for name in self._columns}
        self._updates: dict[str, dict[int, dict[str, Any]]] = {name: {} for name in self._columns}
        self._insertion: Insertion = None
        if projection.reads is None or not {NodeStarted, NodeEnded}.isdisjoint(projection.reads):
            self._named = NamedValues()

    def add(self, fold: EpisodeFold, events: Iterable[tuple[StoredEvent, Happening]], *, kept: bool) -> Refused | None:
        """Add the changes of rows that a fold makes of events, if both databases store their values alike.

        With `kept` False the fold only reads the events, to restore its state: their rows are in the tables already.
        Returns None, or the sequence of the first event that could not be folded, with the exception; none of the
        changes of that event are added then, and its episode is parked.
        """
        for event, happening in events:
            changes = Changes()
            try:
                fold(self._event(event, happening), changes)
                if kept and changes.all:
                    self._add(event.number, changes.all)
            except Exception as fault:  # noqa: BLE001 - user code; the reason parks the episode
                return event.sequence, fault
        return None

    def _add(self, number: int, changes: Changed) -> None:
        """Add the changes of one event to the rows of the batch. Raises `CannotFold`, and then has added none."""
        new: set[tuple[str, int]] = set()
        checked = []
        for inserts, table, id_, columns in changes:
            checked.append((inserts, table, id_, self._checked(number, table, id_, columns)))
            if inserts and ((table, id_) in new or id_ in self._inserts[table]):
                raise CannotFold(f"{table} has a row {id_} already")
            if inserts:
                new.add((table, id_))
        for inserts, table, id_, values in checked:
            if inserts:
                self._inserts[table][id_] = {"id": id_, "process_metadata_id": number, **values}
                self._updates[table].pop(id_, None)  # an update before the insert had no row, so it has no effect
            elif id_ in self._inserts[table]:
                self._inserts[table][id_] |= values
            elif values:
                self._updates[table].setdefault(id_, {}).update(values)

    def to_insert(self) -> dict[tuple[str, tuple[str, ...]], list[Row]]:
        """Return all rows to insert, by (table, columns)."""
        rows_by_table: dict[tuple[str, tuple[str, ...]], list[Row]] = {}
        for table, rows in self._inserts.items():
            columns = tuple(self._columns[table])
            if rows:
                rows_by_table[f"{OWN}{table}", columns] = [tuple(map(each.get, columns)) for each in rows.values()]
        return rows_by_table

    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        """Prepare the statements that insert the rows, and leave the folds of the episodes to the next batch."""
        await super().ready(engine, generation)
        self._insertion = await dialect_of(engine).insertion(stored_rows(engine, self.to_insert(), generation))

    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Write all rows in the caller's transaction. Raises `RowRefused`."""
        dialect, quote = dialect_of(connection), connection.dialect.identifier_preparer.quote
        await dialect.insert(connection, self._insertion)
        for table, rows in self._updates.items():
            updates: dict[tuple[str, ...], list[Row]] = {}
            for id_, values in rows.items():
                updates.setdefault(tuple(sorted(values)), []).append((id_, *(values[name] for name in sorted(values))))
            for columns, changed in updates.items():
                kinds = {
                    quote(dialect.stored_column(name)): column_type(self._columns[table][name]).compile(
                        dialect=connection.dialect
                    )
                    for name in ("id", *columns)
                }
                await dialect.update_rows(connection, physical_name(f"{OWN}{table}", generation), kinds, changed)

    def _event(self, stored: StoredEvent, happening: Happening) -> Event:
        number, sequence, _, _, wall_ns, monotonic_ns, payload = stored
        if self._named is not None:
            happening = self._named.whole(number, happening)
        parameters: Mapping[str, Any] = {}
        dtype = declaration = None
        if isinstance(happening, NodeStarted) and happening.designator is not None:
            declaration = self._declared.get(happening.designator)
            if declaration is None:
                raise CannotFold(f"the designator type {happening.designator} was never declared")
            # A copy, because another projection gets the same happening, and a fold may take parameters out.
            dtype, parameters = declaration.dtype, dict(happening.parameters)
            if b'"missing"' in payload:  # only then can a parameter be a `MissingValue`, so most events skip the copy
                parameters = {name: None if is_missing(each) else each for name, each in parameters.items()}
        time_us = microseconds(wall_ns)
        return make(Event, (number, sequence, time_us, monotonic_ns, happening, dtype, parameters, declaration))

    def _checked(self, number: int, table: str, id_: Any, values: Mapping[str, Any]) -> dict[str, Any]:
        columns = self._columns.get(table)
        if columns is None:
            raise CannotFold(f"{self._projection.name} has no table {table!r}")
        if not isinstance(id_, int) or row_key(id_).number != number:
            raise CannotFold(f"{table}: {id_!r} is not a row of this episode: use event.id or event.row(sequence)")
        for name in values:
            if name not in columns or name in OF_EVERY_TABLE:
                raise CannotFold(f"{table} has no column {name!r} to fill")
        return {name: _value(table, name, columns[name], each) for name, each in values.items()}


def _value(table: str, name: str, storage: Storage, value: Any) -> Any:
    """Return the value as the column stores it. Raises `CannotFold` where SQLite would accept it and change it."""
    if value is None:
        return None
    match storage:
        case "json":
            try:
                return json_text(value)
            except (TypeError, ValueError) as error:
                raise CannotFold(f"{table}.{name}: {error}") from None
        case "text":
            fits = isinstance(value, str)
        case "boolean":
            fits = isinstance(value, bool)
        case "real":
            fits = isinstance(value, int | float) and not isinstance(value, bool)
        case _:
            fits = isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _INTEGER_MAX
    if not fits:
        raise CannotFold(f"{table}.{name}: {repr(value)[:80]} is not of the declared type {storage}")
    if storage == "real":
        value = float(value)
    fault = unwritable(value)
    if fault is not None:
        raise CannotFold(f"{table}.{name}: {fault}")
    return value
