"""Processes that fold one memory on PostgreSQL share its episodes: no event is folded twice or forgotten."""

from __future__ import annotations

import asyncio
import itertools
import random
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path

import asyncpg
import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.operations.destination import LogAndTables, open_destination
from pycrorm_async.projections import fold_group
from pycrorm_async.projections.pipeline import WHOLE, Share
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialect import FOLDING
from tests.commands import NOTES_PLAN, Started, answer, pycrorm
from tests.databases import Server, ask
from tests.store.factories import started

pytestmark = pytest.mark.slow


@pytest.fixture
def database_url(server: Server) -> str:
    """Use PostgreSQL alone: SQLite has one writer at a time, and no group."""
    return server.new_memory()


@pytest.fixture
async def folders(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[list[LogAndTables]]:
    """Three processes' connections to the memory, which look at the group at each call."""
    monkeypatch.setattr(fold_group, "_LOOK_S", 0.0)
    address = DatabaseAddress.parse(database_url)
    async with AsyncExitStack() as stack:
        yield [
            await stack.enter_async_context(
                open_destination(address, Spool(tmp_path / f"spool{each}", "owner"), clock=SYSTEM_CLOCK)
            )
            for each in range(3)
        ]


async def shares_of(folders: list[LogAndTables]) -> list[Share]:
    for each in folders:
        await each.group.share()  # joins
    return [await each.group.share() for each in folders]


async def test_each_process_has_a_share_of_its_own_and_that_of_a_dead_one_is_taken(
    database_url: str, folders: list[LogAndTables]
) -> None:
    assert await shares_of(folders[:1]) == [WHOLE]
    assert sorted(await shares_of(folders)) == [(0, 3), (1, 3), (2, 3)]
    await folders[0].group.leave()
    assert sorted(await shares_of(folders[1:])) == [(0, 2), (1, 2)]
    # The server ends the session of a process that is killed, as it does here.
    ask(
        database_url,
        "SELECT pg_terminate_backend(pid, 5000) FROM pg_locks"
        " WHERE locktype = 'advisory' AND pid = (SELECT max(pid) FROM pg_locks WHERE locktype = 'advisory')",
    )
    answers = await asyncio.gather(*(each.group.share() for each in folders[1:]), return_exceptions=True)
    assert sorted(map(type, answers), key=str) == [DatabaseUnavailable, Share]
    assert WHOLE in answers
    assert sorted(await shares_of(folders[1:])) == [(0, 2), (1, 2)]  # it has joined again


async def test_each_folds_the_episodes_of_its_share_and_sees_those_of_the_others(folders: list[LogAndTables]) -> None:
    await shares_of(folders)
    await folders[0].append([started(each) for each in range(1, 31)])
    for count, each in enumerate(folders, 1):
        assert await each.has_unfolded()
        while await each.fold_next_batch():
            pass
        assert not await each.has_unfolded()
        assert len(await each.behind()) == 30 - 10 * count


async def test_the_share_of_a_process_that_does_not_look_is_folded_by_another_until_it_looks_again(
    folders: list[LogAndTables], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, idle, _ = folders
    await shares_of([folder, idle])
    await folder.append([started(each) for each in range(1, 31)])
    while await folder.fold_next_batch():
        pass
    assert not await folder.has_unfolded()
    assert len(await folder.behind()) == 15
    monkeypatch.setattr(fold_group, "_STALL_S", 0.0)
    assert await folder.has_unfolded()
    while await folder.fold_next_batch():
        pass
    assert await folder.behind() == {}
    monkeypatch.setattr(fold_group, "_STALL_S", 10.0)
    assert (await folder.group.share()).many == 2
    for many in (2, 1, 1):  # it looks after pauses of its own, of which it counts 5 s each
        folder.group._looked_s -= 100.0
        assert (await folder.group.share()).many == many
    assert (await idle.group.share()).many == (await folder.group.share()).many == 2


async def test_a_daemon_of_an_earlier_version_which_shows_no_look_keeps_its_share(
    database_url: str, folders: list[LogAndTables]
) -> None:
    folder = folders[0]
    earlier = await asyncpg.connect(database_url)
    try:
        await earlier.execute(f"SELECT pg_advisory_lock_shared({FOLDING})")
        for _ in range(5):
            assert (await folder.group.share()).many == 2
            folder.group._looked_s -= 100.0
    finally:
        await earlier.close()
    assert await folder.group.share() == WHOLE


async def test_a_fold_of_all_is_whole_beside_the_task_that_folds_a_share(folders: list[LogAndTables]) -> None:
    """As that of a log that was healed, while the daemon folds."""
    folder, idle, _ = folders
    await shares_of([folder, idle])
    for first in range(1, 200, 20):
        await folder.append([started(each) for each in range(first, first + 20)])
        folding = asyncio.create_task(folder.fold())
        while not folding.done():
            await folder.fold_next_batch()
        assert await folder.behind() == {}


async def test_a_process_that_cannot_fold_leaves_its_share_to_the_others(
    folders: list[LogAndTables], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, broken, _ = folders
    await shares_of([folder, broken])

    async def refuse(_: Share) -> bool:
        raise RuntimeError

    with monkeypatch.context() as patched, pytest.raises(RuntimeError):
        patched.setattr(broken._projector, "fold_next_batch", refuse)
        await broken.fold_next_batch()
    assert await shares_of([folder]) == [WHOLE]


async def test_a_flush_makes_all_visible_whoever_else_is_in_the_group(
    folders: list[LogAndTables], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, idle, _ = folders
    await shares_of([idle])
    monkeypatch.setattr("pycrorm_async.operations.destination.LOOKAHEAD_EVENTS_MIN", 10)
    for count in (5, 30):  # few events are folded at once, and many by share first
        await folder.append([started(each) for each in range(count, 2 * count)])
        assert await folder.fold() == len({*range(count, 2 * count)} - ({*range(5, 10)} if count == 30 else set()))
        assert await folder.behind() == {}
        assert await shares_of([idle]) == [WHOLE]  # the other one has left


async def test_a_flush_ends_while_others_append_and_one_does_not_fold(
    folders: list[LogAndTables], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, idle, recording = folders
    await shares_of([idle])
    monkeypatch.setattr("pycrorm_async.operations.destination.LOOKAHEAD_EVENTS_MIN", 10)
    await recording.append([started(each) for each in range(1, 31)])
    await folder.group.share()  # from now on half of the episodes are of the idle one

    async def append_repeatedly() -> None:
        for each in itertools.count(31):
            await recording.append([started(each)])
            await asyncio.sleep(0.5)

    appending = asyncio.create_task(append_repeatedly())
    try:
        async with asyncio.timeout(30):
            assert await folder.fold() >= 30
    finally:
        appending.cancel()


def test_daemons_that_are_killed_at_any_moment_fold_each_event_once(database_url: str, tmp_path: Path) -> None:
    seed = random.SystemRandom().randrange(2**20)
    print(f"seed {seed}")
    choose = random.Random(seed)
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    at = ("--url", database_url)

    def start(number: int) -> Started:
        daemon = Started("writer", *at, "--spool", str(tmp_path / f"spool{number}"), cwd=tmp_path)
        assert daemon.stderr.readline().startswith("draining")
        return daemon

    daemons = {each: start(each) for each in range(3)}
    try:
        for _ in range(3):
            spool = str(tmp_path / f"spool{choose.randrange(3)}")
            plan = Started("run", "notes.py", *at, "--spool", spool, "--writer", "daemon", cwd=tmp_path)
            killed = choose.randrange(3)
            daemons[killed].send_signal(signal.SIGKILL)
            daemons[killed].communicate()
            daemons[killed] = start(killed)
            plan.communicate()
            assert plan.returncode == 0
    finally:
        for daemon in daemons.values():
            daemon.kill()
            daemon.communicate()
    for number in daemons:
        pycrorm("writer", "--once", *at, "--spool", tmp_path / f"spool{number}", cwd=tmp_path)
    assert ask(database_url, "SELECT count(*), sum(head - folded) FROM episode") == [(3, 0)]
    assert ask(database_url, "SELECT count(*) FROM memory.note_action") == [(9,)]
    answer("verify", *at, cwd=tmp_path)
