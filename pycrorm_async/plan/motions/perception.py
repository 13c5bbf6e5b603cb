"""What a robot perceives: which objects of a type its head's camera sees, or that the world itself tells of.

Seen is what lies in the camera's field of view and of which no more than a fifth is hidden. When nothing is
seen, the failure says for every object of that type why not.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Awaitable, Sequence
from typing import Literal, TypeAlias

from pycrorm_async.plan.current_robot import CurrentRobot, require_world
from pycrorm_async.plan.execution.observer import Seen, recorder
from pycrorm_async.plan.failures import PerceptionObjectNotFound
from pycrorm_async.plan.object_designators import ObjectDesignator, designator_of
from pycrorm_async.plan.task_tree import current_node
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.queries.visibility import met_towards
from pycrorm_async.world.robots.robot_description import FieldOfView

__all__ = ["SEEN_SHARE_MIN", "in_field_of_view", "report_perception", "seen_by_camera", "objects_in_world"]

Source: TypeAlias = Literal["camera", "world_state"]

SEEN_SHARE_MIN = 0.8
"""Of an object that is seen, at least this share is not hidden."""


async def report_perception(
    looking: Awaitable[Sequence[Seen]], *, source: Source, object_type: ObjectType
) -> ObjectDesignator:
    """The best of what was perceived; the recorder is told of all of it, also of nothing.

    Raises:
        PerceptionObjectNotFound: nothing was.
    """
    seen: tuple[Seen, ...] = ()
    try:
        seen = tuple(await looking)
    except PerceptionObjectNotFound:
        _notify(source, object_type, seen)
        raise
    _notify(source, object_type, seen)
    if not seen:
        raise PerceptionObjectNotFound(f"no {object_type.name} was perceived", object_type)
    return designator_of(seen[0].thing)


def seen_by_camera(robot: CurrentRobot, object_type: ObjectType) -> tuple[Seen, ...]:
    """The objects of that type that the head's camera sees, the best seen first.

    What the robot itself hides, or what it carries, is looked past.

    Raises:
        PerceptionObjectNotFound: there is none; its data are the type and, by name, why each is not seen.
    """
    camera = robot.body.link_pose(robot.description.camera_link)
    seen: list[Seen] = []
    unseen: dict[str, str] = {}
    for thing in require_world().objects:
        if thing.object_type is not object_type or thing is robot.body:
            continue
        share, reason = _visibility(robot, camera, thing)
        if reason is None:
            seen.append(Seen(thing, share))
        else:
            unseen[thing.name] = reason
    if not seen:
        there = "; ".join(f"{name} {reason}" for name, reason in unseen.items())
        count = f"{len(unseen)} in the world: {there}" if unseen else "there is none in the world"
        raise PerceptionObjectNotFound(f"no {object_type.name} is seen; {count}", object_type, unseen)
    return tuple(sorted(seen, key=lambda each: -(each.visible or 0.0)))


def objects_in_world(object_type: ObjectType) -> tuple[Seen, ...]:
    """The objects of that type that there are, in the order they came. Raises `PerceptionObjectNotFound`."""
    there = tuple(Seen(thing) for thing in require_world().objects if thing.object_type is object_type)
    if not there:
        raise PerceptionObjectNotFound(f"there is no {object_type.name} in the world", object_type)
    return there


def in_field_of_view(camera: Pose, view: FieldOfView, point: Sequence[float]) -> bool:
    """Whether the point (m, map) lies in the picture of a camera at that pose of its optical frame."""
    x, y, z = Pose(point).relative_to(camera).position
    return abs(math.atan2(x, z)) <= view.horizontal / 2 and abs(math.atan2(y, z)) <= view.vertical / 2


def _notify(source: Source, object_type: ObjectType, seen: tuple[Seen, ...]) -> None:
    observer = recorder.get()
    if observer is not None:
        observer.object_detected(source=source, object_type=object_type, seen=seen, node=current_node.get())


def _visibility(robot: CurrentRobot, camera: Pose, thing: Object) -> tuple[float, str | None]:
    """The share of it that is not hidden, and why it is not seen, if it is not."""
    if not in_field_of_view(camera, robot.description.camera_view_rad, thing.bounding_box().centre):
        return 0.0, "is outside the camera's field of view"
    met = met_towards(thing.world, thing, camera.position, ignore=robot.with_load())
    if not met:
        return 0.0, "has no shape that could be seen"
    by = Counter("the floor" if each is None else each.name for each in met)
    share = by.pop(thing.name, 0) / len(met)
    if share >= SEEN_SHARE_MIN:
        return share, None
    hiding = ", ".join(f"{name} hides {count / len(met):.0%}" for name, count in by.most_common())
    return share, f"is hidden: {hiding} of it"
