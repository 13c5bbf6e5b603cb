"""`remember` records unmodified plans of the real PyCRAM 1.0.4, which runs in an environment of its own."""

from __future__ import annotations

import json
from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy import text as sql

from pycrorm_async import Reading
from pycrorm_async.orm import PickUpWithContextView, TaskTreeNode
from pycrorm_async.world import ObjectType
from tests.commands import pycrorm
from tests.integrations.pycram.environment import ROOT
from tests.integrations.pycram.performed_plans import OF, Run, text, tree_of

pytestmark = [pytest.mark.slow, pytest.mark.pycram]


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


@pytest.mark.parametrize(
    ("plan", "status", "root"),
    [
        ("failed_plan", "FAILED", "FAILED"),
        ("broken_plan", "ERROR", "ERROR"),
        ("interrupted_plan", "INTERRUPTED", "CANCELLED"),
    ],
)
def test_a_failure_that_leaves_the_block_is_the_episodes_and_all_seams_are_removed(
    run: Run, plan: str, status: str, root: str
) -> None:
    assert run.rows(plan, "SELECT status FROM process_metadata") == [(status,)]
    assert run.rows(plan, "SELECT status FROM task_tree_node WHERE kind = 'root'") == [(root,)]
    assert run.facts[plan]["seams"] == []


def test_an_exception_that_takes_the_place_of_an_exit_leaves_the_nodes_cancelled(run: Run) -> None:
    nodes = run.rows("interrupted_plan", "SELECT status, reason FROM task_tree_node WHERE kind != 'root'")
    assert nodes == [("CANCELLED", "AttributeError")]


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


def test_the_types_of_fields_are_those_of_annotations_and_where_these_leave_it_open_of_values(run: Run) -> None:
    assert run.facts["types_of_fields"] == {
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
