"""Make the cases of the episodes that this process records, before their events are in the tables.

Theory of operation. From the first recall on, a buffer of the event feed keeps the events of this process until the
next recall, which folds them as those of the log are folded. The first recall flushes, and reads the earlier events
of the open episodes from the log; so does one that finds events left out because the buffer was full. An episode to
which the database has not given a number yet has one from the end of the numbers, and its cases get the right one as
soon as it is known. Start and duration of such a case are those at which its events were published, some microseconds
later than those in the log; the reader takes the stored case as soon as there is one.
"""

from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from pycrorm_async import errors
from pycrorm_async.clock import Clock
from pycrorm_async.events.codec import encode
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, EpisodeId, episode_text, parse_episode_id, row_id, row_key
from pycrorm_async.events.types import EpisodeEnded
from pycrorm_async.projections.fold import decode_events
from pycrorm_async.recall.cases import READS, EpisodeCases
from pycrorm_async.recall.columns import Case
from pycrorm_async.record.episode_writer import Emitter
from pycrorm_async.record.event_feed import EventBuffer
from pycrorm_async.store.log import EventLog, episode_named
from pycrorm_async.store.stored import StoredEvent

_READS: Final = frozenset(each.__name__ for each in READS)
_EVENTS_MAX: Final = 100_000
"""Bounds the events between two recalls. Beyond it the open episodes are read from the log again."""


@dataclass(slots=True)
class _Running:
    """An episode that this process records.

    Attributes:
        number: that of the database, or while that is not known one from the end of the numbers.
        reached: the sequence of the last event that was folded.
        unnumbered: its cases that `ProcessCases.new` has not returned under the database's number yet.
    """

    id: str
    number: int
    is_numbered: bool
    fold: EpisodeCases = field(default_factory=EpisodeCases)
    reached: int = 0
    unnumbered: list[Case] = field(default_factory=list)
    has_ended: bool = False


@dataclass
class ProcessCases:
    """The cases of the episodes that one memory records. Implements `RunningCases`.

    Attributes:
        emitter: of the memory.
        open_episodes: returns the ids of the open episodes.
        flush: makes all events visible in the tables.
        log: returns the memory's log.
        clock: gives the times of published events.
    """

    emitter: Emitter
    open_episodes: Callable[[], Iterable[EpisodeId]]
    flush: Callable[[], Awaitable[None]]
    log: Callable[[], Awaitable[EventLog]]
    clock: Clock
    _buffer: EventBuffer | None = None
    _left_out: int = 0
    _episodes: dict[str, _Running] = field(default_factory=dict)
    _own_numbers: int = 0

    async def new(self) -> tuple[Sequence[Case], Sequence[Case]]:
        """Return the new cases of episodes with a number, and all cases of those that have none yet.

        Raises `CallerError` once the memory is closed.
        """
        if self.emitter.is_closed:
            raise errors.CallerError("the memory is closed, so nothing can be recalled from it: ask while it is open")
        cases: list[Case] = []
        if self._buffer is None:
            self._buffer = self.emitter.feed.keep(READS, _EVENTS_MAX, self.clock)
            cases += await self._read_open()
        elif self._buffer.left_out > self._left_out:
            self._left_out = self._buffer.left_out
            self._buffer.take()
            self._episodes.clear()
            cases += await self._read_open()
        for event, wall_ns, monotonic_ns in sorted(self._buffer.take(), key=lambda each: each.event[:2]):
            episode, sequence, happening, _ = event
            running = self._episodes.get(episode)
            if running is None and sequence == 1:
                self._own_numbers += 1
                running = _Running(episode, EPISODE_NUMBER_MAX + 1 - self._own_numbers, is_numbered=False)
                self._episodes[episode] = running
            if running is not None and sequence > running.reached and not running.has_ended:
                kind, payload = type(happening), encode(happening)
                identity = running.number, sequence, kind.__name__, kind.version
                running.unnumbered += self._read(running, [StoredEvent(*identity, wall_ns, monotonic_ns, payload)])
        cases += await self._numbered()
        return cases, [case for each in self._episodes.values() for case in each.unnumbered]

    async def _read_open(self) -> list[Case]:
        """Fold the earlier events of the open episodes; cases that are in the tables too are returned again."""
        with suppress(errors.EpisodeParked):  # `flush` and `status` report it; what is stored is folded here
            await self.flush()
        log = await self.log()
        cases: list[Case] = []
        for episode in self.open_episodes():
            if await log.episode_number(episode) is None:
                continue
            row = await episode_named(log, episode_text(episode))
            running = self._episodes[row.id] = _Running(row.id, row.number, is_numbered=True)
            async for page in log.pages(row):
                cases += self._read(running, page)
                if running.has_ended:
                    break
        return cases

    def _read(self, running: _Running, events: Sequence[StoredEvent]) -> Sequence[Case]:
        """Fold the next events from their payloads.

        An observed event itself has poses and references to objects where a decoded one has JSON.
        """
        happenings, undecodable = decode_events(events, _READS)
        decoded = [(event, each) for event, each in zip(events, happenings, strict=False) if each is not None]
        cases: list[Case] = []
        refused = running.fold.read(decoded, self.emitter.feed.declaration, cases)
        running.reached = events[-1].sequence
        # The fold of the tables parks the episode at an event that is undecodable or refused, with the reason.
        is_parked = undecodable is not None or refused is not None
        running.has_ended = is_parked or events[-1].type == EpisodeEnded.__name__
        return cases

    async def _numbered(self) -> list[Case]:
        """Return the cases of the episodes that have a number by now, and drop those episodes that have ended."""
        cases: list[Case] = []
        for episode, running in list(self._episodes.items()):
            if not running.is_numbered:
                number = await (await self.log()).episode_number(parse_episode_id(episode))
                if number is not None:
                    running.number, running.is_numbered = number, True
            if running.is_numbered:
                cases += [_renumbered(case, running.number) for case in running.unnumbered]
                running.unnumbered = []
                if running.has_ended:
                    del self._episodes[episode]
        return cases


def _renumbered(case: Case, number: int) -> Case:
    parent = None if case.parent is None else row_id(number, row_key(case.parent).sequence, 0)
    return case._replace(node=row_id(number, case.sequence, 0), parent=parent)
