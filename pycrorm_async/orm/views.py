"""Views that join what learning asks for; users register more of them, as `projections.schema.user_views` says."""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from pycrorm_async.orm.base import Base
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp, ObjectType

__all__ = ["PickUpWithContextView"]


class PickUpWithContextView(Base):
    """Every pick-up with what was around it: the sample the thesis learns from (section 5.2).

    Where the robot stood is there twice: along the axes of the map, as in the thesis, and as seen from the object. The
    latter is what can be learned for an object that is turned otherwise.

    Attributes:
        torso_height: of the robot, m.
        relative_x, relative_y: robot minus object, m, along the axes of the map.
        quaternion_x, quaternion_y, quaternion_z, quaternion_w: of the robot's base.
        obj_type: of the object, as it was when the action started.
        status: of the action's node.
        process_metadata_id: the episode.
        node_id: the node; the same number as `id`.
        object_x, object_y, object_z: of the robot's base in the object's own frame, m.
        object_qx, object_qy, object_qz, object_qw: of the robot's base, turned into the object's own frame. They and
            `object_z` are read only when asked for by name: `select(PickUpWithContextView.object_z)`.
        height_over_torso: how much higher than the robot's torso is lifted the object is, m: its z minus that of the
            robot's base minus `torso_height`. What an arm reaches depends on it. Read when asked for by name.
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
