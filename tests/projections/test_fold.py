"""The fold of events into rows; every expected row is written here by hand, column by column as in `CORE`."""

from __future__ import annotations

from typing import Any

import pytest

from pycrorm_async.events.types import (
    CandidateValue,
    CellsValue,
    DesignatorTypeDeclared,
    EpisodeEnded,
    EpisodeStarted,
    EpisodeTagged,
    FailureValue,
    JointsMoved,
    LocationResolved,
    MissingValue,
    NodeEnded,
    NodeReference,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    ObjectValue,
    Observed,
    RefusalValue,
    RobotValue,
    SeenValue,
    StateSampled,
)
from pycrorm_async.projections.columns import COLUMNS
from pycrorm_async.projections.fold import fold_happening, happening_of
from pycrorm_async.projections.row_batch import CannotFold, Designators, Rows
from pycrorm_async.store.stored import StoredEvent
from tests.projections.event_script import (
    NAVIGATE,
    PICK_UP,
    POSE_US,
    SAYING,
    Script,
    declared,
    field,
    name_of,
    pose,
    row,
    time_us,
)

EVERYTHING = declared(
    "EverythingAction",
    "everything_action",
    field("count", "integer", 2),
    field("speed", "real", 3),
    field("text", "text", 4),
    field("flag", "boolean", 5),
    field("due", "datetime", 6),
    field("arm", "enum", 7),
    field("there", "pose", 8),
    field("thing", "object", 9),
    field("via", "list", 10, item="pose"),
    field("joints", "dict", 11, item="real"),
    field("things", "list", 12, item="object"),
    field("names", "list", 13, item="text"),
)


def fold(event: StoredEvent, designators: Designators, rows: Rows) -> None:
    fold_happening(event, happening_of(event), designators, rows)


def test_an_episode_is_one_row_from_its_start_to_its_end() -> None:
    script = Script()
    thinker = NodeReference("018bcfe5-6800-7000-8000-000000000001", 12)
    former, rest = "018bcfe5-6800-7000-8000-000000000002", "018bcfe5-6800-7000-8000-000000000003"
    script.put(
        EpisodeStarted("why", "me", "host", "1.2", "3.11.7", "breakfast", "a kitchen", 42, True, thinker, former,
                       "f3d6", "702b", True, {"numpy": "2.4.6"}, {"writer": "daemon"}, True, 250,
                       ("kitchen",), {"n": 1})
    )  # fmt: skip
    script.put(EpisodeEnded("FAILED", FailureValue("plans.IKError", "too far"), rest, "a fridge"))
    script.put(EpisodeTagged(("late",), ("kitchen",)))
    assert rows_of(script, number=7) == {
        "process_metadata": [
            (
                7, None, time_us(1), "me", "why", "1.2", "host", "3.11.7", "breakfast", "a kitchen", 42,
                "FAILED", 1_000_000_005, 2_000_000_005, 2, "plans.IKError", "too far", True,
                "018bcfe5-6800-7000-8000-000000000001", 12,
                former, rest, "f3d6", "702b", True, '{"numpy":"2.4.6"}', '{"writer":"daemon"}', True, 250, "a fridge",
                '{"n":1}',
            )
        ],
        "episode_tagging": [
            (row(1, number=7), 0, 7, "kitchen", True, time_us(1)),
            (row(3, number=7), 0, 7, "kitchen", False, time_us(3)),
            (row(3, number=7), 1, 7, "late", True, time_us(3)),
        ],
        "simulated_episode": [(7,)],
    }  # fmt: skip


