"""Generate mapped classes, for one memory, for the declared types that no class of this process maps.

    classes = DynamicClasses()
    united = unite(layout, payloads)
    classes.learn(united.accepted.values(), united.layout.renamed)
    classes.map()
    classes.use_in(engine)                          # its rows of type SayingAction are read as SayingAction objects
    SayingAction = classes.of("SayingAction")
    classes.dispose()

Enum fields are member names (text), because the enum's class may not be importable. A generated class inherits from the
class of its nearest base type. Two memories in one process may have different `SayingAction`s: each class has a
polymorphic identity of its own, and only the engines of its memory map rows to it. Their parameters are loaded with
their objects, because objects may outlive the memory, which unmaps their classes when it is closed.
"""

import itertools
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, Final
from weakref import WeakSet, ref

from sqlalchemy import BigInteger, Boolean, Column, Double, Engine, ForeignKey, MetaData, Table, Text, event
from sqlalchemy.ext.asyncio import AsyncEngine
from sqlalchemy.orm import ORMExecuteState, Session, registry, synonym
from sqlalchemy.types import TypeEngine

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared, FieldType
from pycrorm_async.orm.base import EPISODE, Base, UtcTime, inherited_from, known_classes, map_leaves, one_of
from pycrorm_async.orm.episodes import Pose
from pycrorm_async.orm.rows import Action, Designator, Language, Motion, Object

_DEPTH_MAX = 32
"""Bounds the ancestors of a class: a query joins the view of each, and SQLite joins at most 64 tables and views."""
_ROOTS: dict[str, type[Designator]] = {"action": Action, "motion": Motion, "language": Language}
_TYPES: dict[FieldType, TypeEngine[Any]] = {
    "integer": BigInteger(),
    "real": Double(),
    "text": Text(),
    "enum": Text(),
    "boolean": Boolean(),
    "datetime": UtcTime(),
}
_OWNER: Final = "pycrorm_classes"
"""The key of a reference to the `DynamicClasses` in the metadata of its tables."""
_numbers: Final = itertools.count(1)
"""Numbers the memories of this process, so that their classes of one name have different identities."""


