"""Define the base of the mapped classes, their relationships, and attributes that are loaded on request.

All mapped classes are read-only: they select from the public views. A query loads the columns of the class that it
selects. `orm.base` loads the columns of subclasses and related rows when an attribute is read.

**Types.** Define column types for times, enum members and JSON.

| Python | column |
|---|---|
| aware `datetime` | integer, µs since 1970-01-01 00:00 UTC |
| enum member | its name as text; a name that the enum lacks is read as `str`, see `EnumName` |
| what JSON can hold; None is NULL | JSON text |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from enum import Enum
from importlib import import_module
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar, dataclass_transform

import msgspec
import sqlalchemy as sa
from sqlalchemy import orm
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.ext.asyncio import AsyncAttrs
from sqlalchemy.ext.hybrid import hybrid_property
from sqlalchemy.orm.exc import DetachedInstanceError, ObjectDeletedError
from sqlalchemy.types import TypeDecorator
from sqlalchemy.util.concurrency import in_greenlet

from pycrorm_async.clock import microseconds_of, utc_of
from pycrorm_async.errors import CallerError, PycrormError
from pycrorm_async.events.fields import table_name
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX, row_key
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, GripperState, ObjectType

# === types ====================================================================================================


def _moment(value: int | None) -> datetime | None:
    return None if value is None else utc_of(value)


def _decoded(text: str | None) -> Any:
    return None if text is None else msgspec.json.decode(text)


class UtcTime(TypeDecorator[datetime]):
    """An aware datetime, exact to the microsecond and read in UTC. A naive one is refused: it names no time zone."""

    impl = sa.BigInteger
    cache_ok = True
    storage = "time"
    """The storage of its columns (`projections.schema`)."""

    def process_bind_param(self, value: datetime | None, dialect: sa.Dialect) -> int | None:  # noqa: ARG002
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value!r} has no time zone: write datetime(..., tzinfo=UTC)")
        return microseconds_of(value)

    def result_processor(self, dialect: sa.Dialect, coltype: object) -> Callable[[int | None], datetime | None]:  # noqa: ARG002
        return _moment


Moment = UtcTime
"""Its former name, kept until the next release, because mapped classes of users may import it."""


class EnumName(TypeDecorator[Any]):
    """A member of `enum`, stored by name. A query may compare the column with members and with names.

    A column that a synchronous connection selects is read as the name. `pandas.read_sql` uses such a connection, and
    would turn the members of an `IntEnum` into their numbers. Objects have members on every connection (`orm.base`).
    """

    impl = sa.String
    cache_ok = True

    def __init__(self, enum: type[Enum]) -> None:
        super().__init__()
        self.enum = enum
        self._members = _Members(enum)

    def process_bind_param(self, value: Enum | str | None, dialect: sa.Dialect) -> str | None:  # noqa: ARG002
        return value.name if isinstance(value, Enum) else value

    def result_processor(self, dialect: sa.Dialect, coltype: object) -> Callable[[str | None], Any] | None:  # noqa: ARG002
        return self._members.__getitem__ if dialect.is_async else None

    def member(self, name: str) -> Enum | str:
        """Return the member of this name, or the name if the enum lacks it; a further arm of a robot is one too."""
        member: Enum | str = self._members[name]
        return member


class _Members(dict[str | None, Any]):
    """The members of an enum by name. A name that it lacks is an arm of `Arms` or stays a text; NULL is None."""

    def __init__(self, enum: type[Enum]) -> None:
        super().__init__(**enum.__members__)
        self._enum = enum

    def __missing__(self, name: str | None) -> Enum | str | None:
        if name is not None and self._enum is Arms and name.isidentifier():
            return Arms.named(name)
        return name


class JsonText(TypeDecorator[Any]):
    """A value stored as JSON text; None is NULL."""

    impl = sa.Text
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: sa.Dialect) -> str | None:  # noqa: ARG002
        return None if value is None else msgspec.json.encode(value).decode()

    def result_processor(self, dialect: sa.Dialect, coltype: object) -> Callable[[str | None], Any]:  # noqa: ARG002
        return _decoded


# === base =====================================================================================================

_Value = TypeVar("_Value")


EPISODE = "process_metadata_id"
"""The column of every table that names the episode of a row."""
COMPUTED: Final = {"storage": None}
"""Marks a column of a view that its select computes, so that the table behind the view does not have it.

