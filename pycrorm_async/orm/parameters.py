"""Declare the pose and object parameters of actions and motions, one mixin for each name of a field.

The first pose of a designator is `pose` and its first object `object`, as in the thesis' queries. The name of the
designator's field is a synonym, and names the column: `NavigateAction.target_location` is `NavigateAction.pose`.
`sort_order` puts a column before those of the class itself, as in the designator.
"""

from __future__ import annotations

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, MappedAsDataclass, declared_attr, mapped_column, relationship, synonym

from pycrorm_async.orm.base import Pose
from pycrorm_async.orm.objects import Object

__all__ = [
    "PoseParameter",
    "TargetLocationParameter",
    "TargetParameter",
    "ObjectParameter",
    "ObjectDesignatorParameter",
    "ObjectPartParameter",
]


class PoseParameter(MappedAsDataclass, init=False, repr=False, eq=False):
    """A pose; the class or a mixin declares `pose_id`."""

    @declared_attr
    def pose(cls) -> Mapped[Pose]:
        return relationship(viewonly=True, lazy="selectin")


class TargetLocationParameter(PoseParameter):
    """A pose that the designator calls `target_location`."""

    pose_id: Mapped[int] = mapped_column("target_location_id", ForeignKey("pose.id"))

    @declared_attr
    def target_location_id(cls) -> Mapped[int]:
        return synonym("pose_id")

    @declared_attr
    def target_location(cls) -> Mapped[Pose]:
        return synonym("pose")


class TargetParameter(PoseParameter):
    """A pose that the designator calls `target`."""

    pose_id: Mapped[int] = mapped_column("target_id", ForeignKey("pose.id"), sort_order=-1)

    @declared_attr
    def target_id(cls) -> Mapped[int]:
        return synonym("pose_id")

    @declared_attr
    def target(cls) -> Mapped[Pose]:
        return synonym("pose")


class ObjectParameter(MappedAsDataclass, init=False, repr=False, eq=False):
    """An object, as its row from before the node started; the class or a mixin declares `object_id`."""

    @declared_attr
    def object(cls) -> Mapped[Object]:
        return relationship(viewonly=True, lazy="selectin")


class ObjectDesignatorParameter(ObjectParameter):
    """An object that the designator calls `object_designator`."""

    object_id: Mapped[int] = mapped_column("object_designator_id", ForeignKey("object.id"), sort_order=-1)

    @declared_attr
    def object_designator_id(cls) -> Mapped[int]:
        return synonym("object_id")

    @declared_attr
    def object_designator(cls) -> Mapped[Object]:
        return synonym("object")


class ObjectPartParameter(ObjectParameter):
    """An object's part that the designator calls `object_part`."""

    object_id: Mapped[int] = mapped_column("object_part_id", ForeignKey("object.id"), sort_order=-1)

    @declared_attr
    def object_part_id(cls) -> Mapped[int]:
        return synonym("object_id")

    @declared_attr
    def object_part(cls) -> Mapped[Object]:
        return synonym("object")
