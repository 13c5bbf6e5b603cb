"""A robot whose base link is not its model's root is seen again, in tables, snapshots and worlds made of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import distribution
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, Settings, world_of
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.orm import NavigateAction, TaskTreeNode
from pycrorm_async.orm import Object as RecordedObject
from pycrorm_async.plan import (
    CostmapLocation,
    MoveJointsMotion,
    NavigateActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    simulated_robot,
)
from pycrorm_async.plan.language import Designator
from pycrorm_async.world import (
    Arms,
    BulletWorld,
    Drive,
    Grasp,
    GripperState,
    Object,
    ObjectType,
    Pose,
    RobotDescription,
    describe_arm,
    describe_robot,
)
from tests.commands import pycrorm
from tests.databases import ask
from tests.world.base_links import RAILS, link_poses, rail_robot, raised_robot

pytestmark = pytest.mark.slow

MODELS = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")))
TIAGO_URDF = MODELS / "tiago_description/robots/tiago.urdf"


def tiago() -> RobotDescription:
    """Return a TIAGo whose pose is that of `base_link`, 0.0985 m above its root `base_footprint`."""
    fingers = "hand_thumb_joint", "hand_index_joint", "hand_mrl_joint"
    grip = {GripperState.OPEN: dict.fromkeys(fingers, 0.0), GripperState.CLOSE: dict.fromkeys(fingers, 0.5)}
    arm = describe_arm(TIAGO_URDF, "torso_lift_link", "hand_grasping_frame")
    return describe_robot(
        "tiago",
        TIAGO_URDF,
        base_link="base_link",
        arms={Arms.RIGHT: replace(arm, gripper_joints=grip)},
        drive=Drive.DIFFERENTIAL,
        torso_joint="torso_lift_joint",
        head_joints=("head_1_joint", "head_2_joint"),
        camera_link="xtion_rgb_optical_frame",
    )


@pytest.mark.soak_on("postgresql", tiago)
@pytest.mark.parametrize("described", [raised_robot, rail_robot, tiago])
async def test_every_link_is_seen_again_at_its_place_after_every_action(
    database_url: str, tmp_path: Path, described: Callable[[], RobotDescription]
) -> None:
    description = described()
    on_rails = description.name == "railed"
    seen: list[dict[str, dict[str, Pose]]] = []
    settings = Settings(record_meshes="files")
    async with Memory.open(database_url, spool=tmp_path / "spool", settings=settings) as memory:
        with BulletWorld() as world, simulated_robot:
            robot = Object("robot", ObjectType.ROBOT, robot=description)
            height = robot.pose.position.z
            milk = Object("milk", ObjectType.MILK, pose=Pose([3, 1, 1.0]))
            cup = Object("cup", ObjectType.JEROEN_CUP, pose=robot.pose @ Pose([-0.2, 0, 0.4]))
            robot.attach(cup)
            if on_rails:
                robot.set_joint_positions(RAILS)
            async with memory.episode(description="base link"):
                place = CostmapLocation(milk, reachable_for=robot).resolve().pose
                target = place @ Pose([0.6, 0.1, 1.0 - height])
                actions: list[Designator] = [
                    NavigateActionPerformable(place),
                    PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT),
                    NavigateActionPerformable(Pose([-1, 0, height])),
                    NavigateActionPerformable(place),
                    PlaceActionPerformable(milk, Arms.RIGHT, target),
                ]
                if on_rails:
                    actions += [MoveJointsMotion(list(RAILS), [0.1, 0.2, -0.3])]
                for action in actions:
                    await action.perform()
                    seen.append({each.name: link_poses(each) for each in world.objects})
                assert milk.pose.distance(target) < 1e-5
        await memory.flush()
        async with memory.session() as session:
            links = select(RecordedObject.name, RecordedObject.base_link).order_by(RecordedObject.id).limit(3)
            rows = [tuple(each) for each in await session.execute(links)]
            assert rows == [("robot", "base_link"), ("milk", None), ("cup", None)]
            driven = (await session.scalars(select(NavigateAction).order_by(NavigateAction.id))).all()
            assert [each.target_location.z for each in driven] == [height] * 3
            bases = [each.robot_state.pose for each in driven if each.robot_state is not None]
            assert [each.z for each in bases] == [height] * 3
            assert (bases[1].x, bases[1].y) == place.position[:2]
            roots = select(TaskTreeNode.id).where(TaskTreeNode.kind == "root")
            ends = select(TaskTreeNode.end_sequence).where(TaskTreeNode.parent_id.in_(roots)).order_by(TaskTreeNode.id)
            sequences = [each for each in await session.scalars(ends) if each is not None]
        assert len(sequences) == len(seen) == len(actions)
        last = await memory.as_of("last", sequence=sequences[-1], meshes=True)
        for sequence, poses in zip(sequences, seen, strict=True):
            then = await memory.as_of("last", sequence=sequence, meshes=True)
            assert then.world.object("robot").base_link == "base_link"
            with world_of(then) as recorded:
                assert recorded.assumed == {}
                assert {each.name: link_poses(each) for each in recorded.objects} == poses
                assert recorded.object("robot").attachments[recorded.object("cup")] is None
                robot = recorded.object("robot")
                height = recorded.object("cup").pose.position.z
                robot.set_pose(robot.pose @ Pose([0, 0, 1]))
                assert recorded.object("cup").pose.position.z == pytest.approx(height + 1)
    assert pycrorm("verify", "--url", database_url, cwd=tmp_path).returncode == 0
    assert pycrorm("rebuild", "--url", database_url, cwd=tmp_path).returncode == 0
    copy = f"sqlite:///{tmp_path}/copy.db"
    await copy_episodes(database_url, copy)
    by_hand = "SELECT name, base_link FROM object WHERE base_link IS NOT NULL"
    assert ask(database_url, by_hand) == ask(copy, by_hand) == [("robot", "base_link")]
    async with Reading.open(copy) as reading:
        again = await reading.as_of("last", sequence=sequences[-1], meshes=True)
    assert (again.world.objects, again.world.meshes) == (last.world.objects, last.world.meshes)
