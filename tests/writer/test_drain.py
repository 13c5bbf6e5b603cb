"""Drain a source into the log: batches, outages reported once, retries, and drains that run once."""

from __future__ import annotations

import asyncio
import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import DatabaseUnavailable, LogDamaged, SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.settings import Settings
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.daemon import Availability
from pycrorm_async.writer.drain import Backoff, Drain, drain_once, run_to_completion
from tests.databases import ask
from tests.store.factories import episode, record, run_of
from tests.writer.fakes import CountingFold, ForwardingDestination, KeptSource, LosesReplies

TENS = Settings(batch_events_max=10)
STORED = "SELECT episode, count(*), min(sequence), max(sequence) FROM event GROUP BY episode ORDER BY episode"


def name(number: int) -> str:
    return f"00000000-0000-0000-0000-{number:012x}"


async def at_once(_: float) -> None:
    """Sleep without waiting."""


async def test_a_stored_record_is_deleted_from_the_source(log: EventLog) -> None:
    source = KeptSource(run_of(episode(1), 1, 25), closed=True)
    drain = Drain(source, log.append, settings=TENS)
    await drain.run()
    assert ask(log.address.path, STORED) == [(1, 25, 1, 25)]
    assert source.acknowledgements == [10, 20, 25]
    assert drain.state == ("robot", 25, 3, 0, None, None, 25, 25, {})


async def test_a_batch_is_acknowledged_after_it_is_committed_and_before_the_next_is_appended(
    log: EventLog,
) -> None:
    seen: list[str] = []

    class NotingLog(ForwardingDestination):
        async def append(self, *batch: Any, **options: Any) -> Mapping[EpisodeId, str]:
            seen.append(f"append to {batch[0][-1].position} with {source.acknowledgements} acknowledged")
            return await super().append(*batch, **options)

    class NotingSource(KeptSource):
        async def acknowledge(self, position: int) -> None:
            [[stored]] = ask(log.address.path, "SELECT count(*) FROM event")
            seen.append(f"acknowledge {position} with {stored} stored")
            await super().acknowledge(position)

    source = NotingSource(run_of(episode(1), 1, 20), closed=True)
    await Drain(source, NotingLog(CountingFold(log)).append, settings=TENS).run()
    assert seen == [
        "append to 10 with [] acknowledged",
        "acknowledge 10 with 10 stored",
        "append to 20 with [10] acknowledged",
        "acknowledge 20 with 20 stored",
    ]


class StoringLog(ForwardingDestination):
    """Say that a server stores each batch, and store it only then; twice, as an append that is repeated does."""

    async def append(
        self, records: Sequence[Record], on_wait: Callable[[], None] = lambda: None
    ) -> Mapping[EpisodeId, str]:
        for _ in range(2):
            on_wait()
            await asyncio.sleep(0)
        return await super().append(records)


async def test_the_next_batch_is_read_once_while_a_server_stores_this_one(log: EventLog) -> None:
    seen: list[str] = []

    class NotingSource(KeptSource):
        async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
            batch = await super().get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
            seen.append(f"read to {batch[-1].position}" if batch else "read nothing")
            return batch

        async def acknowledge(self, position: int) -> None:
            seen.append(f"acknowledge {position}")
            await super().acknowledge(position)

    source = NotingSource(run_of(episode(1), 1, 25), closed=True)
    await Drain(source, StoringLog(CountingFold(log)).append, settings=TENS).run()
    assert seen[:4] == ["read to 10", "read to 20", "acknowledge 10", "read to 25"]
    assert seen[4:] == ["acknowledge 20", "read nothing", "acknowledge 25"]
    assert ask(log.address.path, STORED) == [(1, 25, 1, 25)]


async def test_damage_that_is_met_while_a_server_stores_a_batch_is_raised_when_that_batch_is_acknowledged(
    log: EventLog,
) -> None:
    class DamagedSource(KeptSource):
        async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
            if self._given:
                raise SpoolDamaged(Path("00000001.segment"), 64, "its checksum is wrong")
            return await super().get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)

    source = DamagedSource(run_of(episode(1), 1, 25))
    with pytest.raises(SpoolDamaged):
        await Drain(source, StoringLog(CountingFold(log)).append, settings=TENS).run()
    assert source.acknowledgements == [10]
    assert ask(log.address.path, STORED) == [(1, 10, 1, 10)]


