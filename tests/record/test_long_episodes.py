"""An episode with as many events as it can hold records nothing more but ends, without effect on the plan."""

from __future__ import annotations

import asyncio
import contextvars
import threading
from dataclasses import dataclass
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading, recover
from pycrorm_async.errors import CallerError, EpisodeFull
from pycrorm_async.events.ids import SEQUENCE_MAX, episode_text
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, NodeEnded, NodeStarted
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.projections.verify import verify
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.commands import answer, pycrorm
from tests.memory.note_actions import NoteActionPerformable
from tests.projections.event_script import Script
from tests.queue.factories import SMALL, ended, make, node, started
from tests.record import fakes

pytestmark = pytest.mark.slow

MAX = 100
LIMITED = Settings(episode_events_max=MAX)


@dataclass
class PatrolActionPerformable(ActionAbstract):
    """Take this many notes, move the milk, and return the number."""

    notes: int
    milk: Object

    async def perform(self) -> int:
        for number in range(self.notes):
            await NoteActionPerformable(f"note {number}").perform()
            self.milk.set_pose(Pose([number, 0, 0]))
        return self.notes


def test_a_full_episode_takes_ends_alone_and_other_episodes_are_not_concerned(tmp_path: Path) -> None:
    queue = make(tmp_path / "spool", settings=Settings(**{**SMALL.changed(), "episode_events_max": MAX}))
    queue.put_nowait(started(), b"{}")
    for sequence in range(2, 89):
        assert queue.put_nowait(node(), b"{}") == sequence
    for _ in range(2):
        with pytest.raises(EpisodeFull, match="has 88 events, as many as one can hold: only ends"):
            queue.put_nowait(node(), b"{}", reserved=True)
    queue.put_nowait(started(2), b"{}")
    assert queue.put_nowait(node(2), b"{}") == 2
    assert queue.put_nowait(ended(), b"{}") == 89
    queue.release()


async def test_a_plan_goes_on_in_a_full_episode_and_each_recorded_node_has_its_end(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url, settings=LIMITED) as memory:
        async with memory.episode(description="patrol"):
            with BulletWorld():
                assert await PatrolActionPerformable(200, Object("milk", ObjectType.MILK)).perform() == 200
        assert "EpisodeFull" in str(memory.status.faults.last)
        await NoteActionPerformable("in an episode of its own").perform()
        await memory.flush()
        patrol, other = await memory.episodes()
        assert (patrol.status, other.status) == ("SUCCEEDED", "SUCCEEDED")
        nodes = await memory.tree(patrol)
        assert 20 < len(nodes) < MAX
        assert {each.status for each in nodes} == {"SUCCEEDED"}
        assert [each.dtype for each in await memory.tree(other)] == [None, "NoteAction"]
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    verified = await verify(log)
    await log.close()
    assert (verified.damages, verified.differences) == ([], [])
    assert (await recover(url)).failed == {}


def test_the_limit_on_the_events_of_an_episode_is_checked() -> None:
    assert Settings().episode_events_max == SEQUENCE_MAX
    for wrong in (0, 99, SEQUENCE_MAX + 1, 150.5):
        with pytest.raises(CallerError, match="from 100 to 67,108,863"):
            Settings(episode_events_max=wrong)  # type: ignore[arg-type]


async def test_the_end_of_an_episode_waits_for_a_node_that_another_thread_is_ending() -> None:
    with fakes.recorder_case(Settings()) as case, case.episode():

        async def late() -> None:
            await fakes.NoteActionPerformable("late").perform()

        ending, go = threading.Event(), threading.Event()

        def pause() -> None:
            if threading.current_thread() is thread:
                ending.set()
                go.wait(5)

        case.sink.before_end = pause
        context = contextvars.copy_context()
        thread = threading.Thread(target=lambda: context.run(asyncio.run, late()))
        thread.start()
        await asyncio.to_thread(ending.wait, 5)
        timer = threading.Timer(0.1, go.set)
        timer.start()
    thread.join()
    timer.join()
    assert case.emitter.faults.total == 0
    (events,) = [case.sink.of(each) for each in case.sink.sequences]
    assert [event.status for _, event in events if isinstance(event, NodeEnded)] == ["SUCCEEDED", "SUCCEEDED"]
    assert isinstance(events[-1][1], EpisodeEnded)


async def test_a_memory_whose_episodes_were_continued_by_an_earlier_version_stays_readable(tmp_path: Path) -> None:
    first, second = Script(1), Script(2)
    ids = [episode_text(each.episode) for each in (first, second)]
    first.put(EpisodeStarted("patrol", "me", "here", "0.1", "3.11"))
    first.put(NodeStarted("root"))
    first.put(NodeEnded(2, "INTERRUPTED"))
    first.put(EpisodeEnded("INTERRUPTED", continued_in=ids[1]))
    second.put(EpisodeStarted("patrol", "me", "here", "0.1", "3.11", continues=ids[0]))
    second.put(NodeStarted("root", continues=2))
    second.put(NodeEnded(2, "SUCCEEDED"))
    second.put(EpisodeEnded("SUCCEEDED"))
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    for each in (first, second):
        await log.append(each.records)
    await log.close()
    await rebuild_memory(url)
    async with Reading.open(url) as reading:
        parts = await reading.episodes()
        assert [(each.continues, each.continued_in) for each in parts] == [(None, ids[1]), (ids[0], None)]
    assert [each["continued_in"] for each in answer("episodes", cwd=tmp_path)] == [ids[1], None]
    assert "patrol (continues episode 1)" in pycrorm("episodes", cwd=tmp_path).stdout
    assert f"continues episode {ids[0]}" in " ".join(pycrorm("show", "2", cwd=tmp_path).stdout.split())
    assert f"continued in episode {ids[1]}" in " ".join(pycrorm("show", "1", cwd=tmp_path).stdout.split())
