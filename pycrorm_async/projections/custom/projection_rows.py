"""Collect the rows of a custom projection for one batch, checked so that every database stores the same values.

`ProjectedBatch`, the base class, gives the events of each episode to the right fold and adds the projection's name to
its faults. `CustomRows` executes the fold of one event at a time, checks the changes of rows, and writes them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.bulk_records import make
from pycrorm_async.events.codec import unwritable
from pycrorm_async.events.ids import row_key
from pycrorm_async.events.types import DesignatorTypeDeclared, NodeStarted
from pycrorm_async.projections.custom.episode_folds import EpisodeFolds, Refused
from pycrorm_async.projections.custom.projected_batch import ProjectedBatch
from pycrorm_async.projections.custom.projection import (
    OF_EVERY_TABLE,
    Changed,
    Changes,
    EpisodeFold,
    Event,
    Projection,
    columns_of,
)
from pycrorm_async.projections.fold.column_values import CannotFold, is_missing, json_text, microseconds
from pycrorm_async.projections.fold.fold import happening_of
from pycrorm_async.projections.fold.row_batch import Row
from pycrorm_async.projections.fold.row_writer import stored_rows
from pycrorm_async.projections.schema.core_columns import OWN, Storage
from pycrorm_async.projections.schema.tables import column_type
from pycrorm_async.projections.table_names import physical_name
from pycrorm_async.store.dialect import Insertion
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.stored import StoredEvent

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

    def add(self, fold: EpisodeFold, events: Sequence[StoredEvent], *, kept: bool) -> Refused | None:
        """Add the changes of rows that a fold makes of events, if both databases store their values alike.

        With `kept` False the fold only reads the events, to restore its state: their rows are in the tables already.
        Returns None, or the sequence of the first event that could not be folded, with the exception; none of the
        changes of that event are added then, and its episode is parked.
        """
        for event in events:
            changes = Changes()
            try:
                fold(self._event(event), changes)
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

    def _event(self, stored: StoredEvent) -> Event:
        number, sequence, _, _, wall_ns, monotonic_ns, payload = stored
        happening = happening_of(stored)
        parameters: Mapping[str, Any] = {}
        dtype = declaration = None
        if isinstance(happening, NodeStarted) and happening.designator is not None:
            declaration = self._declared.get(happening.designator)
            if declaration is None:
                raise CannotFold(f"the designator type {happening.designator} was never declared")
            dtype, parameters = declaration.dtype, happening.parameters
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
