"""Compute the task tree and the world of an episode at any moment by folding its events up to then.

It reads the log and not the tables, which contain only the final state of each node. So it also works for events that
are not folded yet, and for parked episodes. It reads no further than one page beyond the moment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, TypeAlias

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged, PycrormError, UnknownEpisode
from pycrorm_async.events.codec import description_of
from pycrorm_async.events.types import EVENT_TYPES, DescriptionDeclared
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.query.snapshot_fold import MomentFold
from pycrorm_async.store.episode_lookup import episode_named
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import StoredEvent

if TYPE_CHECKING:
    from pycrorm_async.hooks.episode import Episode

AnyEpisode: TypeAlias = "int | str | Episode | EpisodeSummary"
"""An episode by its number, its id or the first digits of it, `last`, or as an `Episode` or `EpisodeSummary`."""

_NUMBERS_END = 1e15
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_Within: TypeAlias = Callable[[StoredEvent, StoredEvent], bool]
"""Takes the episode's first event and another event; returns whether the other is not later than the moment."""


async def as_of(
    log: EventLog,
    episode: AnyEpisode,
    *,
    time: float | datetime | None = None,
    sequence: int | None = None,
    meshes: bool = False,
) -> Moment:
    """Return the episode's state at a moment; see `Reading.as_of`."""
    limit, within = _limit(time, sequence)
    row = await episode_named(log, str(episode.number if isinstance(episode, EpisodeSummary) else episode))
    if row.head == 0:
        raise UnknownEpisode(f"the log has no event of episode {row.number}")
    fold = MomentFold(row.number, row.id)
    async for page in log.pages(row):
        if not _read(fold, page, within, log):
            break
    if fold.first is None:
        raise CallerError(f"{limit} is before episode {row.number} began")
    payloads = await log.descriptions(fold.descriptions)
    descriptions = {name: _description(payload) for name, payload in payloads.items()}
    return fold.moment(await log.dtypes(), descriptions, await _meshes(log, descriptions.values()) if meshes else {})


async def _meshes(log: EventLog, descriptions: Iterable[DescriptionDeclared]) -> dict[str, bytes]:
    """Read the mesh files that are recorded; one that is missing or damaged in the log is left out."""
    recorded = {mesh.content.hash for each in descriptions for mesh in each.meshes if mesh.content is not None}
    with log.translated():
        contents = {name: await log.blobs.read_blob(name) for name in recorded}
    return {name: content for name, content in contents.items() if content is not None}


def _description(payload: bytes) -> DescriptionDeclared:
    """Decode a description; one that this version cannot read is missing, with the reason."""
    try:
        return description_of(payload)
    except ValueError as error:
        return DescriptionDeclared(missing=f"it cannot be read: {error}")


def _read(fold: MomentFold, page: Sequence[StoredEvent], within: _Within, log: EventLog) -> bool:
    """Fold the events of a page up to the moment; return whether the next page may have more."""
    for event in page:
        if not within(fold.first if fold.first is not None else event, event):
            return False
        try:
            fold.read(event)
        except CannotFold as reason:
            raise unreadable(fold.id, event, str(reason), log) from None
    return True


def _limit(time: float | datetime | None, sequence: int | None) -> tuple[str, _Within]:
    """Return the moment as text and as a condition. Raises `CallerError`."""
    if (time is None) == (sequence is None):
        raise CallerError("a moment needs either a time or the sequence of an event: pass exactly one of them")
    if sequence is not None:
        last = _number(sequence, Integral)
        if last is None:
            raise CallerError(f"sequence must be an integer, got {sequence!r}")
        return f"event {last:.0f}", lambda _, event: event.sequence <= last
    if isinstance(time, datetime):
        if time.utcoffset() is None:
            raise CallerError(f"{time!r} has no time zone: add one, for example .replace(tzinfo=UTC)")
        wall_us = (time - _EPOCH) // timedelta(microseconds=1)
        return time.isoformat(" "), lambda _, event: event.wall_ns // 1000 <= wall_us
    seconds = _number(time, Real)
    if seconds is None:
        raise CallerError(f"time must be seconds since the episode's start or a datetime, got {time!r}")
    since_ns = round(seconds * 1e9)
    return f"{seconds:g} s", lambda first, event: event.monotonic_ns - first.monotonic_ns <= since_ns


def parse_moment(text: str, option: str = "at") -> tuple[float | None, int | None]:
    """Parse the text of a moment as seconds or as the sequence of an event. Raises `CallerError`.

    >>> parse_moment("12.5"), parse_moment("e300"), parse_moment("#300")
    ((12.5, None), (None, 300), (None, 300))
    """
    try:
        return (None, int(text[1:])) if text[:1] in ("e", "#") else (float(text), None)
    except ValueError:
        raise CallerError(
            f"{option} takes seconds since the episode's start, or an event such as e300, got {text!r}"
        ) from None


def _number(value: Any, kind: type) -> float | None:
    """Return a Python or NumPy number as a float; None if it is not finite or of another kind."""
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) < _NUMBERS_END else None


def unreadable(episode: str, event: StoredEvent, reason: str, log: EventLog) -> PycrormError:
    """Return the error for an event that cannot be folded: of a newer version, or damaged."""
    shape = EVENT_TYPES.get(event.type)
    if shape is not None and event.version <= shape.version:
        return LogDamaged(episode, event.sequence, reason)
    return DatabaseForeign(
        f"{log.address}: episode {episode}, event {event.sequence}: {reason}: use a newer pycrorm, or ask for a moment"
        f" before event {event.sequence}"
    )