def test_a_node_with_a_robot_is_a_node_a_pose_and_a_leaf() -> None:
    script = Script()
    parameters = {"target_location": pose(3, 4, 5)}
    robot_row = script.put(
        ObjectAdded(
            "pr2",
            "ROBOT",
            pose(),
            {"torso_lift_joint": 0.25, "wheel": -1.5},
            None,
            "urdf-1",
            (1.0, 0.0, 0.5, 1.0),
            "pr2",
            "7",
        )
    )
    root = script.put(NodeStarted("root"))
    robot = RobotValue(pose(1.5, -2.0, 0.0, turned=0.6), "ROBOT", 0.25, ObjectReference(robot_row, robot_row), "pr2")
    node = script.put(NodeStarted("action", root, name_of(NAVIGATE), parameters, robot, simulated=True))
    assert (robot_row, root, node) == (1, 2, 3)
    assert rows_of(script, NAVIGATE) == {
        "object": [
            (
                row(1), 1, "Object", "pr2", "ROBOT", row(1), None, row(1), time_us(1), None,
                '{"torso_lift_joint":0.25,"wheel":-1.5}', "urdf-1", "[1.0,0.0,0.5,1.0]", "pr2", "7", None, None,
            ),
        ],
        "pose": [
            (row(1), 1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, "map", POSE_US),
            (row(3, 1), 1, 1.5, -2.0, 0.0, 0.0, 0.0, 0.6, 0.8, "map", POSE_US),
            (row(3, 2), 1, 3.0, 4.0, 5.0, 0.0, 0.0, 0.0, 1.0, "map", POSE_US),
        ],
        "navigate_action(id,process_metadata_id,target_location_id)": [(row(3), 1, row(3, 2))],
        "task_tree_node": [
            (
                row(2), 1, None, "root", None, "RUNNING", time_us(2), 2_000_000_005, None, None,
                None, None, None, None, None, None, None, None, None, None, False,
            ),
            (
                row(3), 1, row(2), "action", "NavigateAction", "RUNNING", time_us(3), 3_000_000_005, None, None,
                None, None, None, None, None, row(3, 1), 0.25, "ROBOT", row(1), "pr2", True,
            ),
        ],
    }  # fmt: skip


def test_a_node_that_ends_in_the_batch_in_which_it_started_is_one_insert() -> None:
    script = Script()
    node = script.put(NodeStarted("action", None, name_of(SAYING), {"text": "hi"}))
    failure = FailureValue("plans.failures.IKError", "no way", ["left", 1])
    script.put(NodeEnded(node, "FAILED", failure, {"said": [1, None]}))
    rows = folded(script, SAYING)
    assert rows.node_ends == []
    assert list(rows.nodes.values()) == [
        [
            row(1), 1, None, "action", "SayingAction", "FAILED", time_us(1), 1_000_000_005, 2_000_000_005,
            2, "IKError", "no way", '["left",1]', None, '{"said":[1,null]}', None, None, None, None, None, False,
        ]
    ]  # fmt: skip


def test_the_end_of_a_node_from_an_earlier_batch_is_an_update_without_a_time_if_it_was_lost() -> None:
    script = Script()
    script.put(NodeEnded(77, "SUCCEEDED"))
    script.put(NodeEnded(78, "LOST"))
    rows = folded(script)
    assert rows.to_insert() == {}
    assert rows.node_ends == [
        (row(77), "SUCCEEDED", 1_000_000_005, 1, None, None, None, None, None),
        (row(78), "LOST", None, None, None, None, None, None, None),
    ]


