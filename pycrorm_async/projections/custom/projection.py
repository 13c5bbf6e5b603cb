"""Define custom projections: tables that a pure fold makes from the log, kept live, rebuilt and verified like built-in
ones.

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

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias, final, get_args

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import is_reserved
from pycrorm_async.events.types import DesignatorTypeDeclared, Happening
from pycrorm_async.projections.fold.column_values import in_slot, row
from pycrorm_async.projections.schema.core_columns import Storage
from pycrorm_async.projections.schema.user_views import UserView

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
        return row(self.number, self.sequence)

    def row(self, sequence: int, slot: int = 0) -> int:
        """Return the id of a row of another event in the same episode; each event may have 32, by slot."""
        return in_slot(row(self.number, sequence), slot)


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
