from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from pycrorm_async.errors import DatabaseUnavailable, SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.settings import Settings
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import drain_once
from tests.databases import ask
from tests.store.factories import episode, run_of
from tests.writer.fakes import CountingFold, ForwardingDestination, KeptSource

SETTINGS = Settings(batch_events_max=10)


async def test_one_round_stores_folds_and_reports_all_records(log: EventLog) -> None:
    sources = [KeptSource(run_of(episode(which), 1, 15), closed=True, name=f"robot {which}") for which in (1, 2)]
    recovered = await drain_once(sources, CountingFold(log), settings=SETTINGS)
    assert [(each.source, each.records) for each in recovered.drained] == [("robot 1", 15), ("robot 2", 15)]
    assert (recovered.folded, recovered.failed, recovered.stopped) == (30, {}, {})
    assert ask(log.address.path, "SELECT head, folded FROM episode") == [(15, 15), (15, 15)]
    assert [each.kept for each in sources] == [[], []]


async def test_a_round_without_records_does_nothing(log: EventLog) -> None:
    recovered = await drain_once([], CountingFold(log), settings=SETTINGS)
    assert (recovered.drained, recovered.folded) == ((), 0)


async def test_records_that_are_already_stored_are_counted_once(log: EventLog) -> None:
    await log.append(run_of(episode(1), 1, 12))
    recovered = await drain_once(
        [KeptSource(run_of(episode(1), 1, 15), closed=True)], CountingFold(log), settings=SETTINGS
    )
    assert recovered.folded == 15
    assert ask(log.address.path, "SELECT count(*) FROM event") == [(15,)]


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


@pytest.mark.slow
@pytest.mark.every_python
async def test_a_database_that_stays_unavailable_is_raised(log: EventLog) -> None:
    holder = sqlite3.connect(log.address.path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    source = KeptSource(run_of(episode(1), 1, 3), closed=True)
    with pytest.raises(DatabaseUnavailable, match="database is locked"):
        await drain_once([source], CountingFold(log), settings=SETTINGS)
    holder.close()
    assert source.kept == [1, 2, 3]


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


async def test_a_query_for_stopped_episodes_on_an_unavailable_database_is_retried(log: EventLog) -> None:
    class UnavailableTwice(ForwardingDestination):
        requests = 0

        async def stopped(self) -> Mapping[str, str]:
            self.requests += 1
            if self.requests < 3:
                raise DatabaseUnavailable("the connection was closed")
            return await super().stopped()

    destination = UnavailableTwice(CountingFold(log))
    source = KeptSource([*run_of(episode(1), 1, 3), *run_of(episode(1), 5, 6)], closed=True)
    recovered = await drain_once([source], destination, settings=SETTINGS)
    assert recovered.stopped == {"00000000-0000-0000-0000-000000000001": "event 4 did not arrive before event 5"}
