"""How far a generation has come: one row for each episode, in a table that goes with it.

That is one which is being made, or one of a projection; of the tables that people see, `episode.folded` says it.
"""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import TableClause, column, or_, select, table, text, update
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.projections.schema.tables import Storage, physical_name
from pycrorm_async.store.dialect import Progress, RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.stored import EpisodeRow

__all__ = [
    "TABLE",
    "COLUMNS",
    "SEEN",
    "place_of",
    "behind",
    "late",
    "folded",
    "total",
    "parked",
    "advance",
    "park",
    "carry_over",
]

TABLE = "pycrorm_progress"
COLUMNS: dict[str, Storage] = {"id": "key", "folded": "integer", "parked": "text"}
"""The episode's number, the last sequence that is in the tables, and why no more is."""
SEEN = "SELECT number, folded FROM episode"
"""What tells how much of each episode is in the tables that people see."""


def place_of(generation: int, projection: str | None = None) -> str:
    """The table that says how far this generation has come: of our own tables, or of somebody's projection."""
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
    """Of the episodes that follow number `after`, those that the log has more of; only the n-th of every m of them.

    With `after_tables` only those that people see something of, or will not: before, nobody knows which are thoughts.
    """
    begun = "AND (episode.folded > 0 OR episode.parked IS NOT NULL)" if after_tables else ""
    found = await connection.execute(
        text(f"""
SELECT number, episode.id, head, coalesce(progress.folded, 0), started_wall_ns
FROM episode LEFT JOIN {place} AS progress ON progress.id = number
WHERE number > :after AND head > coalesce(progress.folded, 0) AND progress.parked IS NULL
AND number % :many = :part {begun} ORDER BY number LIMIT :limit"""),  # noqa: S608
        {"after": after, "part": share[0], "many": share[1], "limit": limit},
    )
    return [EpisodeRow(*row) for row in found]


async def late(connection: AsyncConnection, place: str, *, seen: str, limit: int) -> list[EpisodeRow]:
    """The episodes of which people see more than is in this generation; their `head` is what people see.

    `seen` is what tells how much that is: `SEEN`, or `folded` of another generation.
    """
    found = await connection.execute(
        text(f"""
SELECT episode.number, episode.id, seen.folded, coalesce(progress.folded, 0), started_wall_ns
FROM episode JOIN ({seen}) AS seen ON seen.number = episode.number
LEFT JOIN {place} AS progress ON progress.id = episode.number
WHERE seen.folded > coalesce(progress.folded, 0) AND progress.parked IS NULL
ORDER BY episode.number LIMIT :limit"""),  # noqa: S608
        {"limit": limit},
    )
    return [EpisodeRow(*row) for row in found]


def folded(place: str) -> str:
    """What tells, for each episode, how much of it is in this generation."""
    return f"SELECT id AS number, folded FROM {place}"  # noqa: S608


async def total(connection: AsyncConnection, place: str) -> int:
    """How many events are in it."""
    found = await connection.execute(
        text(f"SELECT coalesce(sum(folded), 0) FROM {place}")  # noqa: S608
    )
    return int(found.scalar_one())


async def left(connection: AsyncConnection, place: str) -> int:
    """How many events the log has more; without those of parked episodes."""
    found = await connection.execute(
        text(
            f"SELECT coalesce(sum(head - coalesce(progress.folded, 0)), 0) FROM episode LEFT JOIN {place} AS progress"  # noqa: S608
            " ON progress.id = number WHERE progress.parked IS NULL"
        )
    )
    return int(found.scalar_one())


async def parked(connection: AsyncConnection, place: str) -> dict[int, str]:
    """By episode number, why no more of it is in this generation."""
    found = await connection.execute(
        text(f"SELECT id, parked FROM {place} WHERE parked IS NOT NULL ORDER BY id")  # noqa: S608
    )
    return {each.id: each.parked for each in found}


async def advance(connection: AsyncConnection, place: str, steps: Sequence[Progress]) -> bool:
    """Notes (episode number, folded before, folded now) of each episode; False if one of them is not there any more."""
    dialect = dialect_of(connection)
    progress = _table(place)
    asked = select(progress.c.id, progress.c.folded).where(progress.c.id.in_([number for number, _, _ in steps]))
    found = await connection.execute(asked.order_by(progress.c.id).with_for_update())
    there: dict[int, int] = {row.id: row.folded for row in found}
    if any(there.get(number, 0) != before for number, before, _ in steps):
        return False
    new = [(number, now, None) for number, _, now in steps if number not in there]
    grown = [(number, now) for number, _, now in steps if number in there]
    try:
        if new:
            await dialect.insert(connection, await dialect.insertion({(place, tuple(COLUMNS)): new}))
    except RowRefused:
        return False
    if grown:
        await dialect.update_rows(connection, place, {"id": "bigint", "folded": "bigint"}, grown)
    return True


async def park(connection: AsyncConnection, place: str, number: int, reason: str) -> None:
    """Stops an episode, with the reason."""
    await connection.execute(
        text(
            f"INSERT INTO {place} (id, folded, parked) VALUES (:number, 0, :reason)"  # noqa: S608
            " ON CONFLICT (id) DO UPDATE SET parked = excluded.parked"
        ),
        {"number": number, "reason": reason},
    )


async def carry_over(connection: AsyncConnection, place: str) -> None:
    """What `episode` says of every episode is afterwards what this generation shows."""
    episode = table("episode", column("number"), column("folded"), column("parked"))
    progress = _table(place)
    different = or_(episode.c.folded != progress.c.folded, episode.c.parked.is_distinct_from(progress.c.parked))
    taken = (
        select(episode.c.number, progress.c.folded, progress.c.parked)
        .join_from(episode, progress, progress.c.id == episode.c.number)
        .where(different)
        .order_by(episode.c.number)  # as everybody takes them, so that nobody waits in a circle
        .with_for_update(of=episode)
        .cte("taken")
    )
    change = update(episode).where(episode.c.number == taken.c.number)
    await connection.execute(change.values(folded=taken.c.folded, parked=taken.c.parked))


def _table(place: str) -> TableClause:
    return table(place, *map(column, COLUMNS))
