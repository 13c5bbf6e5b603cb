"""Kill a recorder at each step that touches disk or log, while the log refuses its episode: no event of it is lost."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from pycrorm_async.errors import DatabaseError
from pycrorm_async.events.codec import Record
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Drain
from tests.crash.test_crash_points import LIVE, _made, drained, in_a_child, stored
from tests.queue.factories import RECORDER, STILL, drain, ended, episode, node, started

pytestmark = pytest.mark.soak
"""Each of these tests starts many processes."""

NO_TEXT = b'"\xff"'  # no database stores it
LOST = '{"status":"LOST"}'


def record_and_drain(url: str, spool: Path, report: Callable[..., None]) -> None:
    queue = RecorderQueue.create(spool, settings=LIVE, clock=STILL, recorder=RECORDER)

    async def both() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        task = asyncio.create_task(Drain(queue, log.append, settings=Settings(batch_events_max=4)).run())
        for number in (1, 2):
            report("put", number, queue.put_nowait(started(number), b"{}"))
        for index in range(6):
            payload = NO_TEXT if index == 2 else b'"%d %s"' % (index, b"y" * 900)
            report("put", 1 + index % 2, queue.put_nowait(node(1 + index % 2), payload))
            await queue.synced_to()
        for number in (1, 2):
            report("put", number, queue.put_nowait(ended(number), b"{}"))
        queue.close()
        with contextlib.suppress(DatabaseError):
            await task
        await log.close()

    asyncio.run(both())
    queue.release()


def recover(url: str, spool: Path, _report: object) -> None:
    """Recover the spool as the next process does."""
    for folder in Spool(spool).recorders():
        recovered = open_dead(folder.path)
        if recovered is not None:
            asyncio.run(drained(url, recovered))
            recovered.release()


def dead_letter(spool: Path) -> list[Record]:
    """The dead letters of the first episode, which must be all that the spool holds."""
    folders = Spool(spool).recorders()
    if not folders:
        return []
    [folder] = folders
    recovered = open_dead(folder.path)
    assert recovered is not None
    records = asyncio.run(drain(recovered))
    recovered.release()
    assert {each.episode for each in records} == {episode(1)}
    return records


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
        done, lines = in_a_child(partial(record_and_drain, url, spool), step, after=after)
        in_a_child(partial(recover, url, spool), 1 + step * 7 % 30, after=not after)
        for _ in range(2):  # a part that is refused a second time is not written again
            recover(url, spool, None)
        texts = {
            number: [
                b"{}",
                *(NO_TEXT if each == 2 else b'"%d %s"' % (each, b"y" * 900) for each in range(number - 1, 6, 2)),
                b"{}",
            ]
            for number in (1, 2)
        }
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
