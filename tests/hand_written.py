"""Episodes written by hand, without a plan: every kind of id column, in a memory that holds nothing else."""

from __future__ import annotations

from collections.abc import Sequence

from pycrorm_async.events.codec import Record
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    JointsMoved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectReference,
)
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import NAVIGATE, SAYING, Script, declarations, declared, field, name_of, pose
from tests.projections.sql_queries import stored_and_folded

COUNTING = declared("CountingAction", "counting_action", field("robot_id", "integer", 2), field("milk", "object", 3))


def hand_written(number: int) -> Script:
    """Return an episode in which a robot is added, drives, counts and speaks; it has each kind of id column."""
    script = Script(number)
    script.put(EpisodeStarted(description=f"e{number}", created_by="me", host="h", software="0", python="3"))
    robot = script.put(ObjectAdded(name="pr2", object_type="ROBOT", pose=pose(number)))
    root = script.put(NodeStarted(kind="root"))
    for of, parameters in (
        (
            NAVIGATE,
            {
                "target_location": {
                    "position": [1, 2, number],
                    "orientation": [0, 0, 0, 1],
                    "frame": "map",
                    "time_ns": 5,
                }
            },
        ),
        (COUNTING, {"robot_id": 2**31 * 9, "milk": {"object": robot, "row": robot}}),
        (SAYING, {"text": "a"}),
    ):
        node = script.put(NodeStarted(kind="action", parent=root, designator=name_of(of), parameters=parameters))
        script.put(NodeEnded(node=node, status="SUCCEEDED"))
    script.put(JointsMoved(object=ObjectReference(robot, robot), joints={"a": 0.5, "b": -0.25}, node=root))
    script.put(NodeEnded(node=root, status="SUCCEEDED"))
    script.put(EpisodeEnded(status="SUCCEEDED"))
    return script


async def fill(url: str, episodes: Sequence[Script]) -> None:
    """Store and fold the episodes in the memory at this URL, which is made."""
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    records: list[Record] = [*declarations(NAVIGATE, COUNTING, SAYING)]
    try:
        for each in episodes:
            await stored_and_folded(log, [*records, *each.records])
    finally:
        await log.close()
