"""Map the task tree, its designators, the objects and the percepts.

**Designators.** Map performed designators: actions, motions and expressions of the plan language.

`select(Action)` returns every action as an instance of the nearest class in this process: a built-in one, one declared
with `class ORMSaying(Action)`, or one that the memory generates for a type without a class. If none exists the object
is an `Action`, whose fields are in `parameters` (`await action.awaitable_attrs.parameters`).

Derive from `Action` or `Motion` to map a designator of your own; its table has the name of the class, and its `id` is
that of its base:

>>> class ORMSaying(Action):
...     text: Mapped[str]

A mixin declares a pose or an object parameter for each name that designators give it. The first pose of a designator is
`pose` and its first object `object`, as in the thesis' queries. The name of the designator's field is a synonym, and
names the column: `NavigateAction.target_location` is `NavigateAction.pose`. `sort_order` puts a column before those of
the class itself, as in the designator.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from functools import cached_property
from typing import Any, ClassVar

import sqlalchemy as sa
from sqlalchemy.ext.hybrid import hybrid_property
from sqlalchemy.orm import Mapped, MappedAsDataclass, declared_attr, mapped_column, relationship, synonym
from sqlalchemy.types import TypeDecorator

from pycrorm_async.events.codec import description_of
from pycrorm_async.events.fields import table_name
from pycrorm_async.events.types import BoxValue, DescriptionDeclared, MeshValue
from pycrorm_async.orm import base as orm_base
from pycrorm_async.orm.episodes import Pose, ProcessMetaData, RobotState, RowOfEpisode
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType

# === objects ==================================================================================================
#
# Map objects at each moment of their history, their descriptions, removals, attachments, joint changes, and concepts.
#
# A row of `object` is an object at one moment: one row when it was added and one each time it moved. An action refers
# to the row that was current when it started, so `PickUpAction.object.pose` is the pose at execution. All rows of one
# object share `identity_id`.


class Concept(orm_base.Base):
    """A class of the ontology (SOMA, DUL) and one of its superclasses: several rows if it has several.

    Attributes:
        parent: its superclass; None for the topmost concepts, such as `Task` and `PhysicalObject`.
        source: the ontology that defines it, with its version.
    """

    __tablename__ = "concept"

    name: Mapped[str] = mapped_column(primary_key=True)
    parent: Mapped[str | None] = mapped_column(primary_key=True)
    source: Mapped[str]


class ConceptAncestor(orm_base.Base):
    """A pair of a concept and one of its superclasses, however far up, or itself."""

    __tablename__ = "concept_ancestor"

    concept: Mapped[str] = mapped_column(primary_key=True)
    ancestor: Mapped[str] = mapped_column(primary_key=True)


def is_concept(column: sa.ColumnElement[Any], concept: str) -> sa.ColumnElement[bool]:
    """Return the condition that a column names this concept or one of its subclasses."""
    below = sa.select(ConceptAncestor.concept).where(ConceptAncestor.ancestor == concept)
    return sa.or_(column == concept, column.in_(below))


class ObjectConcept(orm_base.Base):
    """The SOMA concept of an object type, such as `MilkPack` of `MILK`."""

    __tablename__ = "object_concept"

    obj_type: Mapped[ObjectType] = mapped_column(primary_key=True)
    concept: Mapped[str]


class ObjectDescription(orm_base.Base):
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


class Object(RowOfEpisode, orm_base.Base):
    """An object of the world at a moment.

    Attributes:
        identity_id: its first row, from when it was added; None for an object outside the world.
        joints: positions (rad or m) when it was added; None in later rows.
        color: red, green, blue, opacity, 0 to 1, when it was added; None in later rows, and if only its description
            has it.
        description_fingerprint: fingerprint of its description when it was added; None in later rows.
        model: of a robot with a `RobotDescription`, when it was added; None in later rows.
        serial: the serial number of such a robot; None in later rows.
        mass_kg: when it was added; None in later rows, and if it is not known.
        base_link: of a robot, when it was added: the link that has the pose; None in later rows, and for the root link.
        description: its description, in every row; None in episodes of older versions. Not loaded by default: use
            `selectinload(Object.description)` or `await row.awaitable_attrs.description`.
        node_id: the node that moved or added it; None if no node did.
        node: that node. Not loaded by default, because that would take four times as long as the objects: use
            `selectinload(Object.node)` or `await row.awaitable_attrs.node`.
    """

    __tablename__ = "object"

    dtype: Mapped[str]
    name: Mapped[str]
    obj_type: Mapped[ObjectType | None] = mapped_column(index=True)
    pose_id: Mapped[int | None] = mapped_column(sa.ForeignKey("pose.id"))
    identity_id: Mapped[int | None] = mapped_column(sa.ForeignKey("object.id"), index=True)
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"))
    joints: Mapped[dict[str, Any] | None] = mapped_column(orm_base.JsonText())
    description_fingerprint: Mapped[str | None] = mapped_column(sa.ForeignKey("object_description.fingerprint"))
    color: Mapped[list[float] | None] = mapped_column(orm_base.JsonText())
    model: Mapped[str | None]
    serial: Mapped[str | None]
    mass_kg: Mapped[float | None]
    base_link: Mapped[str | None]

    pose: Mapped[Pose | None] = orm_base.one_of(lambda: Object.pose_id, "pose")
    description: Mapped[ObjectDescription | None] = relationship(
        secondary=lambda: _ADDED,
        primaryjoin=lambda: sa.and_(
            Object.identity_id == _ADDED.c.id, Object.process_metadata_id == _ADDED.c.process_metadata_id
        ),
        secondaryjoin=lambda: _ADDED.c.description_fingerprint == ObjectDescription.fingerprint,
        viewonly=True,
        uselist=False,
        info=orm_base.ON_REQUEST,
    )
    node: Mapped[TaskTreeNode | None] = orm_base.one_of(
        lambda: Object.node_id, "task_tree_node", info=orm_base.ON_REQUEST
    )

    __mapper_args__ = {"polymorphic_on": "dtype", "polymorphic_identity": "Object"}  # noqa: RUF012  SQLAlchemy's form

    @classmethod
    def is_a(cls, concept: str) -> sa.ColumnElement[bool]:
        """Return the condition that the SOMA concept of its type is this one or a subclass of it.

        >>> tableware = select(Object).where(Object.is_a("Tableware"))
        """
        types = sa.select(ObjectConcept.obj_type).where(is_concept(ObjectConcept.__table__.c.concept, concept))
        return cls.obj_type.in_(types)


_ADDED: sa.FromClause = Object.__table__.alias("added")
"""The rows of objects from when they were added, which name the descriptions."""


class ObjectPart(Object):
    """A link of an object as an action's parameter; `part_of` is the object it belongs to."""

    part_of_id: Mapped[int | None] = mapped_column(sa.ForeignKey("object.id"), info={"after": "pose_id"})

    part_of: Mapped[Object | None] = orm_base.one_of(lambda: ObjectPart.part_of_id, "object")

    __mapper_args__ = {"polymorphic_identity": "ObjectPart", "polymorphic_load": "inline"}  # noqa: RUF012


