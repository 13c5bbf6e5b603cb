"""Derive the declaration of a designator class of our own plan layer: its fields with their types, slots and columns.

The parameters of a dataclass are the fields that its constructor accepts, except those with a leading underscore. The
parameters of any other user class are its annotated attributes and the arguments of its `__init__`
(`plan.field_types` keeps their values). If a type cannot be resolved, only that one parameter has no column, and its
values are recorded as missing. If the whole class cannot be declared, its nodes are recorded without a type. In strict
mode both cases raise `DeclarationRefused` the first time the class is performed.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
import types
import typing
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

from pycrorm_async.errors import DeclarationRefused
from pycrorm_async.events.fields import fault_in_dtype, table_name
from pycrorm_async.events.types import DesignatorTypeDeclared, FieldDeclared
from pycrorm_async.plan.field_types import ARGUMENTS
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.task import Performable
from pycrorm_async.record import declarations
from pycrorm_async.record.values import message_of

OUR_PACKAGE = "pycrorm_async."
_NESTED_MAX = 8
"""Bounds the nesting of dataclasses in a parameter, so that a dataclass that contains itself ends."""
_DTYPE_IN_USE = "already has the dtype or table {!r} (set a class attribute `dtype` on one of the two)"
_ALIAS_IN_USE = "already has the alias {!r} (only one class can have it)"


class Declarations:
    """Holds the declarations of all designator classes that one memory has recorded.

    Only one of two live classes with the same dtype is declared.

    Args:
        known: holds the types of the memory, for all executives.
        strict: raise `DeclarationRefused` for a class or field that cannot be declared, instead of omitting it.
    """

    def __init__(self, known: declarations.KnownTypes, *, strict: bool = True) -> None:
        self._strict = strict
        self._known = known
        self.declared: weakref.WeakKeyDictionary[type, declarations.DeclaredType] = weakref.WeakKeyDictionary()
        self._classes_by_name: dict[str, weakref.ref[type]] = {}
        self._classes_by_alias: dict[str, weakref.ref[type]] = {}

    def of(
        self, designator: type[Performable], on_new: Callable[[declarations.Declared], None]
    ) -> declarations.DeclaredType:
        """Return the declaration of a class; before returning it for the first time, call `on_new` with it."""
        cached = self.declared.get(designator)
        if cached is not None:
            return cached
        declared = self._new(designator)
        if declared.type.fingerprint:
            on_new(declared)
            declaration = declared.type.declaration
            self._classes_by_name |= dict.fromkeys((declaration.dtype, declaration.table), weakref.ref(designator))
            self._classes_by_alias |= dict.fromkeys(declaration.aliases, weakref.ref(designator))
            self._known.note(declaration)
        self.declared[designator] = declared.type
        return declared.type

    def _new(self, designator: type[Performable]) -> declarations.Declared:
        try:
            declared = _declared(
                designator,
                strict=self._strict,
                field_types=self._known.fields_of(designator.__dtype__),
                classes_by_alias=self._classes_by_alias,
            )
            kept = declared.type
            fault = self._fault_in_names(designator, kept) if kept.fingerprint else None
        except DeclarationRefused:
            raise
        except Exception as error:
            if self._strict:
                raise
            fault = f"its fields cannot be read: {type(error).__name__}: {message_of(error)}"
            return declarations.Declared(
                declarations.without_type(designator.__kind__, designator.__dtype__, fault), {}
            )
        if fault is None:
            return declared
        if self._strict:
            raise DeclarationRefused(_path(designator), fault)
        return declarations.Declared(
            declarations.without_type(designator.__kind__, designator.__dtype__, fault, kept.fields), {}
        )

    def _fault_in_names(self, designator: type[Performable], declared: declarations.DeclaredType) -> str | None:
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


def _descendants(root: type) -> Iterator[Any]:
    each: Any
    for each in root.__subclasses__():
        yield each
        yield from _descendants(each)


def declared_type(designator: type[Performable], *, strict: bool = True) -> declarations.DeclaredType:
    """Derive the declaration of one class.

    With `strict`, raises `DeclarationRefused`, naming class and field, for a field or class that cannot be declared.
    """
    return _declared(designator, strict=strict, field_types={}, classes_by_alias={}).type


def _declared(
    designator: type[Performable],
    *,
    strict: bool,
    field_types: Mapping[str, str],
    classes_by_alias: Mapping[str, weakref.ref[type]],
) -> declarations.Declared:
    """Derive the declaration of one class.

    Args:
        field_types: field types of earlier classes with the same dtype; a field must not change its type.
        classes_by_alias: classes by the aliases they have; an alias belongs to one class.
    """

    def contradiction(field: FieldDeclared) -> str | None:
        now = declarations.type_text(field)
        before = field_types.get(field.name, now)
        if before == now:
            return None
        return f"field {field.name!r} was {before} before and is {now} now (rename it, or set another dtype)"

    own = list(_own_fields(designator, (), (), optional=False))
    aliases, fault = _aliases_or_fault(designator, classes_by_alias)
    declared = declarations.declare(
        designator.__kind__,
        designator.__dtype__,
        own,
        contradiction=contradiction,
        table=getattr(designator.__orm_class__, "__tablename__", None) or table_name(designator.__dtype__),
        concept=designator.__concept__,
        bases=_bases(designator),
        aliases=aliases,
    )
    if strict and (refusal := _refusal(designator, own, declared) or fault) is not None:
        raise DeclarationRefused(_path(designator), refusal)
    if fault is not None and declared.type.fault is None:
        return declared._replace(type=declared.type._replace(fault=fault))
    return declared


def _refusal(designator: type, own: Sequence[declarations.OwnField], declared: declarations.Declared) -> str | None:
    """Return the first reason why a class is not declared as it is written; None if it is."""
    undecorated = undecorated_fields(designator)
    if undecorated and not designator.__module__.startswith(OUR_PACKAGE):
        return f"it has the field {undecorated[0]!r} but is not a dataclass (add @dataclass)"
    for each in own:
        if each.shape is None:
            return f"field {each.name!r} {each.reason}"
    reasons = (*declared.type.undeclared.values(), *(each.reason for each in declared.fields.values()))
    return next(iter(reasons), declared.type.fault)


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
    """Return the former names of a type, which a subclass does not inherit; none if one is not allowed, and why."""
    aliases = designator.__aliases__
    if not isinstance(aliases, tuple | list) or not all(isinstance(each, str) for each in aliases):
        return (), f"its aliases {aliases!r} are not a tuple of names such as ('OldAction',)"
    for each in aliases:
        if (fault := _fault_in_alias(each, designator)) is not None:
            return (), f"its alias {each!r} {fault}"
    fault = _conflict(designator, classes_by_alias, aliases, _ALIAS_IN_USE)
    return (tuple(aliases), None) if fault is None else ((), fault)


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


def _built_in_classes(dtype: str) -> Iterator[type[Designator]]:
    for other in _descendants(Designator):
        if other.__module__.startswith(OUR_PACKAGE) and getattr(other, "__dtype__", None) == dtype:
            yield other


def _own_fields(
    owner: type, outer: tuple[str, ...], prefix: tuple[str, ...], *, optional: bool
) -> Iterator[declarations.OwnField]:
    """Yield the parameters of a class; those of a nested dataclass take the place of the parameter."""
    for each in parameters_of(owner):
        names, path = (*outer, each.name), (*prefix, *each.path)
        name, read = "_".join(names), attrgetter(".".join(path))
        shape = None if isinstance(each.hint, Unresolved) else declarations.shape_of(each.hint)
        if shape is None:
            yield declarations.OwnField(name, read, None, _without_column(each), path)
        elif shape.nested is None:
            yield declarations.OwnField(name, read, shape._replace(optional=optional or shape.optional), path=path)
        elif len(names) > _NESTED_MAX:
            yield declarations.OwnField(name, read, None, f"is nested more than {_NESTED_MAX} deep", path)
        else:
            yield from _own_fields(shape.nested, names, path, optional=optional or shape.optional)


def _without_column(parameter: Parameter) -> str:
    if isinstance(parameter.hint, Unresolved):
        return parameter.hint.reason
    hint = parameter.hint
    text = hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)
    return (
        f"has the type {text}, which has no column: use int, float, str, bool, an Enum, an aware"
        " datetime, a Pose, an object designator, a dataclass of these, or a list or dict of these"
    )


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


# === parameters of a class ====================================================================================


class Unresolved(NamedTuple):
    """The substitute for a parameter's type if the parameter has none or the type cannot be resolved."""

    reason: str


