"""Robots of other builds than the PR2's, also with other base links, perform what their parts allow."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.metadata import distribution
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.transport import TransportPolicy
from pycrorm_async.orm import PickUpWithContextView
from pycrorm_async.orm import TransportAction as TransportRow
from pycrorm_async.plan import (
    AccessingLocation,
    ActionAbstract,
    CostmapLocation,
    DatabaseCostmapLocation,
    DetectActionPerformable,
    FaceAtPerformable,
    GripActionPerformable,
    LookAtActionPerformable,
    MoveJointsMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectPart,
    Parallel,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    Resource,
    SetGripperActionPerformable,
    SimulatedTaskTree,
    TransportActionPerformable,
    geometry,
    simulated_robot,
)
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    ManipulationGoalInCollision,
    ReachabilityFailure,
)
from pycrorm_async.plan.motions import simulated_robot_within
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import (
    COURIER,
    PR2,
    Arms,
    BulletWorld,
    Drive,
    Grasp,
    GripperState,
    Limits,
    Object,
    ObjectType,
    Pose,
    RobotDescription,
    describe_arm,
    describe_robot,
    register_robot,
)
from pycrorm_async.world.models import box_urdf, built_in_model
from pycrorm_async.world.pose import rotated, yaw_quaternion
from tests.world.fakes import HEIGHT_M, RAILS, link_poses, rail_robot, raised_robot

# === any robot ================================================================================================
#
# Robots of other builds than the PR2's perform every action that their parts allow, and fail at the others by name.

MODELS = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")))
PANDA_URDF = MODELS / "panda_description/urdf/panda.urdf"
PANDA_SRDF = MODELS / "panda_description/srdf/panda.srdf"
TIAGO_URDF = MODELS / "tiago_description/robots/tiago_no_hand.urdf"
TABLE = """<robot name="table"><link name="top"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1"
iyz="0" izz="1"/></inertial><collision><origin xyz="0 0 0.375"/><geometry><box size="0.6 1.2 0.75"/></geometry>
</collision></link></robot>"""


@pytest.fixture
def courier() -> Iterator[Object]:
    with BulletWorld(), simulated_robot:
        yield Object("courier", ObjectType.ROBOT)


async def test_the_courier_detects_and_transports_an_object(courier: Object) -> None:
    table = Object("table", ObjectType.ENVIRONMENT, TABLE, pose=Pose([2, 0, 0]))
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.85, 0.3, 0.84]))
    await NavigateActionPerformable(Pose([0.9, 0.3, 0])).perform()
    await LookAtActionPerformable(milk.pose).perform()
    found = await DetectActionPerformable(milk).perform()
    assert found.name == "milk"
    goal = Pose([1.85, -0.3, 0.84])
    await TransportActionPerformable(milk, Arms.RIGHT, goal).perform()
    assert milk.pose.distance(goal) < 1e-5
    assert milk.attached_to is None
    park = COURIER.arms[Arms.RIGHT].park
    assert {joint: courier.joint_position(joint) for joint in park} == dict(park)
    assert courier.bounding_box("base_link").min.x < table.pose.position.x


async def test_the_courier_fails_at_what_its_build_lacks(courier: Object) -> None:
    milk = Object("milk", ObjectType.MILK, pose=Pose([0.7, 0, 0.9]))
    for action, part in (
        (MoveTorsoActionPerformable(0.1), "courier has no torso to lift"),
        (ParkArmsActionPerformable(Arms.LEFT), "courier has no LEFT arm"),
        (ParkArmsActionPerformable(Arms.BOTH), "courier has no LEFT arm"),
        (SetGripperActionPerformable(Arms.LEFT, GripperState.OPEN), "courier has no LEFT arm"),
        (PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT), "courier has no LEFT arm"),
        (PickUpActionPerformable(milk, Arms.named("CENTRE"), Grasp.FRONT), "courier has no CENTRE arm"),
        (TransportActionPerformable(milk, Arms.LEFT, milk.pose), "courier has no LEFT arm"),
    ):
        await fails(action, part)
    assert courier.pose == courier.original_pose


@pytest.mark.parametrize("model", ["courier", "tiago"])
async def test_a_head_without_a_closed_form_points_its_camera_at_the_target(model: str) -> None:
    with BulletWorld(), simulated_robot:
        Object(model, ObjectType.ROBOT, robot=COURIER if model == "courier" else tiago(), pose=Pose([0.3, 0, 0]))
        for target in ((2, 0.5, 0.9), (1, -2, 0.8), (1.5, 1, 1.3)):
            await LookAtActionPerformable(Pose(target)).perform()
            x, y, z = Pose(target).relative_to(require_robot().camera_pose()).position
            assert math.hypot(x, y) / z < 1e-6
        await LookAtActionPerformable(Pose([-3, 0.1, 1])).perform()  # behind it: as far as the joints go


def tiago() -> RobotDescription:
    return describe_robot(
        "tiago",
        TIAGO_URDF,
        arms={Arms.LEFT: describe_arm(TIAGO_URDF, "torso_lift_link", "arm_tool_link")},
        drive=Drive.DIFFERENTIAL,
        torso_joint="torso_lift_joint",
        head_joints=("head_1_joint", "head_2_joint"),
        camera_link="xtion_rgb_optical_frame",
    )


def panda() -> RobotDescription:
    return describe_robot("panda", PANDA_URDF, srdf=PANDA_SRDF, park="default", drive=Drive.FIXED)


async def test_a_tiago_without_a_hand_moves_what_it_has() -> None:
    with BulletWorld(), simulated_robot:
        robot = Object("tiago", ObjectType.ROBOT, robot=tiago())
        milk = Object("milk", ObjectType.MILK, pose=Pose([2, 0, 1.0]))
        await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
        await MoveTorsoActionPerformable(0.3).perform()
        assert robot.joint_position("torso_lift_joint") == 0.3
        await FaceAtPerformable(milk.pose).perform()
        assert (await DetectActionPerformable(milk).perform()).name == "milk"
        place = CostmapLocation(Pose([3, 1, 0.9]), reachable_for=robot).resolve()
        assert place.reachable_arms == (Arms.LEFT,)
        await fails(SetGripperActionPerformable(Arms.LEFT, GripperState.OPEN), "no gripper at its LEFT arm")
        await fails(PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT), "no gripper at its LEFT arm")
        await fails(GripActionPerformable(Arms.LEFT, milk, 1.0), "no gripper at its LEFT arm")
        await fails(ParkArmsActionPerformable(Arms.LEFT), "no park posture of its LEFT arm")


async def test_a_panda_on_a_fixed_base_picks_and_places_and_cannot_drive() -> None:
    description = panda()
    [arm] = description.arms.values()
    assert (arm.joints, arm.tool_frame) == (tuple(f"panda_joint{n}" for n in range(1, 8)), "panda_hand_tcp")
    assert arm.gripper_joints[GripperState.OPEN] == {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04}
    assert arm.opening_m == pytest.approx(0.08)
    assert description.postures["default"]["panda_joint4"] == -2.35619
    with BulletWorld(), simulated_robot:
        robot = Object("panda", ObjectType.ROBOT, robot=with_fingers_along_x(description))
        spoon = Object("spoon", ObjectType.SPOON, pose=Pose([0.45, 0.2, 0.1]))
        await fails(NavigateActionPerformable(Pose([1, 0, 0])), "no drive: its base is fixed")
        await fails(LookAtActionPerformable(spoon.pose), "no head to turn")
        await fails(DetectActionPerformable(spoon), "no camera")
        await fails(MoveTorsoActionPerformable(0.1), "no torso to lift")
        await ParkArmsActionPerformable(Arms.RIGHT).perform()
        await PickUpActionPerformable(spoon, Arms.RIGHT, Grasp.TOP).perform()
        assert spoon.attached_to is robot
        ahead = rotated(require_robot().tool_pose(Arms.RIGHT).orientation, (1.0, 0.0, 0.0))
        assert ahead == pytest.approx((0, 0, -1), abs=1e-5)
        await PlaceActionPerformable(spoon, Arms.RIGHT, Pose([0.45, -0.2, 0.1])).perform()
        assert spoon.pose.distance(Pose([0.45, -0.2, 0.1])) < 1e-5
        near = CostmapLocation(Pose([0.45, 0, 0.4]), reachable_for=robot).resolve()
        assert near.pose == robot.pose
        with pytest.raises(ReachabilityFailure):
            CostmapLocation(Pose([3, 0, 0.4]), reachable_for=robot).resolve()


def with_fingers_along_x(description: RobotDescription) -> RobotDescription:
    """The Panda's tool link has z along its fingers."""
    arm = replace(description.arms[Arms.RIGHT], tool_in_link=Pose(orientation=(0, -1, 0, 1)))
    return replace(description, arms={Arms.RIGHT: arm})


