"""Record one episode with rows of most classes, and read the mapped objects of a log."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async.events import types as events
from pycrorm_async.orm.base import known_classes
from pycrorm_async.query.reading import EpisodeSession, LoadOnAccess
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import MOVE, NAVIGATE, PICK_UP, Script, declarations, declared, field, name_of, pose
from tests.projections.sql_queries import stored_and_folded

OPEN = declared("OpenAction", "open_action", field("object_designator", "object", 2), field("arm", "enum", 3))
MOVE_JOINTS = declared(
    "MoveJointsMotion",
    "move_joints_motion",
    field("names", "list", 2, item="text"),
    field("positions", "list", 3, item="real"),
    kind="motion",
)


def moment(sequence: int) -> datetime:
    return datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC) + timedelta(seconds=sequence)


async def fill(url: str) -> None:
    """Record that a robot drives (with a motion inside), picks up the milk, and opens the fridge, in one episode."""
    script = Script()
    put = script.put
    put(events.EpisodeStarted("Tutorial", "me", "host", "1.0", "3.11", plan="breakfast"))  # 1
    root = put(events.NodeStarted("root"))  # 2
    robot = put(events.ObjectAdded("pr2", "ROBOT", pose(0.5), {"torso": 0.25}))  # 3
    milk = put(events.ObjectAdded("milk", "MILK", pose(1, 2, 3)))  # 4
    fridge = put(events.ObjectAdded("fridge", "ENVIRONMENT", pose()))  # 5
    state = events.RobotValue(pose(0.5, 0, 0, turned=0.6), "ROBOT", 0.25, events.ObjectReference(robot, robot))
    drive = put(events.NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7, 8)}, state))  # 6
    put(events.LocationResolved("CostmapLocation", (events.CandidateValue(pose(7, 8), ("LEFT",)),), 0, 9, drive))  # 7
    move = put(events.NodeStarted("motion", drive, name_of(MOVE), {"target": pose(7, 8)}, state))  # 8
    put(events.NodeEnded(move, "SUCCEEDED"))  # 9
    put(events.NodeEnded(drive, "SUCCEEDED"))  # 10
    seen = events.ObjectReference(milk, milk)
    grasp = {"object_designator": seen, "arm": "LEFT", "grasp": "TOP"}
    pick = put(events.NodeStarted("action", root, name_of(PICK_UP), grasp, state))  # 11
    put(events.ObjectMoved(milk, "milk", "MILK", pose(9, 9, 9), pick))  # 12
    put(events.ObjectAttached(events.ObjectReference(robot, robot), seen, "l_gripper_tool_frame", pick))  # 13
    put(events.NodeEnded(pick, "FAILED", events.FailureValue("plan.failures.IKError", "too far", ["LEFT"])))  # 14
    handle = events.ObjectValue(
        "ObjectPart", "handle", "GENERIC_OBJECT", pose(1), events.ObjectReference(fridge, fridge)
    )
    put(events.NodeStarted("action", root, name_of(OPEN), {"object_designator": handle, "arm": "RIGHT"}, None))  # 15
    joints = {"names": ["a", "b"], "positions": [0.5, -1.0]}
    put(events.NodeStarted("motion", root, name_of(MOVE_JOINTS), joints, state))  # 16
    put(events.JointsMoved(events.ObjectReference(robot, robot), {"a": 0.5}, root))  # 17
    put(events.ObjectRemoved(seen))  # 18
    put(events.EpisodeEnded("LOST"))  # 19
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    await stored_and_folded(log, [*declarations(NAVIGATE, PICK_UP, MOVE, OPEN, MOVE_JOINTS), *script.records])
    await log.close()


async def every(log: EventLog, question: Any) -> list[Any]:
    async with session_on(log) as session:
        return list((await session.scalars(question)).unique().all())


# === sessions =================================================================================================
#
# Open a session on a log, as `Reading.session` does, but without mapping the types that are declared in it.


def session_on(log: EventLog) -> AsyncSession:
    """Return a session whose objects load what is read of them, with the classes of the log's engine."""
    engine = log.address.engine(read_only=True)
    vars(engine.dialect)["pycrorm_known_classes"] = known_classes(log.engine.dialect)
    on_access = LoadOnAccess(engine, log.translated)
    return AsyncSession(log.engine, expire_on_commit=False, sync_session_class=EpisodeSession, on_access=on_access)
