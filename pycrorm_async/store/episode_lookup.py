"""Which episode people mean: by its number here, its id, or the first digits of that; `last` is the newest that really
happened. Asked of the log alone, so that it also works where there are no tables yet."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow

__all__ = ["number_named", "episode_named"]


def number_named(name: str, ids: Mapping[int, str], *, listed: int) -> int:
    """The number of the episode, among these ids by number; `listed` is how many of them `pycrorm episodes` shows.

    Raises `UnknownEpisode`, also when several ids begin like that.
    """
    # A short one is a number; a long one may be the beginning of an id that happens to have no letter.
    found = [number for number in ids if str(number) == name] or [
        number for number, identity in ids.items() if len(name) >= 4 and identity.startswith(name.lower())
    ]
    if len(found) > 1:
        raise UnknownEpisode(f"{len(found)} episodes have an id that begins with {name!r}: give more of it")
    if not found:
        raise UnknownEpisode(f"there is no episode {name!r} (`pycrorm episodes` lists the {listed} there are)")
    return found[0]


async def episode_named(log: EventLog, name: str) -> EpisodeRow:
    """The episode of that name. Raises `UnknownEpisode`."""
    rows = {row.number: row for row in await log.episodes()}
    if name == "last":
        for row in reversed(rows.values()):
            if not await _is_thought(log, row):
                return row
    return rows[number_named(name, {number: row.id for number, row in rows.items()}, listed=len(rows))]


class _Started(msgspec.Struct):
    simulated: bool = False


async def _is_thought(log: EventLog, row: EpisodeRow) -> bool:
    first = await log.events(row.number, limit=1)
    try:
        return bool(first) and msgspec.json.decode(first[0].payload, type=_Started).simulated
    except msgspec.DecodeError:  # damaged; whoever reads it will say so
        return False
