"""From a designator class to its declaration: which fields it has, of which type, in which slot and column.

Each parameter of the class (`parameter_types`) becomes a field. One that cannot be a column stays out of the
declaration, and its values are recorded as missing; where the class as a whole cannot be declared, its nodes are
recorded without a type. In strict mode both are refused by name instead, the first time the class is performed.
"""

from __future__ import annotations

import dataclasses
import typing
import weakref
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple

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
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared
from pycrorm_async.hooks.values.parameter_types import (
    OUR_PACKAGE,
    Parameter,
    Shape,
    Unresolved,
    bare_fields,
    in_words,
    parameters_of,
    shape_of,
)
from pycrorm_async.hooks.values.texts import clean, cut, message_of
from pycrorm_async.plan.designator import Designator

__all__ = ["DeclaredType", "Field", "Undeclared", "Declarations", "declared_type"]


_NESTED_MAX = 8
_REASON_MAX = 500
_TAKEN = "is {!r} already (set a class attribute `dtype` on one of them)"
_ALIASED = "was {!r} already (only one of them can have that alias)"


class Field(NamedTuple):
    """A declared field, the attribute path that leads to its value, and the enum class if it is one."""

    declared: FieldDeclared
    path: tuple[str, ...]
    enum: type[Enum] | None


class Undeclared(NamedTuple):
    """A field without a column, the attribute path that leads to its value, and why it has none."""

    name: str
    path: tuple[str, ...]
    reason: str


class DeclaredType(NamedTuple):
    """A designator class as the memory knows it.

    Attributes:
        fingerprint: of the payload; empty if the class cannot be declared.
        undeclared: fields whose values are recorded as missing.
        fault: why the class, or one of its aliases, cannot be declared.
    """

    dtype: str
    payload: bytes
    fingerprint: str
    fields: tuple[Field, ...]
    declaration: DesignatorTypeDeclared
    undeclared: tuple[Undeclared, ...] = ()
    fault: str | None = None


class Declarations:
    """The live designator classes of one memory. Two classes of one dtype are not both declared.

    Args:
        strict: refuse what cannot be declared, with `DeclarationRefused`, instead of leaving it out.
    """

    def __init__(self, *, strict: bool = True) -> None:
        self._strict = strict
        self._declared: weakref.WeakKeyDictionary[type, DeclaredType] = weakref.WeakKeyDictionary()
        self._classes: dict[str, weakref.ref[type]] = {}
        self._former: dict[str, weakref.ref[type]] = {}
        self._shapes: dict[str, dict[str, str]] = {}

    def of(self, designator: type[Designator], on_new: Callable[[DeclaredType], None]) -> DeclaredType:
        """The declaration of this class; `on_new` is called before the first time it is given out."""
        known = self._declared.get(designator)
        if known is not None:
            return known
        declared = self._new(designator)
        if declared.fingerprint:
            on_new(declared)
            declaration = declared.declaration
            self._classes |= dict.fromkeys((declaration.dtype, declaration.table), weakref.ref(designator))
            self._former |= dict.fromkeys(declaration.aliases, weakref.ref(designator))
            self._shapes.setdefault(declaration.dtype, {}).update(_shape_of(declared))
        self._declared[designator] = declared
        return declared

    def _new(self, designator: type[Designator]) -> DeclaredType:
        try:
            declared = declared_type(
                designator, strict=self._strict, shapes=self._shapes.get(designator.dtype, {}), former=self._former
            )
            fault = declared.fault or self._fault_in_names(designator, declared)
        except DeclarationRefused:
            raise
        except Exception as error:
            if self._strict:
                raise
            unread = f"its fields cannot be read: {type(error).__name__}: {message_of(error)}"
            return _without_type(designator, (), (), cut(clean(unread), _REASON_MAX))
        if fault is None or not declared.fingerprint:
            return declared
        if self._strict:
            raise DeclarationRefused(_path(designator), fault)
        return _without_type(designator, declared.fields, declared.undeclared, fault)

    def _fault_in_names(self, designator: type[Designator], declared: DeclaredType) -> str | None:
        """Which other live class has one of its names already."""
        if not designator.__module__.startswith(OUR_PACKAGE):
            for other in _ours(designator.dtype):
                return f"{_path(other)} is {other.dtype!r} already (set a class attribute `dtype`)"
        names = (declared.declaration.dtype, declared.declaration.table)
        return _taken(designator, self._classes, names, _TAKEN)


