"""Declare designator types: from a class of our own plan layer, or from names and types of fields."""

from __future__ import annotations

import inspect
import re
import typing
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

from msgspec.structs import replace

from pycrorm_async.errors import DeclarationRefused
from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.fields import (
    AcceptedFields,
    column_name,
    fault_in_declaration,
    fault_in_dtype,
    fault_in_fields,
    fault_in_table,
    table_name,
    without_reserved_names,
)
from pycrorm_async.events.ids import SLOT_FIRST_FIELD
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    FieldDeclared,
    FieldType,
    ItemType,
    ObjectReference,
    PoseValue,
)
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.task import Performable
from pycrorm_async.record.parameters import (
    OUR_PACKAGE,
    DeclaredType,
    Field,
    FieldShape,
    Parameter,
    Undeclared,
    Unresolved,
    hint_text,
    parameters_of,
    shape_of,
    undecorated_fields,
)
from pycrorm_async.record.values import clean, clean_repr, cut, message_of
from pycrorm_async.recorded_names import recorded_name

#
# Declare a designator type from the names and types of its fields, for an executive that has no class for it.
#
# A field with a reserved name is kept under `<field>_`, as that of a designator. One whose type contradicts a built-in
# type or an earlier declaration of the same dtype is kept under `<field>_<type>`, because one column cannot hold both.
# A type that cannot have its name gets the most similar one that it can have.

RecordedKind: TypeAlias = Literal["action", "motion", "language"]
FieldSpec: TypeAlias = FieldType | tuple[FieldType, ItemType] | type[Any]
"""`real`; `("list", "real")`; or a Python type: `float`, an `Enum` class, `list[float]`, `Pose`."""

_REASON_MAX = 500
"""Bounds the characters of the reason why a field or type cannot be declared; reasons may quote a user's names."""
_TYPES: frozenset[str] = frozenset(get_args(FieldType))
_WITHOUT_ITEMS = _TYPES - {"list", "dict"}
_ITEMS: frozenset[str] = frozenset(get_args(ItemType))


class Renamed(NamedTuple):
    """The name under which a field or type is recorded, and the reason why it is not its own."""

    name: str
    reason: str


class Declared(NamedTuple):
    """A declared type, the renamed fields by their own names, and the name of the type if it was renamed."""

    type: DeclaredType
    fields: dict[str, Renamed]
    dtype: Renamed | None


class PreparedType(NamedTuple):
    """A type that was derived ahead, and what was known of its table then (`KnownTypes.state_of`)."""

    declared: Declared
    state: tuple[str | None, int]


class _Named(NamedTuple):
    """A field under a name that it may have, and the reason why it is not its own; None if it is."""

    field: Field
    reason: str | None


