"""Gaps of the systems after the thesis', read in their code, each with the property that this package keeps instead.

Numbers are those of the table in tests/README.md; they follow the order in which the gaps were noted.
"""

from __future__ import annotations

import asyncio
import functools
import operator
import re
import sys
import tomllib
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import grimp
import pytest
from sqlalchemy import select

import pycrorm_async
from pycrorm_async import Reading, RecordedEvent, performable_of, world_of
from pycrorm_async.events.types import NodeEnded, NodeStarted
from pycrorm_async.orm import Designator, NavigateAction
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.plan import (
    ActionAbstract,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    PlanFailure,
)
from pycrorm_async.plan import MoveTorsoAction as MoveTorso
from pycrorm_async.plan import NavigateAction as Navigate
from pycrorm_async.query.again import NotPerformable
from pycrorm_async.world import Arms, BulletWorld, Grasp, Pose
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.chronicle import joints_of_bullet, numbers
from tests.promises.lab import (
    WITHIN_REACH,
    FailingActionPerformable,
    at,
    lab,
    nodes_of,
    recorded,
    results_of,
    statuses,
    url_of,
)

pytestmark = pytest.mark.slow


async def test_every_node_of_a_sequence_has_its_own_status_and_times(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab():
            plan = Navigate([Pose([1, 0, 0])]) + MoveTorso([0.2]) + FailingActionPerformable(PlanFailure("no"))
            with pytest.raises(PlanFailure):
                await (plan + NoteActionPerformable("never")).perform()
    _, sequence, *nodes = await nodes_of(tmp_path)
    assert statuses(nodes) == [
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("MoveTorsoAction", "SUCCEEDED"),
        ("MoveJointsMotion", "SUCCEEDED"),
        ("FailingAction", "FAILED"),
    ]
    assert sequence.end_ns is not None
    ends = [sequence.start_ns]
    for node in nodes:
        assert node.end_ns is not None
        assert ends[0] < node.start_ns < node.end_ns < sequence.end_ns
        if node.kind == "action":  # one after the other
            assert node.start_ns > ends[-1]
            ends.append(node.end_ns)


async def test_the_state_after_an_action_is_not_the_state_before_it(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await NavigateActionPerformable(Pose([0.6, 0.4, 0])).perform()
            await MoveTorsoActionPerformable(0.3).perform()
            await NavigateActionPerformable(WITHIN_REACH).perform()
            await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
            lifted = scene.milk.pose
    first, second = await results_of(tmp_path, select(NavigateAction).order_by(NavigateAction.id))
    assert [(at(each.robot_state.pose), each.robot_state.torso_height) for each in (first, second)] == [
        ((0, 0, 0), 0.0),
        ((0.6, 0.4, 0), 0.3),
    ]
    robot = await results_of(tmp_path, select(ObjectRow).where(ObjectRow.name == "pr2").order_by(ObjectRow.id))
    assert [at(each.pose) for each in robot] == [(0, 0, 0), (0.6, 0.4, 0), (0.6, 0.9, 0)]
    before, after = await results_of(tmp_path, select(ObjectRow).where(ObjectRow.name == "milk").order_by(ObjectRow.id))
    assert (at(before.pose), at(after.pose)) == ((1.3, 1, 0.9), lifted.position)
    assert at(before.pose) != at(after.pose)


async def test_an_observer_of_a_plan_is_notified_of_every_start_and_end(tmp_path: Path) -> None:
    seen: list[RecordedEvent] = []
    async with recorded(tmp_path) as memory:
        with memory.subscribe(seen.append), lab():
            await (Navigate([Pose([1, 0, 0])]) - NoteActionPerformable("not needed")).perform()
            with pytest.raises(PlanFailure):
                await FailingActionPerformable(PlanFailure("no")).perform()
    dtypes = {(each.episode, each.sequence): each.dtype for each in seen if isinstance(each.happening, NodeStarted)}
    assert [  # the root began before
        f"{each.dtype} RUNNING"
        if isinstance(each.happening, NodeStarted)
        else f"{dtypes[each.episode, each.happening.node]} {each.happening.status}"
        for each in seen
        if isinstance(each.happening, NodeStarted | NodeEnded)
    ] == [
        "TryInOrder RUNNING",
        "NavigateAction RUNNING",
        "MoveMotion RUNNING",
        "MoveMotion SUCCEEDED",
        "NavigateAction SUCCEEDED",
        "TryInOrder SUCCEEDED",
        "FailingAction RUNNING",
        "FailingAction FAILED",
    ]


async def test_a_stored_episode_can_be_replayed_in_a_new_world(tmp_path: Path) -> None:
    states = []
    async with recorded(tmp_path):
        with lab() as scene:
            for step in (
                ParkArmsActionPerformable(Arms.BOTH),
                NavigateActionPerformable(WITHIN_REACH),
                PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT),
                NavigateActionPerformable(Pose([-1, 0, 0], (0, 0, 0.6, 0.8))),
                ParkArmsActionPerformable(Arms.LEFT),
            ):
                await step.perform()
                states.append((datetime.now(UTC), *state_of(scene.world)))
    held = {("pr2", "milk", "l_gripper_tool_frame")}
    assert [attachments for *_, attachments in states] == [set(), set(), held, held, held]
    # Each moment in a new world, made from the memory alone.
    async with Reading.open(url_of(tmp_path)) as reading:
        for time, objects, hand, attachments in states:
            with world_of(await reading.as_of("last", time=time)) as world:
                objects_again, hand_again, attachments_again = state_of(world)
            assert [each[:3] for each in objects_again] == [each[:3] for each in objects]
            for (*_, again), (*_, joints) in zip(objects_again, objects, strict=True):
                assert again == pytest.approx(joints, abs=1e-9)
            assert attachments_again == attachments
            assert hand_again.distance(hand) < 1e-6


def state_of(world: BulletWorld) -> tuple[list[tuple[Any, ...]], Pose, set[tuple[str, str, str | None]]]:
    """Return objects in their order with poses and joints in Bullet, the pose of a hand, and attachments."""
    objects = [(each.name, each.object_type, numbers(each.pose), joints_of_bullet(each)) for each in world.objects]
    attachments = {(each.parent.name, each.child.name, each.link) for each in world.attachments}
    return objects, world.object("pr2").link_pose("l_gripper_tool_frame"), attachments


async def test_every_stored_node_can_be_turned_back_into_its_designator(tmp_path: Path) -> None:
    performed: list[Any] = [
        ParkArmsActionPerformable(Arms.BOTH),
        MoveTorsoActionPerformable(0.2),
        NavigateActionPerformable(WITHIN_REACH),
    ]
    async with recorded(tmp_path):
        with lab() as scene:
            performed.append(PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT))
            performed.append(PlaceActionPerformable(scene.milk, Arms.LEFT, Pose([1.3, 0.95, 0.9])))
            await functools.reduce(operator.add, performed).perform()
            resting, joints, standing = scene.milk.pose, scene.robot.joint_positions(), scene.robot.pose
    rows = await results_of(tmp_path, select(Designator).order_by(Designator.id))
    assert len(await nodes_of(tmp_path)) == 1 + len(rows) == 1 + 1 + 5 + 1 + 1 + 1 + 5 + 3
    language, *others = rows
    assert [type(row).__name__ for row in others if row.kind == "action"] == [type(each).dtype for each in performed]
    with pytest.raises(NotPerformable, match="Sequential is an expression"):  # its operands are rows
        performable_of(language)
    # From the rows alone the same actions run again, and the same motions, in new worlds, with the same outcome.
    for kind in ("action", "motion"):
        with lab() as again:
            for row in others:
                if row.kind == kind:
                    await performable_of(row).perform()
            assert again.robot.joint_positions() == pytest.approx(joints, abs=1e-9)
            assert again.robot.pose.distance(standing) < 1e-9
            if kind == "action":  # motions alone do not attach the milk
                assert again.milk.pose.distance(resting) < 1e-9


