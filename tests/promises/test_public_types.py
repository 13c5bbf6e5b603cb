"""A user's program type-checks strictly against the wheel of the package, and its mistakes are reported."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from tests.commands import environment

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
PROGRAM = """\
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import assert_type

from sqlalchemy import select
from sqlalchemy.orm import Mapped, selectinload

from pycrorm_async import Memory, MemoryStatus, Projection, Reading, RecordedEvent, Settings, UserView
from pycrorm_async import performable_of, world_of
from pycrorm_async.events.types import NodeEnded
from pycrorm_async.orm import AccessingMotion, Action, FaceAtAction, GraspingAction, Monitor
from pycrorm_async.orm import MoveAndPickUpAction, MoveMotion, NavigateAction, Object as ObjectRow, OpeningMotion
from pycrorm_async.orm import PickUpAction, PlaceAction, Pose, ProcessMetaData, RootFailure, TaskTreeNode
from pycrorm_async.plan import Designator, TaskStatus
from pycrorm_async.plan import ActionAbstract, NavigateAction as Navigate, PlanFailure, simulated_robot
from pycrorm_async.projections.custom import Changes, Event
from pycrorm_async.testing.contracts import check_designator, check_executive, check_projection
from pycrorm_async.testing.fake_clock import FakeClock
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose as WorldPose


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
"""
SETTINGS = """\
[mypy]
strict = true
[mypy-IPython.*,matplotlib.*,numpy.*,PIL.*,psycopg.*,psycopg_pool.*,rich.*]
follow_imports = skip
follow_imports_for_stubs = true
"""
"""mypy does not read libraries that the program does not use, which would take a quarter of its time."""


def installed(folder: Path) -> Path:
    """Unpack the wheel of the package here, as pip does, and return the folder that imports find it in."""
    [wheel] = WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    assert (folder / "site" / "pycrorm_async" / "py.typed").exists()  # else an editable installation could be read
    return folder / "site"


def test_a_users_program_is_typed_and_its_mistakes_are_reported(tmp_path: Path) -> None:
    """One call checks both programs, outside the package's folder, because each would read all of SQLAlchemy."""
    mistakes = {
        'GreetActionPerformable("Ada") +': "GreetActionPerformable(1) +",
        "Settings(sync_interval_ms=10)": 'Settings(sync_interval_ms="ten")',
        "await memory.flush()": "await memory.flsh()",
        "assert_type(arms, Sequence[Arms])": "assert_type(arms, Sequence[str])",
        "memory.subscribe(watch)": "memory.subscribe(walk)",
        "performable_of(row, ": 'performable_of("PickUpAction", ',
        'episode.end("go", "FAILED"': 'episode.end("go", "BROKEN"',
    }
    wrong = PROGRAM
    for correct, mistake in mistakes.items():
        assert wrong.count(correct) == 1
        wrong = wrong.replace(correct, mistake)
    (tmp_path / "right.py").write_text(PROGRAM)
    (tmp_path / "wrong.py").write_text(wrong)
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    command = [sys.executable, "-m", "mypy", "--cache-dir", os.devnull, "right.py", "wrong.py"]
    found = environment() | {"PYTHONPATH": str(installed(tmp_path))}
    done = subprocess.run(command, cwd=tmp_path, env=found, capture_output=True, text=True, check=False)
    *errors, summary = done.stdout.splitlines()
    assert [(line.partition(":")[0], line.rpartition("[")[2]) for line in errors if ": error: " in line] == [
        ("wrong.py", "arg-type]"),
        ("wrong.py", "arg-type]"),
        ("wrong.py", "attr-defined]"),
        ("wrong.py", "assert-type]"),
        ("wrong.py", "arg-type]"),
        ("wrong.py", "arg-type]"),
        ("wrong.py", "arg-type]"),
    ], done.stdout
    assert summary == "Found 7 errors in 1 file (checked 2 source files)"