def _taken(designator: type, taken: Mapping[str, weakref.ref[type]], names: Sequence[str], reason: str) -> str | None:
    for name in names:
        reference = taken.get(name)
        other = reference() if reference is not None else None
        if other is not None and _path(other) != _path(designator):
            return f"{_path(other)} {reason.format(name)}"
    return None


def _shape_of(declared: DeclaredType) -> dict[str, str]:
    """Each field's type, in words; a member of an enum is stored as text."""
    return {each.name: _kind_of(each) for each in declared.declaration.fields}


def _kind_of(field: FieldDeclared) -> str:
    return f"{'text' if field.type == 'enum' else field.type}{f' of {field.item}' if field.item else ''}"


def _descendants(root: type) -> typing.Iterator[Any]:
    each: Any
    for each in root.__subclasses__():
        yield each
        yield from _descendants(each)


def declared_type(
    designator: type[Designator],
    *,
    strict: bool = True,
    shapes: Mapping[str, str] | None = None,
    former: Mapping[str, weakref.ref[type]] | None = None,
) -> DeclaredType:
    """The declaration of one class.

    Args:
        designator: the class.
        strict: raise `DeclarationRefused`, naming class and field, for what cannot be declared.
        shapes: types of the fields of earlier classes of its dtype, which must not change.
        former: classes by their aliases, of which each belongs to one class.
    """
    undeclared: list[Undeclared] = []

    def leave_out(name: str, path: tuple[str, ...], reason: str) -> None:
        if strict:
            raise DeclarationRefused(_path(designator), f"field {name!r} {reason}")
        undeclared.append(Undeclared(name, path, cut(clean(reason), _REASON_MAX)))

    bare = bare_fields(designator)
    if strict and bare and not designator.__module__.startswith(OUR_PACKAGE):
        raise DeclarationRefused(
            _path(designator), f"it has the field {bare[0]!r} but is no dataclass (add @dataclass)"
        )
    fields = tuple(_fitting(designator, list(_fields(designator, leave_out)), shapes or {}, undeclared, strict=strict))
    orm_class = vars(designator).get("orm_class")
    table = getattr(orm_class, "__tablename__", None) or table_name(designator.dtype)
    fault = fault_in_dtype(designator.dtype) or fault_in_table(table)
    if fault is not None:
        if strict:
            raise DeclarationRefused(_path(designator), fault)
        return _without_type(designator, fields, tuple(undeclared), fault)
    aliases, fault = _aliases_or_fault(designator, former or {})
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
    if (unfit := fault_in_declaration(declaration)) is not None:
        if strict:
            raise DeclarationRefused(_path(designator), unfit)
        return _without_type(designator, fields, tuple(undeclared), unfit)
    payload = encode(declaration)
    return DeclaredType(designator.dtype, payload, fingerprint(payload), fields, declaration, tuple(undeclared), fault)


def _without_type(
    designator: type[Designator], fields: tuple[Field, ...], undeclared: tuple[Undeclared, ...], fault: str
) -> DeclaredType:
    """For a class that cannot be declared: its nodes are recorded with their parameters, and without a type."""
    dtype = cut(clean(designator.dtype), _REASON_MAX)
    nothing = DesignatorTypeDeclared(kind=designator.kind, dtype=dtype, table="")
    return DeclaredType(dtype, b"", "", fields, nothing, undeclared, fault)


