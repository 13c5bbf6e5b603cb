"""Map performed designators: actions, motions and expressions of the plan language.

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
from typing import TYPE_CHECKING, Any

from sqlalchemy import BigInteger, Column, ColumnElement, Dialect, ForeignKey, String, Table, select
from sqlalchemy.ext.hybrid import hybrid_property
from sqlalchemy.orm import Mapped, MappedAsDataclass, declared_attr, mapped_column, relationship, synonym
from sqlalchemy.types import TypeDecorator

from pycrorm_async.orm.base import EPISODE, Base, HybridOnRequest, RowOfEvent, inherited_from, many_of, one_of
from pycrorm_async.orm.episodes import Pose, ProcessMetaData, RobotState
from pycrorm_async.orm.loading.known_classes import known_classes
from pycrorm_async.orm.objects import Object, is_concept
from pycrorm_async.orm.types import JsonText
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    from pycrorm_async.orm.tree import TaskTreeNode

__all__ = [
    "DesignatorType",
    "ParameterItem",
    "Designator",
    "Action",
    "Motion",
    "Language",
    "PoseParameter",
    "TargetLocationParameter",
    "TargetParameter",
    "ObjectParameter",
    "ObjectDesignatorParameter",
    "ObjectPartParameter",
]


class DesignatorType(Base):
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
    fields: Mapped[list[Any]] = mapped_column(JsonText())


class ParameterItem(RowOfEvent, Base):
    """One entry of a list or dict field. Its value is in the column of its type; a pose is in x to frame.

    Attributes:
        field: the field's name.
        position: 0, 1, 2 … in the order of the list or dict.
        key: of a dict; None in a list.
        object_id: the object's row at that moment; for an object outside the world, its name and type are set instead.
    """

    __tablename__ = "parameter_item"
    _row = "node_id"

    node_id: Mapped[int] = mapped_column(ForeignKey("designator.id"), primary_key=True)
    field: Mapped[str] = mapped_column(primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
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
    object_id: Mapped[int | None] = mapped_column(ForeignKey("object.id"))
    object_name: Mapped[str | None]
    obj_type: Mapped[str | None]

    object: Mapped[Object | None] = one_of(lambda: ParameterItem.object_id, "object")

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

    impl = String
    cache_ok = True

    def result_processor(self, dialect: Dialect, coltype: object) -> Callable[[str | None], str | None]:  # noqa: ARG002
        identity, mapped = known_classes(dialect).identity, Designator.__mapper__.polymorphic_map
        return lambda lineage: None if lineage is None else identity(lineage, mapped)


class Designator(RowOfEvent, Base):
    """A performed designator; it has the id of its task tree node.

    Attributes:
        dtype: the type's name, such as `PickUpAction`, also if no class exists for it.
        kind: action, motion or language.
        robot_state: at the moment it started; None without a robot.
        items: the entries of its list and dict fields.
        parameters: its fields as recorded. Deferred: load them with `undefer(Action.parameters)` or
            `await action.awaitable_attrs.parameters`.
        status, start_time, end_time, reason: of its node. A type with a field of such a name has the field instead.
        robot: the name of the robot that acted; None without one. A type with a field `robot` has the field instead.
        duration: of its node, in s; None while it runs, and if it is LOST.
        sequence, end_sequence: the events of its start and its end, 1, 2, 3 … inside the episode.
        episode: the same as `process_metadata`.
        node: its node of the task tree, mainly for joins: `select(...).join(PickUpAction.node)`. Not loaded by default:
            use `selectinload(Action.node)` or `await action.awaitable_attrs.node`.
    """

    __tablename__ = "designator"

    def __init_subclass__(cls, **arguments: Any) -> None:
        # Each class gets a table of its own, named like the class unless the class names one, and that table's key.
        if not vars(cls).keys() & {"__table__", "__abstract__"}:
            if "__tablename__" not in vars(cls):
                cls.__tablename__ = cls.__name__
            if "id" not in vars(cls):
                base = _mapped_base(cls)
                cls.id = mapped_column(ForeignKey(f"{base.__tablename__}.id"), primary_key=True, sort_order=-2)
        super().__init_subclass__(**arguments)

    @classmethod
    def __table_cls__(cls, *arguments: Any, **options: Any) -> Table:
        # Every leaf's view also has the episode, which joins use. Queries read it from `designator` alone.
        episode = () if cls.__name__ == "Designator" else (Column(EPISODE, BigInteger()),)
        return Table(*arguments, *episode, **options)

    @declared_attr.directive
    def __mapper_args__(cls) -> dict[str, Any]:
        arguments = {"polymorphic_identity": cls.__name__}
        if cls.__name__ == "Designator":
            return {"polymorphic_on": "_lineage", **arguments}
        return {**arguments, **inherited_from(_mapped_base(cls), cls.__table__)}

    id: Mapped[int] = mapped_column(primary_key=True)
    process_metadata_id: Mapped[int] = mapped_column(ForeignKey("process_metadata.id"))
    dtype: Mapped[str]
    kind: Mapped[str]
    robot_state_id: Mapped[int | None] = mapped_column(ForeignKey("robot_state.id"))
    _parameters: Mapped[dict[str, Any]] = mapped_column("parameters", JsonText(), deferred=True)
    _lineage: Mapped[str] = mapped_column("lineage", ClassOfRow())
    _status: Mapped[TaskStatus] = mapped_column("status")
    _start_time: Mapped[datetime] = mapped_column("start_time")
    _end_time: Mapped[datetime | None] = mapped_column("end_time")
    _duration: Mapped[float | None] = mapped_column("duration")
    _reason: Mapped[str | None] = mapped_column("reason")
    _end_sequence: Mapped[int | None] = mapped_column("end_sequence")
    _robot: Mapped[str | None] = mapped_column("robot")

    robot_state: Mapped[RobotState | None] = one_of(lambda: Designator.robot_state_id, "robot_state")
    items: Mapped[list[ParameterItem]] = many_of(
        lambda: ParameterItem.node_id, "designator", order_by=(ParameterItem.field, ParameterItem.position)
    )
    process_metadata: Mapped[ProcessMetaData] = relationship(viewonly=True)
    _node: Mapped[TaskTreeNode] = one_of(lambda: Designator.id, "task_tree_node")

    # Hybrids, because a subclass may map a field of such a name, which a column of the same name would collide with.

    @hybrid_property
    def status(self) -> TaskStatus:
        """The status of its node."""
        return self._status

    @hybrid_property
    def start_time(self) -> datetime:
        """The start of its node."""
        return self._start_time

    @hybrid_property
    def end_time(self) -> datetime | None:
        """The end of its node; None while it runs, and if it is LOST."""
        return self._end_time

    @hybrid_property
    def duration(self) -> float | None:
        """The duration of its node in s; None while it runs, and if it is LOST."""
        return self._duration

    @hybrid_property
    def reason(self) -> str | None:
        """The class of the failure that its node ended with."""
        return self._reason

    @hybrid_property
    def end_sequence(self) -> int | None:
        """The event of its node's end; None while it runs, and if it is LOST."""
        return self._end_sequence

    @hybrid_property
    def robot(self) -> str | None:
        """The name of the robot that acted; None without one."""
        return self._robot

    @hybrid_property
    def episode(self) -> ProcessMetaData:
        """The episode that it belongs to."""
        return self.process_metadata

    @HybridOnRequest
    def parameters(self) -> dict[str, Any]:
        """Its fields as recorded. Raises `CallerError` if they are not loaded."""
        return self._parameters

    @HybridOnRequest
    def node(self) -> TaskTreeNode:
        """Its node of the task tree. Raises `CallerError` if it is not loaded."""
        return self._node

    @classmethod
    def is_a(cls, concept: str) -> ColumnElement[bool]:
        """Return the condition that its type's SOMA concept is this one or a subclass of it.

        >>> manipulations = select(Action).where(Action.is_a("Manipulating"))
        """
        types = select(DesignatorType.dtype).where(is_concept(DesignatorType.__table__.c.concept, concept))
        return cls.dtype.in_(types)

    def entries(self, field: str) -> list[Any]:
        """Return the values of a list field, in order."""
        return [item.value for item in self.items if item.field == field]

    def mapping(self, field: str) -> dict[str, Any]:
        """Return the values of a dict field by key."""
        return {item.key: item.value for item in self.items if item.field == field and item.key is not None}


def _mapped_base(class_: Any) -> Any:
    """Return the nearest mapped class that this class derives from."""
    return next(each for each in class_.__mro__[1:] if issubclass(each, Base) and "__table__" in vars(each))


class Action(Designator):
    """A performed action: a task that a plan requests."""

    __tablename__ = "action"


class Motion(Designator):
    """A performed motion: one command to a robot's controllers."""

    __tablename__ = "motion"


class Language(Designator):
    """A performed expression of the plan language. The nodes of its operands are children of its node."""

    __tablename__ = "language"


# --- parameters of actions and motions --------------------------------------------------------------------------


class PoseParameter(MappedAsDataclass, init=False, repr=False, eq=False):
    """A pose; the class or a mixin declares `pose_id`."""

    @declared_attr
    def pose(cls: Any) -> Mapped[Pose]:
        related: Mapped[Pose] = one_of(lambda: cls.pose_id, "pose")
        return related


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
    def object(cls: Any) -> Mapped[Object]:
        related: Mapped[Object] = one_of(lambda: cls.object_id, "object")
        return related


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