async def test_alternatives_that_all_fail_are_a_failure(tmp_path: Path) -> None:
    first, second = (FailingActionPerformable(PlanFailure(f"not {number}", number)) for number in (1, 2))
    async with recorded(tmp_path):
        with pytest.raises(PlanFailure):
            await (first - second).perform()
        await (first - NoteActionPerformable("this one")).perform()
    _, *nodes = await nodes_of(tmp_path)
    assert statuses(nodes) == [
        ("TryInOrder", "FAILED"),
        ("FailingAction", "FAILED"),
        ("FailingAction", "FAILED"),
        ("TryInOrder", "SUCCEEDED"),
        ("FailingAction", "FAILED"),
        ("NoteAction", "SUCCEEDED"),
    ]
    assert nodes[0].failure_message is not None
    for number in (1, 2):
        assert f"not {number}" in nodes[0].failure_message
    assert [node.failure_arguments for node in nodes[1:3]] == [["not 1", 1], ["not 2", 2]]


@dataclass
class WaitingActionPerformable(ActionAbstract):
    _before: asyncio.Event
    _after: asyncio.Event = field(default_factory=asyncio.Event)

    async def perform(self) -> None:
        self._after.set()
        await self._before.wait()


async def test_expressions_have_times(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        one = WaitingActionPerformable(asyncio.Event())
        other = WaitingActionPerformable(one._after, one._before)
        for plan in (one | other, one ^ other, one + NoteActionPerformable("then"), other * 2):
            await plan.perform()
    nodes = await nodes_of(tmp_path)
    expressions = [node for node in nodes if node.kind == "language"]
    assert [node.dtype for node in expressions] == ["Parallel", "TryAll", "Sequential", "Repeat"]
    for expression in expressions:
        inside = [node for node in nodes if node.parent_id == expression.id]
        assert len(inside) == 2
        assert expression.end_ns is not None
        for node in inside:
            assert node.end_ns is not None
            assert expression.start_ns < node.start_ns < node.end_ns < expression.end_ns
        assert expression.start_time <= inside[0].start_time


OF_ROS = "rclpy", "rosidl_runtime_py"
"""Packages that an installation of ROS brings, and no index of packages has."""


OTHERWISE_NAMED = {"bson": "pymongo", "opentelemetry": "opentelemetry-sdk"}
"""The distributions of packages that an extra brings, where it is not installed and the names differ."""


def test_all_imports_are_declared_and_no_code_is_generated() -> None:
    root = Path(pycrorm_async.__file__).parent
    project = tomllib.loads((root.parent / "pyproject.toml").read_text())["project"]
    declared = [
        *project["dependencies"],
        *(each for extra in project["optional-dependencies"].values() for each in extra),
    ]
    names = {canonical(each) for each in declared}
    provided = metadata.packages_distributions()
    graph = grimp.build_graph("pycrorm_async", include_external_packages=True, cache_dir=None)
    for imported in {each for each in graph.modules if graph.is_module_squashed(each)}:
        if imported in sys.stdlib_module_names or imported in OF_ROS:
            continue
        distributions = provided.get(imported, [OTHERWISE_NAMED.get(imported, imported)])
        importers = graph.find_modules_that_directly_import(imported)
        assert names & {canonical(each) for each in distributions}, f"{importers} import {imported}"
    assert not [path for path in root.rglob("*") if path.suffix in (".jinja", ".j2", ".tmpl")]


def canonical(requirement: str) -> str:
    """Return the distribution's name in the form of the package index."""
    return re.split(r"[;\[<>=!~ ]", requirement)[0].lower().replace("_", "-")