def _fitting(
    designator: type, fields: list[Field], shapes: Mapping[str, str], undeclared: list[Undeclared], *, strict: bool
) -> typing.Iterator[Field]:
    """Those that can be columns of one table, each in a slot of its own."""
    accepted: list[FieldDeclared] = []
    all_fit = fault_in_fields([field.declared for field in fields])
    if strict and all_fit is not None:
        raise DeclarationRefused(_path(designator), all_fit)
    for field in fields:
        name, kind = field.declared.name, _kind_of(field.declared)
        fault = fault_in_fields([*accepted, field.declared]) if all_fit is not None else None
        if shapes.get(name, kind) != kind:
            fault = f"field {name!r} was {shapes[name]} before and is {kind} now (rename it, or set another dtype)"
        if fault is None:
            accepted.append(replace(field.declared, slot=SLOT_FIRST_FIELD + len(accepted)))
            yield field._replace(declared=accepted[-1])
        elif strict:
            raise DeclarationRefused(_path(designator), fault)
        else:
            undeclared.append(Undeclared(name, field.path, fault))


def _bases(designator: type[Designator]) -> tuple[str, ...]:
    """dtypes of the recorded ancestors; the abstract roots of the plan layer are none."""
    return tuple(
        base.dtype
        for base in designator.__mro__[1:]
        if issubclass(base, Designator) and not getattr(base, "__abstractmethods__", None)
    )


def _aliases_or_fault(
    designator: type[Designator], former: Mapping[str, weakref.ref[type]]
) -> tuple[tuple[str, ...], str | None]:
    """Its aliases; none of them, and the reason, where one cannot be an alias."""
    try:
        aliases = _aliases(designator)
    except DeclarationRefused as refused:
        return (), refused.reason
    fault = _taken(designator, former, aliases, _ALIASED)
    return (aliases, None) if fault is None else ((), fault)


def _aliases(designator: type[Designator]) -> tuple[str, ...]:
    """The class attribute `aliases`: names that the type itself had before, so a subclass does not inherit them."""
    given = vars(designator).get("aliases", ())
    if dataclasses.is_dataclass(designator) and "aliases" in {each.name for each in dataclasses.fields(designator)}:
        return ()
    if not isinstance(given, tuple | list) or not all(isinstance(each, str) for each in given):
        raise DeclarationRefused(_path(designator), f"its aliases {given!r} are no tuple of names: ('OldAction',)")
    for each in given:
        fault = _fault_in_alias(each, designator)
        if fault is not None:
            raise DeclarationRefused(_path(designator), f"its alias {each!r} {fault}")
    return tuple(given)


def _fault_in_alias(alias: str, designator: type[Designator]) -> str | None:
    if fault_in_dtype(alias) is not None:
        return "is not a name (letters, digits and single underscores)"
    if alias == designator.dtype:
        return "is its present name"
    if alias in _bases(designator):
        return "is that of a class it descends from, which is another type"
    for other in _ours(alias):
        return f"is that of {_path(other)}"
    return None


def _ours(dtype: str) -> typing.Iterator[type[Designator]]:
    """The built-in classes of that name."""
    for other in _descendants(Designator):
        if other.__module__.startswith(OUR_PACKAGE) and getattr(other, "dtype", None) == dtype:
            yield other


def _fields(designator: type, leave_out: Callable[[str, tuple[str, ...], str], None]) -> typing.Iterator[Field]:
    for name, path, shape in _flat(designator, (), (), leave_out, optional=False):
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


def _flat(
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
            yield from _flat(shape.nested, names, path, leave_out, optional=inner_optional)


def _without_column(parameter: Parameter) -> str:
    if isinstance(parameter.hint, Unresolved):
        return parameter.hint.reason
    return (
        f"has the type {in_words(parameter.hint)}, which has no column: use int, float, str, bool, an Enum, an aware"
        " datetime, a Pose, an object designator, a dataclass of these, or a list or dict of these"
    )


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
