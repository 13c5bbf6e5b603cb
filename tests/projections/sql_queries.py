"""Query a database with plain SQL that bypasses the package's classes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pycrorm_async.events.codec import Record
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.log import EventLog


async def ask(log: EventLog, question: str, *parameters: Any) -> list[tuple[Any, ...]]:
    async with log.engine.connect() as connection:
        return [tuple(row) for row in await connection.exec_driver_sql(question, parameters)]


async def lose_event(log: EventLog, number: int, sequence: int) -> None:
    """Delete an event of the log, as if the file had lost it."""
    is_server = log.engine.dialect.name == "postgresql"
    async with log.engine.begin() as connection:
        trigger = "event_is_not_changed ON event" if is_server else "event_is_not_deleted"
        await connection.exec_driver_sql(f"DROP TRIGGER IF EXISTS {trigger}")
        await connection.exec_driver_sql(f"DELETE FROM event WHERE episode = {number} AND sequence = {sequence}")


async def stored_and_folded(log: EventLog, records: Sequence[Record], **options: Any) -> Projector:
    """Return a projector with these options that has folded all of these records."""
    projector = Projector(log, **options)
    await projector.open()
    await log.append(records)
    await projector.catch_up()
    return projector


_KINDS = {"sqlite": {"table": "'table'", "view": "'view'"}, "postgresql": {"table": "'r', 'p'", "view": "'v'"}}
_NAMED = {
    "sqlite": "SELECT name FROM sqlite_master WHERE type IN ({}) ORDER BY name",
    "postgresql": "SELECT relname FROM pg_class JOIN pg_namespace AS place ON place.oid = relnamespace"
    " WHERE nspname IN ('memory', 'memory_tables', 'pycrorm') AND relkind IN ({}) AND NOT relispartition"
    " ORDER BY relname",
}


async def names(log: EventLog, *kinds: str) -> list[str]:
    """Return the names of the tables, or of the views, or of both in the database."""
    database = log.engine.dialect.name
    statement = _NAMED[database].format(", ".join(_KINDS[database][each] for each in kinds))
    return [name for (name,) in await ask(log, statement)]


async def all_rows(log: EventLog) -> dict[str, list[tuple[Any, ...]]]:
    """Return every table of the first generation, ordered."""
    tables = [name for name in await names(log, "table") if name.startswith("zz_") and name.endswith("__1001")]
    return {name: sorted(await ask(log, f'SELECT * FROM "{name}"'), key=repr) for name in tables}
