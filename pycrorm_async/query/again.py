"""Make again what was recorded: the designator of an action or motion, and the world of a moment.

**Recorded designator.** Make the designator of a recorded action or motion from its row, so that it can be performed
again.

>>> async with memory.session() as session:
...     rows = (await session.scalars(select(Action).order_by(Action.id))).all()
>>> with world_of(await memory.as_of("last", time=0)), simulated_robot:
...     await performable_of(rows[0]).perform()

The row's attributes have all values except the objects themselves, which are searched by name in the current world. A
list that could not be recorded has no entries, like an empty one.

**Recorded world.** Make a world with the objects of a snapshot, at the poses, joint positions and attachments of that
moment.

>>> then = await memory.as_of("last", time=12.5)
>>> with world_of(then) as world:
...     world.object("milk").pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')

It needs no file but the database: each object is made from its recorded description, with boxes instead of meshes.
"""

from __future__ import annotations

import inspect
import logging
import typing
from collections.abc import Iterator, Mapping
from enum import Enum
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType, TracebackType
from typing import Any, NamedTuple
from xml.etree.ElementTree import ParseError

from sqlalchemy import inspect as inspect_row

from pycrorm_async import orm
from pycrorm_async.clock import microseconds_of
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.plan import objects
from pycrorm_async.plan.field_types import ARGUMENTS
from pycrorm_async.plan.language import Designator
from pycrorm_async.query.scene import boxed_urdf
from pycrorm_async.query.snapshot import Moment, ObjectThen, WorldThen
from pycrorm_async.record.declarations import FieldShape, shape_of
from pycrorm_async.record.plan_types import Parameter, Unresolved, declared_type, parameters_of
from pycrorm_async.world.bullet import BulletWorld, Object
from pycrorm_async.world.model_boxes import with_mesh_files
from pycrorm_async.world.models import built_in_that_fits, point_urdf
from pycrorm_async.world.pose import DuplicateName, ObjectType, Pose, WorldMode
from pycrorm_async.world.urdf import robot_description

_log = logging.getLogger("pycrorm_async")
_WITHOUT_POSE = "object {!r} was recorded as one outside the world, and without a pose"


class NotPerformable(CallerError):
    """A row lacks a value that its designator needs; the message names it."""


def performable_of(row: orm.Designator, /, **replacements: Any) -> Designator:
    """Return the designator that the row of an action or a motion records.

    Its class is the imported one with the row's dtype or alias. A designator inside another is made like a nested
    dataclass. Objects are those of the current world with the recorded names; believed objects, located objects and
    frozen copies have the recorded pose. An optional list without entries is None.

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
    return typing.cast("Designator", _made(kind, _RowReader(row, names_in_rows(kind)), (), replacements))


def _class_of(dtype: str) -> type[Designator]:
    """Return the class with this dtype or alias; of classes with the same qualified name, the last defined."""
    classes = {
        f"{each.__module__}.{each.__qualname__}": each
        for each in _descendants(Designator)  # type: ignore[type-abstract]  # its concrete descendants are wanted
        if each.__dtype__ == dtype or dtype in each.__aliases__
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


@lru_cache(maxsize=1024)
def names_in_rows(kind: type[Designator]) -> Mapping[str, str]:
    """Return the names of the declared fields by those of the parameters, which differ for reserved names."""
    fields = declared_type(kind, strict=False).fields
    return {"_".join(name for name in each.path if name != ARGUMENTS): each.name for each in fields}


class _RowReader:
    """Reads parameters from one row; `names_in_rows` has the names of its attributes by those of the parameters."""

    def __init__(self, row: orm.Designator, names_in_rows: Mapping[str, str]) -> None:
        self._row = row
        self._names_in_rows = names_in_rows

    def missing(self, names: tuple[str, ...], reason: str) -> NotPerformable:
        return NotPerformable(
            f"row {self._row.id} of {self._row.dtype} has no value for {'_'.join(names)!r}: {reason}; pass one, as in"
            f" performable_of(row, {names[0]}=…)"
        )

    def value(self, parameter: Parameter, outer: tuple[str, ...]) -> Any:
        """Return the parameter's value, converted to its declared type. Raises `NotPerformable`."""
        names = (*outer, parameter.name)
        name = "_".join(names)
        name = self._names_in_rows.get(name, name)
        shape = None if isinstance(parameter.hint, Unresolved) else shape_of(parameter.hint)
        if shape is None:
            raise self.missing(names, "its type has no column")
        if shape.nested is not None:
            return self._nested(shape.nested, names, optional=shape.optional)
        if shape.kind in ("list", "dict"):
            return self._container(name, parameter.hint, shape)
        owner = next((each for each in type(self._row).__mro__ if name in vars(each)), None)
        if owner is None:
            raise self.missing(names, f"the class {type(self._row).__name__} has no such attribute")
        if issubclass(orm.Designator, owner):
            raise self.missing(names, "every row has another attribute of this name")
        value = getattr(self._row, name)
        if value is None and not shape.optional:
            raise self.missing(names, "it was not recorded")
        return _converted(value, parameter.hint, shape.enum)

    def _nested(self, kind: type, names: tuple[str, ...], *, optional: bool) -> Any:
        prefix = "_".join(names) + "_"
        columns = (each.key for each in inspect_row(self._row).mapper.attrs if each.key.startswith(prefix))
        items = (each.field for each in self._row.items if each.field.startswith(prefix))
        if optional and not any(items) and all(getattr(self._row, each) is None for each in columns):
            return None
        return _made(kind, self, names, {})

    def _container(self, name: str, hint: Any, shape: FieldShape) -> Any:
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
        return values if values or not shape.optional else None


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
    turn = row.qx, row.qy, row.qz, row.qw
    return Pose((row.x, row.y, row.z), turn, row.frame, microseconds_of(row.time) * 1000)


