"""Warn before an episode or a memory has used up its numbers.

Row ids have 53 bits: 22 for the episode's number, 26 for the event's sequence. Both limits are distant (a thousand
episodes a day for eleven years, a week of a hundred events a second). From nine tenths of a limit on, `status` warns
and the process that stores the events logs one line, so that a user has time to act.
"""

from __future__ import annotations

from collections.abc import Sequence

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX
from pycrorm_async.store.stored import EpisodeRow

EPISODES_MANY = EPISODE_NUMBER_MAX * 9 // 10 + 1
"""Episode number from which a memory counts as nearly full: 3,774,873, nine tenths of the limit."""

EVENTS_MANY = SEQUENCE_MAX * 9 // 10 + 1
"""Sequence from which an episode counts as nearly full: 60,397,977, nine tenths of the limit."""


def number_warning(number: int) -> str | None:
    """Return the warning for a memory's latest episode number; None below nine tenths.

    >>> number_warning(4_000_000)
    '4,000,000 of 4,194,303 episode numbers are used (95 %): record into a new database before none is left'
    """
    if number < EPISODES_MANY:
        return None
    if number >= EPISODE_NUMBER_MAX:
        return (
            f"all {EPISODE_NUMBER_MAX:,} episode numbers are used: new episodes are kept in the spool until it belongs"
            " to a new database"
        )
    share = number * 100 // EPISODE_NUMBER_MAX
    return (
        f"{number:,} of {EPISODE_NUMBER_MAX:,} episode numbers are used ({share} %): record into a new database before"
        " none is left"
    )


def events_warning(episode: EpisodeRow) -> str | None:
    """Return the warning for an episode that has not ended; None below nine tenths."""
    if episode.head < EVENTS_MANY or episode.ended_wall_ns is not None:
        return None
    share = episode.head * 100 // SEQUENCE_MAX
    return (
        f"episode {episode.number} ({episode.id}) has {episode.head:,} of {SEQUENCE_MAX:,} events ({share} %): it"
        " continues in a follow-up episode before the last of these"
    )


def warnings_of(episodes: Sequence[EpisodeRow]) -> dict[str, str]:
    """Return the warnings for these rows, by "numbers" or an episode's id."""
    last = max((each.number for each in episodes), default=0)
    warnings = {"numbers": number_warning(last)} | {each.id: events_warning(each) for each in episodes}
    return {subject: warning for subject, warning in warnings.items() if warning is not None}
