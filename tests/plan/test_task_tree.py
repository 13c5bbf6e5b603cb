"""The collected task tree: its order, its drawing, and that of the plan of the thesis."""

from __future__ import annotations

import asyncio
import math
import re
from dataclasses import dataclass, field

import pytest

from pycrorm_async.plan import (
    CostmapLocation,
    MoveTorsoAction,
    NavigateAction,
    ObjectDesignatorDescription,
    ParkArmsAction,
    ParkArmsActionPerformable,
    PickUpAction,
    PlaceAction,
    SemanticCostmapLocation,
    TaskStatus,
)
from pycrorm_async.plan.failures import ObjectLost
from pycrorm_async.plan.language import ActionAbstract, BaseMotion
from pycrorm_async.plan.task import TaskTreeNode, collected_tree, current_node
from pycrorm_async.world import Arms, Grasp, Pose
from tests.plan.conftest import Scene
from tests.plan.fakes import Recording

# === task tree ================================================================================================
#
# The collected task tree: its order, its drawing, and its use beside a recorder.


@dataclass
class Step(BaseMotion):
    fails: bool = False

    async def perform(self) -> None:
        if self.fails:
            raise ObjectLost("gone")


@dataclass
class Plan(ActionAbstract):
    parts: list[Step | Plan] = field(default_factory=list)

    async def perform(self) -> None:
        for part in self.parts:
            await part.perform()


def drawn(tree: object) -> list[str]:
    return re.sub(r" \d+\.\d ms", "", str(tree)).splitlines()


async def test_a_tree_is_drawn_with_its_branches_in_order() -> None:
    with collected_tree() as tree:
        await Plan([Step(), Plan([Step(), Plan()]), Step()]).perform()
        with pytest.raises(ObjectLost):
            await Plan([Step(fails=True)]).perform()
    assert drawn(tree) == [
        "Plan SUCCEEDED",
        "├── Step SUCCEEDED",
        "├── Plan SUCCEEDED",
        "│   ├── Step SUCCEEDED",
        "│   └── Plan SUCCEEDED",
        "└── Step SUCCEEDED",
        "Plan FAILED (ObjectLost)",
        "└── Step FAILED (ObjectLost)",
    ]
    assert len(str(tree).splitlines()) == len(tree) == 8
    assert re.fullmatch(r"Plan SUCCEEDED \d+\.\d ms", str(tree).splitlines()[0])
    assert [tree.depth(node) for node in tree] == [0, 1, 1, 2, 2, 1, 0, 1]
    assert tree.children(tree.roots[0]) == tuple(node for node in tree if node.parent is tree.roots[0])


async def test_a_running_node_is_drawn_without_a_duration() -> None:
    class Looking(ActionAbstract):
        async def perform(self) -> None:
            seen.append(str(tree))

    seen: list[str] = []
    with collected_tree() as tree:
        await Looking().perform()
    assert seen == ["Looking RUNNING"]


async def test_a_child_of_a_node_that_is_not_collected_is_a_root() -> None:
    token = current_node.set(TaskTreeNode(None, "root", None, 0))
    try:
        with collected_tree() as tree:
            await Plan([Step()]).perform()
    finally:
        current_node.reset(token)
    assert drawn(tree) == ["Plan SUCCEEDED", "└── Step SUCCEEDED"]


async def test_trees_and_recorders_do_not_disturb_each_other() -> None:
    with Recording().listening() as recording, collected_tree() as outer:
        await Step().perform()
        with collected_tree() as inner:
            await Plan([Step()]).perform()
        await Step().perform()
    assert drawn(outer) == [
        "Step SUCCEEDED",
        "Plan SUCCEEDED",
        "└── Step SUCCEEDED",
        "Step SUCCEEDED",
    ]
    assert drawn(inner) == ["Plan SUCCEEDED", "└── Step SUCCEEDED"]
    assert [each.split()[0] for each in recording.notes] == "start end start start end end start end".split()


