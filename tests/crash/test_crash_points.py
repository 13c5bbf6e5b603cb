"""Kill a process at each step that touches the disk or the log: every event is stored once, refused ones as well."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import shutil
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import DatabaseError
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Drain
from tests.databases import ask
from tests.queue.factories import (
    RECORDER,
    SMALL,
    STILL,
    FolderWriter,
    drain,
    ended,
    episode,
    node,
    opened_dead,
    started,
)

# === crash points =============================================================================================
#
# Kill a process at each step that touches the disk or the log, and its successor too: every event is stored once.
#
# A forked child does the work and exits at once, before or after the n-th such step, without closing anything; n takes
# every value in the soak, and otherwise each sixth from a random one on. A pipe keeps what the child was promised
# before it died.

LIVE = replace(SMALL, sync_interval_ms=1, spool_bytes_max=64 * SMALL.segment_bytes)
STEPS = {
    os: ("open", "fsync", "fdatasync", "posix_fallocate", "truncate", "ftruncate"),
    Path: ("rename", "replace", "unlink", "rmdir", "touch", "mkdir", "write_text"),
    EventLog: ("append",),
}
STORED = "SELECT sequence, type, payload FROM event JOIN episode ON number = episode WHERE id = ? ORDER BY sequence"


def dying_at(step: int, *, after: bool) -> None:
    """Make the n-th of these steps in this process the last one, executed only if `after` is set."""
    done = 0

    def counting(original: Callable[..., Any]) -> Callable[..., Any]:
        def last(*arguments: Any, **options: Any) -> Any:
            nonlocal done
            done += 1
            mine = done
            if mine == step and not after:
                os._exit(9)
            answer = original(*arguments, **options)
            if asyncio.iscoroutine(answer):
                return finished(answer, mine)
            if mine == step:
                os._exit(9)
            return answer

        async def finished(answer: Awaitable[Any], mine: int) -> Any:
            result = await answer
            if mine == step:
                os._exit(9)  # committed, but the caller never learns it
            return result

        return last

    for of, names in STEPS.items():
        for name in names:
            setattr(of, name, counting(getattr(of, name)))


def in_a_child(work: Callable[[Callable[..., None]], None], step: int, *, after: bool) -> tuple[bool, list[list[str]]]:
    """Return whether the child finished its work, and the lines that it wrote."""
    mine, its = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(mine)
        code = 1
        with contextlib.suppress(BaseException):
            dying_at(step, after=after)
            work(partial(_report, its))
            code = 0
        os._exit(code)
    os.close(its)
    output = b""
    while chunk := os.read(mine, 1 << 16):
        output += chunk
    os.close(mine)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    assert code in (0, 9), (step, after, code)
    return code == 0, [line.split() for line in output.decode().splitlines()]


def _report(pipe: int, *words: object) -> None:
    os.write(pipe, (" ".join(map(str, words)) + "\n").encode())


async def drained(url: str, queue: Any) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    settings = Settings(batch_events_max=4)
    await Drain(queue, log.append, settings=settings).run()
    await log.close()


def recover_all(url: str, spool: Path, _report: object = None) -> None:
    """Recover the spool as the next process does."""
    for folder in Spool(spool).recorders():
        recovered = open_dead(folder.path)
        if recovered is not None:
            asyncio.run(drained(url, recovered))
            recovered.release()


def stored(url: str, number: int) -> list[tuple[int, str, str]]:
    return ask(url, STORED, (episode_text(episode(number)),))


KILLS = pytest.mark.parametrize(
    ("after", "stride"),
    [(False, 6), pytest.param(False, 1, marks=pytest.mark.soak), pytest.param(True, 1, marks=pytest.mark.soak)],
)
"""Killed before each step; a kill after the step differs only by what a process does between two steps."""


# --- recovery of a dead recorder --------------------------------------------------------------------------------------


@pytest.fixture
def crashed_folder(tmp_path: Path) -> tuple[str, Path]:
    """A dead recorder's folder: three segments, a torn tail, two open episodes and one ended, none in the log."""
    author = FolderWriter(tmp_path / "spool")
    for number in (1, 2, 3):
        author.put(started(number))
    for index in range(10):
        author.put(node(1 + index % 2), b'"%s"' % (b"x" * 800))
        if index == 5:
            author.sync()
    author.put(ended(3))
    path, offset, size = author.places[-1]
    with path.open("rb+") as file:
        file.seek(offset + size)
        file.write(b"torn" * 20)
    url = f"sqlite:///{tmp_path}/memory.db"
    asyncio.run(_made(url))
    return url, tmp_path