def test_every_type_of_field_has_its_column_and_its_rows() -> None:
    script = Script()
    milk = script.put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    node = script.put(
        NodeStarted(
            "action",
            None,
            name_of(EVERYTHING),
            {
                "count": 3,
                "speed": 0.1,
                "text": "Käse",
                "flag": True,
                "due": "2026-01-02T03:04:05.000006+00:00",
                "arm": "LEFT",
                "there": pose(1, 0, 0),
                "thing": ObjectReference(milk, milk),
                "via": [pose(5, 6, 7), pose(8, 9, 10)],
                "joints": {"b": 2.5, "a": -1.0},
                "things": [
                    ObjectReference(milk, milk),
                    ObjectValue("BelieveObject", "cup", "JEROEN_CUP", pose(4, 4, 4)),
                ],
                "names": ["x", MissingValue("too long", "'y'")],
            },
        )
    )
    assert (milk, node) == (1, 2)
    rows_by_table = rows_of(script, EVERYTHING)
    leaf = "everything_action(id,process_metadata_id,count,speed,text,flag,due,arm,there_id,thing_id)"
    # 2026-01-02 03:04:05.000006 UTC
    assert rows_by_table[leaf] == [(row(2), 1, 3, 0.1, "Käse", True, 1_767_323_045_000_006, "LEFT", row(2, 8), row(1))]
    assert rows_by_table["pose"][1:] == [(row(2, 8), 1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, "map", POSE_US)]
    nothing = (None,) * 5
    nowhere = (None,) * 8
    assert rows_by_table["parameter_item"] == [
        (row(2), "via", 0, 1, None, *nothing, 5.0, 6.0, 7.0, 0.0, 0.0, 0.0, 1.0, "map", None, None, None),
        (row(2), "via", 1, 1, None, *nothing, 8.0, 9.0, 10.0, 0.0, 0.0, 0.0, 1.0, "map", None, None, None),
        (row(2), "joints", 0, 1, "b", None, 2.5, None, None, None, *nowhere, None, None, None),
        (row(2), "joints", 1, 1, "a", None, -1.0, None, None, None, *nowhere, None, None, None),
        (row(2), "things", 0, 1, None, *nothing, *nowhere, row(1), None, None),
        (
            row(2), "things", 1, 1, None, *nothing, 4.0, 4.0, 4.0, 0.0, 0.0, 0.0, 1.0, "map",
            None, "cup", "JEROEN_CUP",
        ),
        (row(2), "names", 0, 1, None, None, None, "x", None, None, *nowhere, None, None, None),
        (row(2), "names", 1, 1, None, *nothing, *nowhere, None, None, None),
    ]  # fmt: skip


def test_a_value_recorded_as_missing_or_left_out_is_null() -> None:
    script = Script()
    script.put(NodeStarted("action", None, name_of(PICK_UP), {"arm": MissingValue("no member", "<x>")}))
    assert rows_of(script, PICK_UP)["pick_up_action(id,process_metadata_id,object_designator_id,arm,grasp)"] == [
        (row(1), 1, None, None, None)
    ]


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (NodeStarted("action", None, "0" * 32), "the designator type " + "0" * 32 + " was never declared"),
        (
            NodeStarted("action", None, name_of(SAYING), {"text": 5}),
            "text: 5 is not of the declared type text",
        ),
        (
            NodeStarted("action", None, name_of(NAVIGATE), {"target_location": {"position": [1, 2]}}),
            "target_location: not a pose: Expected `array` of length 3, got 2 - at `$.position`",
        ),
        (NodeEnded(2**26, "SUCCEEDED"), "no row can have the sequence 67108864 and the slot 0"),
        (
            LocationResolved("CostmapLocation", (), taken=0),
            "candidate 0 was taken, but only 0 were offered",
        ),
        (
            ObjectDetected(
                "camera",
                None,
                (SeenValue("cup", "CUP", pose(1)), SeenValue("milk", "MILK", pose(2), ObjectReference(1, 2**26))),
            ),
            "no row can have the sequence 67108864 and the slot 0",
        ),
    ],
    ids=["undeclared", "another type", "no pose", "no sequence", "no candidate", "no object"],
)
def test_an_event_that_cannot_be_folded_names_the_reason_and_leaves_no_row(event: Any, reason: str) -> None:
    script = Script()
    script.put(event)
    rows = Rows()
    with pytest.raises(CannotFold) as raised:
        fold(script.stored()[0], Designators({name_of(each): each for each in (SAYING, NAVIGATE)}), rows)
    assert str(raised.value) == reason
    assert rows.to_insert() == {}
    assert rows.node_ends == []


@pytest.mark.parametrize(
    ("type_", "payload", "version", "reason"),
    [
        ("RobotDanced", b"{}", 1, "RobotDanced is not an event type of this version"),
        ("NodeEnded", b'{"node":1,"status":"SUCCEEDED"}', 4, "NodeEnded has version 4, this version reads 3"),
        ("NodeEnded", b"{", 1, "NodeEnded cannot be decoded: Input data was truncated"),
    ],
)
def test_an_event_of_an_unknown_version_cannot_be_folded(type_: str, payload: bytes, version: int, reason: str) -> None:
    script = Script()
    script.put_payload(type_, payload, version)
    with pytest.raises(CannotFold) as raised:
        fold(script.stored()[0], Designators(), Rows())
    assert str(raised.value) == reason


