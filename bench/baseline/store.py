"""Store a task tree as the system of the thesis did: objects for all rows, then one commit."""

from __future__ import annotations

from datetime import UTC, datetime
from enum import Enum
from typing import Any

from sqlalchemy import Engine, create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.orm import Session

from bench.baseline.tables import (
    LEAVES,
    ActionRow,
    BaselineBase,
    DesignatorRow,
    MetaDataRow,
    NodeStatus,
    ObjectRow,
    PoseRow,
    PositionRow,
    QuaternionRow,
    RobotStateRow,
    TaskTreeNodeRow,
)
from bench.material.rollouts import Node, Place, Robot, Tree, WorldObject
from pycrorm_async.world.pose import Arms, Grasp, GripperState, ObjectType

__all__ = ["engine_of", "Statements", "store"]

_ENUMS: dict[str, type[Enum]] = {"arm": Arms, "gripper": Arms, "grasp": Grasp, "motion": GripperState}


class Statements:
    """Count the INSERT statements that an engine sends."""

    def __init__(self, engine: Engine) -> None:
        self.sent = 0
        event.listen(engine, "before_cursor_execute", self._note)

    def _note(self, _connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        self.sent += statement.startswith("INSERT")


def engine_of(url: str) -> Engine:
    """Create a synchronous engine, as in the original, and its tables."""
    address = make_url(url)
    if address.get_backend_name() == "postgresql":
        address = address.set(drivername="postgresql+psycopg")
    engine = create_engine(address)
    BaselineBase.metadata.create_all(engine)
    return engine


def store(tree: Tree, engine: Engine) -> None:
    """Store the whole tree in one session and one commit."""
    with Session(engine) as session:
        metadata = MetaDataRow("bench", "rollouts", None)
        session.add(metadata)
        inserts = _Inserts(session, metadata)
        root = inserts.add(TaskTreeNodeRow(_time(tree.began_ns), None, NodeStatus.RUNNING, None))
        for rollout in tree.rollouts:
            inserts.node(rollout, root)
        session.commit()


class _Inserts:
    """Add the rows of each value to the session after the rows that it depends on."""

    def __init__(self, session: Session, metadata: MetaDataRow) -> None:
        self._session = session
        self._metadata = metadata

    def add(self, row: Any) -> Any:
        row.process_metadata = self._metadata
        self._session.add(row)
        return row

    def node(self, node: Node, parent: TaskTreeNodeRow) -> None:
        status = NodeStatus.FAILED if node.failure else NodeStatus.SUCCEEDED
        row = TaskTreeNodeRow(_time(node.start_ns), _time(node.end_ns), status, node.failure)
        row.action = self._designator(node)
        row.parent = parent
        self.add(row)
        for child in node.children:
            self.node(child, row)

    def _designator(self, node: Node) -> DesignatorRow:
        scalars: dict[str, Any] = {}
        linked: dict[str, Any] = {}
        for name, value in node.values.items():
            match value:
                case Place():
                    linked["pose"] = self._pose(value)
                case WorldObject():
                    linked["object"] = self._object(value)
                case str():
                    scalars[name] = _ENUMS[name][value]
                case _:
                    scalars[name] = value
        row: Any = LEAVES[node.dtype](**scalars)
        for name, other in linked.items():
            setattr(row, name, other)
        if isinstance(row, ActionRow):
            assert node.robot is not None
            row.robot_state = self._robot(node.robot)
        designator: DesignatorRow = self.add(row)
        return designator

    def _pose(self, place: Place) -> PoseRow:
        row = PoseRow(_time(place.time_ns), "map")
        row.position = self.add(PositionRow(*place.position))
        row.orientation = self.add(QuaternionRow(*place.orientation))
        pose: PoseRow = self.add(row)
        return pose

    def _object(self, world_object: WorldObject) -> ObjectRow:
        row = ObjectRow(ObjectType[world_object.type], world_object.name)
        row.pose = self._pose(world_object.place)
        stored: ObjectRow = self.add(row)
        return stored

    def _robot(self, robot: Robot) -> RobotStateRow:
        row = RobotStateRow(robot.torso_m, ObjectType.ROBOT)
        row.pose = self._pose(robot.place)
        stored: RobotStateRow = self.add(row)
        return stored


def _time(time_ns: int) -> datetime:
    """Return a datetime without a time zone, as in the original."""
    return datetime.fromtimestamp(time_ns // 1000 / 1e6, UTC).replace(tzinfo=None)
