"""How the system of the thesis stored a task tree: objects for all of it, then one commit."""

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
from bench.material.rollouts import Node, Place, Robot, Thing, Tree
from pycrorm_async.world.enums import Arms, Grasp, GripperState, ObjectType

__all__ = ["engine_of", "Statements", "store"]

_ENUMS: dict[str, type[Enum]] = {"arm": Arms, "gripper": Arms, "grasp": Grasp, "motion": GripperState}


class Statements:
    """Counts what an engine is told to insert: statements sent, and rows in them."""

    def __init__(self, engine: Engine) -> None:
        self.sent = 0
        event.listen(engine, "before_cursor_execute", self._note)

    def _note(self, _connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        self.sent += statement.startswith("INSERT")


def engine_of(url: str) -> Engine:
    """A synchronous engine, as the original had, with its tables made."""
    place = make_url(url)
    if place.get_backend_name() == "postgresql":
        place = place.set(drivername="postgresql+psycopg")
    engine = create_engine(place)
    BaselineBase.metadata.create_all(engine)
    return engine


def store(made: Tree, engine: Engine) -> None:
    """The whole tree in one session and one commit."""
    with Session(engine) as session:
        metadata = MetaDataRow("bench", "rollouts", None)
        session.add(metadata)
        inserting = _Inserting(session, metadata)
        root = inserting.add(TaskTreeNodeRow(_time(made.began_ns), None, NodeStatus.RUNNING, None))
        for rollout in made.rollouts:
            inserting.node(rollout, root)
        session.commit()


class _Inserting:
    """Adds each value's rows to the session, those it depends on first."""

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
                case Thing():
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

    def _object(self, thing: Thing) -> ObjectRow:
        row = ObjectRow(ObjectType[thing.type], thing.name)
        row.pose = self._pose(thing.place)
        stored: ObjectRow = self.add(row)
        return stored

    def _robot(self, robot: Robot) -> RobotStateRow:
        row = RobotStateRow(robot.torso_m, ObjectType.ROBOT)
        row.pose = self._pose(robot.place)
        stored: RobotStateRow = self.add(row)
        return stored


def _time(time_ns: int) -> datetime:
    """Without a time zone, as there."""
    return datetime.fromtimestamp(time_ns // 1000 / 1e6, UTC).replace(tzinfo=None)
