"""Make a world with the objects of a snapshot, at the poses, joint positions and attachments of that moment.

>>> then = await memory.as_of("last", time=12.5)
>>> with world_of(then) as world:
...     world.object("milk").pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')

It needs no file but the database: each object is made from its recorded description, with boxes instead of meshes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType, TracebackType
from typing import NamedTuple
from xml.etree.ElementTree import ParseError

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.query.snapshot import Moment, ObjectThen, WorldThen
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType, WorldMode
from pycrorm_async.world.errors import DuplicateName
from pycrorm_async.world.models.catalog import built_in_that_fits
from pycrorm_async.world.models.mesh_boxes import with_boxes, with_mesh_files
from pycrorm_async.world.models.primitives import point_urdf
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Vector
from pycrorm_async.world.queries.bounding_boxes import BoundingBox
from pycrorm_async.world.robots.robot_description import robot_description


class RecordedWorld(BulletWorld):
    """A world made from a snapshot by `world_of`.

    Attributes:
        assumed: for each object whose shape the memory does not have, by name, the assumed shape and the reason. Empty
            if every object is made from its recorded description or from one of the caller's `descriptions`.
    """

    assumed: Mapping[str, str] = MappingProxyType({})
    _mesh_folder: TemporaryDirectory[str] | None = None

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
) -> RecordedWorld:
    """Return a world that has, once it is entered, the objects of the snapshot in their state of that moment.

    An object is made from its recorded description and has its colour. The box around its link takes the place of a
    mesh, unless the snapshot has the mesh file (`record_meshes="files"` and `as_of(..., meshes=True)`). An entry in
    `descriptions`, by name, replaces the recorded one: URDF text, or the path of a .urdf file.

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
        _object_type(each)
    shapes = {
        each.name: _Shape(descriptions[each.name]) if each.name in descriptions else _shape(each, then)
        for each in then.objects
    }

    files = {name: then.meshes[Path(name).stem] for shape in shapes.values() for name in shape.meshes.values()}

    def add_objects(_world: BulletWorld) -> None:
        folder = world.write_meshes(files) if files else None
        for each in then.objects:
            urdf, _assumed, is_point, meshes = shapes[each.name]
            if folder is not None and isinstance(urdf, str):
                urdf = with_mesh_files(urdf, {name: str(folder / file) for name, file in meshes.items()})
            kind = _object_type(each)
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

    world = RecordedWorld(mode, set_up=add_objects)
    world.assumed = {name: shape.assumed for name, shape in shapes.items() if shape.assumed is not None}
    return world


def _object_type(then: ObjectThen) -> ObjectType:
    if then.object_type not in ObjectType.__members__:
        raise CallerError(
            f"object {then.name!r} was recorded with the type {then.object_type!r}, which ObjectType lacks here"
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
    built_in = built_in_that_fits(then.name, _object_type(then), joints=set(then.joints), links=links)
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
    boxes = {link: BoundingBox(Vector(*box.min), Vector(*box.max)) for link, box in description.boxes.items()}
    present = [each for each in description.meshes if each.sha256 in contents]
    urdf = with_boxes(description.text, boxes, kept=frozenset(each.reference for each in present))
    return _Shape(urdf, meshes={each.reference: f"{each.sha256}{Path(each.name).suffix}" for each in present})