def declare_type(
    kind: str,
    dtype: str,
    fields: Mapping[str, FieldSpec],
    known_types: KnownTypes,
    *,
    bases: Sequence[str] = (),
    concept: str | None = None,
    aliases: Sequence[str] = (),
) -> Declared:
    """Declare a type.

    A type that cannot be declared at all has no payload, and its `fault` states why. Of a built-in dtype, table, bases
    and concept are those of the built-in type.
    """
    own = cut(clean(str(dtype)), _REASON_MAX)
    dtype, table, fault = _dtype(own, kind, known_types)
    renamed = Renamed(dtype, fault) if fault is not None and dtype != own else None
    built_in = known_types.built_in(dtype)
    if built_in is not None:
        known_types.note_stored(built_in)
    accepted: list[Field] = []
    columns = AcceptedFields()
    undeclared: list[Undeclared] = []
    renamed_fields: dict[str, Renamed] = {}
    unreserved = _unreserved(fields)
    for name, spec in fields.items():
        named = _named(str(name), unreserved.get(str(name), str(name)), spec, known_types, table, columns)
        if isinstance(named, str):
            undeclared.append(Undeclared(clean(str(name)), (name,), cut(clean(named), _REASON_MAX)))
            continue
        accepted.append(named.field)
        columns.accept(named.field.declared)
        if named.reason is not None:
            renamed_fields[clean(str(name))] = Renamed(named.field.declared.name, clean(named.reason))
    declaration = DesignatorTypeDeclared(
        kind=kind,  # type: ignore[arg-type]  # checked below
        dtype=dtype,
        table=table,
        concept=cut(clean(concept), _REASON_MAX) if concept else (built_in.concept if built_in is not None else None),
        bases=tuple(bases) or (built_in.bases if built_in is not None else ()),
        fields=tuple(each.declared for each in accepted),
        aliases=tuple(aliases),
    )
    fault = (
        fault_in_declaration(declaration)
        or _fault_in_kind(declaration, built_in)
        or _fault_in_aliases(declaration, known_types)
    )
    if fault is not None:
        placeholder = DesignatorTypeDeclared(kind="action", dtype=own, table="")
        reason = cut(clean(fault), _REASON_MAX)
        undeclared_type = DeclaredType(own, b"", "", tuple(accepted), placeholder, tuple(undeclared), reason)
        return Declared(undeclared_type, renamed_fields, None)
    payload = encode(declaration)
    known_types.note(declaration)
    declared = DeclaredType(dtype, payload, fingerprint(payload), tuple(accepted), declaration, tuple(undeclared))
    return Declared(declared, renamed_fields, renamed)


def prepare_type(
    kind: str, dtype: str, fields: Mapping[str, FieldSpec], known_types: KnownTypes, *, bases: Sequence[str] = ()
) -> PreparedType | None:
    """Derive a type ahead, without noting it; None for one whose names depend on other tables than its own."""
    built_in = known_types.built_in(dtype)
    table = built_in.table if built_in is not None else table_name(dtype)
    declared = declare_type(kind, dtype, fields, known_types.copy_of(table), bases=bases)
    if declared.dtype is not None or not declared.type.payload:
        return None
    return PreparedType(declared, known_types.state_of(table))


def declare_prepared(prepared: PreparedType, known_types: KnownTypes) -> Declared | None:
    """Declare a prepared type; None if its table has got an owner or columns since it was prepared."""
    declaration = prepared.declared.type.declaration
    if known_types.state_of(declaration.table) != prepared.state:
        return None
    built_in = known_types.built_in(declaration.dtype)
    if built_in is not None:
        known_types.note_stored(built_in)
    known_types.note(declaration)
    return prepared.declared


def _dtype(own: str, kind: str, known_types: KnownTypes) -> tuple[str, str, str | None]:
    """Return the first name that the type may have, its table, and the reason why the name is not its own.

    If it may have none of them, the name is its own.
    """
    tables: list[str] = []
    first_fault: str | None = None
    for candidate in _dtype_candidates(own, kind):
        built_in = known_types.built_in(candidate)
        table = built_in.table if built_in is not None else table_name(candidate)
        tables.append(table)
        fault = fault_in_dtype(candidate) or fault_in_table(table) or known_types.fault_in_table(table, candidate)
        if fault is None:
            return candidate, table, first_fault
        first_fault = first_fault or cut(clean(fault), _REASON_MAX)
    return own, tables[0], first_fault


def _dtype_candidates(own: str, kind: str) -> Iterator[str]:
    yield own
    plain = re.sub(r"[\W_]+", "_", own).strip("_") or "Unnamed"
    if not plain.isidentifier():
        plain = f"{kind}_{plain}"
    yield plain
    yield f"{plain}{kind.title()}"


def _fault_in_kind(declaration: DesignatorTypeDeclared, built_in: DesignatorTypeDeclared | None) -> str | None:
    if built_in is None or built_in.kind == declaration.kind:
        return None
    return f"the built-in type {built_in.dtype} is a {built_in.kind}, not a {declaration.kind}"


def _fault_in_aliases(declaration: DesignatorTypeDeclared, known_types: KnownTypes) -> str | None:
    """Return the reason why the table of a former dtype cannot be this one's; None if it can."""
    for alias in declaration.aliases:
        for field in declaration.fields:
            reason = known_types.fault_in_field(field, table_name(alias))
            if reason is not None:
                return f"its alias {alias!r} does not fit: field {field.name!r}: {reason}"
    return None


