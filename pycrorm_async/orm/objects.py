"""Map objects at each moment of their history, their descriptions, removals, attachments, joint changes, and concepts.

A row of `object` is an object at one moment: one row when it was added and one each time it moved. An action refers to
the row that was current when it started, so `PickUpAction.object.pose` is the pose at execution. All rows of one object
share `identity_id`.
"""

from __future__ import annotations

from datetime import datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any

from sqlalchemy import ColumnElement, ForeignKey, FromClause, and_, or_, select
from sqlalchemy.orm import Mapped, mapped_column, relationship, synonym

from pycrorm_async.events.codec import description_of
from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.events.values import BoxValue, MeshValue
from pycrorm_async.orm.base import Base, RowOfEvent, on_request, one_of
from pycrorm_async.orm.episodes import Pose, ProcessMetaData
from pycrorm_async.orm.types import JsonText
from pycrorm_async.world.enums import ObjectType

if TYPE_CHECKING:
    from pycrorm_async.orm.tree import TaskTreeNode

__all__ = [
    "Concept",
    "ConceptAncestor",
    "is_concept",
    "ObjectConcept",
    "ObjectDescription",
    "Object",
    "ObjectPart",
    "BelieveObject",
    "LocatedObject",
    "ObjectRemoval",
    "Attachment",
    "JointChange",
]


class Concept(Base):
    """A class of the ontology (SOMA, DUL) and one of its superclasses: several rows if it has several.

    Attributes:
        parent: its superclass; None for the topmost concepts, such as `Task` and `PhysicalObject`.
        source: the ontology that defines it, with its version.
    """

    __tablename__ = "concept"

    name: Mapped[str] = mapped_column(primary_key=True)
    parent: Mapped[str | None] = mapped_column(primary_key=True)
    source: Mapped[str]


class ConceptAncestor(Base):
    """A pair of a concept and one of its superclasses, however far up, or itself."""

    __tablename__ = "concept_ancestor"

    concept: Mapped[str] = mapped_column(primary_key=True)
    ancestor: Mapped[str] = mapped_column(primary_key=True)


def is_concept(column: ColumnElement[Any], concept: str) -> ColumnElement[bool]:
    """Return the condition that a column names this concept or one of its subclasses."""
    below = select(ConceptAncestor.concept).where(ConceptAncestor.ancestor == concept)
    return or_(column == concept, column.in_(below))


class ObjectConcept(Base):
    """The SOMA concept of an object type, such as `MilkPack` of `MILK`."""

    __tablename__ = "object_concept"

    obj_type: Mapped[ObjectType] = mapped_column(primary_key=True)
    concept: Mapped[str]


class ObjectDescription(Base):
    """A description that objects were made from.

    Attributes:
        payload: the `DescriptionDeclared`, as JSON text.
    """

    __tablename__ = "object_description"

    fingerprint: Mapped[str] = mapped_column(primary_key=True)
    payload: Mapped[str]

    @cached_property
    def declared(self) -> DescriptionDeclared:
        """The event. Raises `ValueError` for one that this version cannot read."""
        return description_of(self.payload.encode())

    @property
    def urdf(self) -> str:
        """The URDF, empty if `missing` is not. The name of a mesh file is `sha256:` and the hash of its content."""
        return self.declared.text

    @property
    def text_sha256(self) -> str:
        """SHA-256 of the URDF as text, thus also of its meshes' contents.

        It is the same for one model in all memories, whereas `fingerprint` identifies what was recorded of it, with
        the mesh files or without.
        """
        return self.declared.text_sha256

    @property
    def meshes(self) -> tuple[MeshValue, ...]:
        """The mesh files: name, hash, size."""
        return self.declared.meshes

    @property
    def boxes(self) -> dict[str, BoxValue]:
        """The box around each link's collision shapes, else its visual ones, in its frame (m); of links with a mesh."""
        return self.declared.boxes

    @property
    def missing(self) -> str | None:
        """The reason if the description could not be recorded."""
        return self.declared.missing


