"""Run and record the thesis' example plan, then query it.

Panel: Record, 1.

The robot parks its arms, raises its torso, finds a base pose, picks up the cereal, finds a place on the kitchen island
and puts the cereal there. The demo then runs five queries on the memory in plain Python.
"""

import asyncio
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import select

from pycrorm_async import plan
from pycrorm_async.cli.output import JsonOption, note, print_json, print_table, stdout
from pycrorm_async.cli.reading import DEFAULT_URL, Place
from pycrorm_async.cli.show import print_tree
from pycrorm_async.memory import Memory
from pycrorm_async.orm import Action, NavigateAction, Object, PickUpAction, ProcessMetaData
from pycrorm_async.orm import Pose as PoseRow
from pycrorm_async.plan import NavigateAction as Navigate
from pycrorm_async.plan import PickUpAction as PickUp
from pycrorm_async.plan import PlaceAction as PutDown
from pycrorm_async.query.named_queries import NodeSummary
from pycrorm_async.world import Arms, BulletWorld, Grasp, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject
from pycrorm_async.world.engines import engine_class


def kitchen_world() -> None:
    """Add the scene of the thesis (kitchen, robot, milk and cereal) to the world of this context."""
    WorldObject("kitchen", ObjectType.ENVIRONMENT)
    WorldObject("pr2", ObjectType.ROBOT)
    WorldObject("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
    WorldObject("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.3, 0.7, 0.95]))


async def breakfast() -> None:
    """Bring the cereal from the counter to the kitchen island."""
    cereal = plan.ObjectDesignatorDescription(names=["cereal"])
    kitchen = plan.ObjectDesignatorDescription(names=["kitchen"]).resolve()
    robot = plan.ObjectDesignatorDescription(names=["pr2"]).resolve()
    with plan.simulated_robot:
        await plan.ParkArmsActionPerformable(Arms.BOTH).perform()
        await plan.MoveTorsoAction([0.3]).resolve().perform()

        base_pose = plan.CostmapLocation(target=cereal.resolve(), reachable_for=robot).resolve()
        arm = base_pose.reachable_arms[0]
        await Navigate([base_pose.pose]).resolve().perform()
        await PickUp(cereal, [arm], [Grasp.FRONT]).resolve().perform()
        await plan.ParkArmsAction([Arms.BOTH]).resolve().perform()

        place = plan.SemanticCostmapLocation("kitchen_island_surface", kitchen, cereal.resolve()).resolve()
        base_pose = plan.CostmapLocation(place.pose, reachable_for=robot, reachable_arm=arm).resolve()
        await Navigate([base_pose.pose]).resolve().perform()
        await PutDown(cereal, [place.pose], [arm]).resolve().perform()
        await plan.ParkArmsActionPerformable(Arms.BOTH).perform()


def demo(place: Place, as_json: JsonOption = False) -> None:
    """Run and record the thesis' example plan, then query it."""
    engine_class()  # raises `EngineMissing` before a database is created
    answers = asyncio.run(_run_and_query(*place))
    if as_json:
        print_json(answers.document())
        return
    answers.print()
    address = place.address
    if address.is_private:
        note(f"The database was {address}, which ended with this process; without --url the demonstration is kept.")
        return
    option = "" if place.url == DEFAULT_URL else f" --url {shlex.quote(address.to_type)}"
    verbs = ("episodes", f"show {answers.episode}", f"report {answers.episode}")
    note(f"The database is {address}. Next: {' | '.join(f'pycrorm {verb}{option}' for verb in verbs)}")


@dataclass
class Answers:
    """The recorded task tree, and title, column names and rows of each query.

    The titles are keys of the `--json` document, so they stay as they are.
    """

    episode: int
    tree: list[NodeSummary]
    questions: list[tuple[str, Sequence[str], list[tuple[Any, ...]]]]

    def print(self) -> None:
        stdout.print("[bold]The recorded task tree[/]")
        print_tree(self.tree)
        for title, columns, rows in self.questions:
            stdout.print()
            print_table(title, columns, rows)

    def document(self) -> dict[str, Any]:
        return {
            "episode": self.episode,
            "tree": self.tree,
            "answers": {
                title: [dict(zip(columns, row, strict=True)) for row in rows] for title, columns, rows in self.questions
            },
        }


async def _run_and_query(url: str, spool: Path | None) -> Answers:
    async with Memory.open(url, spool=spool) as memory:
        async with memory.episode(description="Tutorial for getting familiar with the memory", plan="demo") as episode:
            with BulletWorld():
                kitchen_world()
                await breakfast()

        # A dataclass is enough to define a new action.
        @dataclass
        class SayingActionPerformable(plan.ActionAbstract):
            text: str

            async def perform(self) -> None:
                """Do nothing; the text is recorded as a parameter."""

        await SayingActionPerformable("Patchie, Patchie; Where is my Patchie?").perform()

        await memory.flush()
        number = await memory.number_of(episode)
        tree = await memory.reading.tree(number)
        return Answers(number, tree, await _query(memory, number, memory.mapped(SayingActionPerformable)))


async def _query(memory: Memory, number: int, saying: Any) -> list[tuple[str, Sequence[str], list[Any]]]:
    """Run the thesis' five queries: four about this episode, one about the latest SayingAction."""
    async with memory.session() as session:
        metadata = (await session.scalars(select(ProcessMetaData).where(ProcessMetaData.id == number))).all()
        navigations = (
            await session.scalars(select(NavigateAction).where(NavigateAction.process_metadata_id == number))
        ).all()
        actions = (await session.scalars(select(Action).where(Action.process_metadata_id == number))).all()
        object_poses = (
            await session.scalars(
                select(PoseRow)
                .join(PickUpAction.object)
                .join(Object.pose)
                .where(PickUpAction.process_metadata_id == number)
            )
        ).all()
        sayings = (await session.scalars(select(saying).order_by(saying.id.desc()).limit(1))).all()
    return [
        (
            "What was done, by whom, with which version?  select(ProcessMetaData)",
            ("id", "created_at", "created_by", "description", "version", "status"),
            [(m.id, m.created_at, m.created_by, m.description, m.version, m.status) for m in metadata],
        ),
        (
            "Where did the robot navigate, and from where?  select(NavigateAction)",
            ("id", "to x", "to y", "from x", "from y", "torso"),
            [
                (n.id, n.pose.position.x, n.pose.position.y, s.pose.position.x, s.pose.position.y, s.torso_height)
                for n, s in ((n, n.robot_state) for n in navigations)
                if s is not None
            ],
        ),
        (
            "Which actions were there, of whatever kind?  select(Action)",
            ("id", "dtype", "robot x", "robot y", "torso"),
            [
                (a.id, a.dtype, s.pose.position.x, s.pose.position.y, s.torso_height)
                for a, s in ((a, a.robot_state) for a in actions)
                if s is not None
            ],
        ),
        (
            "Where were the objects that were picked up?  select(Pose).join(PickUpAction.object).join(Object.pose)",
            ("id", "x", "y", "z", "frame"),
            [(p.id, p.position.x, p.position.y, p.position.z, p.frame) for p in object_poses],
        ),
        (
            "What has the robot spoken?  select(memory.mapped(SayingActionPerformable))",
            ("id", "dtype", "text"),
            [(s.id, s.dtype, s.text) for s in sayings],
        ),
    ]