def _unreserved(fields: Mapping[str, FieldSpec]) -> dict[str, str]:
    """Return the names that fields of a designator would have, by their own names."""
    shapes = {str(name): shape.kind for name, spec in fields.items() if (shape := _shape(spec)) is not None}
    own = [FieldDeclared(name, column_name(name, kind), kind, SLOT_FIRST_FIELD) for name, kind in shapes.items()]
    return {name: each.name for name, each in zip(shapes, without_reserved_names(own), strict=True)}


def _named(
    name: str, unreserved: str, spec: FieldSpec, known_types: KnownTypes, table: str, accepted: AcceptedFields
) -> _Named | str:
    """Return the field under the first name that it may have; the reason if it may have none."""
    shape = _shape(spec)
    if shape is None:
        return f"{clean_repr(spec)} is not a type of a field ({', '.join(sorted(_TYPES))}) and not a Python type of one"
    first_reason: str | None = None
    for candidate in _candidates(name, unreserved, shape, known_types.columns_of(table)):
        declared = FieldDeclared(
            name=candidate,
            column=column_name(candidate, shape.kind),
            type=shape.kind,
            slot=SLOT_FIRST_FIELD + accepted.count,
            optional=True,
            enum=recorded_name(shape.enum) if shape.enum is not None else None,
            item=shape.item,
        )
        reason = _fault_in_field(declared, accepted) or known_types.fault_in_field(declared, table)
        if reason is None:
            return _Named(Field(declared, (name,), shape.enum), first_reason if candidate != unreserved else None)
        first_reason = first_reason or reason
    return first_reason or "it has no name"


def _candidates(name: str, unreserved: str, shape: FieldShape, columns: Collection[str]) -> Iterator[str]:
    yield name
    if f"{name}_{shape.kind}".lower() not in columns:  # earlier versions kept a reserved name so
        yield unreserved
    plain = re.sub(r"\W+", "_", name).strip("_") or "field"
    if not plain.isidentifier():
        plain = f"field_{plain}"
    if plain != name:
        yield plain
    yield f"{plain}_{shape.kind}"


def _fault_in_field(field: FieldDeclared, accepted: AcceptedFields) -> str | None:
    if not field.name.isidentifier() or field.name.startswith("_"):
        return f"{cut(field.name, 100)!r} is not a valid field name"
    return accepted.fault_in(field)


def _shape(spec: object) -> FieldShape | None:
    """Return the field type of a spec; None if there is none."""
    if isinstance(spec, str):
        return FieldShape(spec) if spec in _WITHOUT_ITEMS else None  # type: ignore[arg-type]  # just checked
    if isinstance(spec, tuple) and len(spec) == 2 and spec[0] in ("list", "dict") and spec[1] in _ITEMS:
        return FieldShape(spec[0], item=spec[1])
    if isinstance(spec, type) and not isinstance(spec, Enum) and issubclass(spec, PoseValue | ObjectReference):
        return FieldShape("pose" if issubclass(spec, PoseValue) else "object")
    shape = shape_of(spec)
    return shape if shape is not None and shape.nested is None else None


# === known types ==============================================================================================
#
# `KnownTypes` holds the field types of all designator types that one memory has declared.

_COLUMNS_MAX = 500
"""Bounds the names of one table, below the columns that the databases allow."""


