"""Draw the scene of an episode at a moment as PNG: a world made from the recorded geometry, photographed there.

The world is made in a thread with an empty context, so that it belongs to no open episode and is not recorded.
"""

import asyncio
import math
from collections.abc import Collection, Sequence
from contextvars import Context
from dataclasses import replace
from datetime import datetime
from typing import TypeAlias

import numpy as np
from sqlalchemy import func, select

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import row_key
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.orm import ObjectRemoval
from pycrorm_async.query.again import RecordedWorld, world_of
from pycrorm_async.query.observed_images import png_of
from pycrorm_async.query.question import AskedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.scene import object_model
from pycrorm_async.query.snapshot import Moment, parse_moment
from pycrorm_async.visible_text import visible
from pycrorm_async.world.bullet import Object
from pycrorm_async.world.pose import ObjectType, Vector
from pycrorm_async.world.queries import Camera, photograph

MomentReference: TypeAlias = float | str | datetime | None
"""Seconds since the start, `e115` for an event, a wall clock's time; None: the moment before the world is emptied."""

_PIXELS_MAX = 4_000_000
"""Bounds a picture, which then takes about 15 s."""
_PIXELS_LEAST = 16
"""The least width and height of a picture, in pixels."""
_LAST = 1 << 40
_RADIUS_LEAST_M = 0.3
"""The least radius in m of the sphere that the camera frames, so that one small object has surroundings."""
_YAWS = range(0, 360, 30)


async def picture(
    reading: Reading,
    episode: AskedEpisode,
    *,
    at: MomentReference = None,
    width: int = 640,
    height: int = 480,
    yaw_deg: float | None = None,
    pitch_deg: float = 32.0,
    focus: str | None = None,
) -> bytes:
    """Return the scene at a moment as PNG. It needs the extra `world`, and no display.

    The camera frames the objects that move in the episode, where they are at that moment, and looks from the side from
    which most of them is visible.

    Args:
        episode: its number, its id or the first digits of it, `last`, or an object of the episode.
        at: seconds since the episode's start, `"e115"` for an event, or an aware datetime; by default the last moment
            before the world was emptied.
        width, height: in pixels. 640 x 480 takes about 1 s.
        yaw_deg: direction from the scene to the camera, 0 along +x, 90 along +y; give it for pictures of a series.
        pitch_deg: of the camera above the scene.
        focus: name of the object to frame instead.

    Raises `UnknownEpisode`; `CallerError` for a moment without objects or without recorded shapes, an unknown `focus`,
    an angle that is none, or a size that is too small or too large; `EngineMissing`.
    """
    if min(width, height) < _PIXELS_LEAST or width * height > _PIXELS_MAX:
        raise CallerError(
            f"a picture has at least {_PIXELS_LEAST} x {_PIXELS_LEAST} and at most {_PIXELS_MAX:,} pixels,"
            f" not {width} x {height}"
        )
    if not (math.isfinite(pitch_deg) and -89 <= pitch_deg <= 89):
        raise CallerError(f"pitch_deg must be -89 to 89, got {pitch_deg}")
    if yaw_deg is not None and not math.isfinite(yaw_deg):
        raise CallerError(f"yaw_deg must be a finite number, got {yaw_deg}")
    then = await _moment(reading, episode, at)
    if not then.world.objects:
        raise CallerError(await _emptiness(reading, then))
    if focus is not None:
        then.world.object(focus)
    of_world = ObjectRow.process_metadata_id == then.number, ObjectRow.identity_id.is_not(None)
    each_object = select(ObjectRow.name).where(*of_world).group_by(ObjectRow.name, ObjectRow.identity_id)
    moving = await reading.rows(each_object.having(func.count() > 1))
    moved = {focus} if focus is not None else {name for (name,) in moving}
    return await asyncio.to_thread(Context().run, _drawn, then, moved, (width, height), yaw_deg, pitch_deg)


async def _moment(reading: Reading, episode: AskedEpisode, at: MomentReference) -> Moment:
    if isinstance(at, str):
        time, sequence = parse_moment(at)
        return await reading.as_of(episode, time=time, sequence=sequence, meshes=True)
    if at is not None:
        return await reading.as_of(episode, time=at, meshes=True)
    then = await reading.as_of(episode, sequence=_LAST, meshes=True)
    if then.world.objects:
        return then
    async with reading.session() as session:
        of_episode = ObjectRow.process_metadata_id == then.number
        changed = select(func.max(ObjectRow.id)).where(of_episode).scalar_subquery()
        removed = ObjectRemoval.process_metadata_id == then.number, ObjectRemoval.id > changed
        removal = await session.scalar(select(func.min(ObjectRemoval.id)).where(*removed))
    return then if removal is None else await _moment(reading, episode, f"e{row_key(removal).sequence - 1}")