def _pose_of_entry(entry: orm.ParameterItem) -> Pose:
    numbers = [entry.x, entry.y, entry.z, entry.qx, entry.qy, entry.qz, entry.qw]
    position_and_orientation = [each for each in numbers if each is not None]
    assert len(position_and_orientation) == len(numbers), "an entry has all columns of a pose or none"
    return Pose(position_and_orientation[:3], position_and_orientation[3:], entry.frame or "map")


def _object(row: orm.Object, hint: Any) -> Object | objects.ObjectDesignator:
    """Return an object of the current world if the row is that of a world's object; otherwise a designator."""
    if row.identity_id is not None:
        present = objects.require_world().object(row.name)
        accepted = (hint, *typing.get_args(hint))
        return (
            present
            if Object in accepted and objects.ObjectDesignator not in accepted
            else objects.designator_of(present)
        )
    if isinstance(row, orm.ObjectPart) and row.part_of is not None:
        return objects.ObjectPart(
            row.name, objects.require_world().object(row.part_of.name), _object_type(row.name, row.obj_type)
        )
    if row.pose is None:
        raise NotPerformable(_WITHOUT_POSE.format(row.name))
    pose = _pose(row.pose)
    kind = _object_type(row.name, row.obj_type)
    if isinstance(row, orm.LocatedObject) and row.reference is not None and row.reference.pose is not None:
        reference = objects.require_world().object(row.reference.name)
        relative = pose.relative_to(_pose(row.reference.pose))
        return objects.LocatedObject(row.name, kind, relative, reference, row.pose.time)
    return (
        objects.BelieveObject(row.name, kind, pose)
        if isinstance(row, orm.BelieveObject)
        else _frozen(row.name, kind, pose)
    )


def _frozen(name: str, kind: ObjectType | str | None, pose: Pose) -> objects.ObjectDesignator:
    return objects.ObjectDesignator(name, _object_type(name, kind), None, pose)


def _object_type(name: str, kind: ObjectType | str | None) -> ObjectType:
    if isinstance(kind, str):
        return typing.cast("ObjectType", _member(ObjectType, kind))
    if kind is None:
        raise NotPerformable(f"object {name!r} was recorded without a type")
    return kind


# === recorded world ===========================================================================================


class RecordedWorld(BulletWorld):
    """A world made from a snapshot by `world_of`.

    Attributes:
        assumed: for each object whose shape the memory does not have, by name, the assumed shape and the reason. Empty
            if every object is made from its recorded description or from one of the caller's `descriptions`.
    """

    assumed: Mapping[str, str] = MappingProxyType({})
    _mesh_folder: TemporaryDirectory[str] | None = None

    def note_engine(self, recorded: str | None) -> None:
        """Log that the episode was recorded in a world of another engine, if that is known."""
        title = self.engine_title or ""
        if recorded is not None and recorded.split()[0] != title.split()[0]:
            _log.warning(
                "the episode was recorded in a world of %s, and this one is of %s: distances between shapes may"
                " differ by 2 mm",
                recorded,
                title,
            )

    def write_meshes(self, contents: Mapping[str, bytes]) -> Path:
        """Write mesh files, by name, into a folder that exists until the world is left, for copies of the world."""
        self._mesh_folder = TemporaryDirectory(prefix="pycrorm-meshes-")
        folder = Path(self._mesh_folder.name)
        for name, content in contents.items():
            (folder / name).write_bytes(content)
        return folder

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            super().__exit__(kind, error, traceback)
        finally:
            if self._mesh_folder is not None:
                self._mesh_folder.cleanup()


class _Shape(NamedTuple):
    """The URDF of an object.

    Attributes:
        assumed: the reason if it is not the recorded one.
        meshes: file names of the meshes that the snapshot has, by their names in the URDF.
    """

    urdf: str | Path
    assumed: str | None = None
    is_point: bool = False
    meshes: Mapping[str, str] = MappingProxyType({})


