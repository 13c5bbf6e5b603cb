"""The demonstration of the thesis (5.1) with this memory: its tree and its five answers, computed from the world."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Mapped, mapped_column
from sqlalchemy.schema import ForeignKey

from pycrorm_async import Memory
from pycrorm_async.cli.demo import breakfast, kitchen_world
from pycrorm_async.orm import (
    Action,
    Attachment,
    JointChange,
    LocationCandidate,
    LocationResolution,
    NavigateAction,
    Object,
    PickUpAction,
    PickUpWithContextView,
    PlaceAction,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.orm import Pose as PoseRow
from pycrorm_async.plan import ActionAbstract, PlaceActionPerformable
from pycrorm_async.plan.execution import PlanObserver, recorder
from pycrorm_async.plan.task import TaskTreeNode as Node
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Grasp, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject
from tests.commands import answer, pycrorm

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""

THESIS_TREE = """
root
  ParkArmsAction
    MoveArmJointsMotion
  MoveTorsoAction
    MoveJointsMotion
  NavigateAction
    MoveMotion
  PickUpAction
    MoveTCPMotion
    MoveGripperMotion
    MoveTCPMotion
    MoveGripperMotion
    MoveTCPMotion
  ParkArmsAction
    MoveArmJointsMotion
  NavigateAction
    MoveMotion
  PlaceAction
    MoveTCPMotion
    MoveGripperMotion
    MoveTCPMotion
  ParkArmsAction
    MoveArmJointsMotion
"""


class ORMSaying(Action):
    """An author's own mapped class, as the thesis declares it."""

    id: Mapped[int] = mapped_column(ForeignKey(f"{Action.__tablename__}.id"), primary_key=True)
    text: Mapped[str]


@dataclass
class SayingActionPerformable(ActionAbstract):
    text: str
    orm_class = ORMSaying

    async def perform(self) -> None:
        """Succeed without doing anything."""


class WorldObserver:
    """An observer before the memory that notes the state of the world when an action starts."""

    def __init__(self, memory: PlanObserver, world: BulletWorld) -> None:
        self.memory = memory
        self.world = world
        self.seen: list[tuple[str, Pose, float, Pose]] = []
        self.designators: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.memory, name)

    def node_started(self, node: Node) -> None:
        if node.kind == "action":
            robot, cereal = self.world.object("pr2"), self.world.object("cereal")
            name = type(node.designator).__name__.removesuffix("Performable")
            self.seen.append((name, robot.pose, robot.joint_position("torso_lift_joint"), cereal.pose))
            self.designators.append(node.designator)
        self.memory.node_started(node)


def tree_text(nodes: list[Any]) -> str:
    return "\n" + "".join(f"{'  ' * node.depth}{node.dtype or 'root'}\n" for node in nodes)


def same(row: Any, pose: Pose) -> bool:
    return (row.x, row.y, row.z) == pose.position and (row.qx, row.qy, row.qz, row.qw) == pose.orientation


