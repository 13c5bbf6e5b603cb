"""Projections of one's own: tables that a pure fold makes from the log, kept live, rebuilt and verified like ours.

>>> class GraspRate(Projection):
...     name, version = "grasp_rate", 1
...     tables = {"grasp_try": {"arm": "text", "grasp": "text", "status": "text"}}
...
...     def fold(self, event, rows):
...         match event.happening:
...             case NodeStarted(parameters=given) if event.dtype == "PickUpAction":
...                 rows.insert("grasp_try", event.id, arm=given["arm"], grasp=given["grasp"], status="RUNNING")
...             case NodeEnded(node=node, status=status):
...                 rows.update("grasp_try", event.row(node), status=status)
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias, get_args

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import is_reserved
from pycrorm_async.events.types import Happening
from pycrorm_async.projections.fold.column_values import row
from pycrorm_async.projections.schema.tables import Storage
from pycrorm_async.projections.schema.user_views import UserView

__all__ = ["Projection", "Event", "Changes", "Column", "OF_EVERY_TABLE", "columns_of"]

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
Column: TypeAlias = Literal["row", "integer", "real", "text", "boolean", "time", "json"]
"""How a column is stored: the id of a row, a scalar, µs since 1970, JSON."""
OF_EVERY_TABLE: dict[str, Storage] = {"id": "key", "process_metadata_id": "row"}


class Event(NamedTuple):
    """One event of the log, as a fold gets it.

    Attributes:
        number: of its episode, in this database.
        sequence: of the event in its episode.
        time: µs since 1970.
        monotonic_ns: by the clock that never goes back.
        happening: what happened, one of `pycrorm_async.events.types`.
        dtype: of a NodeStarted, its designator's type; None for others.
        parameters: of a NodeStarted, by field, as `NodeStarted.parameters`; None for one that could not be recorded.
    """

    number: int
    sequence: int
    time: int
    monotonic_ns: int
    happening: Happening
    dtype: str | None
    parameters: Mapping[str, Any]

    @property
    def id(self) -> int:
        """The id of the row this event makes, in any table: for a NodeStarted that of its node and designator."""
        return row(self.number, self.sequence)

    def row(self, sequence: int, slot: int = 0) -> int:
        """The id of the row that an event of the same episode makes; up to 32 of them, by their slots."""
        return row(self.number, sequence, slot)


class Changes:
    """What one event changes. Both keep the rule that an event changes rows of its own episode only."""

    def __init__(self) -> None:
        self.all: list[tuple[bool, str, int, dict[str, Any]]] = []

    def insert(self, table: str, id: int, /, **columns: Any) -> None:  # noqa: A002
        """A row that is not there yet; columns that are not given are null."""
        self.all.append((True, table, id, columns))

    def update(self, table: str, id: int, /, **columns: Any) -> None:  # noqa: A002
        """Other values for a row; no effect if there is none of this id."""
        self.all.append((False, table, id, columns))


class Projection(ABC):
    """Derive from it, say what the tables are, and fold.

    Attributes:
        name: in the database: small letters, digits and underscores.
        version: counts what the fold means. With another one `pycrorm rebuild NAME` makes the tables anew.
        tables: columns and how they are stored (`row` for the id of one, `integer`, `real`, `text`, `boolean`,
            `time` in µs since 1970, `json`). Every table also has `id`, and `process_metadata_id` for its episode.
        views: questions about these tables with a name, shown beside them.
    """

    name: ClassVar[str]
    version: ClassVar[int] = 1
    tables: ClassVar[Mapping[str, Mapping[str, Column]]]
    views: ClassVar[Sequence[UserView]] = ()

    @abstractmethod
    def fold(self, event: Event, rows: Changes) -> None:
        """Says what this event changes. Pure: the same event always changes the same; nothing is looked up or kept.

        One that raises stops its episode in this projection, with the reason in `pycrorm status`, until a rebuild.
        """


def columns_of(projection: Projection) -> dict[str, dict[str, Storage]]:
    """Its tables with all their columns. Raises `CallerError` for a projection that cannot be."""
    fault = _fault_in(projection)
    if fault is not None:
        raise CallerError(f"the projection {type(projection).__qualname__}: {fault}")
    return {name: {**OF_EVERY_TABLE, **columns} for name, columns in projection.tables.items()}


def _fault_in(projection: Projection) -> str | None:
    name: Any = getattr(projection, "name", None)
    version: Any = projection.version
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name == "tables":
        return f"its name is {name!r}, and must be small letters, digits and underscores, 40 at most, not 'tables'"
    if not isinstance(version, int) or not 0 < version < 2**31:
        return f"its version is {version!r}, and must be a number from 1 on"
    if not getattr(projection, "tables", None):
        return "it has no tables: set `tables`"
    for table, columns in projection.tables.items():
        if not _NAME.fullmatch(table):
            return f"the table {table!r}: a name is small letters, digits and underscores, 40 at most"
        if is_reserved(table):
            return f"the table {table!r} has a name that the memory itself uses"
        for column, storage in columns.items():
            if not _NAME.fullmatch(column) or column in OF_EVERY_TABLE:
                return f"the column {table}.{column}: not a name it can have"
            if storage not in get_args(Column):
                return f"the column {table}.{column} is {storage!r}, and must be one of {', '.join(get_args(Column))}"
    if any(each.materialised for each in projection.views):
        return "a view of a projection cannot be materialised: it stands on tables that are kept already"
    names = [*projection.tables, *(each.name for each in projection.views)]
    twice = next((each for each in names if [*map(str.lower, names)].count(each.lower()) > 1), None)
    return f"two of its tables and views are called {twice!r}" if twice else None
