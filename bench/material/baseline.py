"""Store a task tree as the system of the thesis did, with its tables: objects for all rows, then one commit."""

from __future__ import annotations

import enum
from datetime import UTC, datetime
from enum import Enum
from typing import Any

from sqlalchemy import Engine, ForeignKey, String, create_engine, event, func
from sqlalchemy.engine import make_url
from sqlalchemy.orm import (
    DeclarativeBase,
    Mapped,
    MappedAsDataclass,
    Session,
    declared_attr,
    mapped_column,
    relationship,
)

from bench.material.rollouts import Node, Place, Robot, Tree, WorldObject
from pycrorm_async.world.pose import Arms, Grasp, GripperState, ObjectType

# === store ====================================================================================================
#
# Store a task tree as the system of the thesis did: objects for all rows, then one commit.

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


# === tables ===================================================================================================
#
# Tables of the system of the thesis, as far as pick-up rollouts fill them.
#
# Joined-table inheritance, one mapped class for each designator, a pose in three rows, an autoincrement key and the
# episode's metadata in every root table, and indexes on keys only. The names are those of the original; the code is
# new.


class NodeStatus(enum.Enum):
    """The four states of the original."""

    CREATED = 0
    RUNNING = 1
    SUCCEEDED = 2
    FAILED = 3


class BaselineBase(MappedAsDataclass, DeclarativeBase):
    """The declarative base; texts have 255 characters."""

    type_annotation_map = {str: String(255)}  # noqa: RUF012  read by the mapper


class MetaDataRow(BaselineBase):
    """Metadata, one row for each episode."""

    __tablename__ = "ProcessMetaData"

    id: Mapped[int] = mapped_column(init=False, primary_key=True, autoincrement=True)
    created_at: Mapped[datetime] = mapped_column(init=False, server_default=func.current_timestamp())
    created_by: Mapped[str]
    description: Mapped[str]
    pycram_version: Mapped[str | None]


class _EpisodeRow(MappedAsDataclass):
    """A row of a root table, with its own key and the metadata of its episode."""

    id: Mapped[int] = mapped_column(init=False, primary_key=True, autoincrement=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("ProcessMetaData.id"), init=False)

    @declared_attr
    def process_metadata(cls) -> Mapped[MetaDataRow]:
        return relationship(init=False)


class _WithPose(MappedAsDataclass):
    pose_id: Mapped[int] = mapped_column(ForeignKey("Pose.id"), init=False)

    @declared_attr
    def pose(cls) -> Mapped[PoseRow]:
        return relationship(init=False, foreign_keys=[cls.pose_id])  # type: ignore[list-item]


class _WithObject(MappedAsDataclass):
    object_id: Mapped[int] = mapped_column(ForeignKey("Object.id"), init=False)

    @declared_attr
    def object(cls) -> Mapped[ObjectRow]:
        return relationship(init=False, foreign_keys=[cls.object_id])  # type: ignore[list-item]


class PositionRow(_EpisodeRow, BaselineBase):
    __tablename__ = "Position"
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]


class QuaternionRow(_EpisodeRow, BaselineBase):
    __tablename__ = "Quaternion"
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]
    w: Mapped[float]


class PoseRow(_EpisodeRow, BaselineBase):
    __tablename__ = "Pose"
    time: Mapped[datetime]
    frame: Mapped[str]
    position_id: Mapped[int] = mapped_column(ForeignKey("Position.id"), init=False)
    orientation_id: Mapped[int] = mapped_column(ForeignKey("Quaternion.id"), init=False)
    position: Mapped[PositionRow] = relationship(init=False)
    orientation: Mapped[QuaternionRow] = relationship(init=False)


class RobotStateRow(_EpisodeRow, _WithPose, BaselineBase):
    __tablename__ = "RobotState"
    torso_height: Mapped[float]
    type: Mapped[ObjectType]


class ObjectRow(_EpisodeRow, _WithPose, BaselineBase):
    __tablename__ = "Object"
    __mapper_args__ = {"polymorphic_on": "dtype", "polymorphic_identity": "Object"}  # noqa: RUF012
    dtype: Mapped[str] = mapped_column(init=False)
    obj_type: Mapped[ObjectType | None]
    name: Mapped[str]


