"""The baseline has the shape of the system of the thesis, and both sides store the same facts."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from sqlalchemy import Engine

from bench.material.baseline import BaselineBase, Statements, engine_of, store
from bench.material.rollouts import THESIS_NODES, Node, Place, Tree, WorldObject, spool_tree, tree, tree_of
from pycrorm_async.operations.recovery import recover
from tests.databases import ask

pytestmark = pytest.mark.slow

ROOT_ROWS = 2
"""The root's own node, and the episode's metadata."""


@pytest.fixture
def file(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/baseline.db"


@pytest.fixture
def engine(file: str) -> Iterator[Engine]:
    engine = engine_of(file)
    yield engine
    engine.dispose()


def rows_of(url: str) -> dict[str, int]:
    """Return the number of rows of each table that is not empty."""
    counts = {each: ask(url, f'SELECT count(*) FROM "{each}"')[0][0] for each in BaselineBase.metadata.tables}
    return {name: count for name, count in counts.items() if count}


@pytest.mark.parametrize(("motions", "nodes", "rows"), [(1, 9, 84), (3, 11, 95), (5, 13, 106)])
def test_a_rollout_has_as_many_nodes_and_rows_as_in_the_thesis(
    file: str, engine: Engine, motions: int, nodes: int, rows: int
) -> None:
    rollouts = tree_of([motions])
    store(rollouts, engine)
    assert rollouts.nodes == 1 + nodes
    assert sum(rows_of(file).values()) == ROOT_ROWS + rows


def test_one_navigation_is_eleven_inserts_over_eight_tables(file: str, engine: Engine) -> None:
    rollouts = tree_of([1])
    navigation = rollouts.rollouts[0]
    navigation.children.clear()
    statements = Statements(engine)
    store(Tree([navigation], 2), engine)
    rows = rows_of(file)
    assert rows == {
        "ProcessMetaData": 1,
        "TaskTreeNode": 2,
        "Designator": 1,
        "Action": 1,
        "NavigateAction": 1,
        "RobotState": 1,
        "Pose": 2,
        "Position": 2,
        "Quaternion": 2,
    }
    assert statements.sent == ROOT_ROWS + 11


def test_rows_with_a_key_of_their_own_take_a_statement_each_on_sqlite(file: str, engine: Engine) -> None:
    rollouts = tree(1_000, seed=1)
    statements = Statements(engine)
    store(rollouts, engine)
    rows = rows_of(file)
    roots = ("TaskTreeNode", "Designator", "RobotState", "Object", "Pose", "Position", "Quaternion", "ProcessMetaData")
    own = {name: rows.pop(name) for name in roots}
    assert statements.sent == sum(own.values()) + len(rows)
    assert statements.sent / rollouts.nodes == pytest.approx(7.0, abs=0.1)
    assert (sum(own.values()) + sum(rows.values())) / rollouts.nodes == pytest.approx(9.05, abs=0.05)


@pytest.mark.soak
def test_fifty_thousand_rollouts_have_the_number_of_nodes_of_the_thesis() -> None:
    assert tree(THESIS_NODES, seed=69).nodes == 488_043


def test_the_same_seed_makes_the_same_tree_and_another_one_another() -> None:
    assert tree(500, seed=7) == tree(500, seed=7)
    assert tree(500, seed=7) != tree(500, seed=8)


# --- the same facts on both sides -------------------------------------------------------------------------------------

Fact = tuple[Any, ...]
"""A node: type, start and end in µs, status, reason of its failure, its parent's start, then the values of its
fields.
"""


class Stored(NamedTuple):
    """The places of a designator's values: in a pose, in an object, in columns."""

    pose: str | None
    object: str | None
    scalars: tuple[str, ...]


IN_BASELINE = {
    "NavigateAction": Stored("pose_id", None, ()),
    "FaceAtAction": Stored("pose_id", None, ()),
    "LookAtAction": Stored("pose_id", None, ()),
    "PickUpAction": Stored(None, "object_id", ("arm", "grasp")),
    "MoveMotion": Stored("pose_id", None, ()),
    "LookingMotion": Stored("pose_id", None, ()),
    "MoveTCPMotion": Stored("pose_id", None, ("arm", "allow_gripper_collision")),
    "MoveGripperMotion": Stored(None, None, ("motion", "gripper", "allow_gripper_collision")),
}
IN_OURS = {
    "NavigateAction": ("navigate_action", IN_BASELINE["NavigateAction"]._replace(pose="target_location_id")),
    "FaceAtAction": ("face_at_action", IN_BASELINE["FaceAtAction"]),
    "LookAtAction": ("look_at_action", IN_BASELINE["LookAtAction"]._replace(pose="target_id")),
    "PickUpAction": ("pick_up_action", IN_BASELINE["PickUpAction"]._replace(object="object_designator_id")),
    "MoveMotion": ("move_motion", IN_BASELINE["MoveMotion"]._replace(pose="target_id")),
    "LookingMotion": ("looking_motion", IN_BASELINE["LookingMotion"]._replace(pose="target_id")),
    "MoveTCPMotion": ("move_tcp_motion", IN_BASELINE["MoveTCPMotion"]._replace(pose="target_id")),
    "MoveGripperMotion": ("move_gripper_motion", IN_BASELINE["MoveGripperMotion"]),
}


