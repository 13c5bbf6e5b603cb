"""Robots in a memory: their masses, base links and parts, and two that act in one world."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import distribution
from pathlib import Path

import pytest
from sqlalchemy import select, text
from sqlalchemy.orm import selectinload

from pycrorm_async import Memory, world_of
from pycrorm_async.errors import CallerError
from pycrorm_async.orm import (
    Action,
    EpisodeRobot,
    NavigateAction,
    ParkArmsAction,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.orm import Object as RecordedObject
from pycrorm_async.plan import (
    Code,
    CostmapLocation,
    MoveJointsMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    NoRobotHere,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.settings import Settings
from pycrorm_async.world import (
    COURIER,
    PR2,
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
    register_robot,
    robot_acting,
)
from pycrorm_async.world.models import built_in_model
from tests.commands import answer, pycrorm
from tests.databases import ask
from tests.world.fakes import RAILS, link_poses, rail_robot, raised_robot

pytestmark = pytest.mark.slow


# === recorded robots ==========================================================================================
#
# The memory holds of robots and objects what a plan depended on: the masses, the base link, who took part.


@pytest.mark.soak_on("postgresql")
async def test_a_robot_that_is_added_again_has_one_row(database_url: str, tmp_path: Path) -> None:
    def add(name: str, serial: str | None = None) -> Object:
        return Object(name, ObjectType.ROBOT, robot=replace(COURIER, serial=serial))

    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="again"):
            with BulletWorld() as world:
                add("ada", "A-1").remove()
                add("bob")
                ada = add("ada", "A-1")
                ada.set_pose(Pose([1, 0, 0]))
                ada.remove()
                add("ada", "A-2").remove()
                world.object("bob").remove()
                add("bob").set_joint_position("arm_yaw_joint", 0.5)
            with BulletWorld():
                add("bob")
        async with memory.episode(description="other"):
            with BulletWorld():
                add("bob")
        await memory.flush()
        async with memory.session() as session:
            asked = select(ProcessMetaData).options(selectinload(ProcessMetaData.robots)).order_by(ProcessMetaData.id)
            episodes = (await session.scalars(asked)).all()
            first = select(RecordedObject.id).order_by(RecordedObject.id).limit(1)
            assert episodes[0].robots[0].id == (await session.scalars(first)).one()
            joined = select(RecordedObject.sequence).join(EpisodeRobot, RecordedObject.id == EpisodeRobot.id)
            sequences = (await session.scalars(joined.order_by(EpisodeRobot.id))).all()
            assert sequences == (await session.scalars(select(EpisodeRobot.sequence).order_by(EpisodeRobot.id))).all()
        robots = [[(each.name, each.serial) for each in one.robots] for one in episodes]
        assert robots == [[("ada", "A-1"), ("bob", None), ("ada", "A-2")], [("bob", None)]]
        assert len(sequences) == 4
        summaries = await memory.reading.episodes()
        assert [[(each.name, each.serial) for each in one.robots] for one in summaries] == robots


# === acting robot =============================================================================================
#
# Two robots of one world act in two tasks of one plan: their motions, parts, recorded states and names.


@pytest.fixture
def robots() -> Iterator[tuple[Object, Object]]:
    with BulletWorld(), simulated_robot:
        ada = Object("ada", ObjectType.ROBOT, robot=PR2)
        yield ada, Object("bob", ObjectType.ROBOT, robot=PR2, pose=Pose([5, 0, 0]))


async def rounds(robot: Object, y: float) -> None:
    with robot_acting(robot):
        for number in range(3):
            await NavigateActionPerformable(Pose([robot.original_pose.position.x + number, y, 0])).perform()
            await asyncio.sleep(0)
            await MoveTorsoActionPerformable(0.1 * number).perform()


@pytest.mark.soak_on("postgresql")
async def test_two_tasks_move_their_own_robots_and_each_node_has_the_state_of_its_robot(
    database_url: str, robots: tuple[Object, Object], tmp_path: Path
) -> None:
    ada, bob = robots
    settings = Settings(sample_interval_ms=5)
    async with Memory.open(database_url, spool=tmp_path / "spool", settings=settings) as memory:
        async with memory.episode(description="together"):
            await asyncio.gather(rounds(ada, 1.0), rounds(bob, -1.0))
            await NavigateActionPerformable(Pose([9, 9, 0])).perform()
        await memory.flush()
        assert (ada.pose.position, bob.pose.position) == ((9, 9, 0), (7, -1, 0))
        async with memory.session() as session:
            navigations = (await session.scalars(select(NavigateAction).order_by(NavigateAction.id))).all()
            by_robot = {
                name: [each.robot_state.pose.x for each in navigations if each.robot == name and each.robot_state]
                for name in ("ada", "bob")
            }
            assert by_robot == {"ada": [0, 0, 1, 2], "bob": [5, 5, 6]}
            nodes = (await session.scalars(select(TaskTreeNode).where(TaskTreeNode.robot == "bob"))).all()
            assert {each.torso_height for each in nodes} == {0, 0.1}
            assert (await session.scalars(select(Action).where(Action.robot.is_(None)))).all() == []
            sampled = "SELECT DISTINCT name FROM state_sample JOIN object ON object.id = state_sample.object_id"
            assert sorted(await session.scalars(text(sampled))) == ["ada", "bob"]


@pytest.mark.soak_on("postgresql")
async def test_every_episode_names_its_robots_with_model_serial_and_description(
    database_url: str, tmp_path: Path
) -> None:
    third = replace(COURIER, serial="C-03")
    arm = Arms.named("CENTRE")
    urdf, arms = built_in_model("courier"), {arm: COURIER.arms[Arms.RIGHT]}
    many = replace(third, name="many", urdf=urdf, arms=arms, serial=None)
    register_robot(many)
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="nobody"):
            await asyncio.sleep(0)
        with BulletWorld(), simulated_robot:
            async with memory.episode(description="two"):
                eve = Object("eve", ObjectType.ROBOT, robot=third)
                Object("many", ObjectType.ROBOT)
                with robot_acting(eve):
                    await NavigateActionPerformable(Pose([1, 0, 0])).perform()
                with robot_acting(eve.world.object("many")):
                    await ParkArmsActionPerformable(arm).perform()
        await memory.flush()
        alone, two = await memory.reading.episodes()
        assert alone.robots == ()
        assert [(each.name, each.model, each.serial) for each in two.robots] == [
            ("eve", "courier", "C-03"),
            ("many", "many", None),
        ]
        assert all(each.description for each in two.robots)
        async with memory.session() as session:
            query = select(RecordedObject).where(RecordedObject.model.is_not(None)).order_by(RecordedObject.id)
            robots = (await session.scalars(query)).all()
            assert {each.process_metadata_id for each in robots} == {two.number}
            assert [(each.name, each.model, each.serial) for each in robots] == [
                ("eve", "courier", "C-03"),
                ("many", "many", None),
            ]
            parked = (await session.scalars(select(ParkArmsAction).where(ParkArmsAction.arm == arm))).one()
            assert (parked.arm, parked.robot) == (arm, "many")
            asked = select(ProcessMetaData).order_by(ProcessMetaData.id)
            episodes = (await session.scalars(asked.options(selectinload(ProcessMetaData.robots)))).all()
            assert [[(each.name, each.description_fingerprint) for each in one.robots] for one in episodes] == [
                [],
                [(each.name, each.description) for each in two.robots],
            ]
            joined = select(ProcessMetaData.description).join(ProcessMetaData.robots)
            assert list(await session.scalars(joined.where(EpisodeRobot.serial == "C-03"))) == ["two"]
        async with memory.session() as session:
            (_, unloaded) = (await session.scalars(asked)).all()
            with pytest.raises(CallerError, match=r"selectinload\(ProcessMetaData.robots\)"):
                _ = unloaded.robots
            assert [each.name for each in await unloaded.awaitable_attrs.robots] == ["eve", "many"]
        then = await memory.as_of(str(two.number), sequence=two.end_sequence)
        assert [(each.model, each.serial) for each in then.world.objects] == [("courier", "C-03"), ("many", None)]
        assert [(each.name, each.pose.position.x) for each in then.world.robots] == [("eve", 1), ("many", 0)]
        with world_of(then) as again:
            assert again.object("eve").robot_description is COURIER
    shown = answer("episodes", "--url", database_url, cwd=tmp_path)
    assert [each["model"] for each in shown[1]["robots"]] == ["courier", "many"]
    lines = pycrorm("show", "2", "--url", database_url, cwd=tmp_path).stdout
    assert "eve (courier C-03), many" in lines
    wide = pycrorm("episodes", "--url", database_url, cwd=tmp_path).stdout
    assert "robots" in wide
    assert "eve, many" in wide
    by_hand = "SELECT process_metadata_id, name, model, serial, description_fingerprint FROM episode_robot ORDER BY id"
    rows = ask(database_url, by_hand)
    assert rows == [(2, each.name, each.model, each.serial, each.description) for each in two.robots]
    moment = pycrorm("show", "2", "--at", "9", "--url", database_url, cwd=tmp_path).stdout
    assert "eve at (1.000, 0.000), heading 0.0°; many at (0.000, 0.000), heading 0.0°" in moment


async def test_parallel_branches_of_two_robots_do_not_wait_for_each_others_parts(
    robots: tuple[Object, Object],
) -> None:
    driving: list[str] = []
    both = asyncio.Event()

    @dataclass
    class MeetPerformable(NavigateActionPerformable):
        async def perform(self) -> None:
            driving.append(require_robot().body.name)
            if len(driving) == 2:
                both.set()
            async with asyncio.timeout(30):
                await both.wait()  # blocks for ever if one of the two waits for the other's base

    async def meet(robot: Object) -> None:
        with robot_acting(robot):
            await MeetPerformable(Pose([1, 0, 0])).perform()

    await (Code(meet, robot=robots[0]) | Code(meet, robot=robots[1])).perform()
    assert sorted(driving) == ["ada", "bob"]


async def test_in_a_simulation_the_copy_of_the_acting_robot_acts(robots: tuple[Object, Object]) -> None:
    ada, bob = robots
    with robot_acting(bob):
        with SimulatedTaskTree():
            await NavigateActionPerformable(Pose([1, 1, 0])).perform()
            assert require_robot().body.copy_of is bob
        assert bob.pose == bob.original_pose
        assert require_robot().body is bob
    assert require_robot().body is ada


async def test_a_robot_that_is_not_in_the_world_is_refused_by_name(robots: tuple[Object, Object]) -> None:
    _, bob = robots
    with robot_acting(bob):
        bob.remove()
        with pytest.raises(NoRobotHere, match="robot_acting"):
            await NavigateActionPerformable(Pose([1, 1, 0])).perform()
    with pytest.raises(CallerError, match="type ROBOT"):
        robot_acting(Object("milk", ObjectType.MILK))


# === base link ================================================================================================
#
# A robot whose base link is not its model's root is seen again, in tables, snapshots and worlds made of them.

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
