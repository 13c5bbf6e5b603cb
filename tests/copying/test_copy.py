"""A copy holds what its source holds, whatever interrupts it."""

from __future__ import annotations

import asyncio
import hashlib
import random
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError, DatabaseUnavailable, UnknownEpisode
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.operations.copy import CopySummary, copy_episodes
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.settings import Settings
from pycrorm_async.writer.drain import Backoff
from tests.copying.memories import (
    PATIENT,
    New,
    assert_merged,
    assert_same,
    declarations_as_records,
    everything,
    lost,
    notes,
    random_plans,
)
from tests.crash.forked_processes import ForkedProcess
from tests.databases import Server, ask
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.projections.factories import append_and_fold
from tests.store.factories import episode, record, run_of
from tests.table_comparison import Logs, logs_of, tables_of
from tests.test_table_comparison import episode as hand_written
from tests.test_table_comparison import fill

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""

SMALL = Settings(batch_events_max=40, batch_bytes_max=8_000)
"""Small batches, so that a copy takes many and their boundaries fall within episodes."""


def counts(done: CopySummary) -> list[tuple[int, int, int, int]]:
    assert [(each.damage, each.stopped) for each in done.episodes if each.damage or each.stopped] == []
    return [(each.number, each.were_there, each.copied, each.head) for each in done.episodes]


def path_of(url: str) -> Path:
    return Path(url.removeprefix("sqlite:///"))


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


async def test_a_computed_end_is_copied_like_any_event(new_url: New, new_file: New) -> None:
    source, target = new_file(), new_url()
    await fill(source, [hand_written(2), lost(1)])
    await copy_episodes(source, target)
    await copy_episodes(source, target)
    assert_same(source, target)
    assert ask(target, "SELECT status FROM process_metadata ORDER BY id") == [("SUCCEEDED",), ("LOST",)]
    assert set(ask(target, "SELECT status FROM task_tree_node")) == {("SUCCEEDED",), ("LOST",)}


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
async def test_two_memories_merge_into_the_same_one_in_any_order_and_concurrently(new_url: New, new_file: New) -> None:
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


@pytest.mark.soak
async def test_copies_run_beside_a_recorder_of_the_source_and_one_of_the_target(
    new_url: New, new_file: New, tmp_path: Path
) -> None:
    source, target, separate = new_file(), new_url(), new_file()
    await notes(separate, *map(str, range(200)))
    await notes(source, "before")

    async def record(url: str, name: str) -> None:
        opened = Memory.open(url, spool=tmp_path / f"{name}.spool", settings=PATIENT)
        async with opened as memory, memory.episode(description=name):
            for index in range(150):
                await NoteActionPerformable(f"{name} {index}").perform()
                await asyncio.sleep(0.002)
                assert memory.status.faults.total == 0

    async def copy(url: str) -> None:
        while recording:
            await copy_episodes(url, target, settings=SMALL)
            await asyncio.sleep(0.01)

    recording = True
    async with asyncio.TaskGroup() as group:
        copies = [group.create_task(copy(each)) for each in (source, separate)]
        await asyncio.gather(record(source, "here"), record(target, "there"))
        recording = False
        await asyncio.wait(copies)
    await copy_episodes(source, target)
    copied_logs = logs_of(target)
    expected = logs_of(source) | logs_of(separate)
    assert {episode: copied_logs[episode] for episode in expected} == expected
    assert len(copied_logs) == 4
    async with Reading.open(target) as reading:
        assert sorted(await texts(reading)) == sorted(
            [
                "before",
                *map(str, range(200)),
                *(f"{name} {index}" for name in ("here", "there") for index in range(150)),
            ]
        )


# --- killed -----------------------------------------------------------------------------------------------------------


def copy_and_print(source: str, target: str) -> None:
    asyncio.run(copy_episodes(source, target, settings=SMALL, report_progress=lambda done, *_: print(done)))


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


async def test_a_memory_is_not_copied_into_itself(new_url: New, tmp_path: Path) -> None:
    url = new_url()
    await notes(url, "a")
    before = logs_of(url)
    with pytest.raises(CallerError, match="are the same memory"):
        await copy_episodes(url, url)
    assert logs_of(url) == before


async def test_a_copy_of_the_files_of_a_memory_is_recognised_as_the_same_memory(new_file: New) -> None:
    source, target = new_file(), new_file()
    await notes(source, "a")
    shutil.copy(path_of(source), path_of(target))
    with pytest.raises(CallerError, match=r"or file copies of one memory: copy to a new URL"):
        await copy_episodes(source, target)


async def test_an_impossible_copy_makes_no_target(new_file: New) -> None:
    source, target = new_file(), new_file()
    with pytest.raises(DatabaseUnavailable, match="does not exist"):
        await copy_episodes(source, target)
    await notes(source, "a")
    with pytest.raises(UnknownEpisode, match="there is no episode '7'"):
        await copy_episodes(source, target, episodes=["1", "7"])
    assert not path_of(target).exists()


async def test_large_events_are_copied_in_small_batches(new_file: New, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = new_file(), new_file()
    big = b'{"kind":"action","parameters":{"text":"%s"}}' % (b"x" * 5_000)
    records = [record(episode(1), sequence, payload=big) for sequence in range(1, 601)]
    await append_and_fold(source, [*records, *run_of(episode(2), 1, 30)], folded=False)
    batches: list[int] = []
    append = LogAndTables.append

    async def noted(self: LogAndTables, batch: Sequence[Record]) -> Mapping[EpisodeId, str]:
        batches.append(len(batch))
        return await append(self, batch)

    monkeypatch.setattr(LogAndTables, "append", noted)
    done: list[int] = []
    await copy_episodes(
        source, target, settings=Settings(batch_bytes_max=2**20), report_progress=lambda count, *_: done.append(count)
    )
    assert logs_of(target) == logs_of(source)
    assert (done, batches) == ([250, 500, 600, 630], [250, 250, 130])
    assert len(tables_of(target)["task_tree_node"]) == 630