The `info` of another column may name its `storage`, if its type does not say it, and the column that it comes `after`
in the table, if that is not the one before it in the class. `projections/schema.json` is made from both, and has the
tables of the classes with an indexed column; other classes map views that compute all their rows.
"""


def is_built_in(class_: type) -> bool:
    """Return whether every memory has the view of a mapped class; users declare other classes."""
    return class_.__module__.startswith("pycrorm_async.orm.")


def one_of(reference: Callable[[], Any], table: str, class_: Any = None, **options: Any) -> Any:
    """Return a read-only relationship to the row of `table` whose id the attribute `reference()` contains.

    It joins by id and episode, so that a database whose tables are divided by episode reads one part of them. `class_`
    is the class of these rows, where no annotation names it.
    """

    def joined() -> Any:
        attribute = reference()
        others, own_episode = Base.metadata.tables[table].c, attribute.class_.process_metadata_id
        return sa.and_(
            orm.foreign(attribute) == orm.remote(others.id), own_episode == orm.remote(others.process_metadata_id)
        )

    return _by_id(orm.relationship(class_, primaryjoin=joined, viewonly=True, **options))


def many_of(reference: Callable[[], Any], table: str, **options: Any) -> Any:
    """Return a read-only relationship to the rows whose attribute `reference()` contains the id of a row of `table`."""

    def joined() -> Any:
        attribute = reference()
        own, episode = Base.metadata.tables[table].c, attribute.class_.process_metadata_id
        return sa.and_(own.id == orm.remote(orm.foreign(attribute)), own.process_metadata_id == orm.remote(episode))

    return _by_id(orm.relationship(primaryjoin=joined, viewonly=True, **options))


def inherited_from(base: Any, table: Any) -> dict[str, Any]:
    """Return the arguments of a mapper that joins the rows of `table` with those of `base` by id and episode."""
    repeated = [each.local_table.c[EPISODE] for each in (*base.__mapper__.iterate_to_root(),)][:-1]
    return {"inherit_condition": same_row(table, base.__table__), "exclude_properties": [table.c[EPISODE], *repeated]}


def same_row(one: Any, other: Any) -> Any:
    """Return the condition that rows of two tables have the same id and episode."""
    return sa.and_(one.c.id == other.c.id, one.c[EPISODE] == other.c[EPISODE])


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

    def result_processor(self, dialect: sa.Dialect, coltype: object) -> Callable[[str | None], Any] | None:
        """Listen to loads from the first result of a synchronous connection on, because listening costs a load 8 %."""
        if not dialect.is_async and not sa.event.contains(Base, "load", _read_members):
            for loaded in ("load", "refresh"):
                sa.event.listen(Base, loaded, _read_members, raw=True, propagate=True)
        return super().result_processor(dialect, coltype)


def _read_members(state: orm.InstanceState[Base], *_: Any) -> None:
    values = state.dict
    for key, kind in state.manager.info[_ENUMS].items():
        if type(values.get(key)) is str:
            values[key] = kind.member(values[key])


@dataclass_transform(
    field_specifiers=(
        orm.MappedColumn,
        orm.RelationshipProperty,
        orm.Synonym,
        orm.mapped_column,
        orm.relationship,
        orm.synonym,
        one_of,
        many_of,
    )
)
class Base(orm.MappedAsDataclass, AsyncAttrs, orm.DeclarativeBase, init=False, repr=False, eq=False):
    """The root of the mapped classes. The text of an object has the columns of its class and the robot's state."""

    _unmapped: ClassVar[dict[str, dict[str, str]]] = {}
    """Columns of the table that the view leaves out, with their `info` (`COMPUTED`)."""

    type_annotation_map: ClassVar[dict[Any, Any]] = {
        int: sa.BigInteger(),
        float: sa.Double(),
        str: sa.Text(),
        bool: sa.Boolean(),
        datetime: UtcTime(),
        **{enum: EnumOfObject(enum) for enum in (Arms, Grasp, GripperState, ObjectType, TaskStatus)},
    }

    def __repr__(self) -> str:
        mapper = sa.inspect(self).mapper
        names = [
            *(each.key for each in mapper.column_attrs if not each.key.startswith("_") and not _is_deferred(each)),
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


def map_leaves() -> None:
    """Map the classes of single types, unless they are mapped.

    They are configured at once, because a cached statement would meet the new mappers unconfigured.
    """
    import_module("pycrorm_async.orm.actions")
    Base.registry.configure()


def view_mappers() -> dict[str, orm.Mapper[Any]]:
    """Return the mappers of this process by view; of the classes that share a view, that of their base."""
    map_leaves()
    own = [
        each
        for each in Base.registry.mappers
        if each.inherits is None or each.local_table is not each.inherits.local_table
    ]
    return {str(each.local_table.description): each for each in own}


class RowOfEvent:
    """A row whose id, the attribute named by `_row`, contains the sequence of the row's event."""

    _row: ClassVar[str] = "id"

    @hybrid_property
    def sequence(self) -> int:
        """The event that made the row: 1, 2, 3 … inside the episode."""
        return row_key(getattr(self, self._row)).sequence

    @sequence.inplace.expression
    @classmethod
    def _sequence_of_class(cls) -> sa.ColumnElement[int]:
        # Literals, because PostgreSQL shifts by a 4-byte integer only and a parameter would be of 8 bytes.
        row: sa.ColumnElement[int] = getattr(cls, cls._row)
        shifted = row.bitwise_rshift(sa.literal_column(str(SLOT_MAX.bit_length())))
        return shifted.bitwise_and(sa.literal_column(str(SEQUENCE_MAX)))


@sa.event.listens_for(Base, "mapper_configured", propagate=True)
def _complete_mapping(mapper: orm.Mapper[Any], class_: type[Base]) -> None:
    """Let columns of subclasses be loaded in batches, guard attributes on request, and note the enum columns."""
    if mapper.inherits is not None:
        mapper.class_manager.expired_attribute_loader = load_columns
    for each in (*mapper.column_attrs, *mapper.relationships):
        if not each.key.startswith("_") and (_is_deferred(each) or each.info.get("on_request")):
            getattr(class_, each.key).__class__ = AttributeOnRequest
    kinds = {each.key: each.columns[0].type for each in mapper.column_attrs}
    mapper.class_manager.info[_ENUMS] = {key: kind for key, kind in kinds.items() if isinstance(kind, EnumName)}


def _is_deferred(attribute: Any) -> bool:
    return getattr(attribute, "deferred", False) is True


def require_loaded(row: Base, name: str, requested_by: Base | None = None, request: str | None = None) -> None:
    """Raise `CallerError` with the remedy if this attribute is not loaded and can only be loaded by awaiting it.

    The message names the object `requested_by` and the attribute `request`, if they differ from `row` and `name`.
    """
    if name in vars(row):
        return
    session = orm.object_session(row)
    if session is not None and (in_greenlet() or not session.get_bind().dialect.is_async):
        return
    named, attribute = requested_by or row, request or name.removeprefix("_")
    state, class_ = sa.inspect(named), type(named).__name__
    columns = state.mapper.column_attrs
    key, option = state.identity, "undefer" if {attribute, f"_{attribute}"} & {*columns.keys()} else "selectinload"
    raise CallerError(
        f"{attribute} of {class_} {key} is not loaded: in its session use `await row.awaitable_attrs.{attribute}`,"
        f" or select with `{option}({class_}.{attribute})`"
    )


ON_REQUEST: Final = {"on_request": True}
"""Marks a relationship that is loaded on request only, as deferred columns are."""


class AttributeOnRequest(orm.InstrumentedAttribute[Any]):
    """An attribute of a mapped class that raises `CallerError` if it is read without being loaded."""

    inherit_cache = True
    __slots__ = ()

    def __get__(self, instance: Any, owner: Any) -> Any:
        if instance is not None:
            require_loaded(instance, self.key)
        return super().__get__(instance, owner)


class HybridOf(hybrid_property[_Value]):
    """A private attribute under its public name, which a subclass may map a field of its own under.

    If it is loaded `on_request` only, reading it before it is loaded raises `CallerError`.
    """

    def __init__(self, name: str, *, on_request: bool = False) -> None:
        private = attrgetter(f"_{name}")

        def read(row: Any) -> Any:
            require_loaded(row, f"_{name}")
            return private(row)

        super().__init__(read if on_request else private, expr=private)
        self.__name__ = name

    if not TYPE_CHECKING:  # which takes the types from SQLAlchemy's own

        def __get__(self, instance: Any, owner: Any) -> Any:
            attribute = super().__get__(instance, owner)
            # `undefer` asks an attribute for its columns, which SQLAlchemy 2.1 cannot answer here.
            if instance is None:
                attribute._column_strategy_attrs = lambda: [getattr(owner, f"_{self.__name__}")]  # noqa: SLF001
            return attribute


# === batch loads ==============================================================================================
#
# Load an attribute of many objects at once, at the first access to one that is not loaded.
#
# A query for a base class, such as `select(Action)`, loads the columns of the base only, and no relationship. The first
# time that `arm` of one action is read, the columns of its class are loaded for up to `BATCH` objects of this class in
# the session, beginning with that one. A relationship such as `robot_state` is loaded in the same way. So a query for
# 25,000 actions loads only the attributes that are read, and reading one of each takes 50 queries, not 25,000.

BATCH = 500
"""Bounds the objects for which one query loads an attribute. SQLAlchemy passes as many keys to a query."""

KEYS = "primary_keys"
"""The parameter in which SQLAlchemy's loads and those of this module pass the ids."""


def load_related(state: orm.ORMExecuteState) -> None:
    """Load a relationship for further objects too, when SQLAlchemy loads it for one: a hook of a session.

    SQLAlchemy's own load follows, and takes the related rows from those that are loaded by then.
    """
    if not state.is_relationship_load:
        return
    loaded, path = state.lazy_loaded_from, state.loader_strategy_path
    if loaded is None or not path or not isinstance(path[-1], orm.RelationshipProperty):
        return
    related = path[-1]
    class_ = related.parent.class_
    peers = _peers(state.session, loaded, class_, related.key)
    if len(peers) > 1:
        _load(state.session, class_, peers, orm.load_only(_key(class_)), orm.selectinload(getattr(class_, related.key)))


def load_columns(state: orm.InstanceState[Any], toload: set[str], passive: Any) -> None:  # noqa: ARG001  SQLAlchemy's
    """Load columns of an object's class that the query for its base did not, and those of further such objects."""
    session = state.session
    if session is None:
        raise DetachedInstanceError(f"{sorted(toload)} of {state.class_.__name__} {state.identity} are not loaded")
    by_class: dict[Any, list[str]] = {}
    for key in sorted(toload.intersection(state.mapper.column_attrs.keys())):
        by_class.setdefault(state.mapper.column_attrs[key].parent.class_, []).append(key)
    for class_, keys in by_class.items():
        _load(
            session,
            class_,
            _peers(session, state, class_, *keys),
            orm.load_only(*(getattr(class_, key) for key in keys)),
        )
        if not state.dict.keys() >= set(keys):
            raise ObjectDeletedError(state)


def _peers(
    session: orm.Session, state: orm.InstanceState[Any], class_: type, *names: str
) -> list[orm.InstanceState[Any]]:
    """Return this object and those behind it in the session that lack one of these attributes, at most `BATCH`."""
    states = session.identity_map.all_states()
    position = states.index(state)
    peers = []
    for each in (*states[position:], *states[:position]):
        if issubclass(each.class_, class_) and any(name not in each.dict for name in names) and each.obj() is not None:
            peers.append(each)
            if len(peers) == BATCH:
                break
    return peers


def _load(session: orm.Session, class_: Any, states: list[orm.InstanceState[Any]], *options: Any) -> None:
    rows = [each.obj() for each in states]  # so that no row is collected, and made again, during the load
    keys = sorted({each.identity[0] for each in states if each.identity})
    statement = sa.select(class_).where(_key(class_).in_(sa.bindparam(KEYS, expanding=True))).options(*options)
    session.execute(statement, {KEYS: keys}).unique().all()
    del rows


def _key(class_: Any) -> Any:
    """Return the first attribute of the class's key: the id of its row, or of the row that it belongs to."""
    mapper: orm.Mapper[Any] = class_.__mapper__
    return getattr(class_, mapper.get_property_by_column(mapper.primary_key[0]).key)


# === known classes ============================================================================================
#
# Resolve the lineage of a designator's row to the nearest class that this process maps.


class KnownClasses:
    """Resolves lineages to mapped classes in one engine: the first name of a lineage that has a class wins.

    The names are types and tables. `own` maps those of one memory's generated classes to their identities.
    """

    def __init__(self) -> None:
        self.own: dict[str, str] = {}
        self._identities: dict[str, str] = {}
        self._size = -1

    def identity(self, lineage: str, mapped: Mapping[str, Any]) -> str:
        """Return the polymorphic identity for this lineage; its last name always has a class.

        `mapped` has all mapped classes by identity. Classes of another kind are skipped, because an author may map as
        an action a type that another process declares as a motion.
        """
        if self._size != len(mapped):  # a class was mapped since the last call
            self._identities.clear()
            self._size = len(mapped)
        identity = self._identities.get(lineage)
        if identity is None:
            tables = {mapper.local_table.name: key for key, mapper in list(mapped.items()) if "@" not in key}
            identities = {name: name for name in mapped} | tables | self.own
            *names, root = lineage.split(" ")
            candidates = (identities.get(each) for name in names for each in (name, table_name(name)))
            fitting = (each for each in candidates if each is not None and mapped[each].class_.__root__ == root)
            identity = self._identities[lineage] = next(fitting, root)
        return identity

    def adopt(self, own: Mapping[str, str]) -> None:
        """Replace the identities of generated classes in this engine."""
        self.own = dict(own)
        self._identities.clear()


def known_classes(dialect: sa.Dialect) -> KnownClasses:
    """Return the `KnownClasses` of the engine that this dialect belongs to, which owns them."""
    classes: KnownClasses = vars(dialect).setdefault("pycrorm_known_classes", KnownClasses())
    return classes