class DesignatorRow(_EpisodeRow, BaselineBase):
    __tablename__ = "Designator"
    __mapper_args__ = {"polymorphic_on": "dtype", "polymorphic_identity": "Designator"}  # noqa: RUF012
    dtype: Mapped[str] = mapped_column(init=False)


class TaskTreeNodeRow(_EpisodeRow, BaselineBase):
    __tablename__ = "TaskTreeNode"
    start_time: Mapped[datetime]
    end_time: Mapped[datetime | None]
    status: Mapped[NodeStatus]
    reason: Mapped[str | None]
    action_id: Mapped[int | None] = mapped_column(ForeignKey("Designator.id"), init=False)
    parent_id: Mapped[int | None] = mapped_column(ForeignKey("TaskTreeNode.id"), init=False)
    action: Mapped[DesignatorRow | None] = relationship(init=False)
    parent: Mapped[TaskTreeNodeRow | None] = relationship(init=False, remote_side="TaskTreeNodeRow.id")


class ActionRow(DesignatorRow):
    __tablename__ = "Action"
    __mapper_args__ = {"polymorphic_identity": "Action"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Designator.id"), init=False, primary_key=True)
    dtype: Mapped[str] = mapped_column("action_dtype", init=False)
    robot_state_id: Mapped[int] = mapped_column(ForeignKey("RobotState.id"), init=False)
    robot_state: Mapped[RobotStateRow] = relationship(init=False)


class MotionRow(DesignatorRow):
    __tablename__ = "Motion"
    __mapper_args__ = {"polymorphic_identity": "Motion"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Designator.id"), init=False, primary_key=True)
    dtype: Mapped[str] = mapped_column("motion_dtype", init=False)


class NavigateRow(_WithPose, ActionRow):
    __tablename__ = "NavigateAction"
    __mapper_args__ = {"polymorphic_identity": "NavigateAction"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Action.id"), init=False, primary_key=True)


class FaceAtRow(_WithPose, ActionRow):
    __tablename__ = "FaceAtAction"
    __mapper_args__ = {"polymorphic_identity": "FaceAtAction"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Action.id"), init=False, primary_key=True)


class LookAtRow(_WithPose, ActionRow):
    __tablename__ = "LookAtAction"
    __mapper_args__ = {"polymorphic_identity": "LookAtAction"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Action.id"), init=False, primary_key=True)


class PickUpRow(_WithObject, ActionRow):
    __tablename__ = "PickUpAction"
    __mapper_args__ = {"polymorphic_identity": "PickUpAction"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Action.id"), init=False, primary_key=True)
    arm: Mapped[Arms]
    grasp: Mapped[Grasp]


class MoveRow(_WithPose, MotionRow):
    __tablename__ = "MoveMotion"
    __mapper_args__ = {"polymorphic_identity": "MoveMotion"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Motion.id"), init=False, primary_key=True)


class LookingRow(_WithPose, MotionRow):
    __tablename__ = "LookingMotion"
    __mapper_args__ = {"polymorphic_identity": "LookingMotion"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Motion.id"), init=False, primary_key=True)


class MoveTCPRow(_WithPose, MotionRow):
    __tablename__ = "MoveTCPMotion"
    __mapper_args__ = {"polymorphic_identity": "MoveTCPMotion"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Motion.id"), init=False, primary_key=True)
    arm: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


class MoveGripperRow(MotionRow):
    __tablename__ = "MoveGripperMotion"
    __mapper_args__ = {"polymorphic_identity": "MoveGripperMotion"}  # noqa: RUF012
    id: Mapped[int] = mapped_column(ForeignKey("Motion.id"), init=False, primary_key=True)
    motion: Mapped[GripperState]
    gripper: Mapped[Arms]
    allow_gripper_collision: Mapped[bool | None]


LEAVES: dict[str, type[DesignatorRow]] = {
    each.__tablename__: each
    for each in (NavigateRow, FaceAtRow, LookAtRow, PickUpRow, MoveRow, LookingRow, MoveTCPRow, MoveGripperRow)
}
"""Mapped classes by their name, which table and designator share."""
