"""Map the task tree: a node for every perform, and the candidates of its location designators."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column, relationship, synonym

from pycrorm_async.orm.base import Base, RowOfEvent, many_of, on_request, one_of, require_loaded
from pycrorm_async.orm.designators import Designator
from pycrorm_async.orm.episodes import Pose, ProcessMetaData
from pycrorm_async.orm.types import JsonText
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp

__all__ = ["TaskTreeNode", "LocationResolution", "LocationCandidate", "LocationRefusal"]


class TaskTreeNode(RowOfEvent, Base):
    """One perform, from its start to its end.

    Attributes:
        action: the performed `Action`, `Motion` or other `Designator`; None at the root of an episode.
        parent: the node that performed it; None at the root of an episode.
        children: the nodes that it performed, in order. Not loaded by default, because it would nearly double the time
            of a query: use `selectinload(TaskTreeNode.children)` or `await node.awaitable_attrs.children`.
        ancestors: the parent, its parent and so on to the root: `await node.awaitable_attrs.ancestors`.
        end_time: None while it runs, and if it is LOST.
        start_ns, end_ns: monotonic time, for exact durations.
        sequence, end_sequence: the events of its start and its end, 1, 2, 3 … inside the episode. `end_sequence` is
            None while it runs, and if it is LOST.
        duration: in s; None while it runs, and if it is LOST.
        reason: the class of the failure it ended with; `failure_message` and `failure_arguments` belong to it.
        result: the return value of perform, as JSON.
        robot: the name of the robot that acted; None without one.
        simulated: whether it belongs to a simulation, performed in a copy of the world.
    """

    __tablename__ = "task_tree_node"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    parent_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))
    action_id: Mapped[int | None] = mapped_column(ForeignKey("designator.id"))
    kind: Mapped[str]
    dtype: Mapped[str | None]
    status: Mapped[TaskStatus]
    start_time: Mapped[datetime]
    end_time: Mapped[datetime | None]
    start_ns: Mapped[int]
    end_ns: Mapped[int | None]
    end_sequence: Mapped[int | None]
    reason: Mapped[str | None]
    failure_message: Mapped[str | None]
    failure_arguments: Mapped[list[Any] | None] = mapped_column(JsonText())
    result: Mapped[Any | None] = mapped_column(JsonText())
    robot_pose_id: Mapped[int | None] = mapped_column(ForeignKey("pose.id"))
    torso_height: Mapped[float | None]
    robot_object_id: Mapped[int | None] = mapped_column(ForeignKey("object.id"))
    robot: Mapped[str | None]
    simulated: Mapped[bool]
    duration: Mapped[float | None]

    action: Mapped[Designator | None] = one_of(lambda: TaskTreeNode.action_id, "designator")
    parent: Mapped[TaskTreeNode | None] = one_of(lambda: TaskTreeNode.parent_id, "task_tree_node")
    _children: Mapped[list[TaskTreeNode]] = many_of(
        lambda: TaskTreeNode.parent_id, "task_tree_node", order_by=lambda: TaskTreeNode.id
    )
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)

    children: Mapped[list[TaskTreeNode]] = synonym("_children", descriptor=on_request("children"))

    @property
    def ancestors(self) -> list[TaskTreeNode]:
        """Its parent, the parent of that, and so on to the root. Raises `CallerError` if one is not loaded."""
        nodes: list[TaskTreeNode] = []
        node: TaskTreeNode | None = self
        while node is not None:
            require_loaded(node, "parent", self, "ancestors")
            node = node.parent
            nodes += [] if node is None else [node]
        return nodes

    @property
    def duration_s(self) -> float | None:
        """The same as `duration`."""
        return self.duration


class LocationCandidate(RowOfEvent, Base):
    """A place that a location designator offered; `position` is its rank, 0 first."""

    __tablename__ = "location_candidate"
    _row = "resolution_id"

    resolution_id: Mapped[int] = mapped_column(ForeignKey("location_resolution.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]
    qx: Mapped[float]
    qy: Mapped[float]
    qz: Mapped[float]
    qw: Mapped[float]
    frame: Mapped[str]
    arms: Mapped[str]
    """Names of the arms that reach the target from this place, separated by commas."""
    taken: Mapped[bool]
    grasp: Mapped[Grasp | None]
    """The grasp that succeeded at a place from experience; `torso_height` (m) is that of the same success."""
    torso_height: Mapped[float | None]

    @property
    def reachable_arms(self) -> list[Arms]:
        """The arms that reach the target from this place."""
        return [Arms.named(name) for name in self.arms.split(",") if name]


class LocationRefusal(RowOfEvent, Base):
    """A place that a location designator tried and did not offer, and the reason; `position` is its rank, 0 first."""

    __tablename__ = "location_refusal"
    _row = "resolution_id"

    resolution_id: Mapped[int] = mapped_column(ForeignKey("location_resolution.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]
    qx: Mapped[float]
    qy: Mapped[float]
    qz: Mapped[float]
    qw: Mapped[float]
    frame: Mapped[str]
    reason: Mapped[str]


class LocationResolution(RowOfEvent, Base):
    """A location designator's answer to one request for a place.

    Attributes:
        location: the designator's class.
        considered, offered, refused: the number of places it checked, of those it offered, and of all others.
        candidates: the first 999 places that it offered, and the last one.
        taken: the rank among `candidates` of the place that the plan used, whose pose is `pose`; None if it used none.
        node: the node that made the request.
        refusals: the first 1,000 places that it refused. Not loaded by default: use
            `await resolution.awaitable_attrs.refusals`.
        occupied_cells, hidden_cells, free_cells: the places in its costmaps that are too near an obstacle, those from
            which the target is not visible, and those it chose from. None without costmaps and in older episodes.
    """

    __tablename__ = "location_resolution"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))
    location: Mapped[str]
    considered: Mapped[int]
    offered: Mapped[int]
    taken: Mapped[int | None]
    pose_id: Mapped[int | None] = mapped_column(ForeignKey("pose.id"))
    time: Mapped[datetime]
    refused: Mapped[int]
    occupied_cells: Mapped[int | None]
    hidden_cells: Mapped[int | None]
    free_cells: Mapped[int | None]

    node: Mapped[TaskTreeNode | None] = one_of(lambda: LocationResolution.node_id, "task_tree_node")
    pose: Mapped[Pose | None] = one_of(lambda: LocationResolution.pose_id, "pose")
    candidates: Mapped[list[LocationCandidate]] = many_of(
        lambda: LocationCandidate.resolution_id, "location_resolution", order_by=LocationCandidate.position
    )
    _refusals: Mapped[list[LocationRefusal]] = many_of(
        lambda: LocationRefusal.resolution_id,
        "location_resolution",
        order_by=LocationRefusal.position,
    )
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)

    refusals: Mapped[list[LocationRefusal]] = synonym("_refusals", descriptor=on_request("refusals"))