async def _emptiness(reading: Reading, then: Moment) -> str:
    async with reading.session() as session:
        added = await session.scalar(select(func.min(ObjectRow.id)).where(ObjectRow.process_metadata_id == then.number))
    if added is None:
        return f"episode {then.number} has no objects to draw: no world was recorded"
    begin = f"its first object was added at event {row_key(added).sequence}"
    return f"the world of episode {then.number} was empty at event {then.sequence}, so nothing is drawn; {begin}"


def _drawn(
    then: Moment, moved: Collection[str], size: tuple[int, int], yaw_deg: float | None, pitch_deg: float
) -> bytes:
    drawable = _drawable(then)
    pairs = zip(then.world.objects, drawable.world.objects, strict=True)
    framed = {drawn.name for recorded, drawn in pairs if recorded.name in moved}
    with world_of(drawable) as world:
        points = [name for name, shape in world.assumed.items() if shape.startswith("a point")]
        if len(points) == len(world.objects):
            reason = world.assumed[points[0]].removeprefix("a point, because ")
            raise CallerError(f"episode {then.number} has no shapes to draw: of {points[0]}, {reason}")
        camera = _camera(world, framed.difference(points) or framed, size, yaw_deg, pitch_deg)
        return png_of(photograph(world, camera, *size).pixels, 9)


def _drawable(then: Moment) -> Moment:
    """Return the moment as a world can hold it that is only drawn.

    Another executive may have types of its own, names that occur twice or have control characters, and joints that are
    not in its descriptions. Attachments move nothing in a picture.
    """
    objects, names = [], set[str]()
    for each in then.world.objects:
        kind = each.object_type if each.object_type in ObjectType.__members__ else "GENERIC_OBJECT"
        name = visible(each.name, kept="")
        name = f"{name}#{each.id}" if name in names else name
        names.add(name)
        joints = {visible(joint, kept=""): position for joint, position in each.joints.items()}
        described = then.world.descriptions.get(each.description_fingerprint or "")
        if described is not None and described.missing is None:
            movable = {joint[0] for joint in object_model(described)["joints"] if joint[1] != "fixed" and not joint[-1]}
            joints = {joint: position for joint, position in joints.items() if joint in movable}
        base_link = visible(each.base_link, kept="") if each.base_link else None
        objects.append(replace(each, name=name, object_type=kind, joints=joints, attached_to=None, base_link=base_link))
    return replace(then, world=replace(then.world, objects=tuple(objects)))


def _camera(
    world: RecordedWorld, moved: Collection[str], size: tuple[int, int], yaw_deg: float | None, pitch_deg: float
) -> Camera:
    """Return the camera that frames the moved objects; without one, all but the environment; without these, all."""
    actors = [each for each in world.objects if each.name in moved]
    actors = actors or [each for each in world.objects if each.object_type.name != "ENVIRONMENT"] or list(world.objects)
    low = np.min([each.bounding_box().min for each in actors], axis=0)
    high = np.max([each.bounding_box().max for each in actors], axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, _RADIUS_LEAST_M)
    target = Vector(*((low + high) / 2).tolist())
    view = 40.0
    aspect = size[0] / size[1]
    narrow = math.atan(math.tan(math.radians(view / 2)) * min(1.0, aspect))
    cameras = [
        Camera(target, radius / math.sin(narrow), yaw, pitch_deg, view)
        for yaw in (_YAWS if yaw_deg is None else (yaw_deg,))
    ]
    return cameras[0] if len(cameras) == 1 else max(cameras, key=lambda each: _visible(world, each, radius, actors))


def _visible(world: RecordedWorld, camera: Camera, radius: float, actors: Sequence[Object]) -> float:
    """Rate the visibility of the actors by the sum of the logarithms, so that small ones count as much as robots.

    An object between the camera and the framed objects, such as a wall, costs as much as it covers.
    """
    picture = photograph(world, camera, 80, 60, smooth=False)
    covered = float((picture.depths < camera.distance_m - 1.2 * radius).mean())
    return sum(math.log1p(int((picture.bodies == each.body.number).sum())) for each in actors) * (1 - covered)
