"""A copy holds what its source holds, whatever interrupts it, and memories merge, damaged ones too."""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import random
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError, DatabaseUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import NodeStarted
from pycrorm_async.operations.copy import CopySummary, copy_episodes, declared_by
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.workers import WORKERS, forked
from pycrorm_async.settings import Settings
from pycrorm_async.store.stored import StoredEvent
from pycrorm_async.writer.drain import Backoff
from tests.crash.forked_processes import ForkedProcess
from tests.databases import Server, ask, ask_to_change, change_each
from tests.hand_written import fill, hand_written
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.operations.memories import (
    PATIENT,
    New,
    append_in_own_thread,
    assert_merged,
    assert_same,
    declarations_as_records,
    everything,
    notes,
    random_plans,
)
from tests.projections.event_script import Script, append_and_fold, declarations, declared, field, name_of
from tests.projections.rebuild_cases import traces
from tests.store.factories import episode, record, run_of
from tests.table_comparison import Logs, logs_of, tables_of

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]


# === copy =====================================================================================================
#
# A copy holds what its source holds, whatever interrupts it.

SMALL = Settings(batch_events_max=40)
"""Small batches, so that a copy takes many and their boundaries fall within episodes."""


def counts(done: CopySummary) -> list[tuple[int, int, int, int]]:
    assert [(each.damage, each.stopped) for each in done.episodes if each.damage or each.stopped] == []
    return [(each.number, each.were_there, each.copied, each.head) for each in done.episodes]


def path_of(url: str) -> Path:
    return Path(url.removeprefix("sqlite:///"))


def test_events_of_all_versions_name_a_type_by_the_same_digits_of_its_fingerprint() -> None:
    whole, short = b'{"designator":"00112233445566778899aabbccddeeff"}', b'{"designator":"0011223344556677"}'
    added = b'{"description":"urdf-00112233445566778899aabbccddeeff"}'
    starts = [StoredEvent(1, 1, "NodeStarted", 3, 0, 0, payload) for payload in (whole, short, b"{}")]
    events = [*starts, StoredEvent(1, 2, "ObjectAdded", 2, 0, 0, added)]
    assert declared_by(events) == {"0011223344556677", "urdf-00112233445566778899aabbccddeeff"}


# --- complete copies --------------------------------------------------------------------------------------------------


async def test_a_memory_copied_to_a_server_and_back_is_the_same_and_the_source_is_not_written(
    new_file: New, server: Server
) -> None:
    source, middle, back = new_file(), server.new_database(), new_file()
    await everything(source)
    before = hashlib.sha256(path_of(source).read_bytes()).digest()
    tables = tables_of(source)
    for table in ("object", "attachment", "parameter_item", "joint_change", "simulated_episode", "object_removal"):
        assert table in tables, f"the source has no row in {table}, so this proves little"
    assert {row["status"] for row in tables["process_metadata"].values()} >= {"SUCCEEDED", "LOST"}
    await copy_episodes(source, middle, settings=SMALL)
    await copy_episodes(middle, back)
    assert_same(source, middle)
    assert_same(source, back)
    assert hashlib.sha256(path_of(source).read_bytes()).digest() == before


async def test_events_that_the_target_has_are_not_copied_again(new_url: New, new_file: New) -> None:
    source, target = new_file(), new_url()
    await notes(source, "a", "b")
    await notes(source, "c")
    assert counts(await copy_episodes(source, target)) == [(1, 0, 8, 8), (2, 0, 6, 6)]
    assert counts(await copy_episodes(source, target)) == [(1, 8, 0, 8), (2, 6, 0, 6)]
    assert_same(source, target)
    await notes(source, "d")
    assert counts(await copy_episodes(source, target)) == [(1, 8, 0, 8), (2, 6, 0, 6), (3, 0, 6, 6)]
    assert_same(source, target)


async def test_only_the_requested_episodes_are_copied_with_their_own_types(new_file: New) -> None:
    source, target = new_file(), new_file()
    await notes(source, "a")
    await random_plans(source, [1])
    await notes(source, "b")
    ids = list(logs_of(source))
    assert counts(await copy_episodes(source, target, episodes=["3", ids[2], "last"])) == [(3, 0, 6, 6)]
    assert list(logs_of(target)) == [ids[2]]
    assert ask(target, "SELECT count(*) FROM pycrorm_declaration") == [(1,)]
    async with Reading.open(target) as reading:
        assert await texts(reading) == ["b"]
    await copy_episodes(source, target, episodes=[ids[1], "1"])
    assert_same(source, target)


