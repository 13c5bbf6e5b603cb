"""Find an episode by its number, its id, the first digits of its id, or `last`.

`last` is the newest episode that is not a simulation. The lookup reads only the log, so it works without tables.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import msgspec
from sqlalchemy import bindparam, text

from pycrorm_async.errors import LogDamaged, UnknownEpisode
from pycrorm_async.events.tags import retagged
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow


def number_named(name: str, ids: Mapping[int, str], *, listed: int) -> int:
    """Return the number of the named episode among these ids by number.

    `listed` is the number of episodes that `pycrorm episodes` lists. Raises `UnknownEpisode`, also if several ids
    match.
    """
    # Four digits may be a number, or the beginning of an id without a letter: the number wins.
    numbers = [number for number in ids if str(number) == name] or [
        number for number, identity in ids.items() if len(name) >= 4 and identity.startswith(name.lower())
    ]
    if len(numbers) > 1:
        raise UnknownEpisode(f"{len(numbers)} episodes have an id that begins with {name!r}: use more of its digits")
    if not numbers:
        raise UnknownEpisode(f"there is no episode {name!r} ({_present(listed)})")
    return numbers[0]


def _present(listed: int) -> str:
    if listed == 0:
        return "this memory has none yet: record one with `pycrorm run` or `pycrorm demo`"
    return f"`pycrorm episodes` lists {'the only one' if listed == 1 else f'all {listed}'}"


async def episode_named(log: EventLog, name: str) -> EpisodeRow:
    """Find the named episode. Raises `UnknownEpisode`."""
    rows = {row.number: row for row in await log.episodes()}
    if name == "last":
        for row in reversed(rows.values()):
            if not await is_simulated(log, row):
                return row
    return rows[number_named(name, {number: row.id for number, row in rows.items()}, listed=len(rows))]


_GROWN = text(
    "SELECT number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked FROM episode"
    " WHERE number > :above OR ended_wall_ns IS NULL OR number IN :numbers ORDER BY number"
).bindparams(bindparam("numbers", expanding=True))


async def grown_episodes(log: EventLog, *, above: int, numbers: Collection[int]) -> list[EpisodeRow]:
    """Read the episodes that may have grown: with a number above `above`, not ended, or with one of these numbers."""
    async with log.reading() as connection:
        rows = await connection.execute(_GROWN, {"above": above, "numbers": sorted(numbers)})
        return [EpisodeRow(*row) for row in rows]


async def tags_of(log: EventLog, row: EpisodeRow) -> tuple[str, ...]:
    """Return the tags of an episode according to its events. Raises `LogDamaged` if one of these cannot be read."""
    tags: tuple[str, ...] = ()
    query = text(
        "SELECT sequence, payload FROM event WHERE episode = :number AND type IN ('EpisodeStarted', 'EpisodeTagged')"
        " ORDER BY sequence"
    )
    async with log.reading() as connection:
        for sequence, payload in await connection.execute(query, {"number": row.number}):
            try:
                change = msgspec.json.decode(payload, type=_Tagging)
            except msgspec.DecodeError as error:
                raise LogDamaged(row.id, sequence, f"its payload cannot be read: {error}") from error
            tags = retagged(tags, (*change.tags, *change.added), change.removed)
    return tags


class _Tagging(msgspec.Struct):
    """The parts of `EpisodeStarted` and `EpisodeTagged` that concern tags."""

    tags: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()


class _Started(msgspec.Struct):
    simulated: bool = False


async def is_simulated(log: EventLog, row: EpisodeRow) -> bool:
    """Return whether the episode is a simulation, according to its first event."""
    first = await log.events(row.number, limit=1)
    try:
        return bool(first) and msgspec.json.decode(first[0].payload, type=_Started).simulated
    except msgspec.DecodeError:  # damaged; reading the episode reports it
        return False
