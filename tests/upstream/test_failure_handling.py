"""PyCRAM's tests of retrying (July 2024), by name: the alternatives of a description are tried in turn."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import IKError, ParkArmsAction, PickUpAction, PlanFailure, Retry, TaskStatus, collected_tree
from pycrorm_async.plan.failures import GripperClosedCompletely
from pycrorm_async.world import Arms, Grasp, Pose
from tests.plan.conftest import Scene, kitchen
from tests.promises.lab import statuses, url_of
from tests.upstream.conftest import Recorded

pytestmark = pytest.mark.slow


async def test_retry_with_success(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
        with kitchen() as scene:
            await Retry(ParkArmsAction([Arms.LEFT]), max_tries=5).perform()
            # The right arm does not reach from there, the left one does: the second alternative.
            scene.robot.set_pose(Pose([0.6, 0.4, 0]))
            await Retry(PickUpAction(scene.milk, [Arms.RIGHT, Arms.LEFT], [Grasp.FRONT])).perform()
            assert scene.robot.attachments == {scene.milk: "l_gripper_tool_frame"}
    nodes = await Recorded(tmp_path).all(select(TaskTreeNode).order_by(TaskTreeNode.id))
    assert statuses(nodes) == [
        (None, "SUCCEEDED"),
        ("Retry", "SUCCEEDED"),
        ("ParkArmsAction", "SUCCEEDED"),
        ("MoveArmJointsMotion", "SUCCEEDED"),
        ("Retry", "SUCCEEDED"),
        ("PickUpAction", "FAILED"),
        ("MoveTCPMotion", "FAILED"),
        ("PickUpAction", "SUCCEEDED"),
        ("MoveTCPMotion", "SUCCEEDED"),
        ("MoveGripperMotion", "SUCCEEDED"),
        ("MoveTCPMotion", "SUCCEEDED"),
        ("MoveGripperMotion", "SUCCEEDED"),
        ("MoveTCPMotion", "SUCCEEDED"),
    ]


async def test_retry_with_failure(scene: Scene) -> None:
    with collected_tree() as tree, pytest.raises(PlanFailure) as caught:
        # From the origin no alternative can be reached.
        await Retry(PickUpAction(scene.milk, [Arms.LEFT, Arms.RIGHT], [Grasp.FRONT, Grasp.TOP]), max_tries=3).perform()
    assert isinstance(caught.value, IKError)
    assert not isinstance(caught.value, GripperClosedCompletely)
    tried = [node for node in tree if type(node.designator).__name__ == "PickUpActionPerformable"]
    assert [(node.designator.arm, node.designator.grasp) for node in tried] == [  # type: ignore[union-attr]  # they are
        (Arms.LEFT, Grasp.FRONT),
        (Arms.LEFT, Grasp.TOP),
        (Arms.RIGHT, Grasp.FRONT),
    ]
    assert {node.status for node in tree} == {TaskStatus.FAILED}
