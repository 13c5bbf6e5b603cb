"""Read a designator's parameters when it is performed, and shorten a node's start that is too long.

Each parameter is read on its own, so a fault in one leaves the values of the others intact.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import sys
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from enum import Enum
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from pycrorm_async.events.codec import NotEncodable, encode, encoded_bytes
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    FieldDeclared,
    FieldType,
    Happening,
    ItemType,
    LocationResolved,
    MissingValue,
    NodeEnded,
    NodeStarted,
    ObjectDetected,
    PoseValue,
)
from pycrorm_async.plan.field_types import ARGUMENTS
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.task import Performable
from pycrorm_async.record.values import (
    OBJECT_TYPES,
    References,
    UnrecordableValue,
    clean,
    cut,
    encode_parameter,
    missing_value,
    reading_fault,
)
from pycrorm_async.world.pose import Pose

ROBOT = "robot state"
"""The name under which a missing robot state is counted; the blank keeps it apart from every field's name."""
_MISSING_BYTES = 400
"""Bounds from below the parameters worth dropping: about the encoded size of the `MissingValue` that replaces one."""


def read_parameters(
    designator: Performable, declared: DeclaredType, references: References, missing: dict[str, str]
) -> dict[str, Any]:
    """Read the parameters of a designator as JSON values by field name.

    For each parameter that becomes a `MissingValue`, the function adds the reason to `missing`.
    """
    parameters: dict[str, Any] = {}
    for field, path, enum in declared.fields:
        value: Any = designator
        try:
            for name in path:
                value = getattr(value, name, None)
            if value is not None:
                parameters[field.name] = encode_parameter(field, enum, value, references)
        except UnrecordableValue as reason:
            parameters[field.name] = missing_value(str(reason), value)
            missing[field.name] = str(reason)
        except Exception as error:  # noqa: BLE001  a property or a __float__ of the user's may raise anything
            missing[field.name] = fault = reading_fault(error)
            parameters[field.name] = missing_value(fault, value)
    if declared.undeclared:
        _read_undeclared(designator, declared, parameters, missing)
    return parameters


def _read_undeclared(
    designator: Performable, declared: DeclaredType, parameters: dict[str, Any], missing: dict[str, str]
) -> None:
    for field, path, undeclared in declared.undeclared:
        value: Any = designator
        reason: str = undeclared
        try:
            for name in path:
                value = getattr(value, name, None)
        except Exception as error:  # noqa: BLE001  a property of the user's may raise anything
            reason = reading_fault(error)
        if value is not None:
            parameters[field] = missing_value(reason, value)
            missing[field] = reason


def fit_node_start(event: NodeStarted, bytes_max: int, missing: dict[str, str]) -> NodeStarted:
    """Replace parts of a node's start by `MissingValue` until it can be encoded.

    First the parts that JSON cannot hold, then the largest parameters, then the reprs of the missing values, at last
    all parameters. For each replaced part, the function adds the reason to `missing`.
    """
    sizes: dict[str, int] = {}
    parameters = dict(event.parameters)
    for name, value in event.parameters.items():
        if isinstance(value, MissingValue):
            continue
        try:
            sizes[name] = encoded_bytes(value)
        except NotEncodable as error:
            parameters[name] = missing_value(error.reason, value)
            missing[name] = error.reason
    if event.robot is not None:
        try:
            encoded_bytes(event.robot)
        except NotEncodable as error:
            event = replace(event, robot=None)
            missing[ROBOT] = error.reason
    small = sorted((name for name in sizes if name not in missing), key=lambda name: sizes[name])
    while not fits(replace(event, parameters=parameters), bytes_max):
        if small and sizes[small[-1]] > _MISSING_BYTES:
            name = small.pop()
            missing[name] = f"takes {sizes[name]:,} bytes, {bytes_max:,} are allowed for the record (record_bytes_max)"
            parameters[name] = missing_value(missing[name], parameters[name])
        elif any(isinstance(each, MissingValue) and each.repr for each in parameters.values()):
            parameters = {name: _without_repr(each) for name, each in parameters.items()}
        else:
            reason = f"the record would take more than {bytes_max:,} bytes (record_bytes_max)"
            missing.update((name, reason) for name in parameters if name not in missing)
            return replace(event, parameters={})
    return replace(event, parameters=parameters)


def _without_repr(value: Any) -> Any:
    return MissingValue(value.missing) if isinstance(value, MissingValue) else value


# === declared type ============================================================================================
#
# A `DeclaredType` is the declaration of one designator type, encoded, with the paths to read its parameters.


class Field(NamedTuple):
    """A declared field, the attribute path to its value, and its enum class if it is an enum."""

    declared: FieldDeclared
    path: tuple[str, ...]
    enum: type[Enum] | None


class Undeclared(NamedTuple):
    """A field without a column, the attribute path to its value, and the reason."""

    name: str
    path: tuple[str, ...]
    reason: str