async def test_a_third_arm_has_a_name_of_its_own_and_parts_of_its_own() -> None:
    arm = COURIER.arms[Arms.RIGHT]
    centre = Arms.named("CENTRE")
    three = RobotDescription(name="three", urdf=built_in_model("courier"), arms={centre: arm})
    with BulletWorld(), simulated_robot:
        robot = Object("three", ObjectType.ROBOT, robot=three)
        park = ParkArmsActionPerformable(centre)
        assert park.resources() == {Resource.OTHER_ARM}
        await Parallel(park, NavigateActionPerformable(Pose([1, 0, 0]))).perform()
        assert {joint: robot.joint_position(joint) for joint in arm.park} == dict(arm.park)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.65, 0, 0.9]))
        await PickUpActionPerformable(milk, centre, Grasp.FRONT).perform()
        assert robot.attachments == {milk: "tool_frame"}


def test_an_srdf_names_arms_grippers_and_postures() -> None:
    joint = '<joint name="{0}_slide" type="prismatic"><parent link="{1}"/><child link="{0}"/><axis xyz="{2}"/>'
    limit = '<limit lower="0" upper="{}" effort="1" velocity="1"/></joint>'
    links, joints = ["base"], []
    for side in ("left", "right", "spare"):
        for number, (name, parent, axis, upper) in enumerate(
            ((f"{side}_arm", "base", "1 0 0", 1), (f"{side}_a", f"{side}_arm", "0 1 0", 0.03),
             (f"{side}_b", f"{side}_arm", "0 -1 0", 0.02))
        ):  # fmt: skip
            assert number < 3
            links.append(name)
            joints.append(joint.format(name, parent, axis) + limit.format(upper))
    urdf = f'<robot name="trio">{"".join(f"<link name={name!r}/>" for name in links)}{"".join(joints)}</robot>'
    srdf = "".join(
        f'<group name="{side}_arm"><chain base_link="base" tip_link="{side}_arm"/></group>'
        f'<end_effector name="{side}" parent_link="{side}_arm" group="{side}_hand" parent_group="{side}_arm"/>'
        f'<group_state name="home" group="{side}_arm"><joint name="{side}_arm_slide" value="0.5"/></group_state>'
        for side in ("left", "right", "spare")
    )
    trio = describe_robot("trio", urdf, srdf=f'<robot name="trio">{srdf}</robot>', park="home", serial="7")
    assert [each.name for each in trio.arms] == ["LEFT", "RIGHT", "SPARE_ARM"]
    left = trio.arms[Arms.LEFT]
    assert (left.joints, left.base_link, left.tool_frame) == (("left_arm_slide",), "base", "left_arm")
    assert left.gripper_joints[GripperState.OPEN] == {"left_a_slide": 0.03, "left_b_slide": 0.02}
    assert (left.opening_m, left.park, trio.serial) == (0.05, {"left_arm_slide": 0.5}, "7")
    with pytest.raises(CallerError, match="of a group without a chain"):
        describe_robot("trio", urdf, srdf='<robot><end_effector parent_link="left_arm" group="none"/></robot>')
    with pytest.raises(CallerError, match="cannot be read"):
        describe_robot("trio", urdf, srdf="<robot><group>")


