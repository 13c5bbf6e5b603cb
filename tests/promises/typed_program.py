"""A user's program, with the types that it gets; mypy checks it with the tests, and nothing runs it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import assert_type

from sqlalchemy import select
from sqlalchemy.orm import Mapped, selectinload

from pycrorm_async import (
    Memory,
    MemoryStatus,
    Projection,
    Reading,
    RecordedEvent,
    Settings,
    UserView,
    performable_of,
    world_of,
)
from pycrorm_async.events.types import NodeEnded
from pycrorm_async.orm import (
    AccessingMotion,
    Action,
    FaceAtAction,
    GraspingAction,
    Monitor,
    MoveAndPickUpAction,
    MoveMotion,
    NavigateAction,
    OpeningMotion,
    PickUpAction,
    PlaceAction,
    Pose,
    ProcessMetaData,
    RootFailure,
    TaskTreeNode,
)
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.plan import ActionAbstract, Designator, PlanFailure, TaskStatus, simulated_robot
from pycrorm_async.plan import NavigateAction as Navigate
from pycrorm_async.projections.custom import Changes, Event
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.testing.contracts import check_designator, check_executive, check_projection
from pycrorm_async.testing.fake_clock import FakeClock
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType
from pycrorm_async.world import Pose as WorldPose


@dataclass
class GreetActionPerformable(ActionAbstract):
    whom: str
    kind: str = "warm"
    dtype: int = 8
    concept: float = 0.5

    async def perform(self) -> None:
        if not self.whom:
            raise PlanFailure("nobody to greet")


def described(greet: GreetActionPerformable) -> str:
    assert_type(greet.kind, str)
    assert_type(ActionAbstract.dtype, str)
    return greet.__dtype__


class ORMGreet(Action):
    whom: Mapped[str]


class ORMCarefulPickUp(PickUpAction):
    force: Mapped[float]


def rows(place: PlaceAction, grasping: GraspingAction, face: FaceAtAction, both: MoveAndPickUpAction) -> None:
    assert_type(place.id, int)
    assert_type(place.object, ObjectRow)
    assert_type(place.object_designator, ObjectRow)
    assert_type(place.object_designator_id, int)
    assert_type(place.object.pose, Pose | None)
    assert_type(place.pose, Pose)
    assert_type(place.target_location, Pose)
    assert_type(place.target_location_id, int)
    assert_type(place.arm, Arms)
    assert_type(grasping.object, ObjectRow)
    assert_type(grasping.object_desig, ObjectRow)
    assert_type(face.pose, Pose)
    assert_type(face.pose_id, int)
    assert_type(both.standing_position, Pose)
    assert_type(both.standing_position_id, int)
    assert_type(both.object, ObjectRow)


def motion_rows(move: MoveMotion, opening: OpeningMotion, accessing: AccessingMotion, monitor: Monitor) -> None:
    assert_type(move.target, Pose)
    assert_type(move.target_id, int)
    assert_type(opening.object, ObjectRow)
    assert_type(opening.object_part, ObjectRow)
    assert_type(opening.object_part_id, int)
    assert_type(accessing.part_of, ObjectRow)
    assert_type(accessing.object_id, int)
    assert_type(monitor.interval_s, float)


def course(action: Action, pick: PickUpAction, node: TaskTreeNode) -> None:
    assert_type(action.status, TaskStatus)
    assert_type(action.start_time, datetime)
    assert_type(pick.end_time, datetime | None)
    assert_type(pick.duration, float | None)
    assert_type(pick.reason, str | None)
    assert_type(action.episode, ProcessMetaData)
    assert_type(node.duration, float | None)
    assert_type(node.children, list[TaskTreeNode])
    assert_type(node.ancestors, list[TaskTreeNode])
    assert_type(pick.object.node, TaskTreeNode | None)
    print(select(TaskTreeNode).options(selectinload(TaskTreeNode.children)))


def failures(failure: RootFailure) -> None:
    assert_type(failure.path, str)
    assert_type(failure.object, str | None)
    assert_type(failure.arm, Arms | None)
    assert_type(failure.recovered, bool)
    assert_type(failure.episode, ProcessMetaData)


def own_rows(greet: ORMGreet, careful: ORMCarefulPickUp) -> None:
    assert_type(greet.id, int)
    assert_type(greet.whom, str)
    assert_type(careful.object, ObjectRow)
    assert_type(careful.force, float)


async def plan() -> None:
    with BulletWorld() as world, simulated_robot:
        assert_type(world, BulletWorld)
        robot = Object("pr2", ObjectType.ROBOT)
        assert_type(robot.pose, WorldPose)
        await Navigate([WorldPose([0.6, 0.4, 0])]).resolve().perform()
        await (GreetActionPerformable("Ada") + GreetActionPerformable("Grace")).perform()


async def main() -> Sequence[Action]:
    settings = Settings(sync_interval_ms=10)
    view = UserView("failures", select(TaskTreeNode.id))
    async with Memory.open("sqlite:///memory.db", settings=settings, views=[view]) as memory:
        assert_type(memory, Memory)
        async with memory.episode(description="typed"):
            await plan()
        await memory.flush()
        assert_type(memory.status, MemoryStatus)
        assert_type(memory.reading, Reading)
        async with memory.session() as session:
            poses = (await session.scalars(select(Pose).join(NavigateAction.pose))).all()
            assert_type(poses, Sequence[Pose])
            actions = (await session.scalars(select(Action))).all()
            assert_type(actions, Sequence[Action])
            arms = (await session.scalars(select(PickUpAction.arm))).all()
            assert_type(arms, Sequence[Arms])
            places = (await session.scalars(select(PlaceAction.target_location_id))).all()
            assert_type(places, Sequence[int])
            slow = select(Action.duration).where(Action.duration > 1, Action.status == TaskStatus.FAILED)
            slow = slow.join(Action.episode).order_by(Action.duration.desc())
            assert_type((await session.scalars(slow)).all(), Sequence[float | None])
            query = select(PickUpAction.grasp, ObjectRow.name, TaskTreeNode.end_ns)
            query = query.join(PickUpAction.object).join(PickUpAction.node)
            for grasp, name, end_ns in await session.execute(query):
                assert_type(grasp, Grasp)
                assert_type(name, str)
                assert_type(end_ns, int | None)
        frame = await memory.dataframe(select(TaskTreeNode.dtype))
        print(len(frame))
    return actions


class Rate(Projection):
    name = "rate"
    version = 1

    def fold(self, event: Event, rows: Changes) -> None:
        assert_type(event.dtype, str | None)
        rows.insert("rate", event.id, status="RUNNING")


def watch(event: RecordedEvent) -> None:
    assert_type(event.dtype, str | None)
    if isinstance(event.happening, NodeEnded):
        assert_type(event.happening.node, int)


async def watched(memory: Memory) -> None:
    with memory.subscribe(watch) as subscription:
        assert_type(subscription.left_out, int)
    async for event in memory.events():
        assert_type(event, RecordedEvent)


async def asked(memory: Memory, row: PickUpAction) -> None:
    print(await memory.ask.root_failures(object="milk", episode="last"))
    answer = await memory.recall(PickUpAction, near={"height": 0.5})
    assert_type(answer[0].score, float)
    assert_type(len(answer), int)
    then = await memory.as_of("last", sequence=115)
    assert_type(then.world.object("milk").pose, WorldPose)
    with world_of(then) as recorded:
        assert_type(recorded.object("milk"), Object)
        assert_type(performable_of(row, grasp=Grasp.TOP), Designator)


def walk() -> None:
    with Memory.sync("sqlite:///memory.db") as memory:
        drive = memory.recording.type("action", "NavigateAction", {"target_location": WorldPose, "speed": float})
        with memory.recording.episode(description="a walk", metadata={"executive": "mine"}) as episode:
            episode.start("go", drive, {"target_location": WorldPose([1, 0, 0]), "speed": 0.5}, robot="base")
            episode.end("go", "FAILED", "the left wheel slipped")
        assert_type(memory.status, MemoryStatus)


async def checked(memory: Memory, folder: Path) -> None:
    await check_designator(GreetActionPerformable("Ada"), folder)
    assert_type(await check_executive(lambda recording: recording.episode().close(), folder), list[TaskTreeNode])
    rows = await check_projection(Rate(), plan, folder)
    print(rows["rate"][0]["id"], FakeClock().clock.wall_ns() + 1)


async def mistaken(memory: Memory, row: PickUpAction, episode: RecordedEpisode) -> None:
    """Each of these mistakes is reported: mypy refuses an `ignore` that is not needed."""
    GreetActionPerformable(1)  # type: ignore[arg-type]
    Settings(sync_interval_ms="ten")  # type: ignore[arg-type]
    await memory.flsh()  # type: ignore[attr-defined]
    async with memory.session() as session:
        arms = (await session.scalars(select(PickUpAction.arm))).all()
        assert_type(arms, Sequence[str])  # type: ignore[assert-type]
    memory.subscribe(walk)  # type: ignore[arg-type]
    performable_of("PickUpAction", grasp=Grasp.TOP)  # type: ignore[arg-type]
    episode.end("go", "BROKEN", "the left wheel slipped")  # type: ignore[arg-type]