async def _made(url: str) -> None:
    await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()


def complete(url: str) -> None:
    for number in (1, 2):
        rows = stored(url, number)
        assert [row[0] for row in rows] == [1, 2, 3, 4, 5, 6, 7]
        assert [row[1] for row in rows] == ["EpisodeStarted", *["NodeStarted"] * 5, "EpisodeEnded"]
        assert rows[-1][2] == '{"status":"LOST"}'
    assert [row[1:] for row in stored(url, 3)] == [("EpisodeStarted", "{}"), ("EpisodeEnded", "{}")]


def pairs(stride: int) -> Iterator[tuple[int, int]]:
    """Kill at a first step alone, and at the same first step with a second step."""
    for first in range(random.randint(1, stride), 60, stride):
        for second in (0, 1 + first * 3 % 30):
            yield first, second


@pytest.mark.slow
@KILLS
def test_a_recovery_killed_at_any_step_and_again_in_the_next_one_stores_every_event_once(
    crashed_folder: tuple[str, Path], after: bool, stride: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    _, prepared = crashed_folder
    ended_at: int | None = None
    for first, second in pairs(stride):
        place = tmp_path_factory.mktemp("round")
        shutil.copytree(prepared, place, dirs_exist_ok=True)
        url, spool = f"sqlite:///{place}/memory.db", place / "spool"
        done, _ = in_a_child(partial(recover_all, url, spool), first, after=after)
        if done and ended_at is None:
            ended_at = first
        if second:
            in_a_child(partial(recover_all, url, spool), second, after=not after)
        recover_all(url, spool)
        complete(url)
        # A recovery that is killed after it deleted the last file may leave the folder, empty.
        left_behind = [folder for folder in spool.iterdir() if folder.name != "stored"]
        assert [path for folder in left_behind for path in folder.iterdir()] == []
        shutil.rmtree(place)
        if ended_at is not None and first > ended_at:
            break
    assert ended_at is not None  # the kills reached every one of its steps
    assert ended_at > 20


# --- a recorder that is alive -----------------------------------------------------------------------------------------


def record_and_drain(url: str, spool: Path, payloads: Sequence[bytes], report: Callable[..., None]) -> None:
    """Put these nodes into two episodes in turn, and both ends, while a task drains them."""
    queue = RecorderQueue.create(spool, settings=LIVE, clock=STILL, recorder=RECORDER)

    async def both() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        drain = asyncio.create_task(Drain(queue, log.append, settings=Settings(batch_events_max=4)).run())
        for number in (1, 2):
            report("put", number, queue.put_nowait(started(number), b"{}"))
        for index, payload in enumerate(payloads):
            report("put", 1 + index % 2, queue.put_nowait(node(1 + index % 2), payload))
            await queue.synced_to()
        for number in (1, 2):
            report("put", number, queue.put_nowait(ended(number), b"{}"))
        queue.close()
        with contextlib.suppress(DatabaseError):
            await drain
        await log.close()

    asyncio.run(both())
    queue.release()


TEXTS = [b'"%d %s"' % (index, b"y" * 900) for index in range(14)]


@pytest.mark.slow
@KILLS
def test_a_recorder_and_its_writer_killed_at_any_step_lose_no_event_that_was_put(
    tmp_path: Path, after: bool, stride: int
) -> None:
    asyncio.run(_made(f"sqlite:///{tmp_path}/made.db"))
    done = False
    step = random.randint(1, stride) - stride
    while not done:
        step += stride
        place = tmp_path / str(step)
        place.mkdir()
        url, spool = f"sqlite:///{place}/memory.db", place / "spool"
        shutil.copy(tmp_path / "made.db", place / "memory.db")
        done, output = in_a_child(partial(record_and_drain, url, spool, TEXTS), step, after=after)
        recover_all(url, spool)
        for number in (1, 2):
            put = [int(line[2]) for line in output if line[:2] == ["put", str(number)]]
            rows = [row for row in stored(url, number) if row[2] != '{"status":"LOST"}']
            assert [row[0] for row in rows] == list(range(1, len(rows) + 1))
            assert len(put) <= len(rows) <= len(put) + 1, (step, after)
            texts = [b"{}", *TEXTS[number - 1 :: 2], b"{}"]
            assert [row[2].encode() for row in rows] == texts[: len(rows)]
        assert [path.parent.name for path in spool.glob("*/alive") if not path.parent.name.endswith(".making")] == []
    assert step > 40


# === dead letters killed ======================================================================================
#
# Kill a recorder at each step that touches disk or log, while the log refuses its episode: no event of it is lost.

NO_TEXT = b'"\xff"'  # no database stores it
LOST = '{"status":"LOST"}'


REFUSED_TEXTS = [*TEXTS[:2], NO_TEXT, *TEXTS[3:6]]


def dead_letter(spool: Path) -> list[Record]:
    """The dead letters of the first episode, which must be all that the spool holds."""
    folders = Spool(spool).recorders()
    if not folders:
        return []
    [folder] = folders
    recovered = opened_dead(folder.path)
    records = asyncio.run(drain(recovered))
    recovered.release()
    assert {each.episode for each in records} == {episode(1)}
    return records


@pytest.mark.soak
@pytest.mark.parametrize("after", [False, True])
def test_a_kill_at_any_step_and_again_neither_loses_nor_doubles_an_event_of_a_refused_episode(
    tmp_path: Path, after: bool
) -> None:
    done, step = False, 0
    while not done:
        step += 1
        place = tmp_path / str(step)
        place.mkdir()
        url, spool = f"sqlite:///{place}/memory.db", place / "spool"
        asyncio.run(_made(url))
        done, lines = in_a_child(partial(record_and_drain, url, spool, REFUSED_TEXTS), step, after=after)
        in_a_child(partial(recover_all, url, spool), 1 + step * 7 % 30, after=not after)
        for _ in range(2):  # a part that is refused a second time is not written again
            recover_all(url, spool)
        texts = {number: [b"{}", *REFUSED_TEXTS[number - 1 :: 2], b"{}"] for number in (1, 2)}
        stored_by_episode = {number: {row[0]: row[2].encode() for row in stored(url, number)} for number in (1, 2)}
        aside = dead_letter(spool)
        sequences = [each.sequence for each in aside]
        assert sequences == list(range(sequences[0], sequences[0] + len(aside)) if aside else ()), (step, after)
        assert set(sequences) & set(stored_by_episode[1]) <= {1, 2}
        stored_by_episode[1] |= {each.sequence: each.payload for each in aside}
        for number in (1, 2):
            put = [int(line[2]) for line in lines if line[:2] == ["put", str(number)]]
            rows = [stored_by_episode[number][sequence] for sequence in sorted(stored_by_episode[number])]
            assert sorted(stored_by_episode[number]) == list(range(1, len(rows) + 1)), (step, after)
            rows = rows[:-1] if rows and rows[-1] == LOST.encode() else rows
            assert rows == texts[number][: len(rows)]
            assert len(put) <= len(rows) <= len(put) + 1, (step, after)
        if done:
            assert sequences[-1] == 5
    assert step > 50
