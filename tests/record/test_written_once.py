"""What an event of an episode has already is named by later ones, and the tables are those of events that repeat it."""

from __future__ import annotations

import math
import weakref
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import pytest
from msgspec.structs import replace

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import declaration_of, decode, encode, fingerprint
from pycrorm_async.events.types import (
    BriefPose,
    DesignatorTypeDeclared,
    EndReference,
    FailureValue,
    Happening,
    NodeEnded,
    NodeStarted,
    ObjectReference,
    PoseReference,
    PoseValue,
    RobotValue,
    with_poses,
)
from pycrorm_async.plan import ActionAbstract, PlanFailure
from pycrorm_async.plan.actions import MoveTorsoActionPerformable, NavigateActionPerformable, PickUpActionPerformable
from pycrorm_async.plan.motions import simulated_robot
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.projections.columns import COLUMNS
from pycrorm_async.projections.fold import fold_happening, happening_of
from pycrorm_async.projections.row_batch import Designators, Row, Rows
from pycrorm_async.record.episode_writer import fitted
from pycrorm_async.record.values import FailureCopies, FrozenPoses, failure_value
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from tests.projections.event_script import Script
from tests.record.fakes import NoteActionPerformable, RecorderCase, recorder_case

ROBOT_POSE_ID = COLUMNS["task_tree_node"].index("robot_pose_id")
FAILURE = slice(COLUMNS["task_tree_node"].index("failure_message"), COLUMNS["task_tree_node"].index("failure_node_id"))


async def _plan() -> None:
    """Move, fail to reach an object, and move again."""
    Object("pr2", ObjectType.ROBOT)
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
    designator = ObjectDesignator("milk", ObjectType.MILK, milk)
    await MoveTorsoActionPerformable(0.25).perform()
    await NavigateActionPerformable(Pose([0.6, 0.4, 0.0], [0, 0, 0.6, 0.8])).perform()
    for _ in range(2):
        with suppress(PlanFailure):
            await PickUpActionPerformable(designator, Arms.LEFT, Grasp.FRONT).perform()
        await NavigateActionPerformable(Pose([0.7, 0.9, 0.0])).perform()


async def _recorded() -> tuple[RecorderCase, list[Happening]]:
    with recorder_case() as case, case.episode() as episode, BulletWorld(), simulated_robot:
        await _plan()
    return case, [event for _, event in case.sink.of(episode)]


def _as_first_version(case: RecorderCase, event: Happening) -> tuple[str, bytes]:
    """Return an event as it was written before: every pose and failure at each place, with all fields."""
    if isinstance(event, NodeEnded) and event.failure is not None and event.failure.of is not None:
        event = replace(event, failure=_failure_at(case, event.failure.of))
    if isinstance(event, NodeStarted):
        starts = {sequence: each for sequence, each in case.sink.only() if isinstance(each, NodeStarted)}
        event = replace(event, parameters=with_poses(event.parameters, lambda node: starts[node].parameters))
    if isinstance(event, NodeStarted) and event.robot is not None:
        (episode,) = case.sink.sequences
        pose, name = case.sink.robot_pose(episode, event), "".join(("RO", "BOT"))  # not the default itself, so written
        event = replace(event, robot=replace(event.robot, pose=pose, object_type=name))
    return type(event).__name__, encode(event)


def _failure_at(case: RecorderCase, of: EndReference) -> FailureValue:
    (whole,) = [each for sequence, each in case.sink.only() if sequence == of.end]
    assert isinstance(whole, NodeEnded)
    assert whole.node == of.node
    assert whole.failure is not None
    assert whole.failure.of is None
    return whole.failure


def _folded(case: RecorderCase, script: Script) -> dict[str, dict[Any, Row]]:
    """Return the rows by table and key."""
    declared = [encode(each) for _, _, each in case.sink.records if isinstance(each, DesignatorTypeDeclared)]
    designators = Designators({fingerprint(each): declaration_of(each) for each in declared})
    rows = Rows()
    for event in script.stored():
        fold_happening(event, happening_of(event), designators, rows)
    keyed: dict[str, dict[Any, Row]] = {}
    for (table, columns), inserts in rows.to_insert().items():
        keyed[table] = {(each[: 2 if columns[1] == "joint" else 1]): each for each in inserts}
    return keyed


