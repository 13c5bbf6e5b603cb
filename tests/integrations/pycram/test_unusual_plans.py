"""`remember` beside other callbacks, forks, worlds and threads, and in a process that is killed or interrupted."""

from __future__ import annotations

import signal
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.commands import Started, pycrorm
from tests.integrations.pycram.environment import ROOT, make_environment
from tests.integrations.pycram.performed_plans import PLANS, Run, environment, rows, text

pytestmark = [pytest.mark.slow, pytest.mark.pycram]


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
