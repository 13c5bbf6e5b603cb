"""Measured defects in outcomes and times of the system of the thesis, each with what this package keeps instead.

Numbers as in tests/README.md. Every test covers the whole way: a plan in a Bullet world, a memory in a SQLite file, the
mapped classes.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from contextvars import copy_context
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select

import pycrorm_async.plan.failures
from pycrorm_async import Memory, Reading
from pycrorm_async.orm import Attachment, Object, ProcessMetaData, TaskTreeNode
from pycrorm_async.orm import Pose as PoseRow
from pycrorm_async.plan import ActionAbstract, IKError, NavigateActionPerformable, PickUpActionPerformable, PlanFailure
from pycrorm_async.plan.failures import CollisionError, ReasoningError
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, Grasp, Pose
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import (
    WITHIN_REACH,
    FailingActionPerformable,
    every,
    lab,
    nodes_of,
    recorded,
    results_of,
    url_of,
    written,
)

pytestmark = pytest.mark.slow


async def test_an_error_in_an_action_differs_from_a_plan_failure_and_from_an_action_that_never_ran(
    tmp_path: Path,
) -> None:
    with pytest.raises(ZeroDivisionError):
        async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
            with pytest.raises(PlanFailure):
                await FailingActionPerformable(PlanFailure("the milk is gone", "milk", 3)).perform()
            await FailingActionPerformable(ZeroDivisionError("division by zero", 7)).perform()
            await NoteActionPerformable("never ran").perform()
    root, failed, crashed = await nodes_of(tmp_path)
    assert (root.status, root.reason) == (TaskStatus.ERROR, "ZeroDivisionError")
    assert (failed.status, failed.reason, failed.failure_message) == (
        TaskStatus.FAILED,
        "PlanFailure",
        "the milk is gone",
    )
    assert (crashed.status, crashed.reason) == (TaskStatus.ERROR, "ZeroDivisionError")
    assert crashed.failure_message == "('division by zero', 7)"
    assert crashed.failure_arguments == ["division by zero", 7]
    assert all(node.end_time is not None and node.end_time >= node.start_time for node in (root, failed, crashed))
    (episode,) = await results_of(tmp_path, select(ProcessMetaData))
    assert (episode.status, episode.failure_type) == ("ERROR", "builtins.ZeroDivisionError")


async def test_a_failure_keeps_its_message_and_its_arguments(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            with pytest.raises(PlanFailure):
                await FailingActionPerformable(PlanFailure("the milk is gone", "milk", 3)).perform()
            with pytest.raises(IKError) as caught:
                await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    nodes = await nodes_of(tmp_path)
    assert nodes[1].failure_arguments == ["the milk is gone", "milk", 3]
    # 0.1 m before the milk along the gripper, which points along x of the map with all joints at zero
    goal = caught.value.pose
    assert goal.position == pytest.approx((1.2, 1.0, 0.9))
    for node in nodes[2:]:
        assert (node.status, node.reason) == (TaskStatus.FAILED, "IKError")
        assert node.failure_message == str(caught.value)
        assert node.failure_message.startswith(
            "l_gripper_tool_frame cannot reach (1.200, 1.000, 0.900) with the LEFT arm"
        )
        assert node.failure_message.endswith(", reaching for milk")
        assert node.failure_arguments == [written(goal), "LEFT", "l_gripper_tool_frame", caught.value.reason, "milk"]


async def test_every_class_of_failure_can_be_raised_and_is_recorded(tmp_path: Path) -> None:
    module = pycrorm_async.plan.failures
    # The other classes are built from more than a message, by the code that raises them.
    kinds = [
        kind
        for kind in vars(module).values()
        if isinstance(kind, type)
        and issubclass(kind, PlanFailure)
        and (kind is PlanFailure or "__init__" not in vars(kind))
    ]
    assert {CollisionError, ReasoningError} < set(kinds)
    assert len(kinds) >= 52
    async with recorded(tmp_path):
        for kind in kinds:
            with pytest.raises(kind):
                await FailingActionPerformable(kind(f"this is {kind.__name__}", kind.__name__, 1.5)).perform()
    _, *nodes = await nodes_of(tmp_path)
    assert [(node.status, node.reason, node.failure_message, node.failure_arguments) for node in nodes] == [
        (TaskStatus.FAILED, name, f"this is {name}", [f"this is {name}", name, 1.5])
        for name in (kind.__name__ for kind in kinds)
    ]


@dataclass
class InnerActionPerformable(ActionAbstract):
    owner: str

    async def perform(self) -> None:
        await asyncio.sleep(0)


@dataclass
class SlowActionPerformable(ActionAbstract):
    owner: str

    async def perform(self) -> None:
        await asyncio.to_thread(ALL_STARTED.wait, 30)
        for _ in range(5):
            await InnerActionPerformable(self.owner).perform()


ALL_STARTED = threading.Barrier(6)


async def test_concurrent_plans_never_nest_into_each_other(tmp_path: Path) -> None:
    def run_in_own_loop(owner: str) -> None:
        asyncio.run(SlowActionPerformable(owner).perform())

    ALL_STARTED.reset()
    async with recorded(tmp_path):
        tasks = [asyncio.create_task(SlowActionPerformable(f"task {index}").perform()) for index in range(3)]
        contexts = [copy_context() for _ in range(3)]
        threads = [
            threading.Thread(target=context.run, args=(run_in_own_loop, f"thread {index}"))
            for index, context in enumerate(contexts)
        ]
        for thread in threads:
            thread.start()
        await asyncio.gather(*tasks)
        for thread in threads:
            await asyncio.to_thread(thread.join)
    async with Reading.open(url_of(tmp_path)) as reading:
        nodes = {node.id: node for node in await reading.tree(1)}
    owners = {f"{kind} {index}" for kind in ("task", "thread") for index in range(3)}
    slow = [node for node in nodes.values() if node.dtype == "SlowAction"]
    assert {node.parameters["owner"] for node in slow} == owners
    assert {node.depth for node in slow} == {1}
    inner = [node for node in nodes.values() if node.dtype == "InnerAction"]
    assert len(inner) == 30
    for node in inner:
        assert node.parent_id is not None
        parent = nodes[node.parent_id]
        assert (parent.dtype, parent.parameters["owner"]) == ("SlowAction", node.parameters["owner"])
    # They ran concurrently: all six began before the first of them ended.
    assert max(node.started_at for node in slow) <= min(node.started_at for node in inner)


@dataclass
class LookingBackActionPerformable(ActionAbstract):
    """Query the memory about the running action itself."""

    _memory: Memory
    _seen: list[TaskTreeNode] = field(default_factory=list)

    async def perform(self) -> None:
        await NoteActionPerformable("before").perform()
        await self._memory.flush()
        self._seen += await every(self._memory, select(TaskTreeNode).order_by(TaskTreeNode.id))


async def test_a_node_is_running_until_it_ends_and_the_root_ends_too(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        action = LookingBackActionPerformable(memory)
        await action.perform()
    assert [(node.dtype, node.status, node.end_time is None) for node in action._seen] == [
        (None, TaskStatus.RUNNING, True),
        ("LookingBackAction", TaskStatus.RUNNING, True),
        ("NoteAction", TaskStatus.SUCCEEDED, False),
    ]
    root, looking, nothing = await nodes_of(tmp_path)
    assert {node.status for node in (root, looking, nothing)} == {TaskStatus.SUCCEEDED}
    assert None not in (root.end_time, looking.end_time, nothing.end_time)
    assert root.start_ns <= looking.start_ns <= nothing.start_ns
    assert nothing.end_ns is not None
    assert looking.end_ns is not None
    assert root.end_ns is not None
    assert nothing.start_ns <= nothing.end_ns <= looking.end_ns <= root.end_ns


@pytest.fixture
def far_from_greenwich(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The local time of the process is five hours and three quarters ahead of UTC."""
    with monkeypatch.context() as changed:
        changed.setenv("TZ", "XYZ-05:45")
        time.tzset()
        assert datetime.now().astimezone().utcoffset() == timedelta(hours=5, minutes=45)
        yield
    time.tzset()


async def test_all_times_are_moments_in_utc_whatever_the_local_time_is(
    tmp_path: Path, far_from_greenwich: None
) -> None:
    begun = datetime.fromtimestamp(time.time_ns() // 1000 / 1e6, UTC)
    async with recorded(tmp_path):
        with lab() as scene:
            await NavigateActionPerformable(Pose(WITHIN_REACH.position)).perform()
            await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    ended = datetime.now(UTC)
    moments = [
        *await results_of(tmp_path, select(ProcessMetaData.created_at)),
        *await results_of(tmp_path, select(ProcessMetaData.ended_at)),
        *await results_of(tmp_path, select(TaskTreeNode.start_time)),
        *await results_of(tmp_path, select(TaskTreeNode.end_time)),
        *await results_of(tmp_path, select(PoseRow.time)),
        *await results_of(tmp_path, select(Object.time)),
        *await results_of(tmp_path, select(Attachment.time)),
    ]
    assert len(moments) > 30
    assert {moment.utcoffset() for moment in moments} == {timedelta(0)}
    millisecond = timedelta(milliseconds=1)
    assert begun - millisecond <= min(moments) <= max(moments) <= ended + millisecond
