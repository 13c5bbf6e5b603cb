"""Derive the declaration of a designator class: its fields with their types, slots and columns.

Each parameter of the class (see `parameter_types`) becomes a field. A parameter that cannot be a column is omitted from
the declaration, and its values are recorded as missing. If the whole class cannot be declared, its nodes are recorded
without a type. In strict mode both cases raise `DeclarationRefused` the first time the class is performed.
"""

from __future__ import annotations

import dataclasses
import inspect
import typing
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from msgspec.structs import replace

from pycrorm_async.errors import DeclarationRefused
from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.fields import (
    column_name,
    fault_in_declaration,
    fault_in_dtype,
    fault_in_fields,
    fault_in_table,
    table_name,
)
from pycrorm_async.events.ids import SLOT_FIRST_FIELD
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import FieldDeclared
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.protocols import Performable
from pycrorm_async.recording.declarations.declared_type import DeclaredType, Field, Undeclared
from pycrorm_async.recording.declarations.known_types import KnownTypes
from pycrorm_async.recording.declarations.known_types import type_text as type_text_of
from pycrorm_async.recording.values.parameter_types import (
    OUR_PACKAGE,
    Parameter,
    Shape,
    Unresolved,
    parameters_of,
    shape_of,
    type_text,
    undecorated_fields,
)
from pycrorm_async.recording.values.texts import clean, cut, message_of

_NESTED_MAX = 8
"""Bounds the nesting of dataclasses in a parameter, so that a dataclass that contains itself ends."""
_REASON_MAX = 500
"""Bounds the characters of the reason why a field or class cannot be declared; reasons may quote a user's names."""
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
                field_types=self.known.fields_of(designator.dtype),
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
            for other in _built_in_classes(designator.dtype):
                return f"{_path(other)} already has the dtype {other.dtype!r} (set a class attribute `dtype`)"
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
    orm_class = vars(designator).get("orm_class")
    table = getattr(orm_class, "__tablename__", None) or table_name(designator.dtype)
    fault = fault_in_dtype(designator.dtype) or fault_in_table(table)
    if fault is not None:
        if strict:
            raise DeclarationRefused(_path(designator), fault)
        return _without_type(designator, fields, tuple(undeclared), fault)
    aliases, fault = _aliases_or_fault(designator, classes_by_alias or {})
    if strict and fault is not None:
        raise DeclarationRefused(_path(designator), fault)
    declaration = DesignatorTypeDeclared(
        kind=designator.kind,
        dtype=designator.dtype,
        table=table,
        concept=designator.concept,
        bases=_bases(designator),
        fields=tuple(field.declared for field in fields),
        aliases=aliases,
    )
    if (reason := fault_in_declaration(declaration)) is not None:
        if strict:
            raise DeclarationRefused(_path(designator), reason)
        return _without_type(designator, fields, tuple(undeclared), reason)
    payload = encode(declaration)
    return DeclaredType(designator.dtype, payload, fingerprint(payload), fields, declaration, tuple(undeclared), fault)


def _without_type(
    designator: type[Performable], fields: tuple[Field, ...], undeclared: tuple[Undeclared, ...], fault: str
) -> DeclaredType:
    """Build the record of a class that cannot be declared: its nodes keep their parameters, but have no type."""
    dtype = cut(clean(designator.dtype), _REASON_MAX)
    placeholder = DesignatorTypeDeclared(kind=designator.kind, dtype=dtype, table="")
    return DeclaredType(dtype, b"", "", fields, placeholder, undeclared, fault)


def _declarable_fields(
    designator: type, fields: list[Field], field_types: Mapping[str, str], undeclared: list[Undeclared], *, strict: bool
) -> typing.Iterator[Field]:
    """Yield the fields that can be columns of one table, each with its own slot; add the others to `undeclared`."""
    accepted: list[FieldDeclared] = []
    combined_fault = fault_in_fields([field.declared for field in fields])
    if strict and combined_fault is not None:
        raise DeclarationRefused(_path(designator), combined_fault)
    for field in fields:
        name, kind = field.declared.name, type_text_of(field.declared)
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
        base.dtype
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
    """Read the class attribute `aliases`, the former names of this type; a subclass does not inherit them."""
    aliases = vars(designator).get("aliases", ())
    if dataclasses.is_dataclass(designator) and "aliases" in {each.name for each in dataclasses.fields(designator)}:
        return ()
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
    if alias == designator.dtype:
        return "is its current dtype"
    if alias in _bases(designator):
        return "is the dtype of one of its base classes, which is another type"
    for other in _built_in_classes(alias):
        return f"is the dtype of {_path(other)}"
    return None


def _built_in_classes(dtype: str) -> typing.Iterator[type[Designator]]:
    for other in _descendants(Designator):
        if other.__module__.startswith(OUR_PACKAGE) and getattr(other, "dtype", None) == dtype:
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
                enum=_path(shape.enum) if shape.enum is not None else None,
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
) -> typing.Iterator[tuple[str, tuple[str, ...], Shape]]:
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
        f"has the type {type_text(parameter.hint)}, which has no column: use int, float, str, bool, an Enum, an aware"
        " datetime, a Pose, an object designator, a dataclass of these, or a list or dict of these"
    )


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