class DeclaredType(NamedTuple):
    """The declaration of a designator class, encoded, with the paths to read its parameters.

    Attributes:
        payload: the encoded declaration; empty if the class cannot be declared.
        fingerprint: fingerprint of the payload; empty if the class cannot be declared.
        undeclared: fields whose values are recorded as missing.
        fault: reason why the class, or one of its aliases, cannot be declared.
    """

    dtype: str
    payload: bytes
    fingerprint: str
    fields: tuple[Field, ...]
    declaration: DesignatorTypeDeclared
    undeclared: tuple[Undeclared, ...] = ()
    fault: str | None = None


# === event fitting ============================================================================================
#
# Shorten events that cannot be encoded: too long, or with values that JSON cannot hold.

EPISODE_TEXT_MAX = 10_000
"""Bounds the characters of an episode's description, plan and world, so that their columns stay readable."""

_BYTES_PER_CHARACTER_MAX = 7
"""Bounds the encoded size: a control character takes six bytes in JSON; the seventh covers the keys and quotes."""
_CUT_LENGTHS = (1_000, 100, 10)
"""Characters to shorten a text to, tried in turn until the event fits."""
_NAME_MAX = 1_000
"""Bounds the characters of a name, far above real names."""


def fit_episode_start(started: EpisodeStarted, bytes_max: int) -> tuple[EpisodeStarted, list[str]]:
    """Shorten the long texts of an episode's start; return the event and the names of the shortened fields."""
    texts = {
        name: text
        for name in ("description", "plan", "world", "created_by", "host", "software")
        if (text := getattr(started, name)) is not None
    }
    if (
        max(map(len, texts.values())) <= EPISODE_TEXT_MAX
        and _BYTES_PER_CHARACTER_MAX * sum(map(len, texts.values())) < bytes_max
    ):
        return started, []
    for characters_max in (EPISODE_TEXT_MAX, *_CUT_LENGTHS):
        shortened = [name for name, text in texts.items() if len(text) > characters_max]
        if shortened:
            started = replace(started, **{name: cut(texts[name], characters_max) for name in shortened})
        if fits(started, bytes_max):
            break
    return started, shortened


def episode_text_of(text: str) -> str:
    """Clean and shorten a text for a column of an episode."""
    return cut(clean(text), EPISODE_TEXT_MAX)


def fit_node_end(ended: NodeEnded, bytes_max: int) -> NodeEnded:
    """Replace a result that cannot be encoded by a `MissingValue`, then shorten the failure until the event fits."""
    if ended.result is not None:
        try:
            encode(ended, bytes_max=bytes_max)
        except NotEncodable as error:
            ended = replace(ended, result=MissingValue(error.reason))
    for failure in _shortened_failures(ended.failure):
        if fits(ended, bytes_max):
            break
        ended = replace(ended, failure=failure)
    return ended


def fit_episode_end(ended: EpisodeEnded, bytes_max: int) -> EpisodeEnded:
    """Shorten the world and then the failure of an episode's end until the event fits."""
    for characters_max in _CUT_LENGTHS:
        if ended.world is None or fits(ended, bytes_max):
            break
        ended = replace(ended, world=cut(ended.world, characters_max))
    for failure in _shortened_failures(ended.failure):
        if fits(ended, bytes_max):
            break
        ended = replace(ended, failure=failure)
    return ended


def _shortened_failures(failure: FailureValue | None) -> Iterator[FailureValue]:
    """Yield ever shorter versions of a failure: first without its arguments, then with a shortened message."""
    if failure is not None:
        for characters_max in (len(failure.message), *_CUT_LENGTHS):
            yield FailureValue(cut(failure.type, _NAME_MAX), cut(failure.message, characters_max))