async def test_the_tables_of_poses_that_are_named_are_those_of_poses_written_at_every_node() -> None:
    case, events = await _recorded()
    first, today = Script(), Script()
    for event in events:
        first.put_payload(*_as_first_version(case, event), 1)
        today.put(event)
    assert all(each.robot.pose is None for each in events if isinstance(each, NodeStarted) and each.robot is not None)
    before, after = _folded(case, first), _folded(case, today)
    poses_before, poses_after = before.pop("pose"), after.pop("pose")
    nodes_before, nodes_after = before.pop("task_tree_node"), after.pop("task_tree_node")
    references = [each for start in events if isinstance(start, NodeStarted) for each in start.parameters.values()]
    assert sum(PoseReference.of(each) is not None for each in references) == 3  # of the motions of three navigations
    moved = {key: (*each[:2], before["move_motion"][key][2]) for key, each in after["move_motion"].items()}
    targets = [poses_after[each[2],][1:] for each in after["move_motion"].values()]
    assert targets == [poses_before[each[2],][1:] for each in before["move_motion"].values()]
    assert after | {"move_motion": moved} == before
    assert poses_after.items() < poses_before.items()
    assert sum(each[FAILURE.stop] is not None for each in nodes_after.values()) == 2  # of two pick-ups
    assert nodes_after.keys() == nodes_before.keys()
    for key, node in nodes_after.items():
        former = list(nodes_before[key])
        pose, former_pose = node[ROBOT_POSE_ID], former[ROBOT_POSE_ID]
        former[ROBOT_POSE_ID] = pose
        if (of := node[FAILURE.stop]) is not None:
            assert node[FAILURE] == (None, None)
            node = (*node[: FAILURE.start], *nodes_after[of,][FAILURE], None, *node[FAILURE.stop + 1 :])
        assert node == tuple(former)
        assert (pose is None) == (former_pose is None)
        if pose is not None:
            assert poses_after[pose,][1:] == poses_before[former_pose,][1:]


async def test_a_robot_whose_motion_was_not_recorded_is_written_with_its_pose() -> None:
    with recorder_case() as case, case.episode() as episode, BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        case.sink.broken = True
        robot.set_pose(Pose([1, 0, 0]))
        case.sink.broken = False
        await NoteActionPerformable("lost").perform()
        robot.set_pose(Pose([2, 0, 0]))
        await NoteActionPerformable("kept").perform()
    starts = [each for _, each in case.sink.of(episode) if isinstance(each, NodeStarted) and each.kind == "action"]
    lost, kept = (each.robot for each in starts)
    assert lost is not None
    assert lost.pose is not None
    assert lost.pose.position == (1, 0, 0)
    assert kept is not None
    assert kept.pose is None
    assert [case.sink.robot_pose(episode, each).position for each in starts] == [(1, 0, 0), (2, 0, 0)]


async def test_an_observer_gets_the_pose_of_the_robot_with_every_node() -> None:
    with recorder_case() as case, case.episode(), BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        observed = case.emitter.feed.keep((NodeStarted,), 10, SYSTEM_CLOCK)
        for x in (0, 1, 1):
            robot.set_pose(Pose([x, 0, 0]))
            await NoteActionPerformable().perform()
    starts = [each.event.happening for each in observed.take()]
    robots = [each.robot for each in starts if isinstance(each, NodeStarted)]
    assert [each.pose.position[0] for each in robots if each is not None and each.pose is not None] == [0, 1, 1]


def test_a_robot_whose_pose_is_not_finite_is_left_out_and_names_no_row() -> None:
    robot = RobotValue(PoseValue((math.nan, 0.0, 0.0)), "ROBOT", 0.2, ObjectReference(3, 7))
    event, reasons = fitted(NodeStarted("action", 2, robot=robot), 2**20)
    assert isinstance(event, NodeStarted)
    assert event.robot is None
    assert reasons == {"robot state": "nan is not a finite number"}


@pytest.mark.parametrize(
    ("pose", "payload"),
    [
        (PoseValue((1.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0), "map", 5), b'{"position":[1.0,2.0,0.5],"time_ns":5}'),
        (PoseValue((1.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0), "lab"), b'{"position":[1.0,2.0,0.5],"frame":"lab"}'),
        (
            PoseValue((1.0, 2.0, 0.5), (-0.0, 0.0, 0.0, 1.0)),
            b'{"position":[1.0,2.0,0.5],"orientation":[-0.0,0.0,0.0,1.0]}',
        ),
    ],
)
def test_a_brief_pose_omits_what_is_exactly_the_default(pose: PoseValue, payload: bytes) -> None:
    event = NodeStarted("action", robot=RobotValue(BriefPose.of(pose)))
    written = encode(event)
    assert written == b'{"robot":{"pose":%s}}' % payload
    read = decode("NodeStarted", written)
    assert isinstance(read, NodeStarted)
    assert read.robot is not None
    assert repr(read.robot.pose) == repr(pose)


