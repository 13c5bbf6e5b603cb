"""Map perceived objects, and samples of the robot's state during motions."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, relationship

from pycrorm_async.orm.base import Base, ProcessMetaData, RowOfEvent
from pycrorm_async.orm.objects import Object
from pycrorm_async.orm.tree import TaskTreeNode
from pycrorm_async.world.enums import ObjectType

__all__ = ["Detection", "StateSample"]


class Detection(RowOfEvent, Base):
    """A percept. All percepts of one detection share their `id`; the best has `position` 0.

    Attributes:
        source: `camera`, or `world_state` where the world's own state was read; the sensor or method instead, if the
            robot's perception named one.
        looked_for: the requested type; None for any.
        visible: the visible share of the object, 0 to 1; None without a camera.
        confidence: the confidence that the robot's perception computed; None if it computed none.
        object: the row of the object of the world at that moment; None for a hypothesis or a false positive, which
            matches none.
        x, y, z, qx, qy, qz, qw, frame: the perceived pose.
        node: the node that performed the detection.
    """

    __tablename__ = "detection"

    id: Mapped[int] = mapped_column(primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))
    source: Mapped[str]
    looked_for: Mapped[ObjectType | None]
    object_id: Mapped[int | None] = mapped_column(ForeignKey("object.id"))
    name: Mapped[str]
    obj_type: Mapped[ObjectType]
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]
    qx: Mapped[float]
    qy: Mapped[float]
    qz: Mapped[float]
    qw: Mapped[float]
    frame: Mapped[str]
    visible: Mapped[float | None]
    confidence: Mapped[float | None]
    time: Mapped[datetime]

    node: Mapped[TaskTreeNode | None] = relationship(viewonly=True, lazy="selectin")
    object: Mapped[Object | None] = relationship(viewonly=True, lazy="selectin")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True, lazy="selectin")


class StateSample(RowOfEvent, Base):
    """One channel of the robot's state at one moment of a motion, recorded if it had changed.

    Attributes:
        id: the same for all channels of one moment.
        channel: `base.x`, `base.y`, `base.z` (m), `base.qx`, `base.qy`, `base.qz`, `base.qw`, or a joint (rad, m).
        node_id: the motion.
        ns: monotonic time, comparable with `TaskTreeNode.start_ns`.
    """

    __tablename__ = "state_sample"

    id: Mapped[int] = mapped_column(primary_key=True)
    channel: Mapped[str] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    object_id: Mapped[int] = mapped_column(ForeignKey("object.id"))
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))
    value: Mapped[float]
    time: Mapped[datetime]
    ns: Mapped[int]