def test_a_registered_robot_needs_its_name_only(request: pytest.FixtureRequest) -> None:
    model = f"model of {request.node.name}"
    description = RobotDescription(name=model, urdf=built_in_model("courier"), drive=Drive.FIXED)
    assert register_robot(description) is description
    with BulletWorld():
        robot = Object(model, ObjectType.ROBOT)
        assert robot.robot_description is description
        assert "tool_frame" in robot.links


async def fails(action: ActionAbstract, part: str) -> None:
    with pytest.raises(CapabilityAbsenceFailure) as failure:
        await action.perform()
    assert part in failure.value.message


# === base link ================================================================================================
#
# A robot whose base link is above the floor or moved by joints drives, looks, picks up and places like any other.

ROBOTS = pytest.mark.parametrize("description", [raised_robot(), rail_robot()], ids=["raised", "railed"])


@pytest.fixture
def milk() -> Iterator[Object]:
    with BulletWorld(), simulated_robot:
        yield Object("milk", ObjectType.MILK, pose=Pose([3, 1, 1.0]))


def robot_of(description: RobotDescription) -> Object:
    robot = Object("robot", ObjectType.ROBOT, robot=description)
    if description.name == "railed":
        robot.set_joint_positions(RAILS)
    return robot


@ROBOTS
async def test_it_looks_at_its_target_exactly(milk: Object, description: RobotDescription) -> None:
    robot_of(description)
    await LookAtActionPerformable(milk.pose).perform()
    x, y, z = milk.pose.relative_to(require_robot().camera_pose()).position
    assert math.hypot(x, y) / z < 1e-6


