"""Two robots of one world act in two tasks of one plan: their motions, parts, recorded states and names."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from sqlalchemy import select, text
from sqlalchemy.orm import selectinload

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.orm import (
    Action,
    EpisodeRobot,
    NavigateAction,
    ParkArmsAction,
    PickUpWithContextView,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.orm import Object as RecordedObject
from pycrorm_async.plan import (
    Code,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    NoRobotHere,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.query.again import world_of
from pycrorm_async.settings import Settings
from pycrorm_async.world import (
    COURIER,
    PR2,
    Arms,
    BulletWorld,
    Grasp,
    Object,
    ObjectType,
    Pose,
    register_robot,
    robot_acting,
)
from pycrorm_async.world.models import courier_urdf
from tests.commands import answer, pycrorm
from tests.databases import ask

pytestmark = pytest.mark.slow


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
    many = replace(third, name="many", urdf=courier_urdf(), arms={arm: COURIER.arms[Arms.RIGHT]}, serial=None)
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
    assert pycrorm("rebuild", "--url", database_url, cwd=tmp_path).returncode == 0
    assert ask(database_url, by_hand) == rows
    await copy_episodes(database_url, f"sqlite:///{tmp_path}/copy.db")
    assert ask(f"sqlite:///{tmp_path}/copy.db", by_hand) == rows
    moment = pycrorm("show", "2", "--at", "9", "--url", database_url, cwd=tmp_path).stdout
    assert "eve at (1.000, 0.000), heading 0.0°; many at (0.000, 0.000), heading 0.0°" in moment


async def test_a_pick_up_names_its_robot_in_the_view_for_learning(
    database_url: str, robots: tuple[Object, Object], tmp_path: Path
) -> None:
    ada, bob = robots
    bob.set_pose(Pose([0, 2, 0]))
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        for robot, y in ((ada, 0.2), (bob, 2.2)):
            milk = Object(f"milk of {robot.name}", ObjectType.MILK, pose=Pose([0.8, y, 0.9]))
            with robot_acting(robot):
                await PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT).perform()
                assert milk.attached_to is robot
        await memory.flush()
        async with memory.session() as session:
            rows = (await session.execute(select(PickUpWithContextView.robot, PickUpWithContextView.relative_y))).all()
    assert sorted((name, round(y, 6)) for name, y in rows) == [("ada", -0.2), ("bob", -0.2)]


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
