"""Read and write the checkpoint table of a generation: one row for each episode.

Generations that a rebuild fills and those of custom projections have such a table, named after the generation
(`targets`).
"""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import TableClause, column, or_, select, table, text, update
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.projections.schema.core_columns import Storage
from pycrorm_async.projections.table_names import physical_name
from pycrorm_async.store.dialect import Progress, RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.stored import EpisodeRow

TABLE = "pycrorm_progress"
COLUMNS: dict[str, Storage] = {"id": "key", "folded": "integer", "parked": "text"}
"""The episode's number, the last sequence that is in the tables, and the reason if it is parked."""
SEEN = "SELECT number, folded FROM episode"
"""SQL that selects, for each episode, the last sequence in the visible tables."""


def place_of(generation: int, projection: str | None = None) -> str:
    """Return the name of the checkpoint table of a generation, of the built-in tables or of a custom projection."""
    return physical_name(TABLE if projection is None else f"{TABLE}_{projection}", generation)


async def behind(
    connection: AsyncConnection,
    place: str,
    *,
    after: int,
    limit: int,
    share: tuple[int, int] = (0, 1),
    after_tables: bool = False,
) -> list[EpisodeRow]:
    """Return the episodes above number `after` whose log is ahead of their checkpoint, limited to one share.

    With `after_tables`, only episodes whose first event is folded into the visible tables or parked, because that fold
    decides whether an episode is a simulation.
    """
    begun = "AND (episode.folded > 0 OR episode.parked IS NOT NULL)" if after_tables else ""
    rows = await connection.execute(
        text(f"""
SELECT number, episode.id, head, coalesce(progress.folded, 0), started_wall_ns
FROM episode LEFT JOIN {place} AS progress ON progress.id = number
WHERE number > :after AND head > coalesce(progress.folded, 0) AND progress.parked IS NULL
AND number % :many = :part {begun} ORDER BY number LIMIT :limit"""),  # noqa: S608
        {"after": after, "part": share[0], "many": share[1], "limit": limit},
    )
    return [EpisodeRow(*row) for row in rows]


async def late(connection: AsyncConnection, place: str, *, seen: str, limit: int) -> list[EpisodeRow]:
    """Return the episodes of which the visible tables have more events than this generation.

    Their `head` is the last sequence in the visible tables. `seen` is the SQL for the checkpoints of those tables:
    `SEEN`, or `folded` of another generation.
    """
    rows = await connection.execute(
        text(f"""
SELECT episode.number, episode.id, seen.folded, coalesce(progress.folded, 0), started_wall_ns
FROM episode JOIN ({seen}) AS seen ON seen.number = episode.number
LEFT JOIN {place} AS progress ON progress.id = episode.number
WHERE seen.folded > coalesce(progress.folded, 0) AND progress.parked IS NULL
ORDER BY episode.number LIMIT :limit"""),  # noqa: S608
        {"limit": limit},
    )
    return [EpisodeRow(*row) for row in rows]


def folded(place: str) -> str:
    """Return SQL that selects, for each episode, the last sequence in this generation."""
    return f"SELECT id AS number, folded FROM {place}"  # noqa: S608


async def left(connection: AsyncConnection, place: str) -> int:
    """Return the number of events in the log that this generation lacks, without those of parked episodes."""
    result = await connection.execute(
        text(
            f"SELECT coalesce(sum(head - coalesce(progress.folded, 0)), 0) FROM episode LEFT JOIN {place} AS progress"  # noqa: S608
            " ON progress.id = number WHERE progress.parked IS NULL"
        )
    )
    return int(result.scalar_one())


async def parked(connection: AsyncConnection, place: str) -> dict[int, str]:
    """Return the parked episodes of this generation by number, with the reasons."""
    rows = await connection.execute(
        text(f"SELECT id, parked FROM {place} WHERE parked IS NOT NULL ORDER BY id")  # noqa: S608
    )
    return {each.id: each.parked for each in rows}


async def advance(connection: AsyncConnection, place: str, steps: Sequence[Progress]) -> bool:
    """Write (number, folded before, folded now) of each episode; return False if a checkpoint has moved."""
    dialect = dialect_of(connection)
    progress = _table(place)
    query = select(progress.c.id, progress.c.folded).where(progress.c.id.in_([number for number, _, _ in steps]))
    rows = await connection.execute(query.order_by(progress.c.id).with_for_update())
    present: dict[int, int] = {row.id: row.folded for row in rows}
    if any(present.get(number, 0) != before for number, before, _ in steps):
        return False
    new = [(number, now, None) for number, _, now in steps if number not in present]
    grown = [(number, now) for number, _, now in steps if number in present]
    try:
        if new:
            await dialect.insert(connection, await dialect.insertion({(place, tuple(COLUMNS)): new}))
    except RowRefused:
        return False
    if grown:
        await dialect.update_rows(connection, place, {"id": "bigint", "folded": "bigint"}, grown)
    return True


async def park(connection: AsyncConnection, place: str, number: int, reason: str) -> None:
    """Park an episode in this generation."""
    await connection.execute(
        text(
            f"INSERT INTO {place} (id, folded, parked) VALUES (:number, 0, :reason)"  # noqa: S608
            " ON CONFLICT (id) DO UPDATE SET parked = excluded.parked"
        ),
        {"number": number, "reason": reason},
    )


async def carry_over(connection: AsyncConnection, place: str) -> None:
    """Copy the checkpoints of this generation into `episode`, when it becomes the visible one."""
    episode = table("episode", column("number"), column("folded"), column("parked"))
    progress = _table(place)
    different = or_(episode.c.folded != progress.c.folded, episode.c.parked.is_distinct_from(progress.c.parked))
    taken = (
        select(episode.c.number, progress.c.folded, progress.c.parked)
        .join_from(episode, progress, progress.c.id == episode.c.number)
        .where(different)
        .order_by(episode.c.number)  # all transactions lock episodes in this order, which prevents deadlocks
        .with_for_update(of=episode)
        .cte("taken")
    )
    change = update(episode).where(episode.c.number == taken.c.number)
    await connection.execute(change.values(folded=taken.c.folded, parked=taken.c.parked))


def _table(place: str) -> TableClause:
    return table(place, *map(column, COLUMNS))
