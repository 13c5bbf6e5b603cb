"""What perception said, and how the robot moved while it did what it did."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, relationship

from pycrorm_async.orm.base import Base, ProcessMetaData
from pycrorm_async.orm.objects import Object
from pycrorm_async.orm.tree import TaskTreeNode
from pycrorm_async.world.enums import ObjectType

__all__ = ["Detection", "StateSample"]


class Detection(Base):
    """An object that was perceived. Those of one look share their `id`; the best seen has `position` 0.

    Attributes:
        source: camera, or world_state: the world itself was asked.
        looked_for: the type that was looked for; None: anything.
        visible: the share of it that was seen, 0 to 1; None where nobody looked.
        object: as it was; x to frame is its pose then.
        node: the node that looked.
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
    time: Mapped[datetime]

    node: Mapped[TaskTreeNode | None] = relationship(viewonly=True, lazy="selectin")
    object: Mapped[Object | None] = relationship(viewonly=True, lazy="selectin")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True, lazy="selectin")


class StateSample(Base):
    """One channel of the robot's state at one moment of a motion, written where it had changed.

    Attributes:
        id: shared by the channels of one moment.
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