class LocatedObject(Object):
    """An object located relative to another one, `reference`; `pose` is its pose in the map."""

    reference_id: Mapped[int | None] = mapped_column("part_of_id", sa.ForeignKey("object.id"), use_existing_column=True)

    reference: Mapped[Object | None] = orm_base.one_of(lambda: LocatedObject.reference_id, "object")

    __mapper_args__ = {"polymorphic_identity": "LocatedObject", "polymorphic_load": "inline"}  # noqa: RUF012


class BelieveObject(Object):
    """An object that was assumed to be at a place without having been perceived."""

    __mapper_args__ = {"polymorphic_identity": "BelieveObject", "polymorphic_load": "inline"}  # noqa: RUF012


class ObjectRemoval(RowOfEpisode, orm_base.Base):
    """The removal of an object from the world."""

    __tablename__ = "object_removal"

    object_id: Mapped[int] = mapped_column(sa.ForeignKey("object.id"))
    identity_id: Mapped[int] = mapped_column(sa.ForeignKey("object.id"), index=True)
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"))

    object: Mapped[Object] = orm_base.one_of(lambda: ObjectRemoval.object_id, "object")


class Attachment(RowOfEpisode, orm_base.Base):
    """A change at `time`: `child` begins to move with `link` of `parent` (`kind` attached), or stops (detached)."""

    __tablename__ = "attachment"

    kind: Mapped[str]
    parent_id: Mapped[int] = mapped_column(sa.ForeignKey("object.id"))
    child_id: Mapped[int] = mapped_column(sa.ForeignKey("object.id"), index=True)
    link: Mapped[str | None]
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"))

    parent: Mapped[Object] = orm_base.one_of(lambda: Attachment.parent_id, "object")
    child: Mapped[Object] = orm_base.one_of(lambda: Attachment.child_id, "object")