class KnownTypes:
    """The declared types of one memory. A field of one dtype has one type in all its declarations.

    Args:
        built_in: returns the declaration of the plan layer's own type with this dtype; None if it has none.
    """

    def __init__(self, built_in: Callable[[str], DesignatorTypeDeclared | None]) -> None:
        self._find_built_in = built_in
        self._built_in: dict[str, DesignatorTypeDeclared | None] = {}
        self._fields_by_dtype: dict[str, dict[str, str]] = {}
        self._tables: dict[str, str] = {}
        self._columns: dict[str, dict[str, FieldDeclared]] = {}

    def built_in(self, dtype: str) -> DesignatorTypeDeclared | None:
        """Return the declaration of the plan layer's own type with this dtype; None if it has none.

        Each answer is kept for the life of the memory, because finding that there is none searches all classes.
        """
        if dtype not in self._built_in:
            self._built_in[dtype] = self._find_built_in(dtype)
        return self._built_in[dtype]

    def fields_of(self, dtype: str) -> Mapping[str, str]:
        """Return the types of the fields of a dtype as this memory declared them, as `type_text` describes them."""
        return self._fields_by_dtype.get(dtype, {})

    def fault_in_table(self, table: str, dtype: str) -> str | None:
        """Return the reason why another type has this table; None if none has."""
        owner = self._tables.get(table.lower(), dtype)
        return f"the dtype {owner!r} already has the table {table!r}" if owner != dtype else None

    def fault_in_field(self, field: FieldDeclared, table: str) -> str | None:
        """Return the reason why this field cannot be a column of the table beside all declared ones; None if it can."""
        columns = self._columns.get(table.lower(), {})
        for name in (field.name.lower(), field.column.lower()):
            declared = columns.get(name, field)
            if (declared.name, type_text(declared)) != (field.name, type_text(field)):
                return f"its type is {type_text(field)}, but the table has {declared.name!r} as {type_text(declared)}"
        if len(columns) > _COLUMNS_MAX and field.name.lower() not in columns:
            return f"the table has {_COLUMNS_MAX} columns already"
        return None

    def columns_of(self, table: str) -> Collection[str]:
        """Return the names of the table's fields and columns, in lower case."""
        return self._columns.get(table.lower(), {})

    def state_of(self, table: str) -> tuple[str | None, int]:
        """Return the owner of a table and the number of its names; they change with each declaration that adds any."""
        return self._tables.get(table.lower()), len(self._columns.get(table.lower(), ()))

    def copy_of(self, table: str) -> KnownTypes:
        """Return a copy that knows this table alone."""
        copy, name = KnownTypes(self.built_in), table.lower()
        if (owner := self._tables.get(name)) is not None:
            copy._tables[name] = owner
        copy._columns[name] = dict(self._columns.get(name, {}))
        return copy

    def note(self, declaration: DesignatorTypeDeclared) -> None:
        """Note a declaration of this memory."""
        fields = ((each.name, type_text(each)) for each in declaration.fields)
        self._fields_by_dtype.setdefault(declaration.dtype, {}).update(fields)
        self.note_stored(declaration)

    def note_stored(self, declaration: DesignatorTypeDeclared) -> None:
        """Note a declaration, also of another process, whose table and columns the database has."""
        self._tables.setdefault(declaration.table.lower(), declaration.dtype)
        columns = self._columns.setdefault(declaration.table.lower(), {})
        for field in declaration.fields:
            columns.setdefault(field.name.lower(), field)
            columns.setdefault(field.column.lower(), field)


def type_text(field: FieldDeclared) -> str:
    """Describe a field's type; an enum counts as text, because its members are stored as text."""
    return f"{'text' if field.type == 'enum' else field.type}{f' of {field.item}' if field.item else ''}"


# === declaration ==============================================================================================
#
# Derive the declaration of a designator class: its fields with their types, slots and columns.
#
# Each parameter of the class (see `record.parameters`) becomes a field. A parameter that cannot be a column is omitted
# from the declaration, and its values are recorded as missing. If the whole class cannot be declared, its nodes are
# recorded without a type. In strict mode both cases raise `DeclarationRefused` the first time the class is performed.

_NESTED_MAX = 8
"""Bounds the nesting of dataclasses in a parameter, so that a dataclass that contains itself ends."""
_DTYPE_IN_USE = "already has the dtype or table {!r} (set a class attribute `dtype` on one of the two)"
_ALIAS_IN_USE = "already has the alias {!r} (only one class can have it)"


