"""`remember` records unmodified plans of the real PyCRAM 1.0.4, which runs in an environment of its own."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import sqlite3
import subprocess
import textwrap
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy import text as sql

from pycrorm_async import Reading
from pycrorm_async.orm import PickUpWithContextView, TaskTreeNode
from pycrorm_async.world import ObjectType
from tests.commands import Started, pycrorm
from tests.integrations.pycram.environment import ROOT, make_environment
from tests.shared_folders import shared_place

pytestmark = [pytest.mark.slow, pytest.mark.pycram]

PLANS = ("-m", "tests.integrations.pycram.plans")
RUN_S_MAX = 300
"""Bounds all plans; they take 15 s."""


def environment(folder: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "HOME": str(folder)}


class Run:
    """One run of all plans: their databases, and what PyCRAM itself keeps about them."""

    def __init__(self, folder: Path, output: str) -> None:
        self.folder = folder
        self.output = output
        self.facts: dict[str, Any] = json.loads((folder / "facts.json").read_text())

    def rows(self, plan: str, statement: str) -> list[tuple[Any, ...]]:
        assert "raised" not in self.facts.get(plan, {}), self.facts[plan]["raised"]
        return rows(self.folder / f"{plan}.db", statement)

    def tree(self, plan: str, episode: int = 1) -> str:
        """Return an episode's nodes, one a line, indented below their parents."""
        return tree_of(self.rows(plan, f"SELECT id, parent_id, dtype, status FROM task_tree_node {OF} {episode}"))


OF = "WHERE process_metadata_id ="


def rows(database: Path, statement: str) -> list[tuple[Any, ...]]:
    connection = sqlite3.connect(database)
    try:
        return connection.execute(statement).fetchall()
    finally:
        connection.close()


def tree_of(nodes: list[tuple[Any, ...]]) -> str:
    def below(parent: int | None, depth: int) -> list[str]:
        lines = []
        for node, of, dtype, status in sorted(nodes):
            if of == parent:
                lines += [f"{'  ' * depth}{dtype or 'root'} {status}", *below(node, depth + 1)]
        return lines

    return "\n".join(below(None, 0))