class DynamicClasses:
    """The generated classes of one memory, until `dispose`. Not thread-safe."""

    def __init__(self) -> None:
        # Not `id(self)`: it is used again when a memory that was never closed, and unmapped no class, is collected.
        self._number = next(_numbers)
        self._metadata = MetaData(info={_OWNER: ref(self)})
        self._registry = registry(metadata=self._metadata)
        self._classes: dict[str, type[Designator]] = {}
        self._fields: dict[str, set[str]] = {}
        self._engines: WeakSet[Engine] = WeakSet()
        self._declared: dict[str, list[DesignatorTypeDeclared]] = {}
        self._renamed: dict[str, str] = {}
        self._unmapped: tuple[list[DesignatorTypeDeclared], dict[str, str]] | None = None
        if not event.contains(Session, "do_orm_execute", _use_in_own_engine):
            event.listen(Session, "do_orm_execute", _use_in_own_engine)

    def learn(
        self, declarations: Iterable[DesignatorTypeDeclared], renamed: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Take note of the declared types, for which `map` generates classes.

        Pass all declarations for which the memory has tables, in the order of their declaration, and no others: a class
        without tables would make every query of its base fail. `renamed` maps former names of types to present ones.
        """
        self._unmapped = list(declarations), dict(renamed)

    def map(self) -> None:
        """Generate classes for declared types without one, and add new fields to classes generated before.

        Call it before each query. It is apart from `learn` because a class takes 10 ms, and a program that only records
        needs none.
        """
        if self._unmapped is None:
            return
        (declarations, self._renamed), self._unmapped = self._unmapped, None
        self._declared = {}
        for each in declarations:
            self._declared.setdefault(self._present_name(each.dtype), []).append(each)
        grown = self._rename()
        for dtype in self._declared:
            if self._shared(dtype) is None:
                grown |= self._make(dtype)
        if grown:
            # Configure now, because a cached statement would meet the new mappers unconfigured. Shared mappers come
            # first: configured later, they would meet classes that are disposed of but not yet garbage collected.
            Base.registry.configure()
            self._registry.configure(cascade=True)
            for engine in self._engines:
                self._introduce(engine)

    @property
    def present_names(self) -> dict[str, str]:
        """The present name of each type, by all its names."""
        self.map()
        return {each: each for each in self._declared} | self._renamed

    def use_in(self, engine: AsyncEngine | Engine) -> None:
        """Let sessions of this engine return objects of these classes."""
        own = engine.sync_engine if isinstance(engine, AsyncEngine) else engine
        self._engines.add(own)
        self._introduce(own)

    def of(self, name: str | type) -> type[Designator]:
        """Return the mapped class of a dtype, a table or a designator class, also built-in. Raises `CallerError`."""
        self.map()
        wanted: str = name if isinstance(name, str) else name.__name__
        for attribute in ("dtype", "__dtype__") if isinstance(name, type) else ():
            wanted = getattr(name, attribute, wanted)
        of_table = (
            dtype
            for dtype, declarations in self._declared.items()
            if any(each.table == wanted for each in declarations)
        )
        for dtype in map(self._present_name, (wanted, *of_table)):
            mapped = self._classes.get(dtype) or self._shared(dtype)
            if mapped is not None:
                return mapped
        raise CallerError(f"this memory has no type {wanted!r} (its types: {', '.join(self._declared)})")

    def dispose(self) -> None:
        """Unmap all generated classes; existing objects keep plain values. Shared classes drop references to them."""
        self._unmapped = None
        for engine in self._engines:
            known_classes(engine.dialect).adopt({})
            engine.clear_compiled_cache()
        self._engines.clear()
        identities = Designator.__mapper__.polymorphic_map
        for class_ in self._classes.values():
            identities.pop(class_.__mapper__.polymorphic_identity, None)
        self._classes.clear()
        # Shared mappers cache their loading paths, also those through generated classes, which keeps the classes alive.
        # The caches are rebuilt when needed; SQLAlchemy clears them in the same way when a subclass is mapped. A loader
        # option that a program keeps refers to the cache itself, so the cache is emptied and not only replaced.
        for mapper in Base.registry.mappers:
            if (paths := vars(mapper).get("_path_registry")) is not None:
                paths._cache.clear()  # noqa: SLF001  as below
            mapper._expire_memoizations()  # noqa: SLF001  there is no public way, and classes would never be freed

    # --- generating classes -----------------------------------------------------------------------------------

    def _present_name(self, dtype: str) -> str:
        return self._renamed.get(dtype, dtype)

    def _rename(self) -> bool:
        """Move generated classes to the new names of their types; return whether any was moved."""
        before = set(self._classes)
        for old, new in self._renamed.items():
            if old in self._classes and new not in self._classes:
                self._classes[new], self._fields[new] = self._classes.pop(old), self._fields.pop(old)
        return before != set(self._classes)

    def _shared(self, dtype: str) -> type[Designator] | None:
        """Return the class that all memories of this process share, by the type's name or one of its tables."""
        map_leaves()
        declarations = self._declared.get(dtype, [])
        wanted = {dtype, *(each.table for each in declarations)}
        for mapper in Designator.__mapper__.self_and_descendants:
            identity = str(mapper.polymorphic_identity)
            table = mapper.local_table
            assert isinstance(table, Table)
            fits = not declarations or mapper.class_.__root__ == declarations[0].kind.title()
            if fits and "@" not in identity and wanted & {identity, table.name}:
                return mapper.class_
        return None

    def _make(self, dtype: str, descendants: tuple[str, ...] = ()) -> bool:
        """Generate the class, or add its new fields; return whether anything was added."""
        fields = [field for each in self._declared[dtype] for field in each.fields]
        existing = self._classes.get(dtype)
        if existing is not None:
            return self._add_fields(dtype, existing, fields)
        declared = self._declared[dtype][-1]
        base = self._base(declared, (*descendants, dtype))
        table = Table(
            declared.table,
            self._metadata,
            Column("id", ForeignKey(base.__table__.c.id), primary_key=True),
            Column(EPISODE, BigInteger()),
        )
        class_ = type(dtype, (base,), {"__abstract__": True, "__doc__": f"{dtype}, as it was declared."})
        identity = f"{dtype}@{self._number}"
        self._registry.map_imperatively(
            class_,
            table,
            inherits=base.__mapper__,
            **inherited_from(base, table),
            polymorphic_identity=identity,
            polymorphic_load="selectin",
        )
        self._classes[dtype] = class_
        self._fields[dtype] = set()
        self._add_fields(dtype, class_, fields)
        return True

    def _base(self, declared: DesignatorTypeDeclared, descendants: tuple[str, ...]) -> type[Designator]:
        """Return the class of the nearest base of the same kind. Descendants are skipped, because two processes may
        declare the inheritance in opposite directions."""
        root = _ROOTS[declared.kind]
        for dtype in map(self._present_name, declared.bases):
            base = self._classes.get(dtype) or self._shared(dtype)
            if base is None and dtype in self._declared and dtype not in descendants and len(descendants) < _DEPTH_MAX:
                self._make(dtype, descendants)
                base = self._classes.get(dtype)
            if (
                base is not None
                and base.__root__ == root.__root__
                and len(base.__mro__) - len(root.__mro__) < _DEPTH_MAX
            ):
                return base
        return root

    def _add_fields(self, dtype: str, class_: type[Designator], fields: Iterable[FieldDeclared]) -> bool:
        added = [each for each in fields if each.name not in self._fields[dtype]]
        for field in added:
            if not class_.__mapper__.has_property(field.name):  # a base's attribute has the same value
                self._add_field(class_, field)
        self._fields[dtype] |= {each.name for each in added}
        for engine in self._engines if added else ():
            engine.clear_compiled_cache()
        return bool(added)

    def _add_field(self, class_: type[Designator], field: FieldDeclared) -> None:
        if field.type in ("list", "dict"):
            # A field may have the names of these methods itself.
            read = Designator.mapping if field.type == "dict" else Designator.entries
            setattr(class_, field.name, property(lambda designator: read(designator, field.name)))
            return
        mapper = class_.__mapper__
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
        reference = f"{field.name}_id"
        related = one_of(lambda: getattr(class_, reference), target.__tablename__, target, lazy="selectin")
        mapper.add_property(field.name, related)
        for name, own in ((field.type, field.name), (f"{field.type}_id", reference)):
            if not mapper.has_property(name):  # the first pose is also `pose`, the first object also `object`
                mapper.add_property(name, synonym(own))

    def _introduce(self, engine: Engine) -> None:
        identities = {dtype: str(class_.__mapper__.polymorphic_identity) for dtype, class_ in self._classes.items()}
        known_classes(engine.dialect).adopt(identities)


def _use_in_own_engine(state: ORMExecuteState) -> None:
    """Let an engine of the caller's own return objects of the memory whose generated class a session selects."""
    for mapper in state.all_mappers:
        owner = mapper.registry.metadata.info.get(_OWNER)
        classes: DynamicClasses | None = owner() if owner is not None else None
        if classes is not None:
            engine = state.session.get_bind(mapper).engine
            if not known_classes(engine.dialect).own:  # else it is the engine of a memory, or known already
                classes.use_in(engine)