class JointChange(orm_base.RowOfEvent, orm_base.Base):
    """A new position (rad or m) of an object's joint. Rows of one motion share their `id`."""

    __tablename__ = "joint_change"

    id: Mapped[int] = mapped_column(primary_key=True)
    joint: Mapped[str] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"), index=True)
    object_id: Mapped[int] = mapped_column(sa.ForeignKey("object.id"), index=True)
    position: Mapped[float]
    time: Mapped[datetime]
    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"))

    object: Mapped[Object] = orm_base.one_of(lambda: JointChange.object_id, "object")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)


# === designators ==============================================================================================


class DesignatorType(orm_base.Base):
    """A declaration of a designator type; a `dtype` has several rows if its fields changed over time.

    Attributes:
        fingerprint: of the declaration.
        leaf: the table of its parameters.
        concept: its SOMA concept, if it declares one.
        fields: name, column and type of each field.
    """

    __tablename__ = "designator_type"

    fingerprint: Mapped[str] = mapped_column(primary_key=True)
    dtype: Mapped[str]
    kind: Mapped[str]
    leaf: Mapped[str]
    concept: Mapped[str | None]
    fields: Mapped[list[Any]] = mapped_column(orm_base.JsonText())


class ParameterItem(orm_base.RowOfEvent, orm_base.Base):
    """One entry of a list or dict field. Its value is in the column of its type; a pose is in x to frame.

    Attributes:
        field: the field's name.
        position: 0, 1, 2 … in the order of the list or dict.
        key: of a dict; None in a list.
        object_id: the object's row at that moment; for an object outside the world, its name and type are set instead.
    """

    __tablename__ = "parameter_item"
    _row = "node_id"

    node_id: Mapped[int] = mapped_column(sa.ForeignKey("designator.id"), primary_key=True)
    field: Mapped[str] = mapped_column(primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"), index=True)
    key: Mapped[str | None]
    integer: Mapped[int | None]
    real: Mapped[float | None]
    text: Mapped[str | None]
    boolean: Mapped[bool | None]
    time: Mapped[datetime | None]
    x: Mapped[float | None]
    y: Mapped[float | None]
    z: Mapped[float | None]
    qx: Mapped[float | None]
    qy: Mapped[float | None]
    qz: Mapped[float | None]
    qw: Mapped[float | None]
    frame: Mapped[str | None]
    object_id: Mapped[int | None] = mapped_column(sa.ForeignKey("object.id"))
    object_name: Mapped[str | None]
    obj_type: Mapped[str | None]

    object: Mapped[Object | None] = orm_base.one_of(lambda: ParameterItem.object_id, "object")

    @property
    def value(self) -> Any:
        """The scalar, or this item itself if it is a pose or an object."""
        if self.x is not None or self.object_id is not None or self.object_name is not None:
            return self
        values = (self.integer, self.real, self.text, self.boolean, self.time)
        return next((value for value in values if value is not None), None)


class ClassOfRow(TypeDecorator[str]):
    """The discriminator of designators: a lineage, nearest name first, read as the identity of the nearest class.

    `CarefulPickUpAction PickUpAction Action` becomes a `CarefulPickUpAction` if that class is mapped, else a
    `PickUpAction`. No query compares it, so the rows of a type without a class are returned too.
    """

    impl = sa.String
    cache_ok = True

    def result_processor(self, dialect: sa.Dialect, coltype: object) -> Callable[[str | None], str | None]:  # noqa: ARG002
        orm_base.map_leaves()  # before the first row of a designator, whose class may be one of them
        identity, mapped = orm_base.known_classes(dialect).identity, Designator.__mapper__.polymorphic_map
        return lambda lineage: None if lineage is None else identity(lineage, mapped)


class Designator(orm_base.RowOfEvent, orm_base.Base):
    """A performed designator; it has the id of its task tree node.

    Attributes:
        dtype: the type's name, such as `PickUpAction`, also if no class exists for it.
        kind: action, motion or language.
        robot_state: at the moment it started; None if there is no robot.
        items: the entries of its list and dict fields.
        parameters: its fields as recorded. Deferred: load them with `undefer(Action.parameters)` or
            `await action.awaitable_attrs.parameters`.
        status: of its node. A type with a field of such a name, or of one of the next three, has the field instead.
        start_time: when its node started.
        end_time: when its node ended; None while it runs, and if it is LOST.
        reason: why its node failed.
        robot: the name of the robot that acted; None if there is none. A field `robot` of the type replaces it.
        duration_s: of its node by the robot's monotonic clock, in s; None while it runs, and if it is LOST. `duration`
            is its former name.
        sequence, end_sequence: the events of its start and its end, 1, 2, 3 … inside the episode.
        episode: the same as `process_metadata`.
        node: its node of the task tree, mainly for joins: `select(...).join(PickUpAction.node)`. Not loaded by default:
            use `selectinload(Action.node)` or `await action.awaitable_attrs.node`.
    """

    __tablename__ = "designator"
    __root__: ClassVar[str] = "Designator"
    """The nearest of Action, Motion, Language and Designator."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        # Each class gets a table of its own and that table's key. Unless the class names the table, it has the name of
        # the class; that of a built-in class is the table of its designator.
        if not vars(cls).keys() & {"__table__", "__abstract__"}:
            if "__tablename__" not in vars(cls):
                cls.__tablename__ = table_name(cls.__name__) if orm_base.is_built_in(cls) else cls.__name__
            if "id" not in vars(cls):
                base = _mapped_base(cls)
                cls.id = mapped_column(sa.ForeignKey(f"{base.__tablename__}.id"), primary_key=True, sort_order=-2)
        super().__init_subclass__(**arguments)

    @classmethod
    def __table_cls__(cls, *arguments: Any, **options: Any) -> sa.Table:
        # Every leaf's view also has the episode, which joins use. Queries read it from `designator` alone.
        episode = () if cls.__name__ == "Designator" else (sa.Column(orm_base.EPISODE, sa.BigInteger()),)
        return sa.Table(*arguments, *episode, **options)

    @declared_attr.directive
    def __mapper_args__(cls) -> dict[str, Any]:
        arguments = {"polymorphic_identity": cls.__name__}
        if cls.__name__ == "Designator":
            return {"polymorphic_on": "_lineage", **arguments}
        return {**arguments, **orm_base.inherited_from(_mapped_base(cls), cls.__table__)}

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"))
    dtype: Mapped[str]
    kind: Mapped[str]
    robot_state_id: Mapped[int | None] = mapped_column(sa.ForeignKey("robot_state.id"))
    _parameters: Mapped[dict[str, Any]] = mapped_column("parameters", orm_base.JsonText(), deferred=True)
    _lineage: Mapped[str] = mapped_column("lineage", ClassOfRow())
    _status: Mapped[TaskStatus] = mapped_column("status")
    _start_time: Mapped[datetime] = mapped_column("start_time")
    _end_time: Mapped[datetime | None] = mapped_column("end_time")
    _duration_s: Mapped[float | None] = mapped_column("duration_s")
    _duration: Mapped[float | None] = mapped_column("duration")
    _reason: Mapped[str | None] = mapped_column("reason")
    _end_sequence: Mapped[int | None] = mapped_column("end_sequence")
    _robot: Mapped[str | None] = mapped_column("robot")

    robot_state: Mapped[RobotState | None] = orm_base.one_of(lambda: Designator.robot_state_id, "robot_state")
    items: Mapped[list[ParameterItem]] = orm_base.many_of(
        lambda: ParameterItem.node_id, "designator", order_by=(ParameterItem.field, ParameterItem.position)
    )
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)
    _node: Mapped[TaskTreeNode] = orm_base.one_of(lambda: Designator.id, "task_tree_node")

    # Hybrids, because a subclass may map a field of such a name, which a column of the same name would collide with.
    status = orm_base.HybridOf[TaskStatus]("status")
    start_time = orm_base.HybridOf[datetime]("start_time")
    end_time = orm_base.HybridOf[datetime | None]("end_time")
    duration_s = orm_base.HybridOf[float | None]("duration_s")
    duration = orm_base.HybridOf[float | None]("duration")
    reason = orm_base.HybridOf[str | None]("reason")
    end_sequence = orm_base.HybridOf[int | None]("end_sequence")
    robot = orm_base.HybridOf[str | None]("robot")
    parameters = orm_base.HybridOf[dict[str, Any]]("parameters", on_request=True)
    node = orm_base.HybridOf["TaskTreeNode"]("node", on_request=True)

    @hybrid_property
    def episode(self) -> ProcessMetaData:
        """The episode that it belongs to."""
        return self.process_metadata

    @classmethod
    def is_a(cls, concept: str) -> sa.ColumnElement[bool]:
        """Return the condition that its type's SOMA concept is this one or a subclass of it.

        >>> manipulations = select(Action).where(Action.is_a("Manipulating"))
        """
        types = sa.select(DesignatorType.dtype).where(is_concept(DesignatorType.__table__.c.concept, concept))
        return cls.dtype.in_(types)

    def entries(self, field: str) -> list[Any]:
        """Return the values of a list field, in order."""
        return [item.value for item in self.items if item.field == field]

    def mapping(self, field: str) -> dict[str, Any]:
        """Return the values of a dict field by key."""
        return {item.key: item.value for item in self.items if item.field == field and item.key is not None}


def _mapped_base(class_: Any) -> Any:
    """Return the nearest mapped class that this class derives from."""
    return next(each for each in class_.__mro__[1:] if issubclass(each, orm_base.Base) and "__table__" in vars(each))


class Action(Designator):
    """A performed action: a task that a plan requests."""

    __root__ = "Action"


class Motion(Designator):
    """A performed motion: one command to a robot's controllers."""

    __root__ = "Motion"


class Language(Designator):
    """A performed expression of the plan language. The nodes of its operands are children of its node."""

    __root__ = "Language"


# --- parameters of actions and motions --------------------------------------------------------------------------


class PoseParameter(MappedAsDataclass, init=False, repr=False, eq=False):
    """A pose; the class or a mixin declares `pose_id`."""

    @declared_attr
    def pose(cls: Any) -> Mapped[Pose]:
        related: Mapped[Pose] = orm_base.one_of(lambda: cls.pose_id, "pose")
        return related


class TargetLocationParameter(PoseParameter):
    """A pose that the designator calls `target_location`."""

    pose_id: Mapped[int] = mapped_column("target_location_id", sa.ForeignKey("pose.id"))

    @declared_attr
    def target_location_id(cls) -> Mapped[int]:
        return synonym("pose_id")

    @declared_attr
    def target_location(cls) -> Mapped[Pose]:
        return synonym("pose")


class TargetParameter(PoseParameter):
    """A pose that the designator calls `target`."""

    pose_id: Mapped[int] = mapped_column("target_id", sa.ForeignKey("pose.id"), sort_order=-1)

    @declared_attr
    def target_id(cls) -> Mapped[int]:
        return synonym("pose_id")

    @declared_attr
    def target(cls) -> Mapped[Pose]:
        return synonym("pose")


class ObjectParameter(MappedAsDataclass, init=False, repr=False, eq=False):
    """An object, as its row from before the node started; the class or a mixin declares `object_id`."""

    @declared_attr
    def object(cls: Any) -> Mapped[Object]:
        related: Mapped[Object] = orm_base.one_of(lambda: cls.object_id, "object")
        return related


class ObjectDesignatorParameter(ObjectParameter):
    """An object that the designator calls `object_designator`."""

    object_id: Mapped[int] = mapped_column("object_designator_id", sa.ForeignKey("object.id"), sort_order=-1)

    @declared_attr
    def object_designator_id(cls) -> Mapped[int]:
        return synonym("object_id")

    @declared_attr
    def object_designator(cls) -> Mapped[Object]:
        return synonym("object")


class ObjectPartParameter(ObjectParameter):
    """An object's part that the designator calls `object_part`."""

    object_id: Mapped[int] = mapped_column("object_part_id", sa.ForeignKey("object.id"), sort_order=-1)

    @declared_attr
    def object_part_id(cls) -> Mapped[int]:
        return synonym("object_id")

    @declared_attr
    def object_part(cls) -> Mapped[Object]:
        return synonym("object")


# === tree =====================================================================================================
#
# Map the task tree: a node for every perform, and the candidates of its location designators.


class TaskTreeNode(RowOfEpisode, orm_base.Base):
    """One perform, from its start to its end.

    Attributes:
        action: the performed `Action`, `Motion` or other `Designator`; None at the root of an episode.
        parent: the node that performed it; None at the root of an episode.
        children: the nodes that it performed, in order. Not loaded by default, because it would nearly double the time
            of a query: use `selectinload(TaskTreeNode.children)` or `await node.awaitable_attrs.children`.
        ancestors: the parent, its parent and so on to the root: `await node.awaitable_attrs.ancestors`.
        start_time: by the wall clock, which may be set while the plan runs.
        end_time: `start_time` and the duration; None while it runs, and if it is LOST.
        start_ns: monotonic time of the start, for exact durations.
        end_ns: monotonic time of the end.
        sequence, end_sequence: the events of its start and its end, 1, 2, 3 … inside the episode. `end_sequence` is
            None while it runs, and if it is LOST.
        duration_s: by the monotonic clock, in s; None while it runs, and if it is LOST. `duration` is its former name.
        reason: why it failed: the class of an exception, or a text without its numbers and names; `failure_message`
            and `failure_arguments` belong to it.
        result: the return value of perform, as JSON.
        robot: the name of the robot that acted; None if there is none.
        simulated: whether it belongs to a simulation, performed in a copy of the world.
        outcome: how the plan went on after it failed, as `RootFailure.outcome`; None for a node that did not fail.
            Loaded on request.
    """

    __tablename__ = "task_tree_node"
    _unmapped: ClassVar[dict[str, dict[str, str]]] = {
        "robot_type": {"storage": "text", "after": "torso_height"},
        "failure_node_id": {"storage": "row", "after": "failure_arguments"},
    }

    parent_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"), index=True)
    action_id: Mapped[int | None] = mapped_column(sa.ForeignKey("designator.id"), info=orm_base.COMPUTED)
    kind: Mapped[str]
    dtype: Mapped[str | None] = mapped_column(index=True)
    status: Mapped[TaskStatus] = mapped_column(index=True)
    start_time: Mapped[datetime]
    end_time: Mapped[datetime | None] = mapped_column(info=orm_base.COMPUTED)
    start_ns: Mapped[int]
    end_ns: Mapped[int | None]
    end_sequence: Mapped[int | None] = mapped_column(info={"storage": "number"})
    reason: Mapped[str | None]
    failure_message: Mapped[str | None]
    failure_arguments: Mapped[list[Any] | None] = mapped_column(orm_base.JsonText())
    result: Mapped[Any | None] = mapped_column(orm_base.JsonText())
    robot_pose_id: Mapped[int | None] = mapped_column(sa.ForeignKey("pose.id"))
    torso_height: Mapped[float | None]
    robot_object_id: Mapped[int | None] = mapped_column(sa.ForeignKey("object.id"))
    robot: Mapped[str | None]
    simulated: Mapped[bool]
    duration_s: Mapped[float | None] = mapped_column(info=orm_base.COMPUTED)
    duration: Mapped[float | None] = mapped_column(info=orm_base.COMPUTED)
    outcome: Mapped[str | None] = mapped_column(deferred=True, info=orm_base.COMPUTED)

    action: Mapped[Designator | None] = orm_base.one_of(lambda: TaskTreeNode.action_id, "designator")
    parent: Mapped[TaskTreeNode | None] = orm_base.one_of(lambda: TaskTreeNode.parent_id, "task_tree_node")
    children: Mapped[list[TaskTreeNode]] = orm_base.many_of(
        lambda: TaskTreeNode.parent_id, "task_tree_node", order_by=lambda: TaskTreeNode.id, info=orm_base.ON_REQUEST
    )

    @property
    def ancestors(self) -> list[TaskTreeNode]:
        """Its parent, the parent of that, and so on to the root. Raises `CallerError` if one is not loaded."""
        nodes: list[TaskTreeNode] = []
        node: TaskTreeNode | None = self
        while node is not None:
            orm_base.require_loaded(node, "parent", self, "ancestors")
            node = node.parent
            nodes += [] if node is None else [node]
        return nodes


class LocationCandidate(orm_base.RowOfEvent, orm_base.Base):
    """A place that a location designator offered; `position` is its rank, 0 first.

    Attributes:
        torso_height: at which the robot was to stand there, m.
    """

    __tablename__ = "location_candidate"
    _row = "resolution_id"

    resolution_id: Mapped[int] = mapped_column(sa.ForeignKey("location_resolution.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"), index=True)
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


class LocationRefusal(orm_base.RowOfEvent, orm_base.Base):
    """A place that a location designator tried and did not offer, and the reason; `position` is its rank, 0 first."""

    __tablename__ = "location_refusal"
    _row = "resolution_id"

    resolution_id: Mapped[int] = mapped_column(sa.ForeignKey("location_resolution.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"), index=True)
    x: Mapped[float]
    y: Mapped[float]
    z: Mapped[float]
    qx: Mapped[float]
    qy: Mapped[float]
    qz: Mapped[float]
    qw: Mapped[float]
    frame: Mapped[str]
    reason: Mapped[str]


class LocationResolution(RowOfEpisode, orm_base.Base):
    """A location designator's answer to one request for a place.

    Attributes:
        location: the designator's class.
        considered: the number of places it checked.
        offered: the number of those it offered.
        refused: the number of all others.
        candidates: the first 999 places that it offered, and the last one.
        taken: the rank among `candidates` of the place that the plan used, whose pose is `pose`; None if it used none.
        node: the node that made the request.
        refusals: the first 1,000 places that it refused. Not loaded by default: use
            `await resolution.awaitable_attrs.refusals`.
        occupied_cells: the places in its costmaps that are too near an obstacle. None if there are no costmaps and
            in older episodes, also of the next two.
        hidden_cells: the places from which the target is not visible.
        free_cells: the places it chose from.
    """

    __tablename__ = "location_resolution"

    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"), index=True)
    location: Mapped[str]
    considered: Mapped[int]
    offered: Mapped[int]
    taken: Mapped[int | None]
    pose_id: Mapped[int | None] = mapped_column(sa.ForeignKey("pose.id"))
    time: Mapped[datetime]
    refused: Mapped[int]
    occupied_cells: Mapped[int | None]
    hidden_cells: Mapped[int | None]
    free_cells: Mapped[int | None]

    node: Mapped[TaskTreeNode | None] = orm_base.one_of(lambda: LocationResolution.node_id, "task_tree_node")
    pose: Mapped[Pose | None] = orm_base.one_of(lambda: LocationResolution.pose_id, "pose")
    candidates: Mapped[list[LocationCandidate]] = orm_base.many_of(
        lambda: LocationCandidate.resolution_id, "location_resolution", order_by=LocationCandidate.position
    )
    refusals: Mapped[list[LocationRefusal]] = orm_base.many_of(
        lambda: LocationRefusal.resolution_id,
        "location_resolution",
        order_by=LocationRefusal.position,
        info=orm_base.ON_REQUEST,
    )


# === perception ===============================================================================================
#
# Map perceived objects, observations of programs, and samples of the robot's state during motions.


class Detection(orm_base.RowOfEvent, orm_base.Base):
    """A percept. All percepts of one detection share their `id`; the best has `position` 0.

    Attributes:
        source: `camera`, or `world_state` where the world's own state was read; the sensor or method instead, if the
            robot's perception named one.
        looked_for: the requested type; None for any.
        visible: the visible share of the object, 0 to 1; None if there is no camera.
        confidence: the confidence that the robot's perception computed; None if it computed none.
        object: the row of the object of the world at that moment; None for a hypothesis or a false positive, which
            matches none.
        x, y, z: the perceived position.
        qx, qy, qz, qw: the perceived orientation.
        frame: of the perceived pose.
        node: the node that performed the detection.
    """

    __tablename__ = "detection"

    id: Mapped[int] = mapped_column(primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"), index=True)
    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"), index=True)
    source: Mapped[str]
    looked_for: Mapped[ObjectType | None]
    object_id: Mapped[int | None] = mapped_column(sa.ForeignKey("object.id"))
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

    node: Mapped[TaskTreeNode | None] = orm_base.one_of(lambda: Detection.node_id, "task_tree_node")
    object: Mapped[Object | None] = orm_base.one_of(lambda: Detection.object_id, "object")
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)


class StateSample(orm_base.RowOfEvent, orm_base.Base):
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
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"), index=True)
    object_id: Mapped[int] = mapped_column(sa.ForeignKey("object.id"))
    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"), index=True)
    value: Mapped[float]
    time: Mapped[datetime]
    ns: Mapped[int]


class Observation(RowOfEpisode, orm_base.Base):
    """An observation that a program made with `memory.observe`.

    Attributes:
        name: given by the program.
        node: the node that observed it.
        ns: monotonic time, comparable with `TaskTreeNode.start_ns`.
        items: its values, each with its key.
    """

    __tablename__ = "observation"

    node_id: Mapped[int | None] = mapped_column(sa.ForeignKey("task_tree_node.id"), index=True)
    name: Mapped[str] = mapped_column(index=True)
    time: Mapped[datetime]
    ns: Mapped[int]

    node: Mapped[TaskTreeNode | None] = orm_base.one_of(lambda: Observation.node_id, "task_tree_node")
    items: Mapped[list[ObservationValue]] = orm_base.many_of(
        lambda: ObservationValue.id, "observation", order_by=lambda: ObservationValue.position
    )

    @property
    def values(self) -> dict[str, float | str | bool | None]:
        """The values by key: numbers, texts and bools, of a blob its hash; None for a missing value."""
        return {each.key: each.value for each in self.items}


class ObservationValue(orm_base.RowOfEvent, orm_base.Base):
    """A scalar or a blob of an observation. All values of one observation share their `id`.

    Attributes:
        key: the keys and indices that lead to it, joined by dots; `value` if the observation is this value.
        number: the scalar, if it is a number.
        text: the scalar, if it is a text.
        truth: the scalar, if it is a truth value.
        blob: the SHA-256 of a blob, for `memory.blob`; with its `media_type` and its `size` in bytes.
        missing: the reason why the value could not be recorded.
    """

    __tablename__ = "observation_value"

    id: Mapped[int] = mapped_column(sa.ForeignKey("observation.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(sa.ForeignKey("process_metadata.id"), index=True)
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
