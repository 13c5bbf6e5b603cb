"""Tables of the system of the thesis, as far as pick-up rollouts fill them.

Joined-table inheritance, one mapped class for each designator, a pose in three rows, an autoincrement key and the
episode's metadata in every root table, and indexes on keys only. The names are those of the original; the code is new.
"""

from __future__ import annotations

import enum
from datetime import datetime

from sqlalchemy import ForeignKey, String, func
from sqlalchemy.orm import DeclarativeBase, Mapped, MappedAsDataclass, declared_attr, mapped_column, relationship

from pycrorm_async.world.pose import Arms, Grasp, GripperState, ObjectType

__all__ = [
    "ActionRow",
    "BaselineBase",
    "DesignatorRow",
    "LEAVES",
    "MetaDataRow",
    "NodeStatus",
    "ObjectRow",
    "PoseRow",
    "PositionRow",
    "QuaternionRow",
    "RobotStateRow",
    "TaskTreeNodeRow",
]


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
