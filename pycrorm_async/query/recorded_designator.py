"""Make the designator of a recorded action or motion from its row, so that it can be performed again.

>>> async with memory.session() as session:
...     rows = (await session.scalars(select(Action).order_by(Action.id))).all()
>>> with world_of(await memory.as_of("last", time=0)), simulated_robot:
...     await performable_of(rows[0]).perform()

The row's attributes have all values except the objects themselves, which are searched by name in the current world. A
list that could not be recorded has no entries, like an empty one. A query with `undefer(Action.parameters)`
distinguishes them, and errors then name the reason why a value is missing.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from enum import Enum
from typing import Any

from sqlalchemy import inspect as inspect_row

from pycrorm_async import orm
from pycrorm_async.errors import CallerError
from pycrorm_async.plan.current_robot import require_world
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.object_designators import (
    BelieveObject,
    LocatedObject,
    ObjectDesignator,
    ObjectPart,
    designator_of,
)
from pycrorm_async.projections.fold.column_values import is_missing
from pycrorm_async.recording.values.parameter_types import Parameter, Shape, Unresolved, parameters_of, shape_of
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_WITHOUT_POSE = "object {!r} was recorded as one outside the world, and without a pose"


class NotPerformable(CallerError):
    """A row lacks a value that its designator needs; the message names it."""


def performable_of(row: orm.Designator, /, **replacements: Any) -> Designator:
    """Return the designator that the row of an action or a motion records.

    Its class is the imported one with the row's dtype or alias. A designator inside another is made like a nested
    dataclass. Objects are those of the current world with the recorded names; believed objects, located objects and
    frozen copies have the recorded pose. An optional list without entries is None unless `parameters` are loaded.

    Args:
        row: as a session of the memory returns it.
        replacements: values by name of the parameter, instead of the recorded ones.

    Raises:
        NotPerformable: no imported class has the type, or several have; a value was not recorded; an enum lacks the
            recorded member; the row is that of an expression, whose operands are the children of its node.
        ObjectNotInWorld, NoWorld: a recorded object is not in the current world.
        ResolutionError: the class refuses a value.
    """
    if row.kind == "language":
        raise NotPerformable(
            f"{row.dtype} is an expression: combine the designators of the rows whose nodes are children of node"
            f" {row.id}"
        )
    kind = _class_of(row.dtype)
    parameters = inspect.signature(kind).parameters
    if (unknown := next((name for name in replacements if name not in parameters), None)) is not None:
        raise CallerError(f"{row.dtype} has no parameter {unknown!r}; its parameters: {', '.join(parameters)}")
    return typing.cast("Designator", _made(kind, _RowReader(row), (), replacements))


def _class_of(dtype: str) -> type[Designator]:
    """Return the class with this dtype or alias; of classes with the same qualified name, the last defined."""
    classes = {
        f"{each.__module__}.{each.__qualname__}": each
        for each in _descendants(Designator)  # type: ignore[type-abstract]  # its concrete descendants are wanted
        if each.dtype == dtype or dtype in vars(each).get("aliases", ())
    }
    if not classes:
        raise NotPerformable(f"no imported class has the dtype {dtype!r}: import the module that defines it")
    if len(classes) > 1:
        raise NotPerformable(f"several classes have the dtype {dtype!r}: {', '.join(sorted(classes))}")
    return classes.popitem()[1]


def _descendants(root: type[Designator]) -> Iterator[type[Designator]]:
    for each in root.__subclasses__():
        if not inspect.isabstract(each):
            yield each
        yield from _descendants(each)


def _made(kind: type, reader: _RowReader, outer: tuple[str, ...], replacements: Mapping[str, Any]) -> Any:
    """Call the class with the values of its constructor's parameters."""
    recorded = {each.name: each for each in parameters_of(kind)}
    positional: list[Any] = []
    named: dict[str, Any] = {}
    for each in inspect.signature(kind).parameters.values():
        if each.name in replacements and not outer:
            value = replacements[each.name]
        elif each.name in recorded:
            value = reader.value(recorded[each.name], outer)
        elif each.default is not each.empty:
            continue
        else:
            raise reader.missing((*outer, each.name), "its class does not declare it as a parameter")
        if each.kind is each.VAR_POSITIONAL:
            positional += value or ()
        elif each.kind is each.VAR_KEYWORD:
            named |= value or {}
        elif each.kind is each.KEYWORD_ONLY:
            named[each.name] = value
        else:
            positional.append(value)
    return kind(*positional, **named)