class Object(RowOfEvent, Base):
    """An object of the world at a moment.

    Attributes:
        identity_id: its first row, from when it was added; None for an object outside the world.
        joints: positions (rad or m) when it was added; None in later rows.
        color: red, green, blue, opacity, 0 to 1, when it was added; None in later rows, and if only its description
            has it.
        description_fingerprint: fingerprint of its description when it was added; None in later rows.
        model, serial: of a robot with a `RobotDescription`, when it was added; None in later rows.
        mass_kg: when it was added; None in later rows, and if it is not known.
        base_link: of a robot, when it was added: the link that has the pose; None in later rows, and for the root link.
        description: its description, in every row; None in episodes of older versions. Not loaded by default: use
            `selectinload(Object.description)` or `await row.awaitable_attrs.description`.
        node_id: the node that moved or added it; None if no node did.
        node: that node. Not loaded by default, because that would take four times as long as the objects: use
            `selectinload(Object.node)` or `await row.awaitable_attrs.node`.
    """

    __tablename__ = "object"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    dtype: Mapped[str]
    name: Mapped[str]
    obj_type: Mapped[ObjectType | None]
    pose_id: Mapped[int | None] = mapped_column(ForeignKey("pose.id"))
    identity_id: Mapped[int | None] = mapped_column(ForeignKey("object.id"))
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))
    joints: Mapped[dict[str, Any] | None] = mapped_column(JsonText())
    description_fingerprint: Mapped[str | None] = mapped_column(ForeignKey("object_description.fingerprint"))
    color: Mapped[list[float] | None] = mapped_column(JsonText())
    model: Mapped[str | None]
    serial: Mapped[str | None]
    mass_kg: Mapped[float | None]
    base_link: Mapped[str | None]

    pose: Mapped[Pose | None] = one_of(lambda: Object.pose_id, "pose")
    _description: Mapped[ObjectDescription | None] = relationship(
        secondary=lambda: _ADDED,
        primaryjoin=lambda: and_(
            Object.identity_id == _ADDED.c.id, Object.process_metadata_id == _ADDED.c.process_metadata_id
        ),
        secondaryjoin=lambda: _ADDED.c.description_fingerprint == ObjectDescription.fingerprint,
        viewonly=True,
        uselist=False,
    )
    _node: Mapped[TaskTreeNode | None] = one_of(lambda: Object.node_id, "task_tree_node")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)

    __mapper_args__ = {"polymorphic_on": "dtype", "polymorphic_identity": "Object"}  # noqa: RUF012  SQLAlchemy's form

    @classmethod
    def is_a(cls, concept: str) -> ColumnElement[bool]:
        """Return the condition that the SOMA concept of its type is this one or a subclass of it.

        >>> tableware = select(Object).where(Object.is_a("Tableware"))
        """
        types = select(ObjectConcept.obj_type).where(is_concept(ObjectConcept.__table__.c.concept, concept))
        return cls.obj_type.in_(types)

    node: Mapped[TaskTreeNode | None] = synonym("_node", descriptor=on_request("node"))
    description: Mapped[ObjectDescription | None] = synonym("_description", descriptor=on_request("description"))


_ADDED: FromClause = Object.__table__.alias("added")
"""The rows of objects from when they were added, which name the descriptions."""


class ObjectPart(Object):
    """A link of an object as an action's parameter; `part_of` is the object it belongs to."""

    part_of_id: Mapped[int | None] = mapped_column(ForeignKey("object.id"))

    part_of: Mapped[Object | None] = one_of(lambda: ObjectPart.part_of_id, "object")

    __mapper_args__ = {"polymorphic_identity": "ObjectPart", "polymorphic_load": "inline"}  # noqa: RUF012


class LocatedObject(Object):
    """An object located relative to another one, `reference`; `pose` is its pose in the map."""

    reference_id: Mapped[int | None] = mapped_column("part_of_id", ForeignKey("object.id"), use_existing_column=True)

    reference: Mapped[Object | None] = one_of(lambda: LocatedObject.reference_id, "object")

    __mapper_args__ = {"polymorphic_identity": "LocatedObject", "polymorphic_load": "inline"}  # noqa: RUF012


class BelieveObject(Object):
    """An object that was assumed to be at a place without having been perceived."""

    __mapper_args__ = {"polymorphic_identity": "BelieveObject", "polymorphic_load": "inline"}  # noqa: RUF012


class ObjectRemoval(RowOfEvent, Base):
    """The removal of an object from the world."""

    __tablename__ = "object_removal"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    object_id: Mapped[int] = mapped_column(ForeignKey("object.id"))
    identity_id: Mapped[int] = mapped_column(ForeignKey("object.id"))
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))

    object: Mapped[Object] = one_of(lambda: ObjectRemoval.object_id, "object")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)


class Attachment(RowOfEvent, Base):
    """A change at `time`: `child` begins to move with `link` of `parent` (`kind` attached), or stops (detached)."""

    __tablename__ = "attachment"

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    kind: Mapped[str]
    parent_id: Mapped[int] = mapped_column(ForeignKey("object.id"))
    child_id: Mapped[int] = mapped_column(ForeignKey("object.id"))
    link: Mapped[str | None]
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))

    parent: Mapped[Object] = one_of(lambda: Attachment.parent_id, "object")
    child: Mapped[Object] = one_of(lambda: Attachment.child_id, "object")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)


class JointChange(RowOfEvent, Base):
    """A new position (rad or m) of an object's joint. Rows of one motion share their `id`."""

    __tablename__ = "joint_change"

    id: Mapped[int] = mapped_column(primary_key=True)
    joint: Mapped[str] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    object_id: Mapped[int] = mapped_column(ForeignKey("object.id"))
    position: Mapped[float]
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(ForeignKey("task_tree_node.id"))

    object: Mapped[Object] = one_of(lambda: JointChange.object_id, "object")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)
