"""Map the built-in views of pick-ups, failures and spatial relations."""

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, relationship

from pycrorm_async.orm.base import ON_REQUEST, Base, RowOfEvent, one_of
from pycrorm_async.orm.episodes import ProcessMetaData
from pycrorm_async.orm.rows import TaskTreeNode
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType


class PickUpWithContextView(RowOfEvent, Base):
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
        robot_in_object_x, robot_in_object_y, robot_in_object_z: of the robot's base in the object's own frame, m.
        robot_in_object_qx, robot_in_object_qy, robot_in_object_qz, robot_in_object_qw: of the robot's base in the
            object's own frame. They and `robot_in_object_z` are loaded on request:
            `select(PickUpWithContextView.robot_in_object_z)`, `undefer` or `awaitable_attrs`.
        object_x, object_y, object_z: the names of `robot_in_object_x` and the others until the next release, m.
        object_qx, object_qy, object_qz, object_qw: the names of `robot_in_object_qx` and the others until then.
        height_over_torso: height of the object above the robot's torso, m: its z minus that of the robot's base minus
            `torso_height`. The reach of an arm depends on it. Loaded on request.
        robot: the name of the robot; None if a memory of version 0.1.0 recorded it. Loaded on request.
        description: of the episode. Loaded on request.
        scene: the world of the episode, in one line. Loaded on request.
        policy: the name of the policy that chose the pick-up: that of the `MoveAndPickUpAction` around it, or of the
            `BatchRolloutAction` around that. None if none is named. Loaded on request.
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
    robot_in_object_x: Mapped[float]
    robot_in_object_y: Mapped[float]
    robot_in_object_z: Mapped[float] = mapped_column(deferred=True)
    robot_in_object_qx: Mapped[float] = mapped_column(deferred=True)
    robot_in_object_qy: Mapped[float] = mapped_column(deferred=True)
    robot_in_object_qz: Mapped[float] = mapped_column(deferred=True)
    robot_in_object_qw: Mapped[float] = mapped_column(deferred=True)
    height_over_torso: Mapped[float | None] = mapped_column(deferred=True)
    robot: Mapped[str | None] = mapped_column(deferred=True)
    description: Mapped[str] = mapped_column(deferred=True)
    scene: Mapped[str | None] = mapped_column(deferred=True)
    policy: Mapped[str | None] = mapped_column(deferred=True)


class RootFailure(RowOfEvent, Base):
    """A node that ended as FAILED or ERROR and has no child that did: the place where a failure began.

    Attributes:
        id: of the node.
        dtype: of the failed designator; None if the plan itself failed.
        path: the names of the nodes from the root to this one, as in `root > TransportAction > PickUpAction`.
        object: the name of the object that the designator, or else the nearest one around it, has as a parameter.
        arm: the arm that the designator, or else the nearest one around it, has as a parameter.
        reason: the class of the failure, or its text without numbers and names.
        message: its message.
        start_time: when the node started.
        end_time: when it ended.
        recovered: whether `outcome` is `recovered`.
        outcome: `recovered` if the same was tried again and succeeded, or an alternative of the plan language did;
            `tolerated` by an expression of the plan language; `ignored` if the action or plan around it succeeded all
            the same; `failed` if nothing around it succeeded; `open` while the plan runs.
        episode: the same as `process_metadata`.
    """

    __tablename__ = "root_failure"

    id: Mapped[int] = mapped_column(ForeignKey("task_tree_node.id"), primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    dtype: Mapped[str | None]
    status: Mapped[TaskStatus]
    path: Mapped[str]
    object: Mapped[str | None]
    arm: Mapped[Arms | None]
    reason: Mapped[str | None]
    message: Mapped[str | None]
    recovered: Mapped[bool]
    start_time: Mapped[datetime]
    end_time: Mapped[datetime | None]
    duration_s: Mapped[float | None]
    outcome: Mapped[str]

    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)

    @property
    def episode(self) -> ProcessMetaData:
        """The episode in which it failed."""
        return self.process_metadata


class SpatialRelation(RowOfEvent, Base):
    """A spatial relation of an object when it was picked up, or after it was placed.

    `projections.derived_views` defines the relations.

    Attributes:
        node_id: of the pick-up or the placing; `sequence` is the event of its start.
        object: the name of the picked up or placed object.
        object_id: its row at that moment.
        relation: `on`, `in` or `next to`.
        other: the name of the other object.
        other_id: the row of the other object at that moment.
        link: of the other object, such as `sink_area_surface`; an object of one link has its name.
        node: the pick-up or the placing. Loaded on request.
    """

    __tablename__ = "spatial_relation"
    _row = "node_id"

    node_id: Mapped[int] = mapped_column(ForeignKey("task_tree_node.id"), primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    object_id: Mapped[int] = mapped_column(ForeignKey("object.id"))
    object: Mapped[str]
    relation: Mapped[str]
    other_id: Mapped[int] = mapped_column(ForeignKey("object.id"), primary_key=True)
    other: Mapped[str]
    link: Mapped[str] = mapped_column(primary_key=True)

    node: Mapped[TaskTreeNode] = one_of(lambda: SpatialRelation.node_id, "task_tree_node", info=ON_REQUEST)
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)
