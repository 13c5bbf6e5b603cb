"""PyCRAM's tests of its task tree (July 2024), by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import ActionAbstract, PlanFailure, SimulatedTaskTree, TaskStatus, collected_tree
from pycrorm_async.plan.task import CollectedTree
from pycrorm_async.world import Pose
from tests.plan.conftest import Scene, kitchen
from tests.promises.lab import url_of
from tests.upstream.conftest import Recorded, common_plan

# === task tree ================================================================================================
#
# PyCRAM's tests of its task tree (July 2024), by name; the collected tree and the recorded one must agree.


@dataclass
class FailingActionPerformable(ActionAbstract):
    async def perform(self) -> None:
        raise PlanFailure("as it should")


def leaves(tree: CollectedTree) -> list[str]:
    return [type(node.designator).__name__ for node in tree if not tree.children(node)]


async def test_tree_creation(scene: Scene) -> None:
    with collected_tree() as tree:
        await common_plan()
    # Theirs counts 15 with a root, which belongs to a memory here: 4 actions, 1 + 1 + 5 + 3 motions.
    assert len(tree) == 14
    assert len(leaves(tree)) == 10
    assert {node.status for node in tree} == {TaskStatus.SUCCEEDED}


@pytest.mark.slow
async def test_exception(tmp_path: Path) -> None:
    with pytest.raises(PlanFailure):
        async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
            with collected_tree() as tree:
                await FailingActionPerformable().perform()
    (node,) = tree
    assert (node.status, type(node.failure)) == (TaskStatus.FAILED, PlanFailure)
    rows = await Recorded(tmp_path).all(select(TaskTreeNode).order_by(TaskTreeNode.id))
    assert [(row.dtype, row.status, row.reason, row.failure_message) for row in rows] == [
        (None, TaskStatus.FAILED, "PlanFailure", "as it should"),
        ("FailingAction", TaskStatus.FAILED, "PlanFailure", "as it should"),
    ]


async def test_execution(scene: Scene) -> None:
    with collected_tree() as tree:
        await common_plan()
    hand = scene.robot.link_pose("l_gripper_tool_frame")
    scene.world.reset()
    for node in tree:
        if not tree.children(node) and node.designator is not None:
            await node.designator.perform()
    # The same motions bring the robot to the same place; only actions move the milk with it.
    assert scene.robot.pose == Pose([0.6, 0.4, 0])
    assert scene.robot.joint_position("torso_lift_joint") == 0.3
    assert scene.robot.link_pose("l_gripper_tool_frame").distance(hand) < 1e-6
    assert scene.milk.pose == Pose([1.3, 1, 0.9])


async def test_simulated_tree(scene: Scene) -> None:
    with collected_tree() as outside, SimulatedTaskTree() as tree:
        await common_plan()
    assert (len(tree), len(leaves(tree))) == (14, 10)
    assert {node.status for node in tree} == {TaskStatus.SUCCEEDED}
    assert len(outside) == 0
    assert scene.robot.pose == Pose()
    assert scene.robot.joint_position("torso_lift_joint") == 0.0


@pytest.mark.slow
async def test_to_sql(tmp_path: Path) -> None:
    """Every node of the tree has its row, with the same values."""
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
        with kitchen(), collected_tree() as tree:
            await common_plan()
    root, *rows = await Recorded(tmp_path).all(select(TaskTreeNode).order_by(TaskTreeNode.id))
    assert (root.kind, root.action) == ("root", None)
    assert [(row.dtype, row.kind, row.status, row.reason) for row in rows] == [
        (node.designator.__dtype__, node.kind, node.status, None) for node in tree if node.designator is not None
    ]
    assert [row.parent.dtype for row in rows] == [
        node.parent.designator.__dtype__ if node.parent is not None and node.parent.designator is not None else None
        for node in tree
    ]
    for row, node in zip(rows, tree, strict=True):
        assert row.end_ns is not None
        assert node.ended_ns is not None
        assert node.started_ns <= row.start_ns <= row.end_ns
        assert node.ended_ns <= row.end_ns
        assert type(row.action).__name__ == row.dtype
