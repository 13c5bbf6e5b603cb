"""A world made from a snapshot has its objects in their state, or one line names the reason why it cannot."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from pycrorm_async import world_of
from pycrorm_async.errors import CallerError
from pycrorm_async.query.snapshot import Moment, ObjectThen, WorldThen
from pycrorm_async.world import COURIER, BulletWorld, Object, ObjectType, Pose, WorldMode, current_world, register_robot
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import DuplicateName, UnknownJoint, UnknownLink, WorldClosed

AT = Pose([1, 2, 0.5], [0, 0, 0.6, 0.8])
NARROW = box_urdf("milk", x=(0, 0.01), y=(0, 0.01), z=(0, 0.01))


def recorded_snapshot(
    name: str,
    object_type: str = "MILK",
    pose: Pose = AT,
    joints: dict[str, float] | None = None,
    attached_to: tuple[str, str | None] | None = None,
) -> ObjectThen:
    return ObjectThen(1, 1, name, object_type, pose, joints or {}, attached_to)


def snapshot(*objects: ObjectThen) -> Moment:
    now = datetime.now(UTC)
    return Moment(1, "id", "", "", now, False, 1, 0.0, now, "RUNNING", (), WorldThen(objects, None))


def test_built_in_shapes_are_used_where_name_and_type_have_one() -> None:
    with BulletWorld():
        built_in = [Object("pr2", ObjectType.ROBOT), Object("milk", ObjectType.MILK)]
    moment = snapshot(
        recorded_snapshot("pr2", "ROBOT", joints={"torso_lift_joint": 0.2}),
        recorded_snapshot("milk", attached_to=("pr2", "l_gripper_tool_frame")),
        recorded_snapshot("kitchen", "ENVIRONMENT", Pose()),
    )
    with world_of(moment) as world:
        assert current_world.get() is world
        assert world.robot is world.object("pr2")
        assert [each.description_text for each in world.objects[:2]] == [each.description_text for each in built_in]
        assert world.object("pr2").joint_position("torso_lift_joint") == 0.2
        assert world.object("pr2").attachments == {world.object("milk"): "l_gripper_tool_frame"}
        assert [each.pose for each in world.objects] == [AT, AT, Pose()]
        assert [each.original_pose for each in world.objects] == [AT, AT, Pose()]


@pytest.mark.parametrize("name", ["unnamed & <bold>", "tiago"])
def test_a_point_has_the_recorded_joints_links_and_attachments(name: str) -> None:
    moment = snapshot(
        recorded_snapshot(name, "ROBOT", joints={"elbow": 12.5, "torso": -0.3}),
        recorded_snapshot("milk", attached_to=(name, "hand")),
        recorded_snapshot("bowl", "BOWL", attached_to=(name, None)),
        recorded_snapshot("cupboard", "GENERIC_OBJECT", joints={"door": 1.0}),
    )
    with world_of(moment) as world:
        robot, milk, bowl, cupboard = world.objects
        assert robot.joint_positions() == {"elbow": 12.5, "torso": -0.3}
        assert cupboard.joint_positions() == {"door": 1.0}
        assert robot.attachments == {milk: "hand", bowl: None}
        assert robot.bounding_box().size == (0, 0, 0)  # visual only
        reason = "because its description was not recorded"
        assert world.assumed == {
            name: f"a point, {reason}",
            "milk": f"the built-in shape, {reason}",
            "bowl": f"the built-in shape, {reason}",
            "cupboard": f"a point, {reason}",
        }
        robot.set_pose(Pose([5, 5, 5], AT.orientation))
        assert milk.pose.position == bowl.pose.position == pytest.approx((5, 5, 5))


def test_a_point_whose_base_link_is_recorded_is_at_its_pose() -> None:
    then = replace(recorded_snapshot("rover", "ROBOT", joints={"arm": 0.5}), base_link="base")
    with world_of(snapshot(then)) as world:
        [rover] = world.objects
        assert (rover.base_link, rover.pose, rover.link_pose("base")) == ("base", AT, AT)


def test_a_recorded_robot_has_the_recorded_base_link_and_not_that_of_its_description_here() -> None:
    register_robot(replace(COURIER, name="rover", base_link="column_link"))
    then = replace(recorded_snapshot("courier", "ROBOT"), model="rover")
    with world_of(snapshot(then)) as world:
        [rover] = world.objects
        assert (rover.base_link, rover.root_pose()) == ("", AT)


def test_a_users_description_replaces_the_built_in_shape(tmp_path: Path) -> None:
    (tmp_path / "milk.urdf").write_text(NARROW)
    for description in (NARROW, tmp_path / "milk.urdf"):
        with world_of(snapshot(recorded_snapshot("milk", pose=Pose())), descriptions={"milk": description}) as world:
            assert tuple(world.object("milk").bounding_box().size) == pytest.approx((0.01, 0.01, 0.01))


@pytest.mark.parametrize(
    ("moment", "error", "message"),
    [
        (
            snapshot(recorded_snapshot("milk", joints={"lid": 1.0})),
            UnknownJoint,
            "'milk' has no movable joint 'lid'; its joints are: none",
        ),
        (
            snapshot(recorded_snapshot("milk"), recorded_snapshot("bowl", "BOWL", attached_to=("milk", "lid"))),
            UnknownLink,
            "'milk' has no link 'lid'; its links are: milk",
        ),
    ],
)
def test_a_description_that_does_not_fit_the_recorded_state_is_refused(
    moment: Moment, error: type[Exception], message: str
) -> None:
    world = world_of(moment, descriptions={"milk": NARROW})
    with BulletWorld() as outer:
        with pytest.raises(error) as refused, world:
            pytest.fail("the world was entered")
        assert str(refused.value) == message
        assert current_world.get() is outer
        assert not world.entered
        with pytest.raises(WorldClosed):
            _ = world.client


def test_an_impossible_snapshot_is_refused_in_one_line() -> None:
    with pytest.raises(DuplicateName, match="an object named 'milk'"):
        world_of(snapshot(recorded_snapshot("milk"), recorded_snapshot("milk")))
    with pytest.raises(CallerError) as refused:
        world_of(snapshot(recorded_snapshot("drink", "LEMONADE")))
    assert str(refused.value) == ("object 'drink' was recorded with the type 'LEMONADE', which ObjectType lacks here")
    with pytest.raises(CallerError) as refused:
        world_of(snapshot(recorded_snapshot("milk")), descriptions={"melk": NARROW})
    assert str(refused.value) == "the snapshot has no object 'melk' to describe; its objects: milk"


def test_an_empty_snapshot_makes_an_empty_world_and_a_world_can_be_connected() -> None:
    with world_of(snapshot()) as world:
        assert world.objects == ()
    world = world_of(snapshot(recorded_snapshot("milk")), mode=WorldMode.DIRECT).connect()
    assert [each.name for each in world.objects] == ["milk"]
    world.close()
