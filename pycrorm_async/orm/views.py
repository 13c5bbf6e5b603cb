"""Map the built-in view for learning; users register more of them with `projections.schema.user_views`."""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from pycrorm_async.orm.base import Base
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp, ObjectType

__all__ = ["PickUpWithContextView"]


class PickUpWithContextView(Base):
    """Every pick-up with the poses of robot and object: the sample that the thesis learns from (section 5.2).

    The robot's position is given twice: along the axes of the map, as in the thesis, and in the object's frame, which
    also applies to an object with another orientation.

    Attributes:
        torso_height: of the robot, m.
        relative_x, relative_y: robot minus object, m, along the axes of the map.
        quaternion_x, quaternion_y, quaternion_z, quaternion_w: of the robot's base.
        obj_type: of the object when the action started.
        status: of the action's node.
        process_metadata_id: the episode.
        node_id: the node; the same number as `id`.
        object_x, object_y, object_z: of the robot's base in the object's own frame, m.
        object_qx, object_qy, object_qz, object_qw: of the robot's base in the object's own frame. They and `object_z`
            are deferred: select them by name, as in `select(PickUpWithContextView.object_z)`.
        height_over_torso: height of the object above the robot's torso, m: its z minus that of the robot's base minus
            `torso_height`. The reach of an arm depends on it. Deferred.
    """

    __tablename__ = "PickUpWithContextView"

    id: Mapped[int] = mapped_column(primary_key=True)
    arm: Mapped[Arms]
    grasp: Mapped[Grasp]
    torso_height: Mapped[float | None]
    relative_x: Mapped[float]
    relative_y: Mapped[float]
    quaternion_x: Mapped[float]
    quaternion_y: Mapped[float]
    quaternion_z: Mapped[float]
    quaternion_w: Mapped[float]
    obj_type: Mapped[ObjectType | None]
    status: Mapped[TaskStatus]
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    node_id: Mapped[int] = mapped_column(ForeignKey("task_tree_node.id"))
    object_x: Mapped[float]
    object_y: Mapped[float]
    object_z: Mapped[float] = mapped_column(deferred=True)
    object_qx: Mapped[float] = mapped_column(deferred=True)
    object_qy: Mapped[float] = mapped_column(deferred=True)
    object_qz: Mapped[float] = mapped_column(deferred=True)
    object_qw: Mapped[float] = mapped_column(deferred=True)
    height_over_torso: Mapped[float | None] = mapped_column(deferred=True)
