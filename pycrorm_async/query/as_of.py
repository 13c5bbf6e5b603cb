"""As-of: the task tree and the world of an episode at any moment, folded from its events up to then.

The log is asked and not the tables, which show only how each node ended. So it also answers for what the tables do not
show yet, or never will (parked episodes); and it reads hardly further than the moment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged, PycrormError, UnknownEpisode
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.events.types import EVENT_TYPES
from pycrorm_async.projections.fold.fold import CannotFold
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.query.snapshot_fold import MomentFold
from pycrorm_async.store.episode_lookup import episode_named
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import StoredEvent

if TYPE_CHECKING:
    from pycrorm_async.hooks.episode import Episode

__all__ = ["AnyEpisode", "as_of"]

AnyEpisode: TypeAlias = "int | str | Episode | EpisodeSummary"
"""An episode by its number, its id or the first digits of it, `last`, or as what was opened or listed."""

_NUMBERS_END = 1e15
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_Within: TypeAlias = Callable[[StoredEvent, StoredEvent], bool]
"""Whether the second event had happened by the moment; the first is the episode's first."""


async def as_of(
    log: EventLog, episode: AnyEpisode, *, time: float | datetime | None = None, sequence: int | None = None
) -> Moment:
    """The episode as it was then; see `Reading.as_of`."""
    asked, within = _limit(time, sequence)
    found = await episode_named(log, str(episode.number if isinstance(episode, EpisodeSummary) else episode))
    if found.head == 0:
        raise UnknownEpisode(f"nothing of episode {found.number} is in the log")
    then = MomentFold(found.number, found.id)
    async for page in log.pages(found):
        if not _read(then, page, within, log):
            break
    if then.first is None:
        raise CallerError(f"{asked} is before episode {found.number} began")
    return then.moment(
        {fingerprint(each): msgspec.json.decode(each, type=_Named).dtype for each in await log.declarations()}
    )


class _Named(msgspec.Struct):
    """What every version of a declaration says, also one that this program cannot read otherwise."""

    dtype: str


def _read(then: MomentFold, page: Sequence[StoredEvent], within: _Within, log: EventLog) -> bool:
    """Whether all of them had happened by the moment."""
    for event in page:
        if not within(then.first if then.first is not None else event, event):
            return False
        try:
            then.read(event)
        except CannotFold as reason:
            raise _unreadable(then.id, event, str(reason), log) from None
    return True


def _limit(time: float | datetime | None, sequence: int | None) -> tuple[str, _Within]:
    """What is asked for, in words, and as what is within it. Raises `CallerError`."""
    if (time is None) == (sequence is None):
        raise CallerError("a moment is asked for by its time or by the sequence of an event: give one of the two")
    if sequence is not None:
        last = _number(sequence, Integral)
        if last is None:
            raise CallerError(f"the sequence of an event is a whole number, not {sequence!r}")
        return f"event {last:.0f}", lambda _, event: event.sequence <= last
    if isinstance(time, datetime):
        if time.utcoffset() is None:
            raise CallerError(f"{time!r} has no time zone: say which, e.g. .replace(tzinfo=UTC)")
        wall_us = (time - _EPOCH) // timedelta(microseconds=1)
        return time.isoformat(" "), lambda _, event: event.wall_ns // 1000 <= wall_us
    seconds = _number(time, Real)
    if seconds is None:
        raise CallerError(f"a time is seconds since the episode's start, or a datetime, not {time!r}")
    since_ns = round(seconds * 1e9)
    return f"{seconds:g} s", lambda first, event: event.monotonic_ns - first.monotonic_ns <= since_ns


def _number(value: Any, kind: type) -> float | None:
    """As a number, also if it is NumPy's; None if it is no finite one of that kind."""
    right = isinstance(value, kind) and not isinstance(value, bool)
    return float(value) if right and abs(value) < _NUMBERS_END else None


def _unreadable(episode: str, event: StoredEvent, reason: str, log: EventLog) -> PycrormError:
    known = EVENT_TYPES.get(event.type)
    if known is not None and event.version <= known.version:
        return LogDamaged(episode, event.sequence, reason)
    return DatabaseForeign(
        f"{log.address}: episode {episode}, event {event.sequence}: {reason}: a newer version of this program can tell"
        f" what came then; this one, what was before event {event.sequence}"
    )
