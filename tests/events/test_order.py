"""The check of legal order reports every violation with its place, and accepts correct plans."""

import pytest

from pycrorm_async.events.order import Finding, OrderCheck
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    Happening,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    PoseValue,
)

START = EpisodeStarted("d", "me", "here", "0", "3")
POSE = PoseValue((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "map", 0)
DONE = EpisodeEnded("SUCCEEDED")


def findings(*events: tuple[int, Happening]) -> list[Finding]:
    check = OrderCheck()
    return [violation for sequence, event in events for violation in check.read(sequence, event)]


def test_an_ordinary_episode_has_no_findings() -> None:
    assert (
        findings(
            (1, START),
            (2, NodeStarted("root")),
            (3, ObjectAdded("milk", "MILK", POSE)),
            (4, NodeStarted("action", 2)),
            (5, LocationResolved("L", node=4)),
            (6, ObjectMoved(3, "milk", "MILK", POSE, 4)),
            (7, NodeEnded(4, "SUCCEEDED")),
            (8, NodeEnded(2, "SUCCEEDED")),
            (9, DONE),
        )
        == []
    )


@pytest.mark.parametrize(
    ("events", "finding"),
    [
        (((1, START), (3, DONE)), (3, "event 2 is missing")),
        (((1, START), (5, DONE)), (5, "events 2 to 4 are missing")),
        (((1, START), (1, DONE)), (1, "event 1 follows event 1")),
        (((1, DONE),), (1, "the episode has not started")),
        (((1, START), (2, START)), (2, "the episode starts a second time")),
        (((1, START), (2, DONE), (3, DONE)), (3, "the episode has ended already")),
        (((1, START), (2, NodeStarted("action", 7))), (2, "its parent 7 never started")),
        (
            ((1, START), (2, NodeStarted("root")), (3, NodeStarted("root"))),
            (3, "a second node without a parent"),
        ),
        (((1, START), (2, NodeEnded(9, "SUCCEEDED"))), (2, "node 9 ends and never started")),
        (((1, START), (2, ObjectMoved(9, "m", "MILK", POSE))), (2, "object 9 was never added")),
        (((1, START), (2, LocationResolved("L", node=9))), (2, "node 9 never started")),
    ],
)
def test_a_structural_break_is_damage(events: tuple[tuple[int, Happening], ...], finding: tuple[int, str]) -> None:
    assert findings(*events) == [Finding("damage", *finding)]


def test_ending_twice_is_damage() -> None:
    ended = NodeEnded(2, "SUCCEEDED")
    assert findings((1, START), (2, NodeStarted("root")), (3, ended), (4, ended)) == [
        Finding("damage", 4, "node 2 ends a second time")
    ]


def test_a_child_that_ends_after_its_cancelled_parent_is_a_remark() -> None:
    assert findings(
        (1, START),
        (2, NodeStarted("root")),
        (3, NodeStarted("action", 2)),
        (4, NodeStarted("motion", 3)),
        (5, NodeEnded(3, "CANCELLED")),
        (6, NodeEnded(4, "CANCELLED")),
    ) == [Finding("remark", 6, "node 4 ends after its parent 3")]


def test_nodes_open_at_the_end_are_a_remark_unless_the_episode_was_lost() -> None:
    open_node = ((1, START), (2, NodeStarted("root")))
    assert findings(*open_node, (3, DONE)) == [Finding("remark", 3, "1 nodes are open at the end")]
    assert findings(*open_node, (3, EpisodeEnded("LOST"))) == []
