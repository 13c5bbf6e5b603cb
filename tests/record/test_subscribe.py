"""A program in the same process receives every event as it is recorded, and never delays the plan."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from pycrorm_async import Memory, RecordedEvent
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, NodeEnded, NodeStarted, ObjectAdded
from pycrorm_async.plan import ActionAbstract, PlanFailure
from pycrorm_async.world import BulletWorld, Object, ObjectType
from tests.databases import ask, put_memory

pytestmark = pytest.mark.slow


@dataclass
class SayActionPerformable(ActionAbstract):
    text: str

    async def perform(self) -> None:
        if self.text == "nothing":
            raise PlanFailure("nothing to say")


@pytest.fixture
def url(tmp_path: Path) -> str:
    return put_memory(tmp_path / "memory.db")


async def test_every_event_arrives_once_in_order_including_the_end_of_a_failed_node(url: str) -> None:
    seen: list[RecordedEvent] = []
    async with Memory.open(url) as memory:
        with memory.subscribe(seen.append):
            async with memory.episode(description="said") as episode:
                with BulletWorld():
                    Object("milk", ObjectType.MILK)
                    await SayActionPerformable("hello").perform()
                    with contextlib.suppress(PlanFailure):
                        await SayActionPerformable("nothing").perform()
        await SayActionPerformable("unobserved").perform()
    logged = ask(
        url, f"SELECT sequence, type, payload FROM event JOIN episode ON number = episode WHERE id = '{episode}'"
    )
    assert [(each.episode, each.sequence, type(each.happening).__name__) for each in seen] == [
        (str(episode), sequence, kind) for sequence, kind, _ in sorted(logged)
    ]
    kinds = [type(each.happening) for each in seen]
    assert kinds[:3] == [EpisodeStarted, NodeStarted, ObjectAdded]
    assert kinds[-1] is EpisodeEnded
    nodes = [(each.dtype, each.happening.kind) for each in seen if isinstance(each.happening, NodeStarted)]
    assert nodes == [(None, "root"), ("SayAction", "action"), ("SayAction", "action")]
    ends = [each.happening for each in seen if isinstance(each.happening, NodeEnded)]
    assert [each.status for each in ends] == ["SUCCEEDED", "FAILED", "SUCCEEDED"]
    assert ends[1].failure is not None
    assert ends[1].failure.message == "nothing to say"
    logged_ends = [json.loads(payload) for _, kind, payload in sorted(logged) if kind == "NodeEnded"]
    assert [each.get("status", "SUCCEEDED") for each in logged_ends] == [each.status for each in ends]


async def test_a_callback_that_blocks_does_not_delay_the_plan_and_missed_events_are_counted(url: str) -> None:
    seen: list[RecordedEvent] = []
    may_go = threading.Event()

    def block(event: RecordedEvent) -> None:
        may_go.wait(60)
        seen.append(event)

    async with Memory.open(url) as memory:
        subscription = memory.subscribe(block, buffer=5)
        for _ in range(20):
            await SayActionPerformable("hello").perform()
        recorded = 20 * 6  # each in an episode of its own: start, root, node, and their ends
        assert subscription.left_out >= recorded - 6  # five in the buffer, one in the callback
        may_go.set()
        subscription.close()
        subscription.join()
        assert len(seen) + subscription.left_out == recorded
        assert [each.sequence for each in seen[:5]] == [1, 2, 3, 4, 5]


async def test_a_callback_that_raises_is_counted_and_logged_once_and_gets_the_next_event(
    url: str, caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[RecordedEvent] = []

    def fail(event: RecordedEvent) -> None:
        seen.append(event)
        raise ValueError("not for me")

    async with Memory.open(url) as memory:
        with caplog.at_level(logging.ERROR), memory.subscribe(fail) as subscription:
            await SayActionPerformable("hello").perform()
        assert (len(seen), subscription.failed) == (6, 6)
    assert [each.message[:44] for each in caplog.records] == ["an observer of recorded events raised at Rec"]


async def test_a_stream_ends_with_the_memory_after_its_last_event(url: str) -> None:
    seen: list[RecordedEvent] = []

    async def watch(memory: Memory) -> None:
        async for event in memory.events():
            seen.append(event)  # noqa: PERF401 - what came before an error counts too

    async with Memory.open(url) as memory:
        watching = asyncio.create_task(watch(memory))
        await asyncio.sleep(0)
        async with memory.episode(description="open until the end"):
            await SayActionPerformable("hello").perform()
            await asyncio.sleep(0.05)
            assert [type(each.happening).__name__ for each in seen][-1] == "NodeEnded"
    await asyncio.wait_for(watching, 10)
    assert [each.sequence for each in seen] == [1, 2, 3, 4, 5, 6]


async def test_a_stream_whose_loop_is_closed_does_not_delay_the_plan(url: str) -> None:
    async with Memory.open(url) as memory:

        def abandon() -> None:
            async def begin() -> object:
                return memory.events()

            asyncio.run(begin())

        await asyncio.to_thread(abandon)
        assert len(list(observers_of(memory))) == 1
        await SayActionPerformable("hello").perform()
        assert list(observers_of(memory)) == []


def observers_of(memory: Memory) -> Iterator[object]:
    yield from memory._open_parts.emitter.feed.observers