class _RowReader:
    """Reads parameters from one row."""

    def __init__(self, row: orm.Designator) -> None:
        self._row = row
        self._parameters: Mapping[str, Any] = vars(row).get("_parameters", {})  # empty unless the query loads them

    def missing(self, names: tuple[str, ...], reason: str) -> NotPerformable:
        name = "_".join(names)
        if self._is_missing(name):
            reason = f"it was not recorded, because {self._parameters[name]['missing']}"
        return NotPerformable(
            f"row {self._row.id} of {self._row.dtype} has no value for {name!r}: {reason}; pass one, as in"
            f" performable_of(row, {names[0]}=…)"
        )

    def _is_missing(self, name: str) -> bool:
        return is_missing(self._parameters.get(name))

    def value(self, parameter: Parameter, outer: tuple[str, ...]) -> Any:
        """Return the parameter's value, converted to its declared type. Raises `NotPerformable`."""
        names = (*outer, parameter.name)
        name = "_".join(names)
        shape = None if isinstance(parameter.hint, Unresolved) else shape_of(parameter.hint)
        if shape is None:
            raise self.missing(names, "its type has no column")
        if shape.nested is not None:
            return self._nested(shape.nested, names, optional=shape.optional)
        if shape.kind in ("list", "dict"):
            if self._is_missing(name):
                raise self.missing(names, "it was not recorded")
            return self._container(name, parameter.hint, shape)
        if hasattr(orm.Designator, name):
            raise self.missing(names, "every row has another attribute of this name")
        if not hasattr(self._row, name):
            raise self.missing(names, f"the class {type(self._row).__name__} has no such attribute")
        value = getattr(self._row, name)
        if value is None and (not shape.optional or self._is_missing(name)):
            raise self.missing(names, "it was not recorded")
        return _converted(value, parameter.hint, shape.enum)

    def _nested(self, kind: type, names: tuple[str, ...], *, optional: bool) -> Any:
        prefix = "_".join(names) + "_"
        columns = (each.key for each in inspect_row(self._row).mapper.attrs if each.key.startswith(prefix))
        items = (each.field for each in self._row.items if each.field.startswith(prefix))
        if optional and not any(items) and all(getattr(self._row, each) is None for each in columns):
            return None
        return _made(kind, self, names, {})

    def _container(self, name: str, hint: Any, shape: Shape) -> Any:
        container = next(each for each in (hint, *typing.get_args(hint)) if inspect.isclass(typing.get_origin(each)))
        arguments = typing.get_args(container)
        values: Any
        if shape.kind == "dict":
            key, item = arguments
            named = inspect.isclass(key) and issubclass(key, Enum)
            values = {
                _member(key, text) if named else text: _converted(value, item, shape.enum)
                for text, value in self._row.mapping(name).items()
            }
        else:
            items = (_converted(value, arguments[0], shape.enum) for value in self._row.entries(name))
            values = tuple(items) if typing.get_origin(container) is tuple else list(items)
        return values if values or not shape.optional or name in self._parameters else None


def _converted(value: Any, hint: Any, enum: type[Enum] | None) -> Any:
    """Convert a value of a row, or an entry of a list or dict, to a value of the plan."""
    if enum is not None and isinstance(value, str) and not isinstance(value, enum):
        return _member(enum, value)
    if isinstance(value, orm.ParameterItem):
        value = value.object or value
    if isinstance(value, orm.Object):
        return _object(value, hint)
    if isinstance(value, orm.Pose):
        return _pose(value)
    if isinstance(value, orm.ParameterItem):
        if value.object_name is None:
            return _pose_of_entry(value)
        if value.x is None:
            raise NotPerformable(_WITHOUT_POSE.format(value.object_name))
        return _frozen(value.object_name, value.obj_type, _pose_of_entry(value))
    return value


def _member(enum: type[Enum], name: str) -> Enum:
    try:
        return enum[name]
    except KeyError:
        members = ", ".join(enum.__members__)
        raise NotPerformable(f"{enum.__name__} has no member {name!r}, which was recorded; it has: {members}") from None


def _pose(row: orm.Pose) -> Pose:
    time_ns = (row.time - _EPOCH) // timedelta(microseconds=1) * 1000
    return Pose((row.x, row.y, row.z), (row.qx, row.qy, row.qz, row.qw), row.frame, time_ns)


def _pose_of_entry(entry: orm.ParameterItem) -> Pose:
    numbers = [entry.x, entry.y, entry.z, entry.qx, entry.qy, entry.qz, entry.qw]
    position_and_orientation = [each for each in numbers if each is not None]
    assert len(position_and_orientation) == len(numbers), "an entry has all columns of a pose or none"
    return Pose(position_and_orientation[:3], position_and_orientation[3:], entry.frame or "map")


def _object(row: orm.Object, hint: Any) -> Object | ObjectDesignator:
    """Return an object of the current world if the row is that of a world's object; otherwise a designator."""
    if row.identity_id is not None:
        present = require_world().object(row.name)
        accepted = (hint, *typing.get_args(hint))
        return present if Object in accepted and ObjectDesignator not in accepted else designator_of(present)
    if isinstance(row, orm.ObjectPart) and row.part_of is not None:
        return ObjectPart(row.name, require_world().object(row.part_of.name), _object_type(row.name, row.obj_type))
    if row.pose is None:
        raise NotPerformable(_WITHOUT_POSE.format(row.name))
    pose = _pose(row.pose)
    kind = _object_type(row.name, row.obj_type)
    if isinstance(row, orm.LocatedObject) and row.reference is not None and row.reference.pose is not None:
        reference = require_world().object(row.reference.name)
        relative = pose.relative_to(_pose(row.reference.pose))
        return LocatedObject(row.name, kind, relative, reference, row.pose.time)
    return BelieveObject(row.name, kind, pose) if isinstance(row, orm.BelieveObject) else _frozen(row.name, kind, pose)


def _frozen(name: str, kind: ObjectType | str | None, pose: Pose) -> ObjectDesignator:
    return ObjectDesignator(name, _object_type(name, kind), None, pose)


def _object_type(name: str, kind: ObjectType | str | None) -> ObjectType:
    if isinstance(kind, str):
        return typing.cast("ObjectType", _member(ObjectType, kind))
    if kind is None:
        raise NotPerformable(f"object {name!r} was recorded without a type")
    return kind