@ROBOTS
async def test_it_fetches_from_a_place_where_its_base_has_the_same_height(
    milk: Object, description: RobotDescription
) -> None:
    robot = robot_of(description)
    height = robot.pose.position.z
    assert height == pytest.approx(HEIGHT_M)
    place = CostmapLocation(milk, reachable_for=robot, visible_for=robot).resolve()
    assert place.pose.position.z == CostmapLocation(milk).resolve().pose.position.z == height
    before = link_poses(robot)
    with SimulatedTaskTree():
        await NavigateActionPerformable(place.pose).perform()
        assert require_robot().body.pose == place.pose
        await FaceAtPerformable(milk.pose).perform()
        await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
    assert link_poses(robot) == before
    await NavigateActionPerformable(place.pose).perform()
    await FaceAtPerformable(milk.pose).perform()
    await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
    assert milk.attached_to is robot
    await NavigateActionPerformable(Pose([-1, 0, height], yaw_quaternion(2))).perform()
    goal = robot.pose @ Pose([0.7, 0.1, milk.pose.position.z - height])
    await PlaceActionPerformable(milk, Arms.RIGHT, goal).perform()
    assert milk.pose.distance(goal) < 1e-5


async def test_its_rails_bring_it_to_an_object_and_the_object_along(milk: Object) -> None:
    robot = Object("robot", ObjectType.ROBOT, pose=Pose([1.2, 0, HEIGHT_M]), robot=rail_robot())
    root = robot.root_pose()
    await MoveJointsMotion(["rail_x", "rail_y"], [1.1, 1.0]).perform()
    assert robot.pose.position == pytest.approx((2.3, 1, HEIGHT_M))
    await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
    held = milk.pose.relative_to(robot.pose)
    await MoveJointsMotion(["rail_turn"], [1.5]).perform()
    assert milk.pose.relative_to(robot.pose).distance(held) < 1e-6
    assert robot.root_pose().distance(root) < 1e-12


async def test_past_and_learned_places_and_those_at_a_drawer_have_the_height_of_the_base() -> None:
    class Known:
        async def successes(self, object_type: ObjectType, *, arm: Arms | None, **_: object) -> Sequence[PastSuccess]:
            return [PastSuccess(Arms.LEFT, Grasp.FRONT, 0.3, Pose([-0.7, 0, -0.9]), 0.5)]

    with BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT, robot=replace(PR2, base_link="base_link"))
        kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
        assert robot.pose == Pose([0, 0, 0.051])
        robot.set_joint_position("torso_lift_joint", 0.3)
        past = await DatabaseCostmapLocation(milk, robot, experience=Known()).resolve()
        assert past is not None
        drawer = AccessingLocation(ObjectPart("kitchen_counter_upper_drawer_handle", kitchen), robot).resolve()
        learned = next(MoveAndPickUp(milk).plain()).standing_position
        assert {each.position.z for each in (past.pose, drawer.pose, learned)} == {0.051}
        assert robot.root_pose(learned).position.z == pytest.approx(0.0, abs=1e-12)


# === tiago pro ================================================================================================
#
# A second robot does whole tasks: its arms park with the hands up, so an approach along them would come from the table.


@pytest.fixture
def tables() -> Iterator[Object]:
    """A TIAGo Pro with parked arms between a table with milk and an empty one; collisions count."""
    with BulletWorld(), simulated_robot_within(Limits.SOFT, collisions=True):
        robot = Object("tiago_pro", ObjectType.ROBOT)
        assert robot.robot_description is not None
        for each in robot.robot_description.arms.values():
            robot.set_joint_positions(dict(each.park))
        robot.set_joint_position("torso_lift_joint", 0.3)
        for number, x in enumerate((1.6, -1.6)):
            Object(f"table {number}", ObjectType.ENVIRONMENT, TABLE, pose=Pose([x, 0, 0]))
        Object("milk", ObjectType.MILK, pose=Pose([1.55, 0.1, 0.838]))
        yield robot