class Declarations:
    """Holds the declarations of all designator classes that one memory has recorded.

    Only one of two live classes with the same dtype is declared. `known` holds their fields for all executives.

    Args:
        strict: raise `DeclarationRefused` for a class or field that cannot be declared, instead of omitting it.
    """

    def __init__(self, *, strict: bool = True) -> None:
        self._strict = strict
        self.known = KnownTypes(built_in_declaration)
        self._declared: weakref.WeakKeyDictionary[type, DeclaredType] = weakref.WeakKeyDictionary()
        self._classes_by_name: dict[str, weakref.ref[type]] = {}
        self._classes_by_alias: dict[str, weakref.ref[type]] = {}

    def of(self, designator: type[Performable], on_new: Callable[[DeclaredType], None]) -> DeclaredType:
        """Return the declaration of a class; before returning it for the first time, call `on_new` with it."""
        cached = self._declared.get(designator)
        if cached is not None:
            return cached
        declared = self._new(designator)
        if declared.fingerprint:
            on_new(declared)
            declaration = declared.declaration
            self._classes_by_name |= dict.fromkeys((declaration.dtype, declaration.table), weakref.ref(designator))
            self._classes_by_alias |= dict.fromkeys(declaration.aliases, weakref.ref(designator))
            self.known.note(declaration)
        self._declared[designator] = declared
        return declared

    def _new(self, designator: type[Performable]) -> DeclaredType:
        try:
            declared = declared_type(
                designator,
                strict=self._strict,
                field_types=self.known.fields_of(designator.__dtype__),
                classes_by_alias=self._classes_by_alias,
            )
            fault = declared.fault or self._fault_in_names(designator, declared)
        except DeclarationRefused:
            raise
        except Exception as error:
            if self._strict:
                raise
            reason = f"its fields cannot be read: {type(error).__name__}: {message_of(error)}"
            return _without_type(designator, (), (), cut(clean(reason), _REASON_MAX))
        if fault is None or not declared.fingerprint:
            return declared
        if self._strict:
            raise DeclarationRefused(_path(designator), fault)
        return _without_type(designator, declared.fields, declared.undeclared, fault)

    def _fault_in_names(self, designator: type[Performable], declared: DeclaredType) -> str | None:
        """Return the reason why another live class already has the dtype or table name; None if none has."""
        if not designator.__module__.startswith(OUR_PACKAGE):
            for other in _built_in_classes(designator.__dtype__):
                return f"{_path(other)} already has the dtype {other.__dtype__!r} (set a class attribute `dtype`)"
        names = (declared.declaration.dtype, declared.declaration.table)
        return _conflict(designator, self._classes_by_name, names, _DTYPE_IN_USE)


def _conflict(
    designator: type, classes_by_name: Mapping[str, weakref.ref[type]], names: Sequence[str], reason: str
) -> str | None:
    for name in names:
        reference = classes_by_name.get(name)
        other = reference() if reference is not None else None
        if other is not None and _path(other) != _path(designator):
            return f"{_path(other)} {reason.format(name)}"
    return None


_built_in_declarations: dict[str, DesignatorTypeDeclared] = {}
"""Cache of derived declarations, by dtype; deriving one takes a millisecond."""


def built_in_declaration(dtype: str) -> DesignatorTypeDeclared | None:
    """Return the declaration of the plan layer's own type with this dtype; None if it has none."""
    if dtype not in _built_in_declarations:
        for designator in _built_in_classes(dtype):
            if not inspect.isabstract(designator):
                _built_in_declarations[dtype] = declared_type(designator, strict=False).declaration
    return _built_in_declarations.get(dtype)


def _descendants(root: type) -> typing.Iterator[Any]:
    each: Any
    for each in root.__subclasses__():
        yield each
        yield from _descendants(each)


