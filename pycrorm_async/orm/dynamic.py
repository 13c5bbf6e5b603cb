"""Classes for types that have none: made from the declarations in a memory, and belonging to that memory alone.

    classes = DynamicClasses()
    united = unite(layout, payloads)
    classes.learn(united.accepted.values(), united.layout.renamed)
    classes.use_in(engine)                          # this engine's rows of SayingAction become SayingAction objects
    SayingAction = classes.of("SayingAction")
    classes.dispose()

Enum fields are names (text): the enum's class is not here. A type that descends from one with a class has the
attributes of both. Two memories may have different `SayingAction`s in one process: each class has an identity of its
own, and only the engines that use it know that identity.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from sqlalchemy import BigInteger, Boolean, Column, Double, ForeignKey, MetaData, Table, Text
from sqlalchemy.ext.asyncio import AsyncEngine
from sqlalchemy.orm import registry, relationship, synonym
from sqlalchemy.types import TypeEngine

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared, FieldType
from pycrorm_async.orm.base import Base, Pose
from pycrorm_async.orm.designators import Action, Designator, Language, Motion
from pycrorm_async.orm.objects import Object
from pycrorm_async.orm.types import Moment, known_classes

__all__ = ["DynamicClasses"]

_DEPTH_MAX = 32
"""Classes that one descends from: a question joins the views of all of them, and SQLite joins 64."""
_ROOTS: dict[str, type[Designator]] = {"action": Action, "motion": Motion, "language": Language}
_TYPES: dict[FieldType, TypeEngine[Any]] = {
    "integer": BigInteger(),
    "real": Double(),
    "text": Text(),
    "enum": Text(),
    "boolean": Boolean(),
    "datetime": Moment(),
}


class DynamicClasses:
    """The classes of one memory's own types. Used from one thread; `dispose` ends them."""

    def __init__(self) -> None:
        self._registry = registry()
        self._metadata = MetaData()
        self._classes: dict[str, type[Designator]] = {}
        self._fields: dict[str, set[str]] = {}
        self._engines: list[AsyncEngine] = []
        self._declared: dict[str, list[DesignatorTypeDeclared]] = {}
        self._renamed: dict[str, str] = {}

    def learn(
        self, declarations: Iterable[DesignatorTypeDeclared], renamed: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Makes classes for the declared types that have none, and gives known ones their new fields.

        Only what the tables accepted, all of it, in the order of its arrival: classes of what contradicts each other
        would make every question for a common base fail. `renamed` gives the present names of types that had others.
        """
        self._renamed = dict(renamed)
        self._declared = {}
        for each in declarations:
            self._declared.setdefault(self._present_name(each.dtype), []).append(each)
        grown = self._rename()
        for dtype in self._declared:
            if self._shared(dtype) is None:
                grown |= self._make(dtype)
        if grown:
            # A statement compiled before knows nothing of new classes and would meet them unfinished. The shared
            # mappers first: finished later, they would meet classes that are unmapped by then and not yet collected.
            Base.registry.configure()
            self._registry.configure(cascade=True)
            for engine in self._engines:
                self._introduce(engine)

    def use_in(self, engine: AsyncEngine) -> None:
        """Sessions of this engine make objects of these classes."""
        self._engines.append(engine)
        self._introduce(engine)

    def of(self, name: str | type) -> type[Designator]:
        """The mapped class of a dtype, a table or a designator class, built-in ones too. Raises `CallerError`."""
        wanted = getattr(name, "dtype", name.__name__) if isinstance(name, type) else name
        of_table = (dtype for dtype, known in self._declared.items() if any(each.table == wanted for each in known))
        for dtype in map(self._present_name, (wanted, *of_table)):
            found = self._classes.get(dtype) or self._shared(dtype)
            if found is not None:
                return found
        raise CallerError(f"this memory holds nothing of the type {wanted!r} (it holds: {', '.join(self._declared)})")

    def dispose(self) -> None:
        """Unmaps all of them: what is left of the objects are plain values. The shared classes forget them."""
        for engine in self._engines:
            known_classes(engine.dialect).adopt({})
            engine.sync_engine.clear_compiled_cache()
        self._engines.clear()
        identities = Designator.__mapper__.polymorphic_map
        for made in self._classes.values():
            identities.pop(made.__mapper__.polymorphic_identity, None)
        self._classes.clear()
        self._registry.dispose()
        # The shared mappers remember paths they ever loaded along, those through our classes too. What they remember
        # is made again when needed; SQLAlchemy itself forgets it this way whenever a subclass is mapped.
        for mapper in Base.registry.mappers:
            vars(mapper).pop("_path_registry", None)
            mapper._expire_memoizations()  # noqa: SLF001  there is no public way, and classes would never be freed

    # --- inside -----------------------------------------------------------------------------------------------

    def _present_name(self, dtype: str) -> str:
        return self._renamed.get(dtype, dtype)

    def _rename(self) -> bool:
        """Whether a class made before its type was renamed is that of the new name now."""
        moved = [(old, new) for old, new in self._renamed.items() if old in self._classes and new not in self._classes]
        for old, new in moved:
            if new not in self._classes:
                self._classes[new], self._fields[new] = self._classes.pop(old), self._fields.pop(old)
        return bool(moved)

    def _shared(self, dtype: str) -> type[Designator] | None:
        """The class every memory of this process shares, known by the type's name or one of its tables."""
        known = self._declared.get(dtype, [])
        wanted = {dtype, *(each.table for each in known)}
        for mapper in Designator.__mapper__.self_and_descendants:
            identity = str(mapper.polymorphic_identity)
            table = mapper.local_table
            assert isinstance(table, Table)
            fits = not known or _root(mapper.class_) is _ROOTS[known[0].kind]
            if fits and "@" not in identity and wanted & {identity, table.name}:
                return mapper.class_
        return None

    def _make(self, dtype: str, descendants: tuple[str, ...] = ()) -> bool:
        """Whether the class is new or has grown."""
        fields = [field for each in self._declared[dtype] for field in each.fields]
        known = self._classes.get(dtype)
        if known is not None:
            return self._add_fields(dtype, known, fields)
        declared = self._declared[dtype][-1]
        base = self._base(declared, (*descendants, dtype))
        table = Table(declared.table, self._metadata, Column("id", ForeignKey(base.__table__.c.id), primary_key=True))
        made = type(dtype, (base,), {"__abstract__": True, "__doc__": f"{dtype}, as it was declared."})
        identity = f"{dtype}@{id(self):x}"
        self._registry.map_imperatively(
            made,
            table,
            inherits=base.__mapper__,
            polymorphic_identity=identity,
            polymorphic_load="selectin",
        )
        self._classes[dtype] = made
        self._fields[dtype] = set()
        self._add_fields(dtype, made, fields)
        return True

    def _base(self, declared: DesignatorTypeDeclared, descendants: tuple[str, ...]) -> type[Designator]:
        """The class of the nearest type it descends from. One of another kind does not count, nor a descendant (two
        processes may have it the other way round)."""
        root = _ROOTS[declared.kind]
        for dtype in map(self._present_name, declared.bases):
            found = self._classes.get(dtype) or self._shared(dtype)
            if found is None and dtype in self._declared and dtype not in descendants and len(descendants) < _DEPTH_MAX:
                self._make(dtype, descendants)
                found = self._classes.get(dtype)
            if found is not None and _root(found) is root and len(found.__mro__) - len(root.__mro__) < _DEPTH_MAX:
                return found
        return root

    def _add_fields(self, dtype: str, made: type[Designator], fields: Iterable[FieldDeclared]) -> bool:
        present = self._fields[dtype]
        before = len(present)
        for field in fields:
            if field.name in present:
                continue
            present.add(field.name)
            if not made.__mapper__.has_property(field.name):  # a base's attribute shows the same value
                self._add_field(made, field)
        grown = len(present) > before
        if grown:
            for engine in self._engines:
                engine.sync_engine.clear_compiled_cache()
        return grown

    def _add_field(self, made: type[Designator], field: FieldDeclared) -> None:
        if field.type in ("list", "dict"):
            setattr(made, field.name, _entries(field))
            return
        mapper = made.__mapper__
        table = mapper.local_table
        assert isinstance(table, Table)
        if field.type in _TYPES:
            column = Column(field.column, _TYPES[field.type])
            table.append_column(column)
            mapper.add_property(field.name, column)
            return
        target = Pose if field.type == "pose" else Object
        column = Column(field.column, BigInteger(), ForeignKey(target.__table__.c.id))
        table.append_column(column)
        mapper.add_property(f"{field.name}_id", column)
        mapper.add_property(
            field.name,
            relationship(
                target,
                primaryjoin=column == target.__table__.c.id,
                foreign_keys=column,
                viewonly=True,
                lazy="selectin",
            ),
        )
        if not mapper.has_property(field.type):  # the first pose is also `pose`, the first object also `object`
            mapper.add_property(field.type, synonym(field.name))
            mapper.add_property(f"{field.type}_id", synonym(f"{field.name}_id"))

    def _introduce(self, engine: AsyncEngine) -> None:
        identities = {dtype: str(made.__mapper__.polymorphic_identity) for dtype, made in self._classes.items()}
        known_classes(engine.dialect).adopt(identities)


def _entries(field: FieldDeclared) -> property:
    """The values of a list field, or of a dict field by key."""
    read = Designator.mapping if field.type == "dict" else Designator.entries  # a field may have these names itself
    return property(lambda designator: read(designator, field.name))


def _root(made: type[Designator]) -> type[Designator]:
    """Which of the classes that are there always it is, or descends from."""
    for root in (Action, Motion, Language):
        if issubclass(made, root):
            return root
    return Designator