async def test_a_commit_whose_reply_is_lost_is_stored_once(log: EventLog) -> None:
    source = KeptSource(run_of(episode(1), 1, 25), closed=True)
    drain = Drain(source, LosesReplies(CountingFold(log)).append, settings=TENS, sleep=at_once)
    await drain.run()
    assert ask(log.address.path, STORED) == [(1, 25, 1, 25)]
    assert source.acknowledgements == [10, 20, 25]
    assert (drain.state.retries, drain.state.records, drain.state.unavailable) == (3, 25, None)
    assert drain.state.last_error == "the connection was closed before the reply came"


async def test_an_append_to_a_locked_database_is_retried_and_loses_nothing(
    log: EventLog,
) -> None:
    holder = sqlite3.connect(log.address.path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    source = KeptSource(run_of(episode(1), 1, 25), closed=True)
    pauses_s: list[float] = []
    away: list[str | None] = []

    async def sleep(pause_s: float) -> None:
        pauses_s.append(pause_s)
        away.append(drain.state.unavailable)
        if len(pauses_s) == 3:
            assert source.acknowledgements == []
            holder.execute("ROLLBACK")

    drain = Drain(
        source,
        log.append,
        settings=TENS,
        backoff=Backoff(first_s=1.0, longest_s=60.0),
        randomness=lambda: 1.0,
        sleep=sleep,
    )
    await drain.run()
    holder.close()
    assert pauses_s == [1.0, 2.0, 4.0]
    assert away == [f"{log.address}: database is locked"] * 3
    assert ask(log.address.path, STORED) == [(1, 25, 1, 25)]
    assert source.kept == []


async def test_a_drain_with_limited_retries_raises_and_its_source_keeps_everything(log: EventLog) -> None:
    holder = sqlite3.connect(log.address.path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    source = KeptSource(run_of(episode(1), 1, 25), closed=True)
    backoff = Backoff(first_s=1.0, longest_s=1.0, attempts_max=2)
    drain = Drain(source, log.append, settings=TENS, backoff=backoff, sleep=at_once)
    with pytest.raises(DatabaseUnavailable):
        await drain.run()
    holder.close()
    assert source.kept == list(range(1, 26))
    assert drain.state.retries == 2
    assert source.given_up == [f"the writer stopped: {log.address}: database is locked"]


async def test_refused_records_become_dead_letters_before_they_are_acknowledged_and_the_others_are_stored(
    log: EventLog, caplog: pytest.LogCaptureFixture
) -> None:
    class NotingSource(KeptSource):
        async def acknowledge(self, position: int) -> None:
            assert self.aside is not None
            seen.append((position, [each.sequence for each in self.aside]))
            await super().acknowledge(position)

    seen: list[tuple[int, list[int]]] = []
    source = NotingSource(
        [
            *run_of(episode(1), 1, 4, position=1),
            *run_of(episode(1), 6, 9, position=5),
            *run_of(episode(2), 1, 10, position=9),
            *run_of(episode(1), 10, 11, position=19),
        ],
        closed=True,
    )
    drain = Drain(source, log.append, settings=TENS)
    await drain.run()
    assert seen == [(10, [1, 2, 3, 4, 6, 7, 8, 9]), (20, [1, 2, 3, 4, 6, 7, 8, 9, 10, 11])]
    assert (source.kept, source.given_up, drain.state.acknowledged, drain.state.records) == ([], [], 20, 10)
    reason = "event 5 did not arrive before event 6"
    assert drain.state.refused == {name(1): reason}
    assert ask(log.address.path, STORED) == [(1, 4, 1, 4), (2, 10, 1, 10)]
    assert [(each.levelname, each.getMessage()) for each in caplog.records] == [
        ("ERROR", f"recorder robot: episode {name(1)} was refused: {reason}; its events are kept in the spool")
    ]


async def test_a_refused_record_that_stays_in_the_source_stops_all_acknowledgements(log: EventLog) -> None:
    broken = [*run_of(episode(1), 1, 4, position=11), *run_of(episode(1), 6, 9, position=15)]
    records = [
        *run_of(episode(2), 1, 10, position=1),
        *broken,  # positions 11 to 18, in the second batch
        *run_of(episode(2), 11, 30, position=19),
    ]
    source = KeptSource(records, closed=True, stays=True)
    drain = Drain(source, log.append, settings=TENS)
    await drain.run()
    assert source.given_up == []
    reason = "event 5 did not arrive before event 6"
    assert drain.state.refused == {name(1): reason}
    assert ask(log.address.path, STORED) == [(1, 30, 1, 30), (2, 4, 1, 4)]
    assert source.acknowledgements == [10]
    assert drain.state.appended == 38
    assert source.kept == list(range(11, 39))
    assert [(row.id, row.refused) for row in await log.stopped()] == [(name(1), reason)]

    again = source.reopened()
    await Drain(again, log.append, settings=TENS).run()
    assert again.kept == list(range(11, 39))

    await log.append([record(episode(1), 5)])  # the missing event arrives
    last = source.reopened()
    await Drain(last, log.append, settings=TENS).run()
    assert last.kept == []
    assert ask(log.address.path, STORED) == [(1, 30, 1, 30), (2, 9, 1, 9)]
    assert await log.stopped() == []


async def test_a_source_without_dead_letters_is_reported_at_once_and_only_once(
    log: EventLog, caplog: pytest.LogCaptureFixture
) -> None:
    class Full(KeptSource):
        def dead_letter(self, records: Sequence[Record]) -> bool:
            raise SpoolUnavailable(Path("/spool/1.refused"), "No space left on device")

    source = Full([*run_of(episode(1), 1, 4), *run_of(episode(1), 6, 9, position=5)])
    running = asyncio.create_task(Drain(source, log.append, settings=TENS).run())
    refused = (
        f"episode {name(1)} was refused: event 5 did not arrive before event 6;"
        " its events cannot be kept as dead letters: spool /spool/1.refused: No space left on device"
    )
    async with asyncio.timeout(60):
        while not source.given_up:  # noqa: ASYNC110 - what is waited for is not ours to signal
            await asyncio.sleep(0.001)
    source.put([*run_of(episode(1), 11, 12, position=9), *run_of(episode(2), 1, 20, position=11)])
    source.close()
    await running
    assert source.kept == list(range(1, 31))
    assert source.given_up == [refused]
    assert [(each.levelname, each.getMessage()) for each in caplog.records] == [
        ("ERROR", f"recorder robot gets no further acknowledgements: {refused}")
    ]


async def test_damage_ends_the_drain_and_nothing_of_its_batch_is_acknowledged(
    log: EventLog, caplog: pytest.LogCaptureFixture
) -> None:
    await log.append([record(episode(1), 15, payload=b"{}")._replace(sequence=1)])
    source = KeptSource([*run_of(episode(2), 1, 10), *run_of(episode(1), 1, 10, position=11)], closed=True)
    with pytest.raises(LogDamaged):
        await Drain(source, log.append, settings=TENS).run()
    assert source.kept == list(range(11, 21))
    assert ask(log.address.path, STORED) == [(1, 1, 1, 1), (2, 10, 1, 10)]
    damage = f"the writer stopped: episode {name(1)}, event 1: another event is stored under this number already"
    assert source.given_up == [damage]
    assert caplog.records == []  # the caller of the drain reports the error


async def test_a_waiter_for_a_position_learns_when_it_is_stored_or_that_it_never_will_be(log: EventLog) -> None:
    source = KeptSource(run_of(episode(1), 1, 10))
    drain = Drain(source, log.append, settings=TENS)
    running = asyncio.create_task(drain.run())
    assert await drain.reached(10)
    waiting = asyncio.create_task(drain.reached(12))
    source.put(run_of(episode(1), 11, 11))
    source.close()
    await running
    assert not await waiting
    assert await drain.reached(11)


class Points:
    """The points at which the drain is suspended, so that a cancellation can arrive there."""

    def __init__(self, wanted: str, times: int) -> None:
        self._wanted, self._times = wanted, times
        self.reached = asyncio.Event()

    async def pause_at(self, point: str) -> None:
        if point == self._wanted:
            self._times -= 1
            if self._times == 0:
                self.reached.set()
        await asyncio.sleep(0)


class PausingLog(ForwardingDestination):
    def __init__(self, log: EventLog, points: Points) -> None:
        super().__init__(CountingFold(log))
        self._points = points

    async def append(
        self, records: Sequence[Record], on_wait: Callable[[], None] = lambda: None
    ) -> Mapping[EpisodeId, str]:
        on_wait()
        await self._points.pause_at("before append")
        refusals = await super().append(records)
        await self._points.pause_at("after append")
        return refusals


class PausingSource(KeptSource):
    points: Points

    async def acknowledge(self, position: int) -> None:
        await self.points.pause_at("before acknowledge")
        await super().acknowledge(position)
        await self.points.pause_at("after acknowledge")


@pytest.mark.parametrize("point", ["before append", "after append", "before acknowledge", "after acknowledge"])
@pytest.mark.parametrize("times", [1, 2])
async def test_a_drain_cancelled_at_any_point_loses_nothing(log: EventLog, point: str, times: int) -> None:
    source = PausingSource(run_of(episode(1), 1, 25), closed=True)
    source.points = Points(point, times)
    running = asyncio.create_task(Drain(source, PausingLog(log, source.points).append, settings=TENS).run())
    await source.points.reached.wait()
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running
    # The batch that was being appended when the drain was cancelled reached the log completely.
    assert ask(log.address.path, STORED) == [(1, 10 * times, 1, 10 * times)]
    rest = source.reopened()
    assert rest.kept[0] == (10 * times + 1 if point == "after acknowledge" else 10 * (times - 1) + 1)
    await Drain(rest, log.append, settings=TENS).run()
    assert ask(log.address.path, STORED) == [(1, 25, 1, 25)]
    assert rest.kept == []


async def test_uninterruptible_work_is_completed_even_when_it_is_cancelled_twice() -> None:
    may_end, ended = threading.Event(), threading.Event()

    def work() -> None:
        may_end.wait(30)
        ended.set()

    task = asyncio.create_task(run_to_completion(asyncio.to_thread(work)))
    for _ in range(3):
        await asyncio.sleep(0.01)
        task.cancel()
        task.cancel()  # a task group that ends cancels a task that was already cancelled directly
    await asyncio.sleep(0.01)
    assert not task.done()
    may_end.set()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert ended.is_set()


# === availability =============================================================================================
#
# An outage of the database is reported once when it has lasted a second, and so is its end.


class Observed:
    """A database whose calls take a given time by a clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.reports: list[str | float] = []
        self.availability = Availability(
            now_s=lambda: self.now_s, on_lost=self.reports.append, on_back=self.reports.append
        )

    async def call(self, *, takes_s: float = 0.0, fails: bool = False) -> int:
        async def answer() -> int:
            self.now_s += takes_s
            if fails:
                raise DatabaseUnavailable(f"away at {self.now_s:g} s")
            return 7

        return await self.availability.observe(answer())

    async def fail(self, *, takes_s: float = 0.0) -> None:
        with pytest.raises(DatabaseUnavailable):
            await self.call(takes_s=takes_s, fails=True)


async def test_an_outage_shorter_than_a_second_is_not_reported() -> None:
    observed = Observed()
    await observed.fail(takes_s=0.5)
    await observed.fail(takes_s=0.4)
    assert await observed.call() == 7
    await observed.fail(takes_s=0.9)  # another outage
    assert observed.reports == []


async def test_a_longer_outage_and_its_end_are_reported_once() -> None:
    observed = Observed()
    for _ in range(3):
        await observed.fail(takes_s=0.6)
    observed.now_s = 5.0
    assert await observed.call() == 7
    assert await observed.call() == 7
    assert observed.reports == ["away at 1.2 s", 5.0]
    await observed.fail(takes_s=2.0)
    assert observed.reports[2:] == ["away at 7 s"]


async def test_an_answer_to_a_call_from_before_the_outage_does_not_end_it() -> None:
    observed = Observed()
    answered = asyncio.Event()

    async def answer_late() -> None:
        await answered.wait()

    early = asyncio.create_task(observed.availability.observe(answer_late()))
    await asyncio.sleep(0)
    observed.now_s = 1.0
    await observed.fail(takes_s=2.0)
    answered.set()
    await early
    assert observed.reports == ["away at 3 s"]
    assert await observed.call() == 7
    assert observed.reports == ["away at 3 s", 2.0]


# === drain once ===============================================================================================

SETTINGS = Settings(batch_events_max=10)


async def test_one_round_stores_folds_and_reports_all_records(log: EventLog) -> None:
    sources = [KeptSource(run_of(episode(which), 1, 15), closed=True, name=f"robot {which}") for which in (1, 2)]
    recovered = await drain_once(sources, CountingFold(log), settings=SETTINGS)
    assert [(each.source, each.records) for each in recovered.drained] == [("robot 1", 15), ("robot 2", 15)]
    assert (recovered.folded, recovered.failed, recovered.stopped) == (30, {}, {})
    assert ask(log.address.path, "SELECT head, folded FROM episode") == [(15, 15), (15, 15)]
    assert [each.kept for each in sources] == [[], []]


async def test_a_damaged_source_is_reported_and_the_others_are_drained(log: EventLog) -> None:
    class Damaged(KeptSource):
        async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
            if self.acknowledgements:
                raise SpoolDamaged(Path("/spool/1/2.seg"), 64, "a frame does not match its checksum")
            return await super().get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)

    damaged = Damaged(run_of(episode(1), 1, 15), name="robot 1")
    healthy = KeptSource(run_of(episode(2), 1, 3), closed=True, name="robot 2")
    recovered = await drain_once([damaged, healthy], CountingFold(log), settings=SETTINGS)
    assert {source: str(error) for source, error in recovered.failed.items()} == {
        "robot 1": "/spool/1/2.seg is damaged at byte 64: a frame does not match its checksum"
    }
    assert recovered.folded == 13
    assert ask(log.address.path, "SELECT head FROM episode ORDER BY number") == [(10,), (3,)]


async def test_a_gap_in_an_episode_is_reported_with_its_reason(log: EventLog) -> None:
    source = KeptSource([*run_of(episode(1), 1, 3), *run_of(episode(1), 5, 6)], closed=True)
    recovered = await drain_once([source], CountingFold(log), settings=SETTINGS)
    assert recovered.stopped == {"00000000-0000-0000-0000-000000000001": "event 4 did not arrive before event 5"}
    assert recovered.folded == 3


async def test_a_refusal_without_dead_letters_is_a_failure_of_its_source(log: EventLog) -> None:
    class Full(KeptSource):
        def dead_letter(self, records: Sequence[Record]) -> bool:
            raise SpoolUnavailable(Path("/spool/1.refused"), "No space left on device")

    full = Full([*run_of(episode(1), 1, 3), *run_of(episode(1), 5, 6)], closed=True, name="robot 1")
    healthy = KeptSource(run_of(episode(2), 1, 3), closed=True, name="robot 2")
    recovered = await drain_once([full, healthy], CountingFold(log), settings=SETTINGS)
    assert {source: str(error) for source, error in recovered.failed.items()} == {
        "robot 1": "spool /spool/1.refused: No space left on device"
    }
    assert list(recovered.stopped.values()) == ["event 4 did not arrive before event 5"]
    assert (full.kept, healthy.kept) == ([1, 2, 3, 5, 6], [])


class LockedAfterAppend(ForwardingDestination):
    """A second process that locks the database at the first fold, for a given number of attempts."""

    def __init__(self, log: EventLog, *, folds_met: int) -> None:
        super().__init__(CountingFold(log))
        self.folds = 0
        self._folds_met = folds_met
        self._holder = sqlite3.connect(log.address.path, isolation_level=None)

    async def fold(self) -> int:
        if self.folds == 0:
            self._holder.execute("BEGIN IMMEDIATE")
        if self.folds == self._folds_met:
            self.release()
        self.folds += 1
        return await super().fold()

    def release(self) -> None:
        self._holder.close()


async def test_a_fold_on_a_locked_database_is_retried(log: EventLog) -> None:
    destination = LockedAfterAppend(log, folds_met=2)
    recovered = await drain_once([KeptSource(run_of(episode(1), 1, 3), closed=True)], destination, settings=SETTINGS)
    assert (recovered.folded, destination.folds) == (3, 3)
    assert ask(log.address.path, "SELECT head, folded FROM episode") == [(3, 3)]


@pytest.mark.slow
@pytest.mark.every_python
async def test_a_database_that_stays_locked_during_the_fold_is_raised_and_stored_records_remain(log: EventLog) -> None:
    destination = LockedAfterAppend(log, folds_met=99)
    source = KeptSource(run_of(episode(1), 1, 3), closed=True)
    with pytest.raises(DatabaseUnavailable, match="database is locked"):
        await drain_once([source], destination, settings=SETTINGS)
    destination.release()
    assert (destination.folds, source.kept) == (5, [])
    assert ask(log.address.path, "SELECT head, folded FROM episode") == [(3, 0)]


# === retry ====================================================================================================


@pytest.mark.parametrize(
    ("attempts", "randomness", "pauses_s"),
    [
        ((1, 2, 3, 4, 5, 10**9), 1.0, [0.5, 1.0, 2.0, 4.0, 5.0, 5.0]),
        ((3,), 0.0, [1.0]),
        ((3,), 0.5, [1.5]),
    ],
)
def test_pauses_double_up_to_the_longest_and_jitter_takes_up_to_half(
    attempts: Sequence[int], randomness: float, pauses_s: list[float]
) -> None:
    backoff = Backoff(first_s=0.5, longest_s=5.0)
    assert [backoff.pause_s(each, randomness) for each in attempts] == pauses_s
    limited = Backoff(first_s=0.5, longest_s=5.0, attempts_max=1)
    assert limited.pause_s(1, randomness) is None