def fit_resolution(resolved: LocationResolved, bytes_max: int) -> LocationResolved:
    """Drop places until the event fits: first those with non-finite numbers, then the last refused, then candidates.

    The candidate that was taken is kept, unless it holds a non-finite number; then `taken` becomes None.
    """
    refused = tuple(each for each in resolved.refused if _is_finite(each.pose))
    taken = resolved.offered[resolved.taken] if resolved.taken is not None else None
    others = [
        each
        for index, each in enumerate(resolved.offered)
        if index != resolved.taken and _is_finite(each.pose, each.torso_height)
    ]
    last = (taken,) if taken is not None and _is_finite(taken.pose, taken.torso_height) else ()
    while True:
        offered = (*others, *last)
        shorter = replace(
            resolved,
            offered=offered,
            taken=len(offered) - 1 if last else None,
            refused=refused,
            offered_beyond=resolved.offered_beyond + len(resolved.offered) - len(offered),
        )
        if not (others or refused) or fits(shorter, bytes_max):
            return shorter
        if refused:
            refused = refused[: len(refused) // 2]
        else:
            others = others[: len(others) // 2]


def fit_detection(detected: ObjectDetected, bytes_max: int) -> ObjectDetected:
    """Fit a detection: shorten its texts and drop non-finite numbers, then drop the last percepts until it fits.

    A percept with a non-finite pose is dropped.
    """
    shorter = clean_texts(detected)
    assert isinstance(shorter, ObjectDetected)
    shorter = replace(
        shorter,
        seen=tuple(
            replace(each, visible=_finite(each.visible), confidence=_finite(each.confidence))
            for each in shorter.seen
            if _is_finite(each.pose)
        ),
    )
    while shorter.seen and not fits(shorter, bytes_max):
        shorter = replace(shorter, seen=shorter.seen[: len(shorter.seen) // 2])
    return shorter


def _finite(number: float | None) -> float | None:
    return number if number is not None and math.isfinite(number) else None


def _is_finite(pose: PoseValue, height: float | None = None) -> bool:
    numbers = (*pose.position, *pose.orientation, height if height is not None else 0.0)
    return all(map(math.isfinite, numbers))


def clean_texts(event: Happening) -> Happening:
    """Clean and shorten every text of an event, and drop dict entries whose number is not finite."""
    cleaned: Happening = _cleaned(event)
    return cleaned


def _cleaned(value: Any) -> Any:
    if isinstance(value, str):
        return cut(clean(value), _NAME_MAX)
    if isinstance(value, msgspec.Struct):
        return replace(value, **{name: _cleaned(getattr(value, name)) for name in value.__struct_fields__})
    if isinstance(value, tuple):
        return tuple(map(_cleaned, value))
    if isinstance(value, dict):
        finite = {key: each for key, each in value.items() if not isinstance(each, float) or math.isfinite(each)}
        return {_cleaned(key): _cleaned(each) for key, each in finite.items()}
    return value


def fits(event: Happening, bytes_max: int) -> bool:
    """Return whether the event can be encoded in `bytes_max` bytes."""
    try:
        encode(event, bytes_max=bytes_max)
    except NotEncodable:
        return False
    return True


# === parameter types ==========================================================================================
#
# List the parameters of a designator class with their types.
#
# The parameters of a dataclass are the fields that its constructor accepts, except those with a leading underscore. The
# parameters of any other user class are its annotated attributes and the arguments of its `__init__`
# (`plan.field_types` keeps their values). If a type cannot be resolved, only that one parameter has no column.

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


class FieldShape(NamedTuple):
    """The field type of a parameter; `nested` is a dataclass, whose fields replace the parameter."""

    kind: FieldType
    optional: bool = False
    item: ItemType | None = None
    enum: type[Enum] | None = None
    nested: type | None = None


def shape_of(hint: Any) -> FieldShape | None:
    """Map a type hint to a field type; None if no column can hold it."""
    origin = typing.get_origin(hint)
    if isinstance(hint, typing.NewType):
        return shape_of(hint.__supertype__)
    if origin in (typing.Union, types.UnionType):
        return _union_shape(hint)
    if origin is typing.Literal:
        return FieldShape("text") if all(isinstance(each, str) for each in typing.get_args(hint)) else None
    if origin is not None and isinstance(origin, type):
        return _container_shape(origin, typing.get_args(hint))
    if isinstance(hint, type):
        return _class_shape(hint)
    return None


def _class_shape(kind: type) -> FieldShape | None:
    if issubclass(kind, Enum):
        return FieldShape("enum", enum=kind)
    for python, name in _SCALARS:
        if issubclass(kind, python):
            return FieldShape(name)
    if issubclass(kind, OBJECT_TYPES):
        return FieldShape("object")
    if dataclasses.is_dataclass(kind):
        return FieldShape("text", nested=kind)
    return None


_SCALARS: tuple[tuple[type, FieldType], ...] = (
    (bool, "boolean"),
    (int, "integer"),
    (float, "real"),
    (str, "text"),
    (datetime, "datetime"),
    (Pose, "pose"),
)


def _union_shape(hint: Any) -> FieldShape | None:
    members = [each for each in typing.get_args(hint) if each is not type(None)]
    optional = len(members) < len(typing.get_args(hint))
    shapes = {shape._replace(optional=False) if shape else None for shape in map(shape_of, members)}
    optional = optional or any(shape is not None and shape.optional for shape in map(shape_of, members))
    if shapes == {FieldShape("integer"), FieldShape("real")}:
        shapes = {FieldShape("real")}
    if len(shapes) != 1:
        return None
    shape = shapes.pop()
    return shape._replace(optional=optional) if shape is not None else None


def _container_shape(origin: type, arguments: tuple[Any, ...]) -> FieldShape | None:
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
    return FieldShape(kind, item=typing.cast("ItemType", item.kind), enum=item.enum)


def hint_text(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)
