"""A writer drains the folders of dead recorders beside its own queue."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from pycrorm_async.errors import EpisodeParked, SpoolDamaged
from pycrorm_async.events.codec import Record
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Source
from tests.databases import ask
from tests.store.factories import episode, name, record, run_of
from tests.writer.fakes import KeptSource
from tests.writer.writer_threads import QUICK, until, until_answer, writer_for, writers_alive


async def test_the_folders_of_dead_recorders_are_stored_and_folded(address: DatabaseAddress) -> None:
    dead = [KeptSource(run_of(episode(which), 1, 30), closed=True, name=f"dead {which}") for which in (2, 3)]
    source = KeptSource(run_of(episode(1), 1, 10))
    writer = writer_for(source, address, settings=QUICK, adopt=dead)
    await writer.start()
    folded = "SELECT id, folded FROM episode ORDER BY id"
    await until_answer(address.path, folded, [(name(1), 10), (name(2), 30), (name(3), 30)])
    source.close()
    await writer.close()
    assert [each.kept for each in dead] == [[], []]
    assert [each.source for each in writer.state.adopted] == ["dead 2", "dead 3"]


async def test_a_damaged_folder_of_another_recorder_is_shown_and_not_raised(address: DatabaseAddress) -> None:
    class Damaged(KeptSource):
        async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
            raise SpoolDamaged(Path("/spool/2/1.seg"), 4096, "a frame does not match its checksum")

    after = KeptSource(run_of(episode(3), 1, 4), closed=True, name="dead 3")

    def open_sources() -> Iterator[Source]:
        yield Damaged(name="dead 2")
        yield after
        raise SpoolDamaged(Path("/spool/4/1.seg"), 0, "no header")

    source = KeptSource(run_of(episode(1), 1, 3))
    writer = writer_for(source, address, adopt=open_sources())
    await writer.start()
    await until(lambda: len(writer.state.adoption_errors) == 2)
    await writer.flush(3)
    source.close()
    await writer.close()
    assert writer.state.adoption_errors == (
        "dead 2: /spool/2/1.seg is damaged at byte 4096: a frame does not match its checksum",
        "/spool/4/1.seg is damaged at byte 0: no header",
    )
    assert after.kept == []


async def test_a_contradiction_between_a_dead_recorder_and_the_log_is_reported_once(
    address: DatabaseAddress, caplog: pytest.LogCaptureFixture
) -> None:
    log = await EventLog.open(address, create=True)
    await log.append([record(episode(2), 1, payload=b'{"other":1}')])
    await log.close()
    source = KeptSource(run_of(episode(1), 1, 3))
    writer = writer_for(source, address, adopt=[KeptSource(run_of(episode(2), 1, 4), closed=True, name="dead 2")])
    await writer.start()
    await until(lambda: bool(writer.state.adoption_errors))
    await writer.flush(3)
    source.close()
    await writer.close()
    [line] = [each.getMessage() for each in caplog.records]
    assert line == (f"recorder dead 2: episode {name(2)}, event 1: another event is stored under this number already")


async def test_refusals_in_many_dead_folders_are_reported_in_one_line(
    address: DatabaseAddress, caplog: pytest.LogCaptureFixture
) -> None:
    dead = [
        KeptSource([*run_of(episode(n), 1, 3), record(episode(n), 5, position=4)], closed=True, name=f"dead {n}")
        for n in (2, 3, 4)
    ]
    source = KeptSource(run_of(episode(1), 1, 3))
    writer = writer_for(source, address, adopt=dead)
    await writer.start()
    await until(lambda: bool(caplog.records))
    source.close()
    with pytest.raises(EpisodeParked):
        await writer.close()
    [line] = [each.getMessage() for each in caplog.records if each.levelname == "ERROR"]
    assert line == (
        f"recorder dead 2: episode {name(2)} was refused: event 4 did not arrive before event 5;"
        " its events are kept in the spool (and 2 more: see `pycrorm status`)"
    )
    assert [len(each.aside or []) for each in dead] == [4, 4, 4]


async def test_closing_does_not_wait_for_the_records_of_other_recorders(address: DatabaseAddress) -> None:
    release_folder: list[str] = []

    def open_sources() -> Iterator[Source]:
        try:
            yield KeptSource(run_of(episode(2), 1, 5), name="never closed")
        finally:
            release_folder.append("never closed")

    folders = open_sources()
    source = KeptSource(run_of(episode(1), 1, 3))
    writer = writer_for(source, address, adopt=folders)
    await writer.start()
    await until_answer(address.path, "SELECT count(*) FROM event", [(8,)])
    source.close()
    await writer.close()
    assert writers_alive() == []
    assert release_folder == ["never closed"]
    assert ask(address.path, "SELECT id, folded FROM episode ORDER BY id") == [(name(1), 3), (name(2), 5)]