class Parameter(NamedTuple):
    """A parameter, the attribute path from the designator that leads to its value, and its type."""

    name: str
    path: tuple[str, ...]
    hint: Any


def parameters_of(owner: type) -> Iterator[Parameter]:
    """Yield the parameters of a designator class, or the fields of a dataclass nested in its parameters."""
    names: set[str] = set()
    for field in dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ():
        names.add(field.name)
        if field.init and not field.name.startswith("_"):
            yield Parameter(field.name, (field.name,), _class_hint(owner, field.name))
    for kind in reversed(owner.__mro__):
        for each in _parameters_without_decorator(kind):
            if each.name not in names:
                names.add(each.name)
                yield each


def undecorated_fields(owner: type) -> list[str]:
    """List the annotated attributes of a class that lacks the `@dataclass` decorator; empty for a dataclass."""
    if "__dataclass_fields__" in vars(owner):
        return []
    annotations = vars(owner).get("__annotations__", {})
    return [name for name, kind in annotations.items() if "ClassVar" not in str(kind)]


def _parameters_without_decorator(kind: type) -> Iterator[Parameter]:
    """Yield the parameters that one class without `@dataclass` adds: its annotated attributes, then its arguments."""
    own = vars(kind)
    if not issubclass(kind, Designator) or kind.__module__.startswith(OUR_PACKAGE) or "__dataclass_fields__" in own:
        return
    for name in undecorated_fields(kind):
        if not name.startswith("_"):
            yield Parameter(name, (name,), _class_hint(kind, name))
    initialise = own.get("__init__")
    if not inspect.isfunction(initialise):
        return
    _, *arguments = inspect.signature(initialise).parameters.values()
    base_takes_options = any(True for base in kind.__mro__[1:] for _ in _own_parameters(base))
    for each in arguments:
        is_untyped = each.annotation in (each.empty, Any, "Any")
        is_passed_on = each.kind is each.VAR_KEYWORD and is_untyped and base_takes_options
        if not each.name.startswith("_") and not is_passed_on:
            yield Parameter(each.name, (ARGUMENTS, each.name), _argument_hint(inspect.unwrap(initialise), each))