def text(lines: str) -> str:
    return textwrap.dedent(lines).strip()


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Perform all plans once, for all processes of the tests."""
    shared = shared_place(tmp_path_factory)
    folder = shared / "pycram"
    with (shared / "pycram.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            folder.mkdir()
            command = [str(make_environment()), *PLANS, str(folder)]
            done = subprocess.run(
                command,
                check=False,
                cwd=ROOT,
                env=environment(folder),
                capture_output=True,
                text=True,
                timeout=RUN_S_MAX,
            )
            (folder / "output.txt").write_text(done.stdout + done.stderr)
    output = (folder / "output.txt").read_text()
    assert (folder / "facts.json").exists(), output
    return Run(folder, output)


def test_a_plan_of_pycram_is_stored_as_the_tree_that_it_is(run: Run) -> None:
    assert run.tree("pick_and_place") == text("""
        root SUCCEEDED
          Sequential SUCCEEDED
            ParkArmsAction SUCCEEDED
              MoveJointsMotion SUCCEEDED
            MoveTorsoAction SUCCEEDED
              MoveJointsMotion SUCCEEDED
            PickUpAction SUCCEEDED
              ReachToPickUpAction SUCCEEDED
                MoveGripperMotion SUCCEEDED
                MoveTCPMotion SUCCEEDED
                MoveTCPMotion SUCCEEDED
              MoveGripperMotion SUCCEEDED
              MoveTCPMotion SUCCEEDED
            NavigateAction SUCCEEDED
              MoveMotion SUCCEEDED
            PlaceAction SUCCEEDED
              MoveTCPMotion SUCCEEDED
              MoveGripperMotion SUCCEEDED
              MoveTCPMotion SUCCEEDED
    """)


def test_pose_and_torso_of_the_robot_are_those_of_pycrams_own_database_row_by_row(run: Run) -> None:
    ours = run.rows(
        "pick_and_place",
        "SELECT node.dtype, position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w, node.torso_height"
        " FROM task_tree_node AS node JOIN pose ON pose.id = node.robot_pose_id"
        " JOIN position ON position.id = pose.position_id JOIN quaternion AS turn ON turn.id = pose.orientation_id"
        " WHERE node.kind = 'action' AND node.dtype != 'ReachToPickUpAction' ORDER BY node.id",
    )
    assert [list(each) for each in ours] == run.facts["pick_and_place"]["actions"]
    assert len(ours) == 5
    assert len({each[-1] for each in ours}) == 2, "the torso has moved"


def test_the_table_that_compares_the_two_databases_holds_for_this_run(run: Run) -> None:
    theirs = run.facts["pick_and_place"]
    assert theirs["rows"]["PlanNode"] == 0
    assert theirs["columns"]["ORMActionNode"] == theirs["columns"]["ORMMotionNode"] == ["id"]
    assert {"grasp_description_id", "object_designator_id"}.isdisjoint(theirs["columns"]["PickUpAction"])
    [tables] = run.rows("pick_and_place", "SELECT json_group_array(name) FROM sqlite_master WHERE type = 'table'")
    names = [each for each in json.loads(tables[0]) if each.startswith("zz_") and "pycrorm" not in each]
    stored = {each: _count(run, each) for each in names}
    kinds = dict(run.rows("pick_and_place", "SELECT kind, count(*) FROM task_tree_node GROUP BY kind"))
    versions, identities = run.rows("pick_and_place", "SELECT count(*), count(DISTINCT identity_id) FROM object")[0]
    objects = f"{versions} rows of {identities} objects"
    assert kinds == {"root": 1, "language": 1, "action": 6, "motion": 11}
    page = (ROOT / "pycrorm_async" / "integrations" / "README.md").read_text()
    for row in (
        f"| rows | {_size(theirs['rows'])}, after the plan | {_size(stored)}, from {_count(run, 'event')} events,",
        f"| {theirs['rows']['ORMActionNode']} actions twice, {theirs['rows']['ORMMotionNode']} motions: ids without",
        f"| {sum(kinds.values())}: root, sequence, {kinds['action']} actions, {kinds['motion']} motions |",
        f"| {_count(run, 'joint_change')} joint positions, {_count(run, 'attachment')} attachments, {objects} |",
    ):
        assert row in page


def _count(run: Run, table: str) -> int:
    count: int = run.rows("pick_and_place", f"SELECT count(*) FROM {table}")[0][0]
    return count


def _size(rows_by_table: dict[str, int]) -> str:
    return f"{sum(rows_by_table.values())} in {sum(each > 0 for each in rows_by_table.values())} tables"


def test_no_event_of_any_plan_was_lost_or_refused_and_the_memories_verify(run: Run) -> None:
    assert "not recorded" not in run.output
    assert {plan: facts["raised"] for plan, facts in run.facts.items() if "raised" in facts} == {}
    for plan in ("pick_and_place", "simulation", "parallel_branches"):
        done = pycrorm("verify", "--url", f"sqlite:///{run.folder}/{plan}.db", cwd=run.folder)
        assert done.returncode == 0, done.stdout + done.stderr


def test_one_motion_that_sets_fourteen_joints_is_one_event(run: Run) -> None:
    parked = run.rows(
        "pick_and_place",
        "SELECT node.dtype, count(DISTINCT joint.id), count(*) FROM joint_change AS joint"
        " JOIN task_tree_node AS node ON node.id = joint.node_id GROUP BY node.id ORDER BY node.id",
    )
    assert all(events == 1 for _, events, _ in parked), parked
    events = run.rows("pick_and_place", "SELECT count(*) FROM event WHERE type = 'JointsMoved'")
    assert events == [(len(parked),)]
    grip = run.rows(
        "pick_and_place",
        "SELECT joint, position FROM joint_change JOIN task_tree_node AS node ON node.id = joint_change.node_id"
        " WHERE node.dtype = 'MoveGripperMotion' ORDER BY joint_change.id, joint",
    )
    opened = [("l_gripper_l_finger_joint", 0.548), ("l_gripper_r_finger_joint", 0.548)]
    closed = [("l_gripper_l_finger_joint", 0.0), ("l_gripper_r_finger_joint", 0.0)]
    assert grip == [*opened, *closed, *opened]


def test_objects_their_types_and_what_holds_them_are_stored_as_they_change(run: Run) -> None:
    first = "SELECT name, obj_type, model FROM object WHERE id = identity_id ORDER BY id"
    assert run.rows("pick_and_place", first) == [
        ("floor", "ENVIRONMENT", None),
        ("pr2", "ROBOT", "pr2"),
        ("milk", "MILK", None),
    ]
    assert run.rows(
        "pick_and_place",
        "SELECT attachment.kind, parent.name, child.name, link, node.dtype FROM attachment"
        " JOIN object AS parent ON parent.id = attachment.parent_id JOIN object AS child ON child.id = child_id"
        " JOIN task_tree_node AS node ON node.id = attachment.node_id ORDER BY attachment.id",
    ) == [
        ("attached", "pr2", "milk", "l_gripper_tool_frame", "PickUpAction"),
        ("detached", "pr2", "milk", "l_gripper_tool_frame", "PlaceAction"),
    ]
    carried = run.rows(
        "pick_and_place",
        "SELECT node.dtype, round(position.x, 2), round(position.y, 2), round(position.z, 2) FROM object"
        " JOIN task_tree_node AS node ON node.id = object.node_id JOIN pose ON pose.id = pose_id"
        " JOIN position ON position.id = pose.position_id WHERE name = 'milk' ORDER BY object.id",
    )
    assert carried == [
        ("MoveTCPMotion", 0.8, 0.0, 1.0),
        ("MoveMotion", 0.9, 0.2, 1.0),
        ("MoveTCPMotion", 0.9, 0.2, 0.85),
    ]


async def test_the_view_of_pick_ups_answers_about_plans_of_pycram(run: Run) -> None:
    found = {}
    for plan in ("pick_and_place", "top_grasp"):
        async with Reading.open(f"sqlite:///{run.folder / plan}.db") as reading, reading.session() as session:
            found[plan] = [
                (each.arm.name, each.grasp.name, each.obj_type, each.status.name, round(each.relative_x, 2))
                for each in await session.scalars(select(PickUpWithContextView))
            ]
    assert found == {
        "pick_and_place": [("LEFT", "FRONT", ObjectType.MILK, "SUCCEEDED", -0.8)],
        "top_grasp": [("LEFT", "TOP", ObjectType.MILK, "FAILED", -0.8)],
    }


def test_the_goal_of_the_torso_is_in_metres_as_in_this_packages_own_action(run: Run) -> None:
    assert run.rows("pick_and_place", "SELECT torso_state, position FROM move_torso_action") == [("HIGH", 0.3)]


def test_all_motions_of_parallel_branches_are_stored_below_their_own_actions(run: Run) -> None:
    assert run.rows("parallel_branches", "SELECT count(*) FROM task_tree_node WHERE dtype = 'MoveGripperMotion'") == [
        (60,)
    ]
    below = run.rows(
        "parallel_branches",
        "SELECT count(*), count(DISTINCT action.id), count(DISTINCT branches.id) FROM task_tree_node AS motion"
        " JOIN set_gripper_action AS parameters ON parameters.id = (SELECT action_id FROM task_tree_node"
        "   WHERE id = motion.parent_id)"
        " JOIN move_gripper_motion AS goal ON goal.id = motion.action_id"
        " JOIN task_tree_node AS action ON action.id = motion.parent_id"
        " JOIN task_tree_node AS branches ON branches.id = action.parent_id"
        " WHERE branches.dtype = 'Parallel' AND goal.gripper = parameters.gripper AND goal.motion = parameters.motion",
    )
    assert below == [(60, 60, 20)]
    assert run.facts["parallel_branches"]["motions_in_pycrams_plans"] < 60, "PyCRAM's own plan loses some"


def test_failures_of_both_kinds_differ_and_recoveries_succeed(run: Run) -> None:
    assert run.tree("failures") == text("""
        root SUCCEEDED
          MoveTCPMotion FAILED
          Code ERROR
          Code SUCCEEDED
            MoveTCPMotion FAILED
            SetGripperAction SUCCEEDED
              MoveGripperMotion SUCCEEDED
          Repeat ERROR
            SetGripperAction SUCCEEDED
              MoveGripperMotion SUCCEEDED
            SetGripperAction ERROR
    """)
    reasons = run.rows(
        "failures", "SELECT reason, failure_message FROM task_tree_node WHERE reason IS NOT NULL ORDER BY id"
    )
    assert reasons[0][0] == "IKError"
    assert reasons[0][1].startswith("Position [4.")
    assert reasons[1] == ("ValueError", "the driver is gone")
    assert [reason for reason, _ in reasons[2:]] == ["IKError", "StopIteration", "StopIteration"]


@pytest.mark.parametrize(("plan", "status"), [("failed_plan", "FAILED"), ("broken_plan", "ERROR")])
def test_a_failure_that_leaves_the_block_is_the_episodes_and_all_seams_are_removed(
    run: Run, plan: str, status: str
) -> None:
    assert run.rows(plan, "SELECT status FROM process_metadata") == [(status,)]
    assert run.rows(plan, "SELECT status FROM task_tree_node WHERE kind = 'root'") == [(status,)]
    assert run.facts[plan]["seams"] == []


async def test_plans_in_the_prospection_world_are_simulated_episodes_of_the_node_that_thinks(run: Run) -> None:
    acted = """
        root SUCCEEDED
          NavigateAction SUCCEEDED
            MoveMotion SUCCEEDED
    """
    assert run.tree("simulation") == text("""
        root SUCCEEDED
          Code SUCCEEDED
          NavigateAction SUCCEEDED
            MoveMotion SUCCEEDED
    """)
    async with (
        Reading.open(f"sqlite:///{run.folder}/simulation.db") as reading,
        reading.session(simulated=True) as session,
    ):

        async def asked(statement: str) -> list[tuple[Any, ...]]:
            return [tuple(each) for each in await session.execute(sql(statement))]

        thinker = (await session.scalars(select(TaskTreeNode).where(TaskTreeNode.dtype == "Code"))).one().sequence
        episodes = await asked("SELECT id, status, simulated, thought_by_node FROM process_metadata ORDER BY id")
        assert episodes == [(1, "SUCCEEDED", 0, None), (2, "SUCCEEDED", 1, thinker), (3, "SUCCEEDED", 1, thinker)]
        types = "SELECT name, obj_type FROM object WHERE id = identity_id AND process_metadata_id = "
        for episode in (2, 3):
            nodes = f"SELECT id, parent_id, dtype, status FROM task_tree_node {OF} {episode}"
            assert tree_of(await asked(nodes)) == text(acted)
            assert await asked(f"{types}{episode}") == await asked(f"{types}1")
        moved = await asked("SELECT count(*) FROM object WHERE name = 'milk' AND id != identity_id")
        assert moved == [(0,)], "no node ran when the milk of the prospection world moved"


def test_actions_that_an_action_performs_are_below_it(run: Run) -> None:
    assert run.tree("nested") == text("""
        root SUCCEEDED
          MoveAndPickUpAction SUCCEEDED
            NavigateAction SUCCEEDED
              MoveMotion SUCCEEDED
            FaceAtAction SUCCEEDED
              NavigateAction SUCCEEDED
                MoveMotion SUCCEEDED
              LookAtAction SUCCEEDED
                LookingMotion SUCCEEDED
            PickUpAction SUCCEEDED
              ReachToPickUpAction SUCCEEDED
                MoveGripperMotion SUCCEEDED
                MoveTCPMotion SUCCEEDED
                MoveTCPMotion SUCCEEDED
              MoveGripperMotion SUCCEEDED
              MoveTCPMotion SUCCEEDED
    """)


def test_every_expression_of_the_language_is_a_node_with_its_outcome(run: Run) -> None:
    assert run.tree("language") == text("""
        root SUCCEEDED
          TryInOrder SUCCEEDED
            MoveTCPMotion FAILED
            SetGripperAction SUCCEEDED
              MoveGripperMotion SUCCEEDED
          Sequential FAILED
            MoveTCPMotion FAILED
          TryInOrder FAILED
            MoveTCPMotion FAILED
            MoveTCPMotion FAILED
          TryAll SUCCEEDED
            SetGripperAction SUCCEEDED
              MoveGripperMotion SUCCEEDED
            SetGripperAction SUCCEEDED
              MoveGripperMotion SUCCEEDED
          Repeat SUCCEEDED
            Code SUCCEEDED
            Code SUCCEEDED
          Monitor SUCCEEDED
            SetGripperAction SUCCEEDED
              MoveGripperMotion SUCCEEDED
    """)
    assert run.rows("language", "SELECT times FROM repeat") == [(2,)]
    assert run.rows("language", "SELECT condition, interval_s FROM monitor") == [("language.<locals>.<lambda>", 0.1)]
    assert (
        run.rows("language", "SELECT function, result FROM code JOIN task_tree_node ON action_id = code.id")
        == [("language.<locals>.doubled", "2")] * 2
    )


def test_the_types_that_are_prepared_before_a_plan_are_those_that_its_nodes_have(run: Run) -> None:
    facts = run.facts["expected_types"]
    assert json.dumps(facts["expected"]) == json.dumps(facts["actual"]), "also in the same order"
    assert dict(facts["actual"]) == {
        "MoveTCPMotion": {
            "target": "pose",
            "arm": "enum",
            "allow_gripper_collision": "boolean",
            "movement_type": "enum",
        },
        "MoveJointsMotion": {"names": ["list", "text"], "positions": ["list", "real"]},
        "MoveGripperMotion": {"motion": "enum", "gripper": "enum", "allow_gripper_collision": "boolean"},
        "CodeNode": {"function": "text", "arguments": ["dict", "text"]},
        "RepeatNode": {"times": "integer"},
        "MonitorNode": {"condition": "text", "interval_s": "real"},
        "SequentialNode": {},
        "PickUpAction": {
            "object_designator": "object",
            "arm": "enum",
            "grasp": "enum",
            "approach_direction": "enum",
            "rotate_gripper": "boolean",
        },
        "MoveTorsoAction": {"torso_state": "enum", "position": "real"},
    }


def test_a_monitor_is_interrupted_when_its_condition_fires_and_fails_when_its_plan_does(run: Run) -> None:
    failure = "the driver is gone"
    assert run.facts["monitors"] == {"cases": [None, failure, failure], "faults": 0}
    assert run.tree("monitors") == text("""
        root SUCCEEDED
          Monitor INTERRUPTED
            Code SUCCEEDED
          Monitor FAILED
            Code FAILED
          Monitor FAILED
            Code FAILED
    """), "the action after the code is never performed, so it is not recorded"
    reasons = run.rows(
        "monitors", "SELECT dtype, reason, failure_message FROM task_tree_node WHERE dtype = 'Monitor' ORDER BY id"
    )
    assert reasons == [("Monitor", None, None)] + 2 * [("Monitor", "PlanFailure", failure)]


def test_a_plan_in_a_thread_of_ones_own_is_recorded_and_never_below_another_threads_node(run: Run) -> None:
    assert run.tree("threads") == text("""
        root SUCCEEDED
          Code SUCCEEDED
            MoveGripperMotion SUCCEEDED
          ParkArmsAction SUCCEEDED
            MoveJointsMotion SUCCEEDED
    """)


def test_callbacks_and_replaced_methods_of_others_work_beside_and_after_the_seams(run: Run) -> None:
    facts = run.facts["others"]
    action = ["ActionNode", "ResolvedActionNode", "around", "MotionNode"]
    assert facts == {"seen": [*action, "ActionNode", *action, *action], "kept": True, "callbacks": True, "seams": []}
    assert run.tree("others") == text("""
        root SUCCEEDED
          ParkArmsAction SUCCEEDED
            MoveJointsMotion SUCCEEDED
          ParkArmsAction FAILED
          ParkArmsAction SUCCEEDED
            MoveJointsMotion SUCCEEDED
    """), "what another library's callback refuses has failed, and the next one is not below it"


def test_a_forked_child_has_a_remember_of_its_own_and_leaves_that_of_its_parent_alone(run: Run) -> None:
    assert run.facts["forked_child"] == {"exit": 0, "seams": []}
    assert run.tree("child") == text("""
        root SUCCEEDED
          Code SUCCEEDED
    """)
    assert run.tree("forked_child") == run.tree("child")


def test_a_second_remember_another_version_and_a_bad_database_are_refused_before_anything_is_replaced(run: Run) -> None:
    facts = run.facts["refusals"]
    assert facts["url"] == "UnknownUrl"
    assert facts["folder"] == "DatabaseUnavailable"
    assert facts["second"].startswith("another `remember` is active in this process")
    assert facts["version"] == (
        "PyCRAM 1.1.0 is unknown, only 1.0.4 can be recorded: pip install 'pycrorm-async[pycram]'"
    )
    assert facts["seams"] == []
    assert run.rows("refusals", "SELECT description, status FROM process_metadata") == [("The only one", "SUCCEEDED")]


def test_a_world_made_inside_the_block_is_seen_from_its_first_object_to_its_end(run: Run) -> None:
    assert run.rows("world_inside", "SELECT name, obj_type FROM object WHERE id = identity_id ORDER BY id") == [
        ("floor", "ENVIRONMENT"),
        ("pr2", "ROBOT"),
        ("milk", "MILK"),
    ]
    removed = run.rows(
        "world_inside",
        "SELECT name FROM object_removal JOIN object ON object.id = object_id ORDER BY object_removal.id",
    )
    assert removed == [("milk",), ("floor",), ("pr2",)]


def test_what_moves_without_pycrams_methods_is_asked_of_the_world_at_the_next_action(run: Run) -> None:
    states = run.rows(
        "restored_state",
        "SELECT round(position.x, 6), round(position.y, 6), round(node.torso_height, 6) FROM task_tree_node AS node"
        " JOIN pose ON pose.id = node.robot_pose_id JOIN position ON position.id = pose.position_id"
        " WHERE node.dtype = 'SetGripperAction' ORDER BY node.id",
    )
    assert states == [(0.2, 0.3, 0.3), (0.0, 0.0, 0.0)]


def test_what_the_robot_holds_at_the_beginning_and_what_it_detects_are_recorded(run: Run) -> None:
    assert run.rows("held_and_seen", "SELECT kind, link, node_id FROM attachment") == [
        ("attached", "l_gripper_tool_frame", None)
    ]
    assert run.rows(
        "held_and_seen",
        "SELECT node.dtype, detection.name, obj_type, object_id IS NOT NULL FROM detection"
        " JOIN task_tree_node AS node ON node.id = node_id",
    ) == [("DetectingMotion", "milk", "MILK", 1)]


def test_named_arguments_an_outer_except_and_a_second_call_are_recorded_as_they_are(run: Run) -> None:
    assert run.tree("unusual_calls") == text("""
        root SUCCEEDED
          Code SUCCEEDED
          Repeat FAILED
            Code FAILED
          Repeat SUCCEEDED
            Code SUCCEEDED
    """)
    assert run.rows("unusual_calls", "SELECT status FROM process_metadata") == [("SUCCEEDED",)]
    assert run.rows("unusual_calls", "SELECT kind FROM attachment ORDER BY id") == [("attached",), ("detached",)]
    assert run.rows("unusual_calls", "SELECT count(*) FROM object_removal") == [(1,)]
    assert run.rows("unusual_calls", "SELECT count(*) FROM event WHERE type = 'JointsMoved'") == [(2,)]
    assert run.facts["unusual_calls"]["faults"] == 0
    (argument,) = run.rows("unusual_calls", "SELECT text FROM parameter_item WHERE field = 'arguments' AND text > ''")
    assert argument == ("<a Unspeakable whose repr raised OSError>",)


def test_an_object_parameter_is_recorded_as_its_row_a_part_or_a_belief(run: Run) -> None:
    assert run.facts["kinds_of_objects"]["values"] == [
        ["ObjectReference", None, None, None],
        ["ObjectValue", "ObjectPart", "cereal_link", "BREAKFAST_CEREAL"],
        ["ObjectValue", "BelieveObject", "milk", "MILK"],
        ["ObjectValue", "BelieveObject", "MILK", "MILK"],
        ["ObjectValue", "Object", "cereal", "BREAKFAST_CEREAL"],
    ]
    described = "SELECT obj_type, color, description_fingerprint IS NOT NULL FROM object WHERE name = 'cereal'"
    assert run.rows("kinds_of_objects", described) == [("BREAKFAST_CEREAL", "[1.0,1.0,1.0,1.0]", 1)]


def start_endless(folder: Path, writer: str = "thread") -> subprocess.Popen[str]:
    command = [str(make_environment()), *PLANS, str(folder), "endless", writer]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment(folder), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )


def read_until(process: subprocess.Popen[str], number: int) -> int:
    """Read the numbers of actions that have ended until this one; return the last."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip().isdigit() and int(line) >= number:
            return int(line)
    raise AssertionError("the plan ended by itself")