async def test_a_tree_collects_the_tasks_of_its_context_and_no_others() -> None:
    outside = asyncio.Event()

    async def other() -> None:
        await outside.wait()
        await Plan().perform()

    elsewhere = asyncio.create_task(other())
    with collected_tree() as tree:
        inside = asyncio.create_task(Plan([Step()]).perform())
        outside.set()
        await asyncio.gather(elsewhere, inside)
    assert drawn(tree) == ["Plan SUCCEEDED", "└── Step SUCCEEDED"]


async def test_a_deep_tree_is_drawn_without_recursion() -> None:
    deep = current = Plan()
    for _ in range(200):
        current.parts.append(Plan())
        current = current.parts[0]  # type: ignore[assignment]  # only plans here
    with collected_tree() as tree:
        await deep.perform()
    assert len(str(tree).splitlines()) == 201
    assert str(tree).splitlines()[200].startswith("    " * 199 + "└── Plan")


# === thesis plan ==============================================================================================
#
# The plan of thesis 5.1, from the first parked arm to the last.

TREE = """\
ParkArmsActionPerformable
└── MoveArmJointsMotion
MoveTorsoActionPerformable
└── MoveJointsMotion
NavigateActionPerformable
└── MoveMotion
PickUpActionPerformable
├── MoveTCPMotion
├── MoveGripperMotion
├── MoveTCPMotion
├── MoveGripperMotion
└── MoveTCPMotion
ParkArmsActionPerformable
└── MoveArmJointsMotion
NavigateActionPerformable
└── MoveMotion
PlaceActionPerformable
├── MoveTCPMotion
├── MoveGripperMotion
└── MoveTCPMotion
ParkArmsActionPerformable
└── MoveArmJointsMotion"""


async def thesis_plan() -> Pose:
    """The plan as it is printed there, awaited; returns the target of the cereal."""
    cereal_desig = ObjectDesignatorDescription(names=["cereal"])
    robot_desig = ObjectDesignatorDescription(names=["pr2"]).resolve()
    kitchen_desig = ObjectDesignatorDescription(names=["kitchen"])

    await ParkArmsActionPerformable(Arms.BOTH).perform()
    await MoveTorsoAction([0.3]).resolve().perform()
    pickup_pose = CostmapLocation(target=cereal_desig.resolve(), reachable_for=robot_desig).resolve()
    pickup_arm = pickup_pose.reachable_arms[0]
    await NavigateAction(target_locations=[pickup_pose.pose]).resolve().perform()
    await (
        PickUpAction(object_designator_description=cereal_desig, arms=[pickup_arm], grasps=[Grasp.FRONT])
        .resolve()
        .perform()
    )
    await ParkArmsAction([Arms.BOTH]).resolve().perform()
    place_island = SemanticCostmapLocation(
        "kitchen_island_surface", kitchen_desig.resolve(), cereal_desig.resolve()
    ).resolve()
    place_stand = CostmapLocation(place_island.pose, reachable_for=robot_desig, reachable_arm=pickup_arm).resolve()
    await NavigateAction(target_locations=[place_stand.pose]).resolve().perform()
    await PlaceAction(cereal_desig, target_locations=[place_island.pose], arms=[pickup_arm]).resolve().perform()
    await ParkArmsActionPerformable(Arms.BOTH).perform()
    return place_island.pose


async def test_the_thesis_plan_puts_the_cereal_on_the_island(scene: Scene) -> None:
    with collected_tree() as tree:
        goal = await thesis_plan()
    assert scene.cereal.pose.distance(goal) < 0.01
    island, cereal = scene.kitchen.bounding_box("kitchen_island_surface"), scene.cereal.bounding_box()
    assert math.isclose(cereal.min.z, island.max.z, abs_tol=1e-9)
    assert island.min.x < cereal.min.x < cereal.max.x < island.max.x
    assert island.min.y < cereal.min.y < cereal.max.y < island.max.y
    assert (scene.cereal.attached_to, scene.milk.pose.position) == (None, (1.3, 1, 0.9))
    assert re.sub(r" SUCCEEDED \d+\.\d ms", "", str(tree)) == TREE
    assert {node.status for node in tree} == {TaskStatus.SUCCEEDED}