async def test_a_tiago_pro_fetches_an_object_from_one_table_and_places_it_on_another(
    tables: Object, tmp_path: Path
) -> None:
    milk, goal = tables.world.object("milk"), Pose([-1.45, 0.2, 0.838], yaw_quaternion(2.0))
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="a second robot"):
            await _transport(tables, milk, goal)
        await memory.flush()
        async with memory.session() as session:
            [row] = (await session.scalars(select(TransportRow))).all()
            view = PickUpWithContextView
            [picked] = (await session.execute(select(view.robot, view.status, view.obj_type))).all()
    assert (row.robot, row.status, row.target_location.x) == ("tiago_pro", TaskStatus.SUCCEEDED, -1.45)
    assert tuple(picked) == ("tiago_pro", TaskStatus.SUCCEEDED, ObjectType.MILK)
    assert milk.pose.distance(goal) < 1e-5
    assert milk.attached_to is None


async def _transport(tables: Object, milk: Object, goal: Pose) -> None:
    await ParkArmsActionPerformable(Arms.BOTH).perform()
    await MoveTorsoActionPerformable(0.25).perform()
    place = CostmapLocation(milk, reachable_for=tables).resolve()
    await NavigateActionPerformable(place.pose).perform()
    await LookAtActionPerformable(milk.pose).perform()
    assert (await DetectActionPerformable(milk).perform()).name == "milk"
    await TransportActionPerformable(milk, place.reachable_arms[0], goal).perform()


async def test_a_hand_that_is_parked_up_approaches_along_the_fingers_of_the_grasp(tables: Object) -> None:
    milk, robot = tables.world.object("milk"), require_robot()
    assert rotated(robot.tool_pose(Arms.LEFT).orientation, (1, 0, 0)).z > 0.7
    await NavigateActionPerformable(Pose([0.75, 0, 0])).perform()
    with pytest.raises(ManipulationGoalInCollision, match="would be in table 0"):
        tables.robot_description = replace(robot.description, approaches_along_fingers=False)
        await PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT).perform()
    tables.robot_description = robot.description
    await PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT).perform()
    assert milk in tables.attachments


def test_the_parked_arms_of_a_tiago_pro_are_beside_its_torso_and_mirrored(tables: Object) -> None:
    boxes = []
    for arm in require_robot().description.arms.values():
        links = [each for each in tables.links if arm.joints[0] in tables.joints_above(each)]
        box = tables.body.box(links)
        assert box is not None
        boxes.append(
            (box.min.x, box.max.x, min(map(abs, (box.min.y, box.max.y))), max(map(abs, (box.min.y, box.max.y))))
        )
    assert boxes[0] == pytest.approx(boxes[1], abs=0.01)
    assert boxes[0] == pytest.approx((-0.07, 0.36, 0.12, 0.30), abs=0.02)


async def test_a_gripper_of_a_tiago_pro_refuses_what_is_wider_than_its_pads_are_apart(tables: Object) -> None:
    cereal = Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.45, -0.3, 0.85]))
    await NavigateActionPerformable(Pose([0.7, -0.3, 0])).perform()
    wide = PickUpActionPerformable(cereal, Arms.RIGHT, Grasp.LEFT)
    await fails(wide, "0.148 m wide between the fingers, the RIGHT gripper opens 0.079 m")
    await PickUpActionPerformable(cereal, Arms.RIGHT, Grasp.FRONT).perform()


async def test_a_gripper_of_a_tiago_pro_refuses_a_grasp_that_it_could_not_leave(tables: Object) -> None:
    """Its palm is 4 cm behind the middle of its fingers, and would still be in milk 0.2 m tall after moving back."""
    milk, robot = tables.world.object("milk"), require_robot()
    await NavigateActionPerformable(Pose([0.75, 0.1, 0])).perform()
    from_above = PickUpActionPerformable(milk, Arms.LEFT, Grasp.TOP)
    await fails(from_above, "gripper_left_base_link cannot move back out of milk")
    assert [grasp for grasp in Grasp if TransportPolicy().takes(milk, Arms.LEFT, grasp)] == [
        Grasp.FRONT, Grasp.LEFT, Grasp.RIGHT,
    ]  # fmt: skip
    low = Object("low", ObjectType.GENERIC_OBJECT, box_urdf("low", x=(-0.03, 0.03), y=(-0.03, 0.03), z=(-0.06, 0.06)))
    geometry.check_fits(robot, Arms.LEFT, low, geometry.grasping_pose(low.pose, Grasp.TOP))
