"""List the parameters of a designator class with their types.

The parameters of a dataclass are the fields that its constructor accepts, except those with a leading underscore. The
parameters of any other user class are its annotated attributes and the arguments of its `__init__`
(`plan.constructor_arguments` keeps their values). If a type cannot be resolved, only that one parameter has no column.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from enum import Enum
from typing import Any, NamedTuple

from pycrorm_async.events.values import FieldType, ItemType
from pycrorm_async.plan.constructor_arguments import ARGUMENTS
from pycrorm_async.plan.designator import Designator
from pycrorm_async.recording.values.value_snapshot import OBJECT_TYPES
from pycrorm_async.world.pose import Pose

OUR_PACKAGE = "pycrorm_async."


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


# --- from type hints to field types ---


class Shape(NamedTuple):
    """The field type of a parameter; `nested` is a dataclass, whose fields replace the parameter."""

    kind: FieldType
    optional: bool = False
    item: ItemType | None = None
    enum: type[Enum] | None = None
    nested: type | None = None


def shape_of(hint: Any) -> Shape | None:
    """Map a type hint to a field type; None if no column can hold it."""
    origin = typing.get_origin(hint)
    if isinstance(hint, typing.NewType):
        return shape_of(hint.__supertype__)
    if origin in (typing.Union, types.UnionType):
        return _union_shape(hint)
    if origin is typing.Literal:
        return Shape("text") if all(isinstance(each, str) for each in typing.get_args(hint)) else None
    if origin is not None and isinstance(origin, type):
        return _container_shape(origin, typing.get_args(hint))
    if isinstance(hint, type):
        return _class_shape(hint)
    return None


def _class_shape(kind: type) -> Shape | None:
    if issubclass(kind, Enum):
        return Shape("enum", enum=kind)
    for python, name in _SCALARS:
        if issubclass(kind, python):
            return Shape(name)
    if issubclass(kind, OBJECT_TYPES):
        return Shape("object")
    if dataclasses.is_dataclass(kind):
        return Shape("text", nested=kind)
    return None


_SCALARS: tuple[tuple[type, FieldType], ...] = (
    (bool, "boolean"),
    (int, "integer"),
    (float, "real"),
    (str, "text"),
    (datetime, "datetime"),
    (Pose, "pose"),
)


def _union_shape(hint: Any) -> Shape | None:
    members = [each for each in typing.get_args(hint) if each is not type(None)]
    optional = len(members) < len(typing.get_args(hint))
    shapes = {shape._replace(optional=False) if shape else None for shape in map(shape_of, members)}
    optional = optional or any(shape is not None and shape.optional for shape in map(shape_of, members))
    if shapes == {Shape("integer"), Shape("real")}:
        shapes = {Shape("real")}
    if len(shapes) != 1:
        return None
    shape = shapes.pop()
    return shape._replace(optional=optional) if shape is not None else None


def _container_shape(origin: type, arguments: tuple[Any, ...]) -> Shape | None:
    kind: FieldType
    if issubclass(origin, Mapping) and len(arguments) == 2:
        key = shape_of(arguments[0])
        if key is None or key.kind not in ("text", "enum") or key.optional:
            return None
        kind, value = "dict", arguments[1]
    elif issubclass(origin, Sequence) and len({each for each in arguments if each is not Ellipsis}) == 1:
        kind, value = "list", arguments[0]
    else:
        return None
    item = shape_of(value)
    if item is None or item.nested is not None or item.kind in ("list", "dict"):
        return None
    return Shape(kind, item=typing.cast("ItemType", item.kind), enum=item.enum)


def type_text(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)
