"""Map perceived objects, observations of programs, and samples of the robot's state during motions."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, relationship

from pycrorm_async.orm.base import Base, RowOfEvent, many_of, one_of
from pycrorm_async.orm.episodes import ProcessMetaData
from pycrorm_async.orm.objects import Object
from pycrorm_async.orm.tree import TaskTreeNode
from pycrorm_async.world.enums import ObjectType

__all__ = ["Detection", "StateSample", "Observation", "ObservationValue"]


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

    node: Mapped[TaskTreeNode | None] = one_of(lambda: Detection.node_id, "task_tree_node")
    object: Mapped[Object | None] = one_of(lambda: Detection.object_id, "object")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)


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


class Observation(RowOfEvent, Base):
    """An observation that a program made with `memory.observe`.

    Attributes:
        name: given by the program.
        node: the node that observed it.
        ns: monotonic time, comparable with `TaskTreeNode.start_ns`.
        items: its values, each with its key.
    """

    __tablename__ = "observation"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))
    name: Mapped[str]
    time: Mapped[datetime]
    ns: Mapped[int]

    node: Mapped[TaskTreeNode | None] = one_of(lambda: Observation.node_id, "task_tree_node")
    items: Mapped[list[ObservationValue]] = many_of(
        lambda: ObservationValue.id, "observation", order_by=lambda: ObservationValue.position
    )
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)

    @property
    def values(self) -> dict[str, float | str | bool | None]:
        """The values by key: numbers, texts and bools, of a blob its hash; None for a missing value."""
        return {each.key: each.value for each in self.items}


class ObservationValue(RowOfEvent, Base):
    """A scalar or a blob of an observation. All values of one observation share their `id`.

    Attributes:
        key: the keys and indices that lead to it, joined by dots; `value` if the observation is this value.
        number, text, truth: the scalar.
        blob: the SHA-256 of a blob, for `memory.blob`; with its `media_type` and its `size` in bytes.
        missing: the reason why the value could not be recorded.
    """

    __tablename__ = "observation_value"

    id: Mapped[int] = mapped_column(ForeignKey("observation.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    key: Mapped[str]
    number: Mapped[float | None]
    text: Mapped[str | None]
    truth: Mapped[bool | None]
    blob: Mapped[str | None]
    media_type: Mapped[str | None]
    size: Mapped[int | None]
    missing: Mapped[str | None]

    @property
    def value(self) -> float | str | bool | None:
        """The number, text or bool, or the hash of the blob; None for a missing value."""
        scalars = (self.number, self.text, self.truth, self.blob)
        return next((each for each in scalars if each is not None), None)
