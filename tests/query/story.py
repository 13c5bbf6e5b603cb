"""Write an episode event by event, each with the state after it, written beside it by hand."""

from __future__ import annotations

from typing import NamedTuple

from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    Happening,
    JointsMoved,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    RobotValue,
    SeenValue,
    StateSampled,
)
from tests.projections.event_script import MOVE, NAVIGATE, PICK_UP, Script, name_of, pose

TYPES = (NAVIGATE, PICK_UP, MOVE)
PR2, MILK, OUTER, INNER, AGAIN = 3, 4, 5, 9, 18


class Line(NamedTuple):
    """An event, and the state after it: every node's status in tree order, every object, the episode's status."""

    event: Happening
    tree: str
    world: str
    status: str = "RUNNING"


def moved_object(sequence: int) -> ObjectReference:
    return ObjectReference(sequence, sequence)


ROBOT = RobotValue(pose(), "ROBOT", 0.0, moved_object(PR2))
STORY = [
    Line(EpisodeStarted("a story", "me", "host", "1.0", "3.11"), "", ""),
    Line(NodeStarted("root"), "root RUNNING", ""),
    Line(
        ObjectAdded("pr2", "ROBOT", pose(), {"torso_lift_joint": 0.0, "arm": 1.5}),
        "root RUNNING",
        "pr2 0 0 0 | 0 1.5",
    ),
    Line(ObjectAdded("milk", "MILK", pose(1, 2, 3)), "root RUNNING", "pr2 0 0 0 | 0 1.5; milk 1 2 3"),
    Line(
        NodeStarted("action", 2, name_of(NAVIGATE), {"target_location": pose(7)}, ROBOT),
        "root RUNNING, NavigateAction RUNNING",
        "pr2 0 0 0 | 0 1.5; milk 1 2 3",
    ),
    Line(
        ObjectMoved(PR2, "pr2", "ROBOT", pose(0.5, 4), OUTER),
        "root RUNNING, NavigateAction RUNNING",
        "pr2 0.5 4 0 | 0 1.5; milk 1 2 3",
    ),
    Line(
        JointsMoved(ObjectReference(PR2, 6), {"torso_lift_joint": 0.25}, OUTER),
        "root RUNNING, NavigateAction RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 1 2 3",
    ),
    Line(
        StateSampled(
            ObjectReference(PR2, 6), {"base.x": 9.0, "arm": 9.0}, OUTER
        ),  # events may arrive late: the setters are exact
        "root RUNNING, NavigateAction RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 1 2 3",
    ),
    Line(
        NodeStarted("action", OUTER, name_of(PICK_UP), {"object_designator": moved_object(MILK), "arm": "LEFT"}, ROBOT),
        "root RUNNING, NavigateAction RUNNING, PickUpAction RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 1 2 3",
    ),
    Line(
        ObjectAttached(ObjectReference(PR2, 6), moved_object(MILK), "hand", INNER),
        "root RUNNING, NavigateAction RUNNING, PickUpAction RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 1 2 3 < pr2 hand",
    ),
    Line(
        ObjectMoved(MILK, "milk", "MILK", pose(5, 6, 7), INNER),
        "root RUNNING, NavigateAction RUNNING, PickUpAction RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 5 6 7 < pr2 hand",
    ),
    Line(
        NodeEnded(INNER, "FAILED", FailureValue("a.b.IKError", "too far")),
        "root RUNNING, NavigateAction RUNNING, PickUpAction FAILED IKError: too far",
        "pr2 0.5 4 0 | 0.25 1.5; milk 5 6 7 < pr2 hand",
    ),
    Line(
        NodeStarted("motion", 2, name_of(MOVE), {"target": pose(8)}, ROBOT),
        "root RUNNING, NavigateAction RUNNING, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 5 6 7 < pr2 hand",
    ),
    Line(
        NodeEnded(OUTER, "SUCCEEDED"),
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 5 6 7 < pr2 hand",
    ),
    Line(
        ObjectDetached(ObjectReference(PR2, 6), ObjectReference(MILK, 11), "hand"),
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 5 6 7",
    ),
    Line(
        ObjectRemoved(ObjectReference(MILK, 11)),
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5",
    ),
    Line(
        ObjectMoved(MILK, "milk", "MILK", pose(9, 9, 9)),  # recorded late, by another thread
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5",
    ),
    Line(
        ObjectAdded("milk", "MILK", pose(1, 1, 1)),
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5; milk 1 1 1",
    ),
    Line(
        ObjectAttached(moved_object(AGAIN), ObjectReference(PR2, 6), None),
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5 < milk; milk 1 1 1",
    ),
    Line(
        LocationResolved("CostmapLocation", (CandidateValue(pose(1), ("LEFT",)),), 0, 4, OUTER),
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5 < milk; milk 1 1 1",
    ),
    Line(
        ObjectDetected("camera", "MILK", (SeenValue("milk", "MILK", pose(8), moved_object(AGAIN), 1.0),), OUTER),
        "root RUNNING, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion RUNNING",
        "pr2 0.5 4 0 | 0.25 1.5 < milk; milk 1 1 1",
    ),
    Line(
        EpisodeEnded("LOST"),
        "root LOST, NavigateAction SUCCEEDED, PickUpAction FAILED IKError: too far, MoveMotion LOST",
        "pr2 0.5 4 0 | 0.25 1.5 < milk; milk 1 1 1",
        "LOST",
    ),
]


def story(number: int = 1) -> Script:
    script = Script(number)
    for line in STORY:
        script.put(line.event)
    return script
