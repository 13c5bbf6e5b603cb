"""Define the base of the mapped classes, their relationships, and attributes that are loaded on request.

All mapped classes are read-only: they select from the public views. A query loads the columns of the class that it
selects. `orm.loading.batch_loads` loads the columns of subclasses and related rows when an attribute is read.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Any, ClassVar, TypeVar, dataclass_transform

from sqlalchemy import (
    BigInteger,
    Boolean,
    ColumnElement,
    Dialect,
    Double,
    Text,
    and_,
    event,
    inspect,
    literal_column,
)
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.ext.asyncio import AsyncAttrs
from sqlalchemy.ext.hybrid import hybrid_property
from sqlalchemy.orm import (
    DeclarativeBase,
    InstanceState,
    MappedAsDataclass,
    MappedColumn,
    Mapper,
    RelationshipProperty,
    Synonym,
    foreign,
    mapped_column,
    object_session,
    relationship,
    remote,
    synonym,
)
from sqlalchemy.util.concurrency import in_greenlet

from pycrorm_async.errors import CallerError, PycrormError
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX, row_key
from pycrorm_async.orm.loading.batch_loads import load_columns
from pycrorm_async.orm.types import EnumName, Moment
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp, GripperState, ObjectType

__all__ = [
    "Base",
    "RowOfEvent",
    "require_loaded",
    "on_request",
    "HybridOnRequest",
    "one_of",
    "many_of",
    "inherited_from",
    "same_row",
    "EPISODE",
]

_Value = TypeVar("_Value")


EPISODE = "process_metadata_id"
"""The column of every table that names the episode of a row."""


def one_of(reference: Callable[[], Any], table: str, class_: Any = None, **options: Any) -> Any:
    """Return a read-only relationship to the row of `table` whose id the attribute `reference()` contains.

    It joins by id and episode, so that a database whose tables are divided by episode reads one part of them. `class_`
    is the class of these rows, where no annotation names it.
    """

    def joined() -> Any:
        attribute = reference()
        others, own_episode = Base.metadata.tables[table].c, attribute.class_.process_metadata_id
        return and_(foreign(attribute) == remote(others.id), own_episode == remote(others.process_metadata_id))

    return _by_id(relationship(class_, primaryjoin=joined, viewonly=True, **options))


def many_of(reference: Callable[[], Any], table: str, **options: Any) -> Any:
    """Return a read-only relationship to the rows whose attribute `reference()` contains the id of a row of `table`."""

    def joined() -> Any:
        attribute = reference()
        own, episode = Base.metadata.tables[table].c, attribute.class_.process_metadata_id
        return and_(own.id == remote(foreign(attribute)), own.process_metadata_id == remote(episode))

    return _by_id(relationship(primaryjoin=joined, viewonly=True, **options))


def inherited_from(base: Any, table: Any) -> dict[str, Any]:
    """Return the arguments of a mapper that joins the rows of `table` with those of `base` by id and episode."""
    repeated = [each.local_table.c[EPISODE] for each in (*base.__mapper__.iterate_to_root(),)][:-1]
    return {"inherit_condition": same_row(table, base.__table__), "exclude_properties": [table.c[EPISODE], *repeated]}


def same_row(one: Any, other: Any) -> Any:
    """Return the condition that rows of two tables have the same id and episode."""
    return and_(one.c.id == other.c.id, one.c[EPISODE] == other.c[EPISODE])


def _by_id(related: Any) -> Any:
    """Let `selectinload` read related rows by their ids, which are unique in the memory.

    SQLAlchemy does so by itself only where the join is by the mapped key alone, which is the id. Otherwise it would
    join the rows of the parent again for every load. `EpisodeSession` adds the episode to such a load.
    """
    related.omit_join = True
    return related


_ENUMS = "pycrorm_enums"
"""The entry of a class manager's `info` that has its enum columns by attribute."""


class EnumOfObject(EnumName):
    """The enum column of a mapped class, whose objects have members also where a connection reads names."""

    cache_ok = True

    def result_processor(self, dialect: Dialect, coltype: object) -> Callable[[str | None], Any] | None:
        """Listen to loads from the first result of a synchronous connection on, because listening costs a load 8 %."""
        if not dialect.is_async and not event.contains(Base, "load", _read_members):
            for loaded in ("load", "refresh"):
                event.listen(Base, loaded, _read_members, raw=True, propagate=True)
        return super().result_processor(dialect, coltype)


def _read_members(state: InstanceState[Base], *_: Any) -> None:
    values = state.dict
    for key, kind in state.manager.info[_ENUMS].items():
        if type(values.get(key)) is str:
            values[key] = kind.member(values[key])