def declared_type(
    designator: type[Performable],
    *,
    strict: bool = True,
    field_types: Mapping[str, str] | None = None,
    classes_by_alias: Mapping[str, weakref.ref[type]] | None = None,
) -> DeclaredType:
    """Derive the declaration of one class.

    Args:
        designator: the class.
        strict: raise `DeclarationRefused`, naming class and field, for a field or class that cannot be declared.
        field_types: field types of earlier classes with the same dtype; a field must not change its type.
        classes_by_alias: classes by the aliases they have; an alias belongs to one class.
    """
    undeclared: list[Undeclared] = []

    def leave_out(name: str, path: tuple[str, ...], reason: str) -> None:
        if strict:
            raise DeclarationRefused(_path(designator), f"field {name!r} {reason}")
        undeclared.append(Undeclared(name, path, cut(clean(reason), _REASON_MAX)))

    undecorated = undecorated_fields(designator)
    if strict and undecorated and not designator.__module__.startswith(OUR_PACKAGE):
        raise DeclarationRefused(
            _path(designator), f"it has the field {undecorated[0]!r} but is not a dataclass (add @dataclass)"
        )
    fields = tuple(
        _declarable_fields(
            designator, list(_fields(designator, leave_out)), field_types or {}, undeclared, strict=strict
        )
    )
    table = getattr(designator.__orm_class__, "__tablename__", None) or table_name(designator.__dtype__)
    fault = fault_in_dtype(designator.__dtype__) or fault_in_table(table)
    if fault is not None:
        if strict:
            raise DeclarationRefused(_path(designator), fault)
        return _without_type(designator, fields, tuple(undeclared), fault)
    aliases, fault = _aliases_or_fault(designator, classes_by_alias or {})
    if strict and fault is not None:
        raise DeclarationRefused(_path(designator), fault)
    declaration = DesignatorTypeDeclared(
        kind=designator.__kind__,
        dtype=designator.__dtype__,
        table=table,
        concept=designator.__concept__,
        bases=_bases(designator),
        fields=tuple(field.declared for field in fields),
        aliases=aliases,
    )
    if (reason := fault_in_declaration(declaration)) is not None:
        if strict:
            raise DeclarationRefused(_path(designator), reason)
        return _without_type(designator, fields, tuple(undeclared), reason)
    payload = encode(declaration)
    return DeclaredType(declaration.dtype, payload, fingerprint(payload), fields, declaration, tuple(undeclared), fault)


def _without_type(
    designator: type[Performable], fields: tuple[Field, ...], undeclared: tuple[Undeclared, ...], fault: str
) -> DeclaredType:
    """Build the record of a class that cannot be declared: its nodes keep their parameters, but have no type."""
    dtype = cut(clean(designator.__dtype__), _REASON_MAX)
    placeholder = DesignatorTypeDeclared(kind=designator.__kind__, dtype=dtype, table="")
    return DeclaredType(dtype, b"", "", fields, placeholder, undeclared, fault)


def _declarable_fields(
    designator: type, fields: list[Field], field_types: Mapping[str, str], undeclared: list[Undeclared], *, strict: bool
) -> typing.Iterator[Field]:
    """Yield the fields that can be columns of one table, each with its own slot; add the others to `undeclared`."""
    accepted: list[FieldDeclared] = []
    renamed = without_reserved_names(field.declared for field in fields)
    fields = [field._replace(declared=declared) for field, declared in zip(fields, renamed, strict=True)]
    combined_fault = fault_in_fields([field.declared for field in fields])
    if strict and combined_fault is not None:
        raise DeclarationRefused(_path(designator), combined_fault)
    for field in fields:
        name, kind = field.declared.name, type_text(field.declared)
        fault = fault_in_fields([*accepted, field.declared]) if combined_fault is not None else None
        if field_types.get(name, kind) != kind:
            fault = f"field {name!r} was {field_types[name]} before and is {kind} now (rename it, or set another dtype)"
        if fault is None:
            accepted.append(replace(field.declared, slot=SLOT_FIRST_FIELD + len(accepted)))
            yield field._replace(declared=accepted[-1])
        elif strict:
            raise DeclarationRefused(_path(designator), fault)
        else:
            undeclared.append(Undeclared(name, field.path, fault))