def test_a_dict_field_may_contain_the_key_missing_among_others() -> None:
    notes = declared("NoteAction", "note_action", field("notes", "dict", 2, item="text"))
    script = Script()
    script.put(NodeStarted("action", None, name_of(notes), {"notes": {"missing": "milk", "bought": "bread"}}))
    assert [each[2:8] for each in rows_of(script, notes)["parameter_item"]] == [
        (0, 1, "missing", None, None, "milk"),
        (1, 1, "bought", None, None, "bread"),
    ]


# === folded rows ==============================================================================================
#
# Fold a script of events, and return its rows by table.


def rows_of(script: Script, *types: DesignatorTypeDeclared, number: int = 1) -> dict[str, list[tuple[Any, ...]]]:
    """Return every row by table; the columns of leaf tables come with their names."""
    rows = folded(script, *types, number=number)
    rows_by_table = rows.to_insert()
    return {
        table if columns == COLUMNS.get(table) else f"{table}({','.join(columns)})": values
        for (table, columns), values in rows_by_table.items()
    }


def folded(script: Script, *types: DesignatorTypeDeclared, number: int = 1) -> Rows:
    rows = Rows()
    designators = Designators({name_of(each): each for each in types})
    for event in script.stored(number):
        fold(event, designators, rows)
    return rows


# === fold of the world ========================================================================================
#
# The fold of changes of the world, of locations, percepts and observations; every expected row is written by hand.


def test_an_observation_has_a_row_for_each_scalar_and_blob() -> None:
    script = Script()
    root = script.put(NodeStarted("root"))
    cloud = {"$blob": "a" * 64, "media_type": "application/x-npy", "size": 9, "dtype": "float32", "shape": [2]}
    values = {"x": 1, "ok": True, "at": ["map", None], "cloud": cloud, "none": {}}
    observed = script.put(Observed("force", values, root, {"at.1": "nan is not a finite number"}))
    alone = script.put(Observed("alone", None, None, {"": "too long"}))
    rows = rows_of(script)
    assert rows["observation"] == [
        (row(observed), 1, row(root), "force", time_us(observed), script.records[observed - 1].monotonic_ns),
        (row(alone), 1, None, "alone", time_us(alone), script.records[alone - 1].monotonic_ns),
    ]
    empty = (None,) * 6
    assert rows["observation_value"] == [
        (row(observed), 0, 1, "x", 1.0, None, None, None, None, None, None),
        (row(observed), 1, 1, "ok", None, None, True, None, None, None, None),
        (row(observed), 2, 1, "at.0", None, "map", None, None, None, None, None),
        (row(observed), 3, 1, "at.1", *empty, "nan is not a finite number"),
        (row(observed), 4, 1, "cloud", None, None, None, "a" * 64, "application/x-npy", 9, None),
        (row(alone), 0, 1, "value", *empty, "too long"),
    ]


def test_each_change_of_the_world_is_one_row() -> None:
    script = Script()
    table = script.put(ObjectAdded("table", "GENERIC_OBJECT", pose()))
    milk = script.put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    root = script.put(NodeStarted("root"))
    moved = script.put(ObjectMoved(milk, "milk", "MILK", pose(9, 9, 9), root))
    milk_before = ObjectReference(milk, moved)
    script.put(ObjectAttached(ObjectReference(table, table), milk_before, "top", root))
    script.put(ObjectDetached(ObjectReference(table, table), milk_before))
    script.put(JointsMoved(ObjectReference(table, table), {"leaf": 0.5, "drawer": 0.25}, root))
    script.put(ObjectRemoved(milk_before, root))
    rows_by_table = rows_of(script)
    assert rows_by_table["object"][2] == (
        row(4), 1, "Object", "milk", "MILK", row(4), None, row(2), time_us(4), row(3), *[None] * 7,
    )  # fmt: skip
    assert rows_by_table["pose"][2] == (row(4), 1, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 1.0, "map", POSE_US)
    assert rows_by_table["attachment"] == [
        (row(5), 1, "attached", row(1), row(4), "top", time_us(5), row(3)),
        (row(6), 1, "detached", row(1), row(4), None, time_us(6), None),
    ]
    assert rows_by_table["joint_change"] == [
        (row(7), "leaf", 1, row(1), 0.5, time_us(7), row(3)),
        (row(7), "drawer", 1, row(1), 0.25, time_us(7), row(3)),
    ]
    assert rows_by_table["object_removal"] == [(row(8), 1, row(4), row(2), time_us(8), row(3))]


