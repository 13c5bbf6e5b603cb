"""Measured defects in recording of the system of the thesis, each with the property that this package keeps instead.

Numbers as in tests/README.md. Every test covers the whole way: a plan in a Bullet world, a memory in a SQLite file, the
mapped classes.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Reading
from pycrorm_async.orm import (
    Action,
    Attachment,
    BelieveObject,
    ClosingMotion,
    Designator,
    Detection,
    JointChange,
    LocationCandidate,
    LocationRefusal,
    LocationResolution,
    MoveAndPickUpAction,
    MoveArmJointsMotion,
    MoveJointsMotion,
    Object,
    ObjectPart,
    OpeningMotion,
    PickUpAction,
)
from pycrorm_async.plan import (
    ActionAbstract,
    CloseActionPerformable,
    CostmapLocation,
    DetectingMotion,
    IKError,
    LookAtActionPerformable,
    MoveAndPickUpPerformable,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectDesignator,
    OpenActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
)
from pycrorm_async.plan import BelieveObject as Believed
from pycrorm_async.plan import ObjectPart as Part
from pycrorm_async.plan.failures import PerceptionObjectNotInWorld, ReachabilityFailure
from pycrorm_async.world import Arms, Grasp, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import (
    MILK_AT,
    WITHIN_REACH,
    at,
    every,
    lab,
    nodes_of,
    recorded,
    results_of,
    statuses,
    turned,
    url_of,
)

pytestmark = pytest.mark.slow


@dataclass
class MoveAsideActionPerformable(ActionAbstract):
    """Move its object while it runs."""

    what: ObjectDesignator
    where: Pose

    async def perform(self) -> None:
        assert self.what.world_object is not None
        self.what.world_object.set_pose(self.where)


async def test_an_object_is_stored_where_it_was_when_the_action_started(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        with lab() as scene:
            scene.milk.set_pose(Pose([1.3, 0.95, 0.9]))
            await NavigateActionPerformable(WITHIN_REACH).perform()
            await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
            scene.cereal.set_pose(Pose([4, 4, 0.9]))
            meant = ObjectDesignator("cereal", ObjectType.BREAKFAST_CEREAL, scene.cereal)
            await MoveAsideActionPerformable(meant, Pose([5, 5, 0.9])).perform()
            scene.robot.detach(scene.milk)
            scene.milk.set_pose(Pose([5, 5, 1]))
        await memory.flush()
        (pick,) = await every(memory, select(PickUpAction))
        assert at(pick.object.pose) == (1.3, 0.95, 0.9)
        (aside,) = await every(memory, select(memory.mapped("MoveAsideAction")))
        assert at(aside.what.pose) == (4, 4, 0.9)
        assert at(aside.where) == (5, 5, 0.9)
        milk = await every(memory, select(Object).where(Object.name == "milk").order_by(Object.id))
        assert [at(each.pose) for each in milk[:2]] == [MILK_AT, (1.3, 0.95, 0.9)]
        assert at(milk[-1].pose) == (5, 5, 1)
        assert {row.identity_id for row in milk} == {milk[0].id}


async def test_an_action_on_a_believed_object_is_stored_with_its_believed_pose(tmp_path: Path) -> None:
    cup = Believed("cup", ObjectType.JEROEN_CUP, Pose([2, 3, 0.5]))
    async with recorded(tmp_path):
        with lab():
            with pytest.raises(PerceptionObjectNotInWorld):
                await PickUpActionPerformable(cup, Arms.LEFT, Grasp.TOP).perform()
            await NavigateActionPerformable(cup.pose).perform()
    (pick,) = await results_of(tmp_path, select(PickUpAction))
    assert isinstance(pick.object, BelieveObject)
    assert (pick.object.name, pick.object.obj_type, pick.object.identity_id) == ("cup", ObjectType.JEROEN_CUP, None)
    assert at(pick.object.pose) == (2, 3, 0.5)
    assert statuses(await nodes_of(tmp_path)) == [
        (None, "SUCCEEDED"),
        ("PickUpAction", "FAILED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
    ]


TOO_HIGH = Pose([1.3, 1, 2.5])
TOO_FAR = re.compile(r"LEFT: too far: from shoulder to wrist \d\.\d{3} m or more, but the arm reaches 0\.719 m")


async def test_joint_targets_places_detections_and_attachments_are_recorded(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await ParkArmsActionPerformable(Arms.LEFT).perform()
            await MoveTorsoActionPerformable(0.3).perform()
            stand = CostmapLocation(scene.milk, reachable_for=scene.robot, reachable_arm=Arms.LEFT).resolve()
            with pytest.raises(ReachabilityFailure):
                CostmapLocation(TOO_HIGH, reachable_for=scene.robot, reachable_arm=Arms.LEFT).resolve()
            await MoveAndPickUpPerformable(stand.pose, scene.milk, Arms.LEFT, Grasp.FRONT).perform()
            scene.robot.detach(scene.milk)
            await LookAtActionPerformable(scene.cereal.pose).perform()
            await DetectingMotion(ObjectType.BREAKFAST_CEREAL).perform()
            parked = {name: scene.robot.robot_description.arms[Arms.LEFT].park[name] for name in LEFT_ARM}  # type: ignore[union-attr]  # it is a PR2
    rows = {row.dtype: row for row in await results_of(tmp_path, select(Designator).order_by(Designator.id))}
    arm = rows["MoveArmJointsMotion"]
    assert isinstance(arm, MoveArmJointsMotion)
    assert (arm.left_arm_poses, arm.right_arm_poses) == (parked, {})
    torso = rows["MoveJointsMotion"]
    assert isinstance(torso, MoveJointsMotion)
    assert (torso.names, torso.positions) == (["torso_lift_joint"], [0.3])
    both = rows["MoveAndPickUpAction"]
    assert isinstance(both, MoveAndPickUpAction)
    assert (at(both.pose), at(both.object.pose), both.arm, both.grasp) == (
        stand.pose.position,
        MILK_AT,
        Arms.LEFT,
        Grasp.FRONT,
    )
    resolved, failed = await results_of(tmp_path, select(LocationResolution).order_by(LocationResolution.id))
    assert (resolved.location, resolved.offered, resolved.taken) == ("CostmapLocation", 1, 0)
    assert resolved.considered >= 1
    assert (failed.offered, failed.taken, failed.considered, failed.refused) == (0, None, 600, 600)
    assert resolved.refused == resolved.considered - 1
    for each in (resolved, failed):
        assert (each.occupied_cells or 0) + (each.free_cells or 0) == 200 * 200
        assert (each.hidden_cells, (each.occupied_cells or 0) > 1_000) == (0, True)
    refused = await results_of(tmp_path, select(LocationRefusal).order_by(LocationRefusal.position))
    refused = [each for each in refused if each.resolution_id == failed.id]
    assert [each.position for each in refused] == list(range(600))
    assert len({(each.x, each.y) for each in refused}) == 600
    for each in refused:  # each on the floor, near the pose that is too high, facing it
        assert math.dist((each.x, each.y, each.z), TOO_HIGH.position) < 4
        assert math.isclose(math.atan2(1 - each.y, 1.3 - each.x), Pose((0, 0, 0), turned(each)).yaw, abs_tol=1e-9)
        assert TOO_FAR.fullmatch(each.reason), each.reason
    with lab() as again:
        await MoveTorsoActionPerformable(0.3).perform()
        for each in refused[::200]:  # the arm itself refuses with the same words
            again.robot.set_pose(Pose(at(each), turned(each)))
            with pytest.raises(IKError) as unreachable:
                await MoveTCPMotion(TOO_HIGH, Arms.LEFT).perform()
            assert each.reason.removeprefix("LEFT: ") in str(unreachable.value)
    (candidate,) = await results_of(tmp_path, select(LocationCandidate))
    assert ((candidate.x, candidate.y, candidate.z), candidate.arms) == (stand.pose.position, "LEFT")
    (seen,) = await results_of(tmp_path, select(Detection))
    assert (seen.source, seen.looked_for, seen.name) == ("camera", ObjectType.BREAKFAST_CEREAL, "cereal")
    assert ((seen.x, seen.y, seen.z), seen.visible, seen.node.dtype) == ((1.3, 0.7, 0.95), 1.0, "DetectingMotion")
    held = await results_of(tmp_path, select(Attachment).order_by(Attachment.id))
    assert [(each.kind, each.parent.name, each.child.name, each.link) for each in held] == [
        ("attached", "pr2", "milk", "l_gripper_tool_frame"),
        ("detached", "pr2", "milk", "l_gripper_tool_frame"),
    ]


LEFT_ARM = [
    "l_shoulder_pan_joint",
    "l_shoulder_lift_joint",
    "l_upper_arm_roll_joint",
    "l_elbow_flex_joint",
    "l_forearm_roll_joint",
    "l_wrist_flex_joint",
    "l_wrist_roll_joint",
]


async def test_an_action_without_a_mapped_class_is_stored_with_the_rest_of_the_tree(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await NoteActionPerformable("no class of the ORM knows of this").perform()
            await MoveAndPickUpPerformable(WITHIN_REACH, scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    assert statuses(await nodes_of(tmp_path)) == [
        (None, "SUCCEEDED"),
        ("NoteAction", "SUCCEEDED"),
        ("MoveAndPickUpAction", "SUCCEEDED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("FaceAtAction", "SUCCEEDED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("LookAtAction", "SUCCEEDED"),
        ("LookingMotion", "SUCCEEDED"),
        ("PickUpAction", "SUCCEEDED"),
        *[("MoveTCPMotion", "SUCCEEDED"), ("MoveGripperMotion", "SUCCEEDED")] * 2,
        ("MoveTCPMotion", "SUCCEEDED"),
    ]
    async with Reading.open(url_of(tmp_path)) as reading:
        (nothing,) = await every(reading, select(reading.mapped("NoteAction")))
        assert nothing.text == "no class of the ORM knows of this"
        assert isinstance(nothing, Action)


async def test_opening_and_closing_keep_their_object(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab():
            handle = Part("sink_area_drawer_handle", WorldObject("kitchen", ObjectType.ENVIRONMENT))
            await NavigateActionPerformable(Pose([0.1, 1.1, 0])).perform()
            await MoveTorsoActionPerformable(0.1).perform()
            await OpenActionPerformable(handle, Arms.LEFT).perform()
            await CloseActionPerformable(handle, Arms.LEFT).perform()
    for mapped, x in ((OpeningMotion, 1.0), (ClosingMotion, 0.7)):
        (motion,) = await results_of(tmp_path, select(mapped))
        assert isinstance(motion.object, ObjectPart)
        assert motion.object.part_of is not None
        assert (motion.object.name, motion.object.part_of.name) == ("sink_area_drawer_handle", "kitchen")
        assert motion.object.pose is not None
        assert motion.object.pose.x == pytest.approx(x)  # the drawing of the kitchen; 0.3 m further out when open
        assert motion.arm is Arms.LEFT
    turns = await results_of(tmp_path, select(JointChange).where(JointChange.joint == "sink_area_drawer_joint"))
    assert [each.position for each in turns] == [pytest.approx(0.3), 0.0]