@pytest.mark.soak_on("daemon")
@pytest.mark.parametrize("writer", ["thread", "daemon"])
def test_a_killed_plan_of_pycram_loses_no_action_that_it_has_announced(tmp_path: Path, writer: str) -> None:
    with ExitStack() as running:
        if writer == "daemon":
            daemon = Started("writer", "--url", f"sqlite:///{tmp_path}/endless.db", cwd=tmp_path)
            running.callback(daemon.communicate)
            running.callback(daemon.send_signal, signal.SIGTERM)
        process = start_endless(tmp_path, writer)
        try:
            read_until(process, 25)
        finally:
            process.kill()
    assert process.stdout is not None
    announced = max([25, *(int(line) for line in process.stdout if line.strip().isdigit())])
    process.wait()
    process.stdout.close()
    done = pycrorm("writer", "--once", "--url", f"sqlite:///{tmp_path}/endless.db", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    database = tmp_path / "endless.db"
    ended = "SELECT count(*) FROM task_tree_node WHERE dtype = 'SetGripperAction' AND status = 'SUCCEEDED'"
    assert rows(database, ended)[0][0] >= announced
    assert rows(database, "SELECT status FROM process_metadata") == [("LOST",)]


def test_ctrl_c_ends_the_episode_as_interrupted_and_removes_all_seams(tmp_path: Path) -> None:
    process = start_endless(tmp_path)
    try:
        read_until(process, 5)
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        last = [line.strip() for line in process.stdout][-1]
        process.wait(60)
    finally:
        process.kill()
        process.wait()
    process.stdout.close()
    assert last == "seams: []"
    database = tmp_path / "endless.db"
    assert rows(database, "SELECT status FROM process_metadata") == [("INTERRUPTED",)]
    assert {status for (status,) in rows(database, "SELECT status FROM task_tree_node")} <= {"SUCCEEDED", "CANCELLED"}
