"""From a designator class to its declaration: which fields it has, of which type, in which slot and column.

A field is every dataclass field that its constructor takes and whose name has no leading underscore. What cannot be a
column is refused here, by name, the first time the class is performed with a memory open.
"""

from __future__ import annotations

import dataclasses
import types
import typing
import weakref
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from enum import Enum
from typing import Any, NamedTuple

from pycrorm_async.errors import DeclarationRefused
from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.fields import column_name, fault_in_fields, fault_in_table, table_name
from pycrorm_async.events.happenings import DesignatorTypeDeclared, FieldDeclared, FieldType, ItemType
from pycrorm_async.events.ids import SLOT_FIRST_FIELD
from pycrorm_async.hooks.values import OBJECT_TYPES
from pycrorm_async.plan.designator import Designator
from pycrorm_async.world.pose import Pose

__all__ = ["DeclaredType", "Field", "Declarations", "declared_type"]


_OUR_PACKAGE = "pycrorm_async."
_TAKEN = "is {!r} already (set a class attribute `dtype` on one of them)"
_ALIASED = "was {!r} already (only one of them can have that alias)"


class Field(NamedTuple):
    """A declared field, the attribute path that leads to its value, and the enum class if it is one."""

    declared: FieldDeclared
    path: tuple[str, ...]
    enum: type[Enum] | None


class DeclaredType(NamedTuple):
    """A designator class as the memory knows it."""

    declaration: DesignatorTypeDeclared
    payload: bytes
    fingerprint: str
    fields: tuple[Field, ...]


class _Shape(NamedTuple):
    kind: FieldType
    optional: bool = False
    item: ItemType | None = None
    enum: type[Enum] | None = None
    nested: type | None = None


class Declarations:
    """The live designator classes of one memory. Two classes of one dtype are refused, with both paths."""

    def __init__(self) -> None:
        self._declared: weakref.WeakKeyDictionary[type, DeclaredType] = weakref.WeakKeyDictionary()
        self._classes: dict[str, weakref.ref[type]] = {}
        self._former: dict[str, weakref.ref[type]] = {}
        self._shapes: dict[str, dict[str, str]] = {}

    def of(self, designator: type[Designator], on_new: Callable[[DeclaredType], None]) -> DeclaredType:
        """The declaration of this class; `on_new` is called before the first time it is given out."""
        known = self._declared.get(designator)
        if known is not None:
            return known
        declared = declared_type(designator)
        self._refuse_contradiction(designator, declared)
        names = (declared.declaration.dtype, declared.declaration.table)
        self._refuse_taken(designator, self._classes, names, _TAKEN)
        former = declared.declaration.aliases
        self._refuse_taken(designator, self._former, former, _ALIASED)
        on_new(declared)
        self._classes |= dict.fromkeys(names, weakref.ref(designator))
        self._former |= dict.fromkeys(former, weakref.ref(designator))
        self._declared[designator] = declared
        self._shapes.setdefault(declared.declaration.dtype, {}).update(_shape_of(declared))
        return declared

    def _refuse_taken(
        self, designator: type, taken: Mapping[str, weakref.ref[type]], names: Sequence[str], reason: str
    ) -> None:
        for name in names:
            reference = taken.get(name)
            other = reference() if reference is not None else None
            if other is not None and _path(other) != _path(designator):
                raise DeclarationRefused(_path(designator), f"{_path(other)} {reason.format(name)}")

    def _refuse_contradiction(self, designator: type[Designator], declared: DeclaredType) -> None:
        """A class defined again, or one with the name of a built-in, must not give a field another type."""
        known = dict(self._shapes.get(declared.declaration.dtype, {}))
        if not designator.__module__.startswith(_OUR_PACKAGE):
            for other in _ours(designator.dtype):
                raise DeclarationRefused(
                    _path(designator), f"{_path(other)} is {other.dtype!r} already (set a class attribute `dtype`)"
                )
        for name, kind in _shape_of(declared).items():
            if known.setdefault(name, kind) != kind:
                raise DeclarationRefused(
                    _path(designator),
                    f"field {name!r} was {known[name]} before and is {kind} now (rename it, or set another dtype)",
                )


def _shape_of(declared: DeclaredType) -> dict[str, str]:
    """Each field's type, in words; a member of an enum is stored as text."""
    return {
        each.name: f"{'text' if each.type == 'enum' else each.type}{f' of {each.item}' if each.item else ''}"
        for each in declared.declaration.fields
    }


def _descendants(root: type) -> typing.Iterator[Any]:
    each: Any
    for each in root.__subclasses__():
        yield each
        yield from _descendants(each)


def declared_type(designator: type[Designator]) -> DeclaredType:
    """The declaration of one class. Raises `DeclarationRefused` naming class and field."""
    fields = tuple(_fields(designator))
    orm_class = vars(designator).get("orm_class")
    table = getattr(orm_class, "__tablename__", None) or table_name(designator.dtype)
    fault = (
        _fault_in_dtype(designator.dtype)
        or fault_in_table(table)
        or fault_in_fields([field.declared for field in fields])
    )
    if fault is not None:
        raise DeclarationRefused(_path(designator), fault)
    declaration = DesignatorTypeDeclared(
        kind=designator.kind,
        dtype=designator.dtype,
        table=table,
        concept=designator.concept,
        bases=_bases(designator),
        fields=tuple(field.declared for field in fields),
        aliases=_aliases(designator),
    )
    payload = encode(declaration)
    return DeclaredType(declaration, payload, fingerprint(payload), fields)