@dataclass_transform(
    field_specifiers=(
        MappedColumn,
        RelationshipProperty,
        Synonym,
        mapped_column,
        relationship,
        synonym,
        one_of,
        many_of,
    )
)
class Base(MappedAsDataclass, AsyncAttrs, DeclarativeBase, init=False, repr=False, eq=False):
    """The root of the mapped classes. The text of an object has the columns of its class and the robot's state."""

    type_annotation_map: ClassVar[dict[Any, Any]] = {
        int: BigInteger(),
        float: Double(),
        str: Text(),
        bool: Boolean(),
        datetime: Moment(),
        **{enum: EnumOfObject(enum) for enum in (Arms, Grasp, GripperState, ObjectType, TaskStatus)},
    }

    def __repr__(self) -> str:
        mapper = inspect(self).mapper
        names = [
            *(each.key for each in mapper.column_attrs if not each.key.startswith("_")),
            *(["robot_state"] if "robot_state" in mapper.relationships else []),
        ]
        shown = ", ".join(f"{name}={value!r}" for name in names if (value := self._readable(name)) is not None)
        return f"{type(self).__name__}({shown})"

    def _readable(self, name: str) -> Any:
        """Return the attribute; None if it is not loaded and cannot be loaded now."""
        try:
            return getattr(self, name)
        except (PycrormError, SQLAlchemyError):
            return None


class RowOfEvent:
    """A row whose id, the attribute named by `_row`, contains the sequence of the row's event."""

    _row: ClassVar[str] = "id"

    @hybrid_property
    def sequence(self) -> int:
        """The event that made the row: 1, 2, 3 … inside the episode."""
        return row_key(getattr(self, self._row)).sequence

    @sequence.inplace.expression
    @classmethod
    def _sequence_of_class(cls) -> ColumnElement[int]:
        # Literals, because PostgreSQL shifts by a 4-byte integer only and a parameter would be of 8 bytes.
        row: ColumnElement[int] = getattr(cls, cls._row)
        shifted = row.bitwise_rshift(literal_column(str(SLOT_MAX.bit_length())))
        return shifted.bitwise_and(literal_column(str(SEQUENCE_MAX)))


@event.listens_for(Base, "mapper_configured", propagate=True)
def _complete_mapping(mapper: Mapper[Any], class_: type[Base]) -> None:  # noqa: ARG001  SQLAlchemy's
    """Let columns of subclasses be loaded in batches, and note the enum columns for `_read_members`."""
    if mapper.inherits is not None:
        mapper.class_manager.expired_attribute_loader = load_columns
    kinds = {each.key: each.columns[0].type for each in mapper.column_attrs}
    mapper.class_manager.info[_ENUMS] = {key: kind for key, kind in kinds.items() if isinstance(kind, EnumName)}


def require_loaded(row: Base, name: str, requested_by: Base | None = None, request: str | None = None) -> None:
    """Raise `CallerError` with the remedy if this attribute is not loaded and can only be loaded by awaiting it.

    The message names the object `requested_by` and the attribute `request`, if they differ from `row` and `name`.
    """
    if name in vars(row):
        return
    session = object_session(row)
    if session is not None and (in_greenlet() or not session.get_bind().dialect.is_async):
        return
    named, attribute = requested_by or row, request or name.removeprefix("_")
    state, class_ = inspect(named), type(named).__name__
    key, option = state.identity, "undefer" if f"_{attribute}" in state.mapper.column_attrs else "selectinload"
    raise CallerError(
        f"{attribute} of {class_} {key} is not loaded: in its session use `await row.awaitable_attrs.{attribute}`,"
        f" or select with `{option}({class_}.{attribute})`"
    )


def on_request(name: str) -> property:
    """Return the descriptor of a synonym whose relationship or deferred column, `_name`, is loaded on request only.

    Reading it raises `CallerError` if it is not loaded.
    """
    return property(_reader(name))


def _reader(name: str) -> Callable[[Any], Any]:
    def value(row: Base) -> Any:
        require_loaded(row, f"_{name}")
        return getattr(row, f"_{name}")

    return value


class HybridOnRequest(hybrid_property[_Value]):
    """A descriptor like that of `on_request`, for a class with joined inheritance, whose subclasses a query may select.

    A synonym in a query of a subclass would be that of the base, without a join to it.
    """

    def __init__(self, read: Callable[[Any], _Value]) -> None:
        name = read.__name__
        super().__init__(_reader(name), expr=lambda class_: getattr(class_, f"_{name}"))
        self.__name__, self.__doc__ = name, read.__doc__

    def __get__(self, instance: Any, owner: Any) -> Any:
        attribute = super().__get__(instance, owner)
        if instance is None:  # `undefer` asks an attribute for its columns, which SQLAlchemy 2.1 cannot answer here
            attribute._column_strategy_attrs = lambda: [getattr(owner, f"_{self.__name__}")]  # noqa: SLF001
        return attribute