def world_of(
    snapshot: Moment,
    *,
    descriptions: Mapping[str, str | Path] = MappingProxyType({}),
    mode: WorldMode = WorldMode.DIRECT,
    engine: str | None = None,
) -> RecordedWorld:
    """Return a world that has, once it is entered, the objects of the snapshot in their state of that moment.

    An object is made from its recorded description and has its colour. The box around its link takes the place of a
    mesh, unless the snapshot has the mesh file (`record_meshes="files"` and `as_of(..., meshes=True)`). An entry in
    `descriptions`, by name, replaces the recorded one: URDF text, or the path of a .urdf file. A world in another
    engine than the recorded one is logged; `mode` and `engine` are those of `BulletWorld`.

    Version 0.1.0 recorded no descriptions. An object of such an episode gets the built-in shape for its name and type,
    if that has all recorded joints and the links that objects are attached to; otherwise it is a labelled point with
    these joints and links. `RecordedWorld.assumed` lists these objects.

    Raises:
        CallerError: two objects have the same name, a type is unknown here, or a description is for no object.
        DescriptionNotLoadable, UnknownJoint, UnknownLink: on entering; a description does not fit its object.
    """
    then = snapshot.world
    names = [each.name for each in then.objects]
    if (unknown := next((name for name in descriptions if name not in names), None)) is not None:
        raise CallerError(f"the snapshot has no object {unknown!r} to describe; its objects: {', '.join(names)}")
    if (twice := next((name for name in names if names.count(name) > 1), None)) is not None:
        raise DuplicateName(twice)
    for each in then.objects:
        _object_type_then(each)
    shapes = {
        each.name: _Shape(descriptions[each.name]) if each.name in descriptions else _shape(each, then)
        for each in then.objects
    }

    files = {name: then.meshes[Path(name).stem] for shape in shapes.values() for name in shape.meshes.values()}

    def add_objects(_world: BulletWorld) -> None:
        world.note_engine(then.engine)
        folder = world.write_meshes(files) if files else None
        for each in then.objects:
            urdf, _assumed, is_point, meshes = shapes[each.name]
            if folder is not None and isinstance(urdf, str):
                urdf = with_mesh_files(urdf, {name: str(folder / file) for name, file in meshes.items()})
            kind = _object_type_then(each)
            robot = robot_description(each.model) if each.model is not None else None
            added = Object(
                each.name,
                kind,
                urdf,
                each.pose,
                world=world,
                color=each.color,
                mass_kg=each.mass_kg,
                robot=robot,
                base_link=each.base_link or "",
            )
            if is_point:
                added.label(each.name)
        world.restore_state(then.state)

    world = RecordedWorld(mode, engine=engine, set_up=add_objects)
    world.assumed = {name: shape.assumed for name, shape in shapes.items() if shape.assumed is not None}
    return world


def _object_type_then(then: ObjectThen) -> ObjectType:
    if then.object_type not in ObjectType.__members__:
        raise CallerError(
            f"object {then.name!r:.100} was recorded with the type {then.object_type!r:.100},"
            " which ObjectType lacks here"
        )
    return ObjectType[then.object_type]


def _shape(then: ObjectThen, world: WorldThen) -> _Shape:
    """Return the recorded shape; without one the built-in shape if the recorded state fits it, otherwise a point."""
    if then.description_fingerprint is None:
        reason = "its description was not recorded"
    elif (description := world.descriptions.get(then.description_fingerprint)) is None:
        reason = f"its description {then.description_fingerprint} is not in the log"
    else:
        try:
            return _recorded_shape(description, world.meshes)
        except (ValueError, ParseError) as error:
            reason = f"its description is missing: {error}"
    links = {each.link for each in world.attachments if each.parent == then.name and each.link is not None}
    if then.base_link is not None:
        links.add(then.base_link)
    built_in = built_in_that_fits(then.name, _object_type_then(then), joints=set(then.joints), links=links)
    if built_in is not None:
        return _Shape(built_in, f"the built-in shape, because {reason}")
    point = point_urdf(then.name, joints=sorted(then.joints), links=sorted(links))
    return _Shape(point, f"a point, because {reason}", is_point=True)


def _recorded_shape(description: DescriptionDeclared, contents: Mapping[str, bytes]) -> _Shape:
    """Return the recorded shape, with boxes for meshes without content. Raises `ValueError` if it is missing."""
    if description.missing is not None:
        raise ValueError(description.missing)
    if not description.meshes:
        return _Shape(description.text)
    present = [each for each in description.meshes if each.sha256 in contents]
    urdf = boxed_urdf(description, kept=frozenset(each.reference for each in present))
    return _Shape(urdf, meshes={each.reference: f"{each.sha256}{Path(each.name).suffix}" for each in present})