# --- failures -----------------------------------------------------------------------------------------------------


def test_only_poses_of_the_class_whose_objects_never_change_are_copied_once() -> None:
    class Placed(Pose):
        """A class of a user, whose objects may change."""

    poses, pose, placed = FrozenPoses(Pose), Pose([1, 0, 0]), Placed([1, 0, 0])
    value = poses.keep(pose)
    assert poses.get(pose) is value
    assert poses.keep(placed).position == value.position
    assert poses.get(placed) is None
    for x in range(40):
        poses.keep(Pose([x, 0, 0]))
    assert poses.get(pose) is None


class Spilled(Exception):
    """A failure of a class in Python, to which there are weak references."""

    text = ""

    def __str__(self) -> str:
        return self.text


class Poses:
    """Looks up no object, and has the copies of poses that never change."""

    frozen_poses = FrozenPoses(Pose)

    def reference(self, key: Any, /) -> None:
        """Return no row."""


def test_an_exception_is_copied_once_until_it_changes_and_is_not_kept_alive() -> None:
    copies, tried = FailureCopies(), ["left"]
    failure = Spilled("milk", Arms.LEFT, Pose([1.0, 0.0, 0.0]))
    first = copies.copy(failure, Poses())
    assert first == failure_value(failure, Poses())
    assert copies.copy(failure, Poses()) is first
    assert copies.copy(Spilled(*failure.args), Poses()) is not first
    failure.text = "over the table"
    assert copies.copy(failure, Poses()).message == "over the table"
    failure.args = ("water", tried)
    assert copies.copy(failure, Poses()).arguments == ["water", ["left"]]
    tried.append("right")
    assert copies.copy(failure, Poses()).arguments == ["water", ["left", "right"]]
    here = weakref.ref(failure)
    del failure
    assert here() is None
    assert copies.copy(ValueError("too far"), Poses()).message == "too far"  # there are no weak references to it


@dataclass
class PassingActionPerformable(ActionAbstract):
    """Performs others below it; the innermost fails with its arguments."""

    depth: int
    arguments: list[Any]

    async def perform(self) -> None:
        if self.depth == 0:
            raise PlanFailure(*self.arguments)
        await PassingActionPerformable(self.depth - 1, self.arguments).perform()


async def _failures_of(*attempts: tuple[Any, ...]) -> tuple[list[NodeEnded], list[NodeEnded]]:
    """Perform three nested actions that fail for each attempt; return the ends in the log, and those observed."""
    with recorder_case() as case, case.episode() as episode:
        observed = case.emitter.feed.keep((NodeEnded,), 100, SYSTEM_CLOCK)
        for arguments in attempts:
            with suppress(PlanFailure):
                await PassingActionPerformable(2, list(arguments)).perform()
    ends = [replace(each, node=sequence) for sequence, each in case.sink.of(episode) if isinstance(each, NodeEnded)]
    shown = [each.event.happening for each in observed.take()]
    return ends, [each for each in shown if isinstance(each, NodeEnded)]


async def test_a_failure_that_passes_nodes_is_written_once_and_observers_get_it_at_each() -> None:
    far, near = ("too far", {"m": 2.5}), ("too near", 1)
    ends, shown = await _failures_of(far, far, near, far)
    written = [each.failure for each in ends if each.failure is not None]
    kind = f"{PlanFailure.__module__}.PlanFailure"
    contents = [None if each.of else each.arguments for each in written]
    assert contents == [[*far], None, None, None, None, None, [*near], None, None, [*far], None, None]
    first, third = ends[0].node, ends[6].node
    ends_named = [each.of.end for each in written if each.of is not None]
    assert ends_named == [first] * 5 + [third] * 2 + [ends[9].node] * 2
    whole = [FailureValue(kind, str(given), [*given.args]) for given in (PlanFailure(*far), PlanFailure(*near))]
    assert [each.failure for each in shown if each.failure is not None] == [whole[0]] * 6 + [whole[1]] * 3 + [
        whole[0]
    ] * 3


async def test_arguments_that_only_compare_equal_are_written_again() -> None:
    ends, _ = await _failures_of(("n", 1), ("n", True), ("n", 1.0))
    assert [each.failure.of is None for each in ends if each.failure is not None] == [True, False, False] * 3


async def test_a_failure_that_fills_half_a_record_is_written_at_each_node() -> None:
    ends, _ = await _failures_of(("x", ["y" * 9_000 for _ in range(100)]))
    failures = [each.failure for each in ends if each.failure is not None]
    assert [each.of for each in failures] == [None] * 3