def _bases(designator: type[Performable]) -> tuple[str, ...]:
    """Return the dtypes of the base classes, nearest first, without the abstract roots of the plan layer."""
    return tuple(
        base.__dtype__
        for base in designator.__mro__[1:]
        if issubclass(base, Designator) and not getattr(base, "__abstractmethods__", None)
    )


def _aliases_or_fault(
    designator: type[Performable], classes_by_alias: Mapping[str, weakref.ref[type]]
) -> tuple[tuple[str, ...], str | None]:
    """Return the aliases of a class; if one of them is not allowed, return no aliases and the reason."""
    try:
        aliases = _aliases(designator)
    except DeclarationRefused as refused:
        return (), refused.reason
    fault = _conflict(designator, classes_by_alias, aliases, _ALIAS_IN_USE)
    return (aliases, None) if fault is None else ((), fault)


def _aliases(designator: type[Performable]) -> tuple[str, ...]:
    """Read the former names of this type; a subclass does not inherit them."""
    aliases = designator.__aliases__
    if not isinstance(aliases, tuple | list) or not all(isinstance(each, str) for each in aliases):
        raise DeclarationRefused(
            _path(designator), f"its aliases {aliases!r} are not a tuple of names such as ('OldAction',)"
        )
    for each in aliases:
        fault = _fault_in_alias(each, designator)
        if fault is not None:
            raise DeclarationRefused(_path(designator), f"its alias {each!r} {fault}")
    return tuple(aliases)


def _fault_in_alias(alias: str, designator: type[Performable]) -> str | None:
    if fault_in_dtype(alias) is not None:
        return "is not a name (letters, digits and single underscores)"
    if alias == designator.__dtype__:
        return "is its current dtype"
    if alias in _bases(designator):
        return "is the dtype of one of its base classes, which is another type"
    for other in _built_in_classes(alias):
        return f"is the dtype of {_path(other)}"
    return None


def _built_in_classes(dtype: str) -> typing.Iterator[type[Designator]]:
    for other in _descendants(Designator):
        if other.__module__.startswith(OUR_PACKAGE) and getattr(other, "__dtype__", None) == dtype:
            yield other


def _fields(designator: type, leave_out: Callable[[str, tuple[str, ...], str], None]) -> typing.Iterator[Field]:
    for name, path, shape in _flattened_parameters(designator, (), (), leave_out, optional=False):
        yield Field(
            FieldDeclared(
                name=name,
                column=column_name(name, shape.kind),
                type=shape.kind,
                slot=SLOT_FIRST_FIELD,
                optional=shape.optional,
                enum=recorded_name(shape.enum) if shape.enum is not None else None,
                item=shape.item,
            ),
            path,
            shape.enum,
        )


def _flattened_parameters(
    owner: type,
    outer: tuple[str, ...],
    prefix: tuple[str, ...],
    leave_out: Callable[[str, tuple[str, ...], str], None],
    *,
    optional: bool,
) -> typing.Iterator[tuple[str, tuple[str, ...], FieldShape]]:
    for each in parameters_of(owner):
        names, path = (*outer, each.name), (*prefix, *each.path)
        name = "_".join(names)
        shape = None if isinstance(each.hint, Unresolved) else shape_of(each.hint)
        if shape is None:
            leave_out(name, path, _without_column(each))
        elif shape.nested is None:
            yield name, path, shape._replace(optional=optional or shape.optional)
        elif len(names) > _NESTED_MAX:
            leave_out(name, path, f"is nested more than {_NESTED_MAX} deep")
        else:
            inner_optional = optional or shape.optional
            yield from _flattened_parameters(shape.nested, names, path, leave_out, optional=inner_optional)


def _without_column(parameter: Parameter) -> str:
    if isinstance(parameter.hint, Unresolved):
        return parameter.hint.reason
    return (
        f"has the type {hint_text(parameter.hint)}, which has no column: use int, float, str, bool, an Enum, an aware"
        " datetime, a Pose, an object designator, a dataclass of these, or a list or dict of these"
    )


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