def test_a_resolved_location_keeps_the_offered_and_the_chosen_candidates() -> None:
    script = Script()
    root = script.put(NodeStarted("root"))
    offered = (CandidateValue(pose(1, 1), ("LEFT", "RIGHT")), CandidateValue(pose(2, 2), ("LEFT",), "TOP", 0.25))
    refused = (RefusalValue(pose(3, 3), "LEFT: too far"), RefusalValue(pose(4, 4), "not visible"))
    script.put(
        LocationResolved(
            "CostmapLocation",
            offered,
            taken=1,
            considered=600,
            node=root,
            refused=refused,
            cells=CellsValue(17, 5, 700),
        )
    )
    script.put(LocationResolved("AccessingLocation", considered=3))
    rows_by_table = rows_of(script)
    assert rows_by_table["location_resolution"] == [
        (row(2), 1, row(1), "CostmapLocation", 600, 2, 1, row(2), time_us(2), 598, 17, 5, 700),
        (row(3), 1, None, "AccessingLocation", 3, 0, None, None, time_us(3), 3, None, None, None),
    ]
    assert rows_by_table["location_candidate"] == [
        (row(2), 0, 1, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, "map", "LEFT,RIGHT", False, None, None),
        (row(2), 1, 1, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0, "map", "LEFT", True, "TOP", 0.25),
    ]
    assert rows_by_table["location_refusal"] == [
        (row(2), 0, 1, 3.0, 3.0, 0.0, 0.0, 0.0, 0.0, 1.0, "map", "LEFT: too far"),
        (row(2), 1, 1, 4.0, 4.0, 0.0, 0.0, 0.0, 0.0, 1.0, "map", "not visible"),
    ]
    assert rows_by_table["pose"] == [(row(2), 1, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0, "map", POSE_US)]


def test_each_detection_is_a_row_and_the_best_one_is_first() -> None:
    script = Script()
    milk = script.put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    root = script.put(NodeStarted("root"))
    seen = (
        SeenValue("milk", "MILK", pose(1, 2, 3), ObjectReference(milk, milk), 0.75),
        SeenValue("ghost", "MILK", pose(4, 5, 6), confidence=0.25, source="stereo"),
    )
    script.put(ObjectDetected("camera", "MILK", seen, root))
    script.put(ObjectDetected("world_state", None))
    assert rows_of(script)["detection"] == [
        (
            row(3), 0, 1, row(2), "camera", "MILK", row(1), "milk", "MILK",
            1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, "map", 0.75, None, time_us(3),
        ),
        (
            row(3), 1, 1, row(2), "stereo", "MILK", None, "ghost", "MILK",
            4.0, 5.0, 6.0, 0.0, 0.0, 0.0, 1.0, "map", None, 0.25, time_us(3),
        ),
    ]  # fmt: skip


def test_a_sample_of_the_robot_is_a_row_for_each_channel() -> None:
    script = Script()
    robot = script.put(ObjectAdded("pr2", "ROBOT", pose()))
    moved = script.put(ObjectMoved(robot, "pr2", "ROBOT", pose(1)))
    node = script.put(NodeStarted("root"))
    script.put(StateSampled(ObjectReference(robot, moved), {"base.x": 1.0, "torso_lift_joint": 0.25}, node))
    assert rows_of(script)["state_sample"] == [
        (row(4), "base.x", 1, row(2), row(3), 1.0, time_us(4), 4 * 10**9 + 5),
        (row(4), "torso_lift_joint", 1, row(2), row(3), 0.25, time_us(4), 4 * 10**9 + 5),
    ]
