"""The fold of changes of the world, of locations, percepts and observations; every expected row is written by hand."""

from __future__ import annotations

from pycrorm_async.events.types import (
    CandidateValue,
    CellsValue,
    JointsMoved,
    LocationResolved,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    Observed,
    RefusalValue,
    SeenValue,
    StateSampled,
)
from tests.projections.event_script import POSE_US, Script, pose, row, time_us
from tests.projections.folded_rows import rows_of


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
