"""Drain all recorders of a spool, living and dead, in a process of its own, and fold.

**Theory of operation.** All tasks run in one loop and one task group. The scan loop in `run` claims every folder that
can be drained and starts a drain task for it (`_serve`). The fold task folds whenever a drain has appended, and
publishes to each recorder how far its events are visible. On a server it also looks at intervals for events that other
processes appended or folded, because the processes that fold one memory share its episodes. The confirm task asks the
database every few seconds whether it still holds the last stored events, so that a log that went back is refilled even
while no recorder appends.

A recorder's name is in `_serving` from its claim to the release of its folder, and in `_rests` while a failed folder
waits for its next attempt. The scan excludes both, so each folder has at most one drain task. Processes exclude each
other by the folders' `drain` locks.

No task waits for another one's database call. `Availability` observes every call; while the database is
unavailable each task retries with pauses, and the recorders keep their events on disk. An error in one recorder's
folder ends only its drain task; an error in a fold is reported and retried while appending continues.

On `stop` the daemon claims no more folders and drains the records synced at that moment. After `STOP_S` it cancels
the remaining drain tasks. Draining may stop at any point: unacknowledged records stay in their folders for the next
daemon, and the log stores repeated records once. A release always runs to its end, also in a cancelled task, because
the next daemon, possibly in this process, needs the folder's lock.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Final, NamedTuple, TypeVar

from pycrorm_async import errors
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.writer import drain

STOP_S: Final = 10.0
"""Bounds the time of stopping. Records not stored by then stay in their folders for the next daemon."""
_SCAN_INTERVAL_S: Final = 0.2
"""Interval between two scans for folders, and so the delay until a new recorder is drained."""
_CONFIRM_S: Final = 5.0
"""Interval at which the database confirms the last stored events: one row, in a tenth of a millisecond."""
_LOOK_S: Final = (0.05, 0.5)
"""The shortest and longest interval between two looks for what other processes appended or folded: a tenth of the time
since there was anything to do. A look costs 0.15 ms."""
_REST = drain.Backoff(first_s=1.0, longest_s=60.0)
"""Pauses before the next attempt at a folder that could not be drained: a damaged one, or one without dead letters."""


class DaemonSummary(NamedTuple):
    """Numbers of recorders drained and released, and of records appended."""

    recorders: int
    records: int


class Daemon:
    """The daemon. Belongs to the loop that runs it. `report` gets one line per notable event.

    Folds with `fold_next_batch` of the destination, or of another object that has processes for that.
    """

    def __init__(
        self,
        destination: drain.StepwiseDestination,
        scan: drain.SourceScanner,
        *,
        settings: Settings,
        report: Callable[[str], None],
        fold_next_batch: Callable[[], Awaitable[bool]] | None = None,
        randomness: Callable[[], float] = random.random,
    ) -> None:
        self._destination = destination
        self._fold_next_batch = fold_next_batch or destination.fold_next_batch
        availability = Availability(now_s=self._now_s, on_lost=self._note_lost, on_back=self._note_back)
        self._observe = availability.observe
        self._scan = scan
        self._settings = settings
        self._report = report
        self._randomness = randomness
        self._serving: dict[str, VisibilityTracker] = {}
        self._rests: dict[str, tuple[int, float]] = {}  # by name: number of attempts, time of the next one
        self._appended_events = asyncio.Event()
        self._unavailable: str | None = None
        self._pending: str | None = None
        self._last_lines: dict[str, str] = {}  # by subject, the last line
        self._recorders = self._records = 0

    async def run(self, stop: asyncio.Event) -> DaemonSummary:
        """Run until `stop` is set; then drain the records synced at that moment, fold, and return.

        Returns at most `STOP_S` later unless a database call blocks; no record is lost by that. Raises `SpoolForeign`
        if the spool was bound to another database, and `DatabaseForeign` if the database was replaced by another.
        """
        foreign: errors.SpoolForeign | errors.DatabaseForeign | None = None
        async with asyncio.TaskGroup() as tasks:
            folding = tasks.create_task(self._fold_repeatedly(), name="pycrorm fold")
            confirming = tasks.create_task(self._confirm_repeatedly(), name="pycrorm confirm")
            drains: set[asyncio.Task[None]] = set()
            while not stop.is_set() and foreign is None:
                try:
                    for source in await self._claim_sources():
                        task = tasks.create_task(self._serve(source), name=f"pycrorm drain {source.name}")
                        drains.add(task)
                        task.add_done_callback(drains.discard)
                except (errors.SpoolForeign, errors.DatabaseForeign) as error:
                    foreign = error
                await _wait(stop, _SCAN_INTERVAL_S)
            for each in self._serving.values():
                each.source.finish()
            if drains:
                patience_s = 0.0 if isinstance(foreign, errors.DatabaseForeign) else STOP_S
                _, late = await asyncio.wait(drains, timeout=patience_s)
                for task in late:
                    task.cancel()
                if late and foreign is None:
                    self._report(f"not finished after {STOP_S:g} s: the remaining events are safe in the spool")
            folding.cancel()
            confirming.cancel()
        if foreign is not None:
            raise foreign
        return DaemonSummary(self._recorders, self._records)

    # --- claiming ----------------------------------------------------------------------------------------

    async def _claim_sources(self) -> list[drain.ClaimedSource]:
        now_s = self._now_s()
        resting = {name for name, (_, until_s) in self._rests.items() if until_s > now_s}
        excluded = self._serving.keys() | resting
        if not self._scan.is_due(excluded):
            return []
        result = drain.ScanResult([], {})

        def scan() -> None:
            nonlocal result
            result = self._scan(excluded)

        try:
            await drain.run_to_completion(asyncio.to_thread(scan))
        except asyncio.CancelledError:
            for source in result.held:  # free for the next daemon, possibly in this process
                with suppress(errors.PycrormError):
                    source.release()
            raise
        except errors.SpoolForeign:
            raise
        except errors.FilesError as error:
            self._report_if_new(f"cannot scan for recorders: {error}", "scan")
            return []
        self._last_lines.pop("scan", None)
        for name, fault in result.failed.items():
            self._rest(name, str(fault))
        return list(result.held)

    def _rest(self, name: str, reason: str, *, retried: bool = True) -> None:
        attempt = self._rests.get(name, (0, 0.0))[0] + 1
        pause_s = _REST.pause_s(attempt, self._randomness()) if retried else math.inf
        assert pause_s is not None, "retries never end"
        self._rests[name] = attempt, self._now_s() + pause_s
        then = "retrying with pauses" if retried else "the next writer retries"
        self._report_if_new(f"recorder {name}: {reason}; {then}", f"{name} rests")

    # --- one recorder -----------------------------------------------------------------------------------------

    async def _serve(self, source: drain.ClaimedSource) -> None:
        name = source.name
        tracker = VisibilityTracker(
            source,
            self._append,
            settings=self._settings,
            on_append=self._appended_events.set,
            report=lambda line: self._report_if_new(line, name),
        )
        self._serving[name] = tracker
        if name not in self._rests:
            self._report(f"recorder {name} " + ("appeared" if source.is_alive else "is dead: recovering its folder"))
        fault: str | None = None
        try:
            if self._unavailable is not None:
                source.mark_unavailable(self._unavailable)
            if self._pending is not None:
                tracker.mark_pending(self._pending)
            await tracker.run()
        except Exception as error:  # noqa: BLE001 - reported and retried; must not stop the other recorders
            fault = one_line(error)
        finally:
            await drain.run_to_completion(self._release(tracker, fault))

    async def _append(self, records: Sequence[Record], on_wait: Callable[[], None]) -> Mapping[EpisodeId, str]:
        return await self._observe(self._destination.append(records, on_wait))

    async def _release(self, tracker: VisibilityTracker, fault: str | None) -> None:
        name, state, retried = tracker.source.name, tracker.drain.state, True
        try:
            outcome = await asyncio.to_thread(tracker.source.release)
            retried = outcome is not None or not tracker.source.holds_dead_letters
            if fault is None and outcome is None:
                fault = next(
                    (f"episode {episode} {why}" for episode, why in state.refused.items()), "not all events are stored"
                )
            if fault is None:
                self._report(f"recorder {name} {outcome}; {state.records} events stored")
        except errors.PycrormError as error:
            fault = fault or str(error)
        del self._serving[name]
        self._recorders += 1
        self._records += state.records
        if fault is None:
            self._rests.pop(name, None)
            self._last_lines.pop(name, None)
            self._last_lines.pop(f"{name} rests", None)
        else:
            self._rest(name, fault, retried=retried)

    # --- the tables -------------------------------------------------------------------------------------------

    async def _fold_repeatedly(self) -> None:
        self._appended_events.set()  # an earlier process may have left events unfolded
        attempt = 0
        busy_s = self._now_s()
        while True:
            if self._destination.has_other_writers:
                await _wait(self._appended_events, min(max(_LOOK_S[0], (self._now_s() - busy_s) / 10), _LOOK_S[1]))
            else:
                await self._appended_events.wait()
            try:
                more = self._appended_events.is_set() or await self._observe(self._destination.has_unfolded())
                self._appended_events.clear()
                busy_s = self._now_s() if more else busy_s
                if not more:
                    await self._publish_visibility()  # of what other processes folded
                while more:
                    more = await self._observe(self._fold_next_batch())
                    self._publish_pending(None)
                    await self._publish_visibility()
            except Exception as error:  # noqa: BLE001 - reported and retried; appending continues
                attempt += 1
                if isinstance(error, errors.TablesPending):
                    self._publish_pending(str(error))
                if not isinstance(error, errors.DatabaseUnavailable):
                    self._report_if_new(f"the tables cannot be brought up to date: {one_line(error)}", "fold")
                self._appended_events.set()
                await asyncio.sleep(drain.PATIENT.pause_s(attempt, self._randomness()) or 0.0)
            else:
                attempt = 0
                self._last_lines.pop("fold", None)

    async def _confirm_repeatedly(self) -> None:
        """Detect and refill a log that went back, also while no recorder appends."""
        while True:
            try:
                await self._observe(self._destination.confirm())
                self._last_lines.pop("confirm", None)
            except Exception as error:  # noqa: BLE001 - reported and retried
                if not isinstance(error, errors.DatabaseUnavailable):
                    self._report_if_new(f"stored events cannot be confirmed: {one_line(error)}", "confirm")
            await asyncio.sleep(_CONFIRM_S)

    async def _publish_visibility(self) -> None:
        if not any(each.has_invisible for each in self._serving.values()):
            return
        before = {each: each.drain.state.appended for each in self._serving.values()}
        behind = await self._observe(self._destination.behind())
        stopped = await self._observe(self._destination.stopped())
        self._publish(lambda each: each.note(before[each], behind, stopped), before)

    def _publish_pending(self, reason: str | None) -> None:
        if reason != self._pending:
            self._pending = reason
            self._publish(lambda each: each.mark_pending(reason), self._serving.values())

    def _publish(self, publish: Callable[[VisibilityTracker], None], trackers: Iterable[VisibilityTracker]) -> None:
        for tracker in trackers:
            try:
                publish(tracker)
            except errors.FilesError as error:  # the drain meets the same disk error and reports it
                self._report(f"recorder {tracker.source.name}: {error}")

    # --- reports --------------------------------------------------------------------------------------

    def _note_lost(self, reason: str) -> None:
        self._report(f"the database is unavailable: {reason}; retrying")
        self._publish_availability(reason)

    def _note_back(self, after_s: float) -> None:
        self._report(f"the database is available again after {after_s:.1f} s")
        self._publish_availability(None)

    def _publish_availability(self, reason: str | None) -> None:
        self._unavailable = reason
        self._publish(lambda each: each.source.mark_unavailable(reason), self._serving.values())

    def _report_if_new(self, line: str, about: str) -> None:
        """Report a line unless it was the last one about this subject."""
        if self._last_lines.get(about) != line:
            self._last_lines[about] = line
            self._report(line)

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()


async def _wait(event: asyncio.Event, seconds: float) -> None:
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return


def one_line(error: BaseException) -> str:
    """Return the message in one line, with the class of an error that is not of this package."""
    text = " ".join(str(error).split())
    return text if isinstance(error, errors.PycrormError) else f"{type(error).__name__}: {text}"


# === availability =============================================================================================
#
# Report when a database becomes unavailable and available again.

_T = TypeVar("_T")
_NOTABLE_S = 1.0
"""A database that has not answered for less than this is not reported: a deadlock or a quick restart."""


class Availability:
    """Calls `on_lost` with the reason when the database is unavailable, `on_back` with the seconds when it is back."""

    def __init__(
        self, *, now_s: Callable[[], float], on_lost: Callable[[str], None], on_back: Callable[[float], None]
    ) -> None:
        self._now_s = now_s
        self._on_lost = on_lost
        self._on_back = on_back
        self._unanswered_since_s: float | None = None
        self._reported = False

    async def observe(self, call: Awaitable[_T]) -> _T:
        """Await a call of the database, and note whether it answered."""
        called_s = self._now_s()
        try:
            result = await call
        except errors.DatabaseUnavailable as error:
            if self._unanswered_since_s is None:
                self._unanswered_since_s = called_s
            if not self._reported and self._now_s() - self._unanswered_since_s >= _NOTABLE_S:
                self._reported = True
                self._on_lost(str(error))
            raise
        since_s = self._unanswered_since_s
        if since_s is not None and called_s >= since_s:  # else it was called before the database became unavailable
            self._unanswered_since_s = None
            if self._reported:
                self._reported = False
                self._on_back(self._now_s() - since_s)
        return result


# === visibility ===============================================================================================
#
# Drain one recorder for a daemon, and track which of its records are visible in the tables.

_BATCHES_MAX = 256
"""Bounds the batches tracked separately, so that memory stays flat while the tables lag; later ones are merged."""


class VisibilityTracker:
    """Drains a claimed source and notes the batches, so that it can publish their visibility.

    Visibility comes from the log, per episode, so it does not matter which process folded.
    """

    def __init__(
        self,
        source: drain.ClaimedSource,
        append: drain.Append,
        *,
        settings: Settings,
        on_append: Callable[[], None],
        report: Callable[[str], None],
    ) -> None:
        self.source = source
        self.drain = drain.Drain(source, append, settings=settings, on_append=self._track, report=report)
        self._on_append = on_append
        # Of each batch its last position, and each episode's last sequence up to it.
        self._invisible: deque[tuple[int, dict[str, int]]] = deque()
        self._stopped: dict[str, str] = {}
        self._updated = asyncio.Event()
        self._is_pending = False

    @property
    def has_invisible(self) -> bool:
        """Whether appended records are not published as visible yet."""
        return bool(self._invisible)

    async def run(self) -> None:
        """Run until the folder is drained and all its records are visible, or the tables wait for a rebuild.

        Raises as `Drain.run` does.
        """
        await self.drain.run()
        while self._invisible and not self._is_pending:
            self._updated.clear()
            await self._updated.wait()

    def note(self, appended: int, behind: Mapping[str, int], stopped: Mapping[str, str]) -> None:
        """Publish to the recorder which records are visible.

        Args:
            appended: position of the last appended record before `behind` and `stopped` were read.
            behind: by id, the folded sequence of each episode with events that are not visible yet.
            stopped: by id, the reason why an episode is refused or parked.
        """
        visible_to, stopped = 0, {**self.drain.state.refused, **stopped}
        while self._invisible and self._invisible[0][0] <= appended:
            position, lasts = self._invisible[0]
            if any(behind.get(episode, last) < last for episode, last in lasts.items()):
                break
            self._stopped |= {episode: stopped[episode] for episode in lasts if episode in stopped}
            self._invisible.popleft()
            visible_to = position
        if visible_to:
            self.source.mark_visible(visible_to, self._stopped)
            self._updated.set()

    def mark_pending(self, reason: str | None) -> None:
        """Publish to the recorder why its stored records are not visible. Raises `FilesError`."""
        self._is_pending = reason is not None
        self._updated.set()
        self.source.mark_pending(reason)

    def _track(self, batch: Sequence[Record]) -> None:
        by_id = {each.episode: each.sequence for each in batch if each.episode is not None}
        lasts = {episode_text(episode): last for episode, last in by_id.items()}
        if len(self._invisible) >= _BATCHES_MAX:
            _, before = self._invisible.pop()
            lasts = before | lasts
        self._invisible.append((batch[-1].position, lasts))
        self._on_append()