@pytest.mark.every_python
async def test_the_memory_of_the_demo_has_its_tree_and_its_answers(tmp_path: Path, database_url: str) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="Tutorial for getting familiar with the memory") as episode:
            with BulletWorld() as world:
                kitchen_world()
                recorder_of_memory = recorder.get()
                assert recorder_of_memory is not None
                witness = WorldObserver(recorder_of_memory, world)
                token = recorder.set(cast("Any", witness))
                await breakfast()
                recorder.reset(token)
                resting = world.object("cereal").pose
        await SayingActionPerformable("Patchie, Patchie; Where is my Patchie?").perform()
        await memory.flush()
        assert memory.status.faults.total == 0
        number = await memory.number_of(episode)
        assert tree_text(await memory.reading.tree(number)) == THESIS_TREE

        async with memory.session() as session:
            # 1. metadata
            metadata = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
            assert [(each.description, each.status) for each in metadata] == [
                ("Tutorial for getting familiar with the memory", "SUCCEEDED"),
                ("SayingAction", "SUCCEEDED"),
            ]
            assert metadata[0].uuid == str(episode)

            # 2. all navigations with their robot state
            expected = [each for each in witness.seen if each[0] == "NavigateAction"]
            targets = [each.target_location for each in witness.designators if hasattr(each, "target_location")][:2]
            navigations = (await session.scalars(select(NavigateAction).order_by(NavigateAction.id))).all()
            assert len(navigations) == len(expected) == 2
            for row, (_, robot_pose, torso, _), target in zip(navigations, expected, targets, strict=True):
                assert row.robot_state is not None
                assert same(row.robot_state.pose, robot_pose)
                assert (row.robot_state.torso_height, row.robot_state.type) == (torso, ObjectType.ROBOT)
                assert same(row.pose, target)
                assert (row.pose.position.x, row.pose.position.y) == (target.position.x, target.position.y)
            assert expected[1][1] == targets[0]  # the second starts where the first ended

            # 3. all actions, polymorphically
            actions = (await session.scalars(select(Action).order_by(Action.id))).all()
            assert [each.dtype for each in actions] == [each[0] for each in witness.seen] + ["SayingAction"]
            for action, (name, robot_pose, torso, _) in zip(actions, witness.seen, strict=False):
                assert type(action).__name__ == name
                assert action.robot_state is not None
                assert same(action.robot_state.pose, robot_pose)
                assert action.robot_state.torso_height == torso
            assert actions[-1].robot_state is None

            # 4. the poses of picked-up objects, at that moment
            picked = (await session.scalars(select(PoseRow).join(PickUpAction.object).join(Object.pose))).all()
            assert len(picked) == 1
            assert same(picked[0], Pose([1.3, 0.7, 0.95]))
            placed = (await session.scalars(select(PlaceAction))).one()
            carried = next(each[3] for each in witness.seen if each[0] == "PlaceAction")
            assert same(placed.object.pose, carried)
            assert not same(placed.object.pose, Pose([1.3, 0.7, 0.95]))
            assert placed.object.name == "cereal"

            # 5. the action declared in the demo, with the author's own class
            sayings = (await session.scalars(select(ORMSaying))).all()
            assert [each.text for each in sayings] == ["Patchie, Patchie; Where is my Patchie?"]
            assert isinstance(actions[-1], ORMSaying)

            # beyond the memory of the thesis
            last = (await session.scalars(select(Object).where(Object.name == "cereal").order_by(Object.id))).all()[-1]
            assert same(last.pose, resting)
            place = next(each for each in witness.designators if isinstance(each, PlaceActionPerformable))
            assert resting.distance(place.target_location) < 0.01
            attachments = (await session.scalars(select(Attachment).order_by(Attachment.id))).all()
            assert [(each.kind, each.parent.name, each.child.name) for each in attachments] == [
                ("attached", "pr2", "cereal"),
                ("detached", "pr2", "cereal"),
            ]
            lifted = (
                await session.scalars(select(JointChange.position).where(JointChange.joint == "torso_lift_joint"))
            ).all()
            assert lifted == [0.3]
            locations = (await session.scalars(select(LocationResolution).order_by(LocationResolution.id))).all()
            assert [each.location for each in locations] == [
                "CostmapLocation",
                "SemanticCostmapLocation",
                "CostmapLocation",
            ]
            taken = (await session.scalars(select(LocationCandidate).where(LocationCandidate.taken))).all()
            stands = [(each.x, each.y) for each in taken if each.resolution_id in {locations[0].id, locations[2].id}]
            assert stands == [(each.position.x, each.position.y) for each in targets]

            statuses = (await session.scalars(select(TaskTreeNode.status))).all()
            assert set(statuses) == {TaskStatus.SUCCEEDED}
            assert len(statuses) == 23 + 2

            view = (await session.execute(select(PickUpWithContextView))).all()
        pick = next(each for each in witness.seen if each[0] == "PickUpAction")
        frame = await memory.dataframe(select(PickUpWithContextView))
        assert len(view) == len(frame) == 1
        assert (frame.arm[0], frame.grasp[0], frame.status[0]) == ("LEFT", "FRONT", "SUCCEEDED")
        assert frame.obj_type[0] == "BREAKFAST_CEREAL"
        assert frame.torso_height[0] == pick[2] == 0.3
        assert frame.relative_x[0] == pick[1].position.x - 1.3
        assert frame.relative_y[0] == pick[1].position.y - 0.7
        assert (
            frame.quaternion_x[0],
            frame.quaternion_y[0],
            frame.quaternion_z[0],
            frame.quaternion_w[0],
        ) == pick[1].orientation
    assert (Arms.LEFT.name, Grasp.FRONT.name) == ("LEFT", "FRONT")


async def test_the_same_plan_runs_without_a_memory_and_records_nothing(tmp_path: Path) -> None:
    with BulletWorld() as world:
        kitchen_world()
        await breakfast()
        assert world.object("cereal").pose.distance(Pose([1.3, 0.7, 0.95])) > 1
        assert world.observers == ()
    assert not any(tmp_path.iterdir())


async def test_the_plan_also_runs_on_the_mesh_model(tmp_path: Path) -> None:
    from pycrorm_async.world.models import pr2_mesh_urdf_path

    async with Memory.open(f"sqlite:///{tmp_path}/demo.db") as memory:
        async with memory.episode(description="mesh") as episode:
            with BulletWorld():
                WorldObject("kitchen", ObjectType.ENVIRONMENT)
                WorldObject("pr2", ObjectType.ROBOT, pr2_mesh_urdf_path())
                WorldObject("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
                WorldObject("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.3, 0.7, 0.95]))
                await breakfast()
        await memory.flush()
        nodes = await memory.reading.tree(await memory.number_of(episode))
        assert tree_text(nodes) == THESIS_TREE
        assert {node.status for node in nodes} == {"SUCCEEDED"}


@pytest.mark.every_python
def test_the_demo_command_prints_the_tree_and_the_answers(tmp_path: Path) -> None:
    first = answer("demo", cwd=tmp_path)
    names = [node["dtype"] or "root" for node in first["tree"]]
    assert names == THESIS_TREE.split()
    assert [len(rows) for rows in first["answers"].values()] == [1, 2, 8, 1, 1]
    assert answer("demo", cwd=tmp_path)["episode"] == first["episode"] + 2


def test_the_demonstration_in_a_private_database_offers_no_verb_that_could_open_it(tmp_path: Path) -> None:
    done = pycrorm("demo", "--url", "sqlite://", cwd=tmp_path)
    assert done.returncode == 0
    line = "The database was sqlite://, which ended with this process; without --url the demonstration is kept."
    assert done.stderr.splitlines() == [line]