def _fault_in_dtype(dtype: str) -> str | None:
    """The name must work as one of a class and of a table; two underscores are kept for tables of a generation."""
    if not dtype.isidentifier() or "__" in dtype:
        return f"its dtype {dtype!r} is not a name (letters, digits and single underscores)"
    return None


def _bases(designator: type[Designator]) -> tuple[str, ...]:
    """dtypes of the recorded ancestors; the abstract roots of the plan layer are none."""
    return tuple(
        base.dtype
        for base in designator.__mro__[1:]
        if issubclass(base, Designator) and not getattr(base, "__abstractmethods__", None)
    )


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
    if _fault_in_dtype(alias) is not None:
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
        if other.__module__.startswith(_OUR_PACKAGE) and getattr(other, "dtype", None) == dtype:
            yield other


def _fields(designator: type) -> typing.Iterator[Field]:
    if "__dataclass_fields__" not in vars(designator) and vars(designator).get("__annotations__"):
        own = [name for name, kind in vars(designator)["__annotations__"].items() if "ClassVar" not in str(kind)]
        if own:
            raise DeclarationRefused(
                _path(designator), f"it has the field {own[0]!r} but is no dataclass (add @dataclass)"
            )
    slot = SLOT_FIRST_FIELD
    for name, path, shape in _flat(designator, designator, (), optional=False):
        yield Field(
            FieldDeclared(
                name=name,
                column=column_name(name, shape.kind),
                type=shape.kind,
                slot=slot,
                optional=shape.optional,
                enum=_path(shape.enum) if shape.enum is not None else None,
                item=shape.item,
            ),
            path,
            shape.enum,
        )
        slot += 1


def _flat(
    designator: type, owner: type, prefix: tuple[str, ...], *, optional: bool
) -> typing.Iterator[tuple[str, tuple[str, ...], _Shape]]:
    try:
        hints = typing.get_type_hints(owner, include_extras=False)
    except (NameError, TypeError, AttributeError) as error:
        raise DeclarationRefused(_path(designator), f"its field types cannot be read: {error}") from None
    for field in dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ():
        if not field.init or field.name.startswith("_"):
            continue
        path = (*prefix, field.name)
        name = "_".join(path)
        shape = _shape(hints[field.name])
        if shape is None:
            raise DeclarationRefused(
                _path(designator),
                f"field {name!r} has the type {_text(hints[field.name])}, which has no column: use int, float, str,"
                " bool, an Enum, an aware datetime, a Pose, an object designator, a dataclass of these, or a list or"
                " dict of these",
            )
        if shape.nested is not None:
            if len(path) > 8:
                raise DeclarationRefused(_path(designator), f"field {name!r} is nested more than 8 deep")
            yield from _flat(designator, shape.nested, path, optional=optional or shape.optional)
        else:
            yield name, path, shape._replace(optional=optional or shape.optional)


def _shape(hint: Any) -> _Shape | None:
    """What kind of field a type hint makes; None if none."""
    origin = typing.get_origin(hint)
    if isinstance(hint, typing.NewType):
        return _shape(hint.__supertype__)
    if origin in (typing.Union, types.UnionType):
        return _union(hint)
    if origin is typing.Literal:
        return _Shape("text") if all(isinstance(each, str) for each in typing.get_args(hint)) else None
    if origin is not None and isinstance(origin, type):
        return _container(origin, typing.get_args(hint))
    if isinstance(hint, type):
        return _plain(hint)
    return None


def _plain(kind: type) -> _Shape | None:
    if issubclass(kind, Enum):
        return _Shape("enum", enum=kind)
    for python, name in _SCALARS:
        if issubclass(kind, python):
            return _Shape(name)
    if issubclass(kind, OBJECT_TYPES):
        return _Shape("object")
    if dataclasses.is_dataclass(kind):
        return _Shape("text", nested=kind)
    return None


_SCALARS: tuple[tuple[type, FieldType], ...] = (
    (bool, "boolean"),
    (int, "integer"),
    (float, "real"),
    (str, "text"),
    (datetime, "datetime"),
    (Pose, "pose"),
)


def _union(hint: Any) -> _Shape | None:
    members = [each for each in typing.get_args(hint) if each is not type(None)]
    optional = len(members) < len(typing.get_args(hint))
    shapes = {shape._replace(optional=False) if shape else None for shape in map(_shape, members)}
    optional = optional or any(shape is not None and shape.optional for shape in map(_shape, members))
    if shapes == {_Shape("integer"), _Shape("real")}:
        shapes = {_Shape("real")}
    if len(shapes) != 1:
        return None
    shape = shapes.pop()
    return shape._replace(optional=optional) if shape is not None else None


def _container(origin: type, arguments: tuple[Any, ...]) -> _Shape | None:
    kind: FieldType
    if issubclass(origin, Mapping) and len(arguments) == 2:
        key = _shape(arguments[0])
        if key is None or key.kind not in ("text", "enum") or key.optional:
            return None
        kind, value = "dict", arguments[1]
    elif issubclass(origin, Sequence) and len({each for each in arguments if each is not Ellipsis}) == 1:
        kind, value = "list", arguments[0]
    else:
        return None
    item = _shape(value)
    if item is None or item.nested is not None or item.kind in ("list", "dict"):
        return None
    return _Shape(kind, item=typing.cast("ItemType", item.kind), enum=item.enum)


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _text(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)