def _own_parameters(kind: type) -> Iterator[object]:
    if "__dataclass_fields__" in vars(kind):
        yield from dataclasses.fields(kind)
    else:
        yield from _parameters_without_decorator(kind)


def _argument_hint(initialise: Any, argument: inspect.Parameter) -> Any:
    if argument.annotation is argument.empty:
        return Unresolved(f"has no type: annotate it in `__init__`, for example `{argument.name}: str`")
    hint = _resolved(argument.annotation, initialise.__globals__, {})
    if isinstance(hint, Unresolved):
        return hint
    if argument.kind is argument.VAR_POSITIONAL:
        return list[hint]  # type: ignore[valid-type]  # made for this argument
    return dict[str, hint] if argument.kind is argument.VAR_KEYWORD else hint  # type: ignore[valid-type]


def _class_hint(owner: type, name: str) -> Any:
    for kind in owner.__mro__:
        annotations = vars(kind).get("__annotations__", {})
        if name in annotations:
            module = sys.modules.get(kind.__module__)
            return _resolved(annotations[name], vars(module) if module is not None else {}, dict(vars(kind)))
    return Unresolved("has no type")


def _resolved(annotation: Any, globals_: Mapping[str, Any], locals_: Mapping[str, Any]) -> Any:
    """Resolve one annotation alone, so that a faulty annotation of another parameter does not affect it."""
    holder = types.SimpleNamespace(__annotations__={"it": annotation})
    try:
        return typing.get_type_hints(holder, dict(globals_), dict(locals_), include_extras=False)["it"]
    except Exception as error:  # noqa: BLE001  an annotation is any expression
        return Unresolved(f"has a type that cannot be resolved: {error}")