def expected(rollouts: Tree) -> list[Fact]:
    """Return the facts of the values themselves."""
    facts = []

    def note(node: Node, parent_ns: int) -> None:
        values = list(node.values.values())
        place = next((each for each in values if isinstance(each, Place)), None)
        world_object = next((each for each in values if isinstance(each, WorldObject)), None)
        scalars = tuple(each for each in values if not isinstance(each, Place | WorldObject))
        robot = (*_flat(node.robot.place), node.robot.torso_m) if node.robot else (None,) * 9
        status = "FAILED" if node.failure else "SUCCEEDED"
        times = (node.start_ns // 1000, node.end_ns // 1000)
        object_values = (
            (world_object.name, world_object.type, *_flat(world_object.place)) if world_object else (None,) * 10
        )
        facts.append(
            (
                node.dtype,
                *times,
                status,
                node.failure,
                parent_ns // 1000,
                *robot,
                *_flat(place),
                *object_values,
                *scalars,
            )
        )
        for child in node.children:
            note(child, node.start_ns)

    for rollout in rollouts.rollouts:
        note(rollout, rollouts.began_ns)
    return sorted(facts, key=lambda fact: fact[1])


def _flat(place: Place | None) -> Fact:
    if place is None:
        return (None,) * 8
    return (*place.position, *place.orientation, place.time_ns // 1000)


def stored_by_baseline(url: str) -> list[Fact]:
    facts: list[Fact] = []
    for dtype, (pose, object_column, scalars) in IN_BASELINE.items():
        columns = ", ".join(f"leaf.{each}" for each in scalars)
        statement = f"""
            SELECT node.start_time, node.end_time, node.status, node.reason, parent.start_time,
                rp.x, rp.y, rp.z, rq.x, rq.y, rq.z, rq.w, robot_pose.time, robot.torso_height,
                p.x, p.y, p.z, q.x, q.y, q.z, q.w, pose.time,
                object.name, object.obj_type, op.x, op.y, op.z, oq.x, oq.y, oq.z, oq.w, object_pose.time
                {"," if columns else ""} {columns}
            FROM TaskTreeNode AS node JOIN TaskTreeNode AS parent ON parent.id = node.parent_id
            JOIN Designator AS designator ON designator.id = node.action_id AND designator.dtype = '{dtype}'
            JOIN {dtype} AS leaf ON leaf.id = designator.id
            LEFT JOIN Action AS action ON action.id = designator.id
            LEFT JOIN RobotState AS robot ON robot.id = action.robot_state_id
            LEFT JOIN Pose AS robot_pose ON robot_pose.id = robot.pose_id
            LEFT JOIN Position AS rp ON rp.id = robot_pose.position_id
            LEFT JOIN Quaternion AS rq ON rq.id = robot_pose.orientation_id
            LEFT JOIN Pose AS pose ON pose.id = {f"leaf.{pose}" if pose else "NULL"}
            LEFT JOIN Position AS p ON p.id = pose.position_id
            LEFT JOIN Quaternion AS q ON q.id = pose.orientation_id
            LEFT JOIN Object AS object ON object.id = {f"leaf.{object_column}" if object_column else "NULL"}
            LEFT JOIN Pose AS object_pose ON object_pose.id = object.pose_id
            LEFT JOIN Position AS op ON op.id = object_pose.position_id
            LEFT JOIN Quaternion AS oq ON oq.id = object_pose.orientation_id"""
        times = (0, 1, 4, 12, 21, 31)
        facts += [
            (dtype, *(_us(each) if place in times else each for place, each in enumerate(row)))
            for row in ask(url, statement)
        ]
    return sorted(facts, key=lambda fact: fact[1])


def _us(text: str | None) -> int | None:
    if text is None:
        return None
    seconds, micros = divmod(round(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp() * 1e6), 1_000_000)
    return seconds * 1_000_000 + micros


def stored_by_us(url: str) -> list[Fact]:
    facts: list[Fact] = []
    for dtype, (table, (pose, object_column, scalars)) in IN_OURS.items():
        columns = ", ".join(f"leaf.{each}" for each in scalars)
        flat = ", ".join(
            f"{name}.{each}" for name in ("robot", "pose") for each in ("x", "y", "z", "qx", "qy", "qz", "qw", "time")
        ).replace("robot.time", "robot.time, node.torso_height")
        statement = f"""
            SELECT node.start_time, node.end_time, node.status, node.reason, parent.start_time, {flat},
                object.name, object.obj_type, op.x, op.y, op.z, op.qx, op.qy, op.qz, op.qw, op.time
                {"," if columns else ""} {columns}
            FROM task_tree_node AS node JOIN task_tree_node AS parent ON parent.id = node.parent_id
            JOIN {table} AS leaf ON leaf.id = node.id
            LEFT JOIN pose AS robot ON robot.id = node.robot_pose_id
            LEFT JOIN pose ON pose.id = {f"leaf.{pose}" if pose else "NULL"}
            LEFT JOIN object ON object.id = {f"leaf.{object_column}" if object_column else "NULL"}
            LEFT JOIN pose AS op ON op.id = object.pose_id WHERE node.dtype = '{dtype}'"""
        facts += [(dtype, *row) for row in ask(url, statement)]
    return sorted(facts, key=lambda fact: fact[1])


def test_the_baseline_holds_the_facts_of_the_tree(file: str, engine: Engine) -> None:
    rollouts = tree_of([1, 5, 3, 1])
    store(rollouts, engine)
    assert stored_by_baseline(file) == expected(rollouts)


def test_ours_holds_the_facts_of_the_tree(tmp_path: Path) -> None:
    rollouts = tree_of([1, 5, 3, 1])
    url = f"sqlite:///{tmp_path}/ours.db"
    spool_tree(rollouts, tmp_path / "spool")
    report = asyncio.run(recover(url, spool=tmp_path / "spool"))
    assert (report.failed, report.lost, report.drained.stopped) == ({}, (), {})
    assert stored_by_us(url) == expected(rollouts)