async def test_an_episode_that_is_longer_in_the_target_is_not_changed(new_file: New) -> None:
    source, target = new_file(), new_file()
    records = hand_written(1).records
    await fill(target, [hand_written(1)])
    await append_and_fold(source, [*declarations_as_records(target), *records[:4]])
    assert counts(await copy_episodes(source, target)) == [(1, 4, 0, len(records))]
    assert counts(await copy_episodes(target, source)) == [(1, 4, len(records) - 4, len(records))]
    assert_same(target, source)


# --- two sources ------------------------------------------------------------------------------------------------------


async def test_a_copy_repeats_each_step_in_which_another_process_hinders_it(
    new_file: New, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = new_file(), new_file()
    await append_and_fold(source, run_of(episode(1), 1, 2))
    monkeypatch.setattr("pycrorm_async.operations.copy.BRIEF", Backoff(first_s=0, longest_s=0, attempts_max=2))
    hindered: list[str] = []

    def hinder(step: str) -> None:
        method = getattr(LogAndTables, step)

        async def fail_once(self: LogAndTables, *arguments: Sequence[Record]) -> object:
            if step not in hindered:
                hindered.append(step)
                raise DatabaseUnavailable(f"another process hinders the {step}")
            return await method(self, *arguments)

        monkeypatch.setattr(LogAndTables, step, fail_once)

    for step in ("append", "fold_next_batch", "fold"):
        hinder(step)
    await copy_episodes(source, target)
    assert hindered == ["append", "fold_next_batch", "fold"]
    assert_same(source, target)


@pytest.mark.soak
async def test_two_memories_merge_into_the_same_one_in_any_order_and_at_once_and_are_rebuilt(
    new_url: New, new_file: New
) -> None:
    one, other = new_file(), new_file()
    await random_plans(one, range(20, 30))
    await random_plans(other, range(25, 35))
    await notes(other, "only here")
    first, second, at_once = new_url(), new_url(), new_url()
    for source in (one, other):
        await copy_episodes(source, first)
    for source in (other, one):
        await copy_episodes(source, second)
    await copy_episodes(one, at_once, episodes=["3"])  # so that the tables are made before the concurrent copies
    await asyncio.gather(*(copy_episodes(each, at_once, settings=SMALL) for each in (one, other, one)))
    for target in (first, second, at_once):
        assert_merged(target, one, other)
    at = "memory_tables." if first.startswith("postgresql:") else ""
    ask_to_change(
        first, f"UPDATE {at}zz_task_tree_node__1001 SET status = 'RUNNING'"
    )  # the rebuild reads the log alone
    done = await rebuild_memory(first)
    assert (done.generation, done.parked, done.left) == (1002, {}, [])
    assert_merged(first, one, other)
    assert traces(first) == []


# --- concurrent recorders ---------------------------------------------------------------------------------------------


async def test_a_running_episode_is_copied_as_far_as_it_is_and_later_completed(new_url: New, new_file: New) -> None:
    source, target = new_file(), new_url()
    await notes(source, "before")
    copies = 0
    async with Memory.open(source, settings=PATIENT) as memory:
        async with memory.episode(description="long"):
            for index in range(60):
                await NoteActionPerformable(f"{index}").perform()
                if index % 20 == 5:
                    await memory.flush()
                    done = await copy_episodes(source, target, settings=SMALL)
                    copies += 1
                    assert done.episodes[1].head == len(logs_of(target)[done.episodes[1].id]) > 2 * index
        assert ask(target, "SELECT status FROM process_metadata ORDER BY id") == [("SUCCEEDED",), ("RUNNING",)]
    assert copies == 3
    await copy_episodes(source, target)
    assert_same(source, target)


# --- killed -----------------------------------------------------------------------------------------------------------


def copy_and_print(source: str, target: str) -> None:
    with forked(WORKERS, target) as workers:  # as the command does
        copying = copy_episodes(
            source, target, settings=SMALL, report_progress=lambda done, *_: print(done), forked=workers
        )
        asyncio.run(copying)


async def test_a_copy_that_is_killed_and_repeated_is_complete(new_url: New, new_file: New) -> None:
    rounds = 6
    source, target = new_file(), new_url()
    await random_plans(source, range(40, 46))
    await fill(source, [hand_written(number) for number in range(15)])
    await notes(source, *map(str, range(150)))
    expected = logs_of(source)
    count = sum(map(len, expected.values()))
    seed = random.randrange(2**32)
    dice = random.Random(seed)
    copied_logs: Logs = {}
    kills = 0
    for left in range(rounds, 0, -1):
        copying = ForkedProcess(copy_and_print, source, target)
        copying.wait_for_first_output()
        copied = sum(map(len, copied_logs.values()))
        until = copied + dice.randrange(2 * (count - copied) // (left + 1) + 1)  # leaves some for the later rounds
        while copying.process.is_alive() and int(copying.lines[-1] if copying.lines else 0) < until:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        await asyncio.sleep(dice.random() * 0.01)
        kills += copying.process.is_alive()
        copying.kill()
        copied_logs = logs_of(target)
        for name, events in copied_logs.items():
            assert events == expected[name][: len(events)], f"seed {seed}"
    assert kills > rounds // 3, f"seed {seed}"
    await copy_episodes(source, target)
    assert_same(source, target)


async def test_events_appended_but_not_folded_before_a_kill_are_folded_by_the_next_copy(new_file: New) -> None:
    source, target = new_file(), new_file()
    await fill(source, [hand_written(1)])
    await append_and_fold(target, [*declarations_as_records(source), *hand_written(1).records], folded=False)
    assert counts(await copy_episodes(source, target)) == [(1, 12, 0, 12)]
    assert_same(source, target)


# --- wrong use --------------------------------------------------------------------------------------------------------


async def test_a_copy_of_the_files_of_a_memory_is_recognised_as_the_same_memory(new_file: New) -> None:
    source, target = new_file(), new_file()
    await notes(source, "a")
    shutil.copy(path_of(source), path_of(target))
    with pytest.raises(CallerError, match=r"or file copies of one memory: copy to a new URL"):
        await copy_episodes(source, target)


async def test_large_events_are_copied_in_small_batches(new_file: New, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = new_file(), new_file()
    big = b'{"kind":"action","parameters":{"text":"%s"}}' % (b"x" * 20_000)
    records = [record(episode(1), sequence, payload=big) for sequence in range(1, 601)]
    await append_and_fold(source, [*records, *run_of(episode(2), 1, 30)], folded=False)
    batches: list[int] = []
    append = LogAndTables.append

    async def noted(self: LogAndTables, batch: Sequence[Record]) -> Mapping[EpisodeId, str]:
        batches.append(len(batch))
        return await append(self, batch)

    monkeypatch.setattr(LogAndTables, "append", noted)
    done: list[int] = []
    await copy_episodes(source, target, report_progress=lambda count, *_: done.append(count))
    assert logs_of(target) == logs_of(source)
    assert (done, batches) == ([250, 500, 600, 630], [250, 250, 130])
    assert len(tables_of(target)["task_tree_node"]) == 630


# === fixtures =================================================================================================
#
# Fixtures for memories to be made: `new_url` returns the URL of one that does not exist yet, for each kind of database.


@pytest.fixture
def new_file(tmp_path: Path) -> Callable[[], str]:
    numbers = itertools.count(1)
    return lambda: f"sqlite:///{tmp_path}/memory_{next(numbers)}.db"


@pytest.fixture(params=["sqlite", "postgresql"])
def new_url(request: pytest.FixtureRequest, new_file: Callable[[], str]) -> Callable[[], str]:
    if request.param == "sqlite":
        return new_file
    server: Server = request.getfixturevalue("server")
    return server.new_database


# === damaged copy =============================================================================================
#
# Damage, gaps and contradictions in one of two memories are reported, and everything else is copied.


async def test_other_bytes_under_one_key_are_reported_and_the_other_episodes_are_copied(
    new_url: New, new_file: New
) -> None:
    source, target = new_file(), new_url()
    scripts = [hand_written(number) for number in (1, 2, 3)]
    await fill(source, scripts)
    other = [each._replace(wall_ns=each.wall_ns + (each.sequence == 5)) for each in scripts[1].records]
    await append_and_fold(target, [*declarations_as_records(source), *other[:9]])
    before = logs_of(target)
    done = await copy_episodes(source, target)
    (bad,) = [each for each in done.episodes if each.damage]
    identity = "00000000-0000-7000-8000-000000000002"
    assert bad.id == identity
    assert bad.damage is not None
    assert bad.damage.startswith(f"episode {identity}, event 5: ")
    assert (bad.were_there, bad.copied, bad.head) == (9, 0, 9)
    assert [(each.copied, each.damage) for each in done.episodes if each is not bad] == [(12, None)] * 2
    after = logs_of(target)
    assert after.pop(identity) == before[identity]
    copied_logs = logs_of(source)
    del copied_logs[identity]
    assert after == copied_logs


async def test_other_bytes_that_arrive_during_the_copy_are_reported_and_the_other_episodes_are_copied(
    new_url: New, new_file: New
) -> None:
    source, target = new_file(), new_url()
    await fill(source, [hand_written(number) for number in (1, 2, 3)])
    other = [each._replace(monotonic_ns=4) for each in hand_written(2).records]
    progress_calls = 0

    def append_other_bytes(*_: object) -> None:  # events were read and are not appended yet
        nonlocal progress_calls
        if progress_calls == 0:
            append_in_own_thread(target, other)
        progress_calls += 1

    done = await copy_episodes(source, target, report_progress=append_other_bytes)
    assert [each.damage is None for each in done.episodes] == [True, False, True]
    assert done.episodes[1].damage is not None
    assert "another event is stored under this number" in done.episodes[1].damage
    assert [each.head for each in done.episodes] == [12, 12, 12]
    copied_logs = logs_of(target)
    assert {event[4] for event in copied_logs.pop("00000000-0000-7000-8000-000000000002")} == {4}
    assert copied_logs == {each: events for each, events in logs_of(source).items() if each in copied_logs}


@pytest.mark.parametrize(
    ("sequence", "change", "fault"),
    [
        (1, "DELETE FROM event", "is missing in "),
        (7, "DELETE FROM event", "is missing in "),
        (5, "UPDATE event SET payload = '{'", "its payload cannot be read: "),
        (5, """UPDATE event SET payload = '{"node":"four"}'""", "its payload cannot be read: "),
    ],
)
async def test_of_an_episode_with_a_missing_or_unreadable_event_those_before_it_are_copied(
    new_file: New, sequence: int, change: str, fault: str
) -> None:
    source, target = new_file(), new_file()
    await fill(source, [hand_written(number) for number in (1, 2)])
    change_each(source, ["DROP TRIGGER event_is_not_updated", "DROP TRIGGER event_is_not_deleted"])
    ask_to_change(source, f"{change} WHERE episode = 1 AND sequence = {sequence}")
    for _ in range(2):
        (bad, good) = (await copy_episodes(source, target)).episodes
        assert f"{bad.damage} ".startswith(f"episode {bad.id}, event {sequence}: {fault}")
        assert (bad.head, good.head, good.damage) == (sequence - 1, 12, None)
    copied_logs = logs_of(target)
    assert [event[0] for event in copied_logs.get(bad.id, [])] == list(range(1, sequence))
    assert copied_logs[good.id] == logs_of(source)[good.id]


@pytest.mark.parametrize(("sequence", "damaged"), [(1, 0), (12, 1)])
async def test_a_gap_in_both_memories_is_reported(new_file: New, sequence: int, damaged: int) -> None:
    source, target = both = new_file(), new_file()
    for url in both:
        await fill(url, [hand_written(number) for number in (1, 2)])
    ask_to_change(both[damaged], "DROP TRIGGER event_is_not_deleted")
    ask_to_change(both[damaged], f"DELETE FROM event WHERE episode = 1 AND sequence = {sequence}")
    (bad, good) = (await copy_episodes(source, target)).episodes
    assert bad.damage == f"episode {bad.id}, event {sequence}: is missing in {both[damaged]}"
    assert (good.were_there, good.copied, good.damage) == (12, 0, None)


async def test_events_of_a_newer_version_are_copied_unchanged(new_url: New, new_file: New) -> None:
    source, target = new_file(), new_url()
    script = Script(1)
    script.put_payload("HandShaken", b'{"whom": "Ada", "firm": 1.50}')
    script.put_payload("NodeStarted", b'{"designator": ["of", "another", "shape"]}', NodeStarted.version + 1)
    await append_and_fold(source, script.records)
    (done,) = (await copy_episodes(source, target)).episodes
    assert done.damage is None
    assert done.stopped == "event 1: HandShaken is not an event type of this version"
    assert logs_of(target) == logs_of(source)


async def test_an_episode_whose_type_contradicts_the_target_is_copied_and_folded_under_other_names(
    new_file: New,
) -> None:
    source, target = new_file(), new_file()
    await notes(target, "a text")
    number = declared("NoteAction", "note_action", field("text", "integer", 2))
    script = Script(1)
    script.put(NodeStarted("action", None, name_of(number), {"text": 5}))
    await append_and_fold(source, [*declarations(number), *script.records])
    (done,) = (await copy_episodes(source, target)).episodes
    assert (done.damage, done.stopped) == (None, None)
    assert logs_of(target)[done.id] == logs_of(source)[done.id]
    rows = ask(target, "SELECT text, text_integer FROM note_action ORDER BY id")
    assert rows == [("a text", None), (None, 5)]
