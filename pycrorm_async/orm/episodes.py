"""Map episodes, with their tags and robots, and the poses and robot states that the rows of an episode refer to."""

from __future__ import annotations

from datetime import datetime
from typing import Any, ClassVar

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, MappedAsDataclass, declared_attr, mapped_column, relationship, synonym

from pycrorm_async.orm.base import COMPUTED, ON_REQUEST, Base, JsonText, RowOfEvent, one_of
from pycrorm_async.world.pose import ObjectType


class ProcessMetaData(Base):
    """An episode with its user, plan, software and outcome. `id` is the episode's number in this database.

    `status` is RUNNING, SUCCEEDED, FAILED, ERROR, INTERRUPTED, LOST or UNKNOWN.
    """

    __tablename__ = "process_metadata"
    _unmapped: ClassVar[dict[str, dict[str, str]]] = {"entered_world": {"storage": "text", "after": "clock_error_us"}}

    id: Mapped[int] = mapped_column(primary_key=True)
    uuid: Mapped[str] = mapped_column(index=True)
    created_at: Mapped[datetime]
    """Its start."""
    created_by: Mapped[str]
    description: Mapped[str]
    version: Mapped[str]
    """The version of the software that recorded it; `pycram_version`, the thesis' name, is the same."""
    host: Mapped[str]
    python: Mapped[str]
    plan: Mapped[str | None]
    world: Mapped[str | None]
    """The world in one line: at the start, or, if it was entered inside the episode, when it was left.

    Of an episode that runs or is LOST: name and type of the objects in the world that was entered inside it.
    """
    seed: Mapped[int | None]
    status: Mapped[str]
    start_ns: Mapped[int]
    end_ns: Mapped[int | None]
    end_sequence: Mapped[int | None] = mapped_column(info={"storage": "number"})
    """The sequence of its last event; None while it runs."""
    failure_type: Mapped[str | None]
    failure_message: Mapped[str | None]
    simulated: Mapped[bool]
    """True for a simulation, performed in a copy of the world."""
    thought_by: Mapped[str | None] = mapped_column(index=True)
    """UUID of the episode that performed this simulation."""
    thought_by_node: Mapped[int | None]
    """The sequence, in that episode, of the node that performed this simulation."""
    continues: Mapped[str | None]
    """UUID of the episode that this one continues, because that one came near its last possible sequence."""
    continued_in: Mapped[str | None]
    """UUID of the episode that continues this one."""
    plan_sha256: Mapped[str | None]
    """SHA-256 of the plan's file; `git_commit` and `git_dirty` are those of its repository (`pycrorm run`)."""
    git_commit: Mapped[str | None]
    git_dirty: Mapped[bool | None]
    libraries: Mapped[dict[str, str] | None] = mapped_column(JsonText())
    """Version by package."""
    settings: Mapped[dict[str, Any] | None] = mapped_column(JsonText())
    """The settings that differ from their defaults."""
    clock_synchronized: Mapped[bool | None]
    """True if a time service kept the wall clock; `clock_error_us` is its estimated error, µs."""
    clock_error_us: Mapped[int | None]
    ended_at: Mapped[datetime | None] = mapped_column(info=COMPUTED)
    """`created_at` and the duration; None while it runs."""
    duration_s: Mapped[float | None] = mapped_column(info=COMPUTED)
    """From its first to its last event by the robot's monotonic clock, s; None while it runs."""
    episode_metadata: Mapped[dict[str, Any] | None] = mapped_column("metadata", JsonText())
    """The metadata of the executive; the column is `metadata`, a name that SQLAlchemy reserves as an attribute."""
    tag_rows: Mapped[list[Any]] = relationship("EpisodeTag", viewonly=True, order_by="EpisodeTag.tag")
    tags = property(lambda self: [each.tag for each in self.tag_rows], doc="The tags, in alphabetical order.")
    robots: Mapped[list[EpisodeRobot]] = relationship(viewonly=True, order_by="EpisodeRobot.id", info=ON_REQUEST)
    """The robots that took part, in the order in which they were added. Loaded on request."""

    pycram_version: Mapped[str] = synonym("version")


class EpisodeTag(RowOfEvent, Base):
    """A tag that an episode has now, and the time when it was added. The view `episode_tagging` has all changes."""

    __tablename__ = "episode_tag"

    id: Mapped[int]
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"), primary_key=True)
    tag: Mapped[str] = mapped_column(primary_key=True)
    time: Mapped[datetime]


class EpisodeRobot(RowOfEvent, Base):
    """A robot that took part in an episode, as it was when it was first added to the world.

    A robot that was removed and added again, also to another world, has one row. If its description has changed, it has
    a row for each; robots of one name that differ in model or serial have a row each, too.

    Attributes:
        id: of its first row in `object`.
        model: of its `RobotDescription`; None if there is none, and in episodes of version 0.1.0.
        serial: the serial number in it, if it has one.
        description_fingerprint: of its `ObjectDescription`; None in episodes of version 0.1.0.
    """

    __tablename__ = "episode_robot"

    id: Mapped[int] = mapped_column(ForeignKey("object.id"), primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    name: Mapped[str]
    model: Mapped[str | None]
    serial: Mapped[str | None]
    description_fingerprint: Mapped[str | None] = mapped_column(ForeignKey("object_description.fingerprint"))


class Position(Base):
    """The position of a pose in m, with the pose's id."""

    __tablename__ = "position"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]


class Quaternion(Base):
    """The orientation of a pose as a unit quaternion, with the pose's id."""

    __tablename__ = "quaternion"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]
    w: Mapped[float]


class RowOfEpisode(RowOfEvent, MappedAsDataclass, init=False, repr=False, eq=False):
    """A row of an episode, with an id of its own: the first two columns of its table."""

    id: Mapped[int] = mapped_column(primary_key=True, sort_order=-2)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"), index=True, sort_order=-1)

    @declared_attr
    def process_metadata(cls) -> Mapped[ProcessMetaData]:
        related: Mapped[ProcessMetaData] = relationship(viewonly=True)
        return related


class Pose(RowOfEpisode, Base):
    """A position (m) and an orientation (unit quaternion), also as columns, so that queries need no join for them."""

    __tablename__ = "pose"

    time: Mapped[datetime] = mapped_column(info={"after": "qw"})
    frame: Mapped[str] = mapped_column(info={"after": "qw"})
    position_id: Mapped[int] = mapped_column(ForeignKey("position.id"), info=COMPUTED)
    orientation_id: Mapped[int] = mapped_column(ForeignKey("quaternion.id"), info=COMPUTED)
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]
    qx: Mapped[float]
    qy: Mapped[float]
    qz: Mapped[float]
    qw: Mapped[float]

    position: Mapped[Position] = one_of(lambda: Pose.position_id, "position")
    orientation: Mapped[Quaternion] = one_of(lambda: Pose.orientation_id, "quaternion")


class RobotState(RowOfEvent, Base):
    """The robot's base pose and torso position (m) when a node started. Nodes without a robot have no row."""

    __tablename__ = "robot_state"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    torso_height: Mapped[float | None]
    type: Mapped[ObjectType]
    pose_id: Mapped[int] = mapped_column(ForeignKey("pose.id"))

    pose: Mapped[Pose] = one_of(lambda: RobotState.pose_id, "pose")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)
