"""Perceive objects of a type, with the head's camera or by a query of the world.

The camera perceives an object whose centre is in the field of view and of which at most a fifth is hidden. If it
perceives none, the failure names the reason for every object of that type.
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
from pycrorm_async.world.robots.robot_description import FieldOfView

Source: TypeAlias = Literal["camera", "world_state"]

SEEN_SHARE_MIN = 0.8
"""Minimum visible share of a perceived object."""


async def report_perception(
    looking: Awaitable[Sequence[Seen]], *, source: Source, object_type: ObjectType
) -> ObjectDesignator:
    """Report a perception to the observer, also an empty one, and return the designator of the first percept.

    That is the designator of the world object that it matches, with the object's pose in the world, or a
    `BelieveObject` with the perceived pose.

    Raises:
        PerceptionObjectNotFound: no object was perceived.
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
    """Return the objects of that type that the head's camera perceives, the most visible first.

    The robot itself and the objects it carries do not occlude.

    Raises:
        PerceptionObjectNotFound: no object is visible; its data are the type and the reason for each object by name.
    """
    camera = robot.camera_pose()
    seen: list[Seen] = []
    unseen: dict[str, str] = {}
    for obj in require_world().objects:
        if obj.object_type is not object_type or obj is robot.body:
            continue
        share, reason = _visibility(robot, camera, obj)
        if reason is None:
            seen.append(Seen(obj, share))
        else:
            unseen[obj.name] = reason
    if not seen:
        reasons = "; ".join(f"{name} {reason}" for name, reason in unseen.items())
        count = f"{len(unseen)} in the world: {reasons}" if unseen else "there is none in the world"
        raise PerceptionObjectNotFound(f"no {object_type.name} is seen; {count}", object_type, unseen)
    return tuple(sorted(seen, key=lambda each: -(each.visible or 0.0)))


def objects_in_world(object_type: ObjectType) -> tuple[Seen, ...]:
    """Return the world's objects of that type in the order of their creation. Raises `PerceptionObjectNotFound`."""
    detections = tuple(Seen(obj) for obj in require_world().objects if obj.object_type is object_type)
    if not detections:
        raise PerceptionObjectNotFound(f"there is no {object_type.name} in the world", object_type)
    return detections


def in_field_of_view(camera: Pose, view: FieldOfView, point: Sequence[float]) -> bool:
    """Return whether the point (m, map) is in the image of a camera whose optical frame is at that pose."""
    x, y, z = Pose(point).relative_to(camera).position
    return abs(math.atan2(x, z)) <= view.horizontal / 2 and abs(math.atan2(y, z)) <= view.vertical / 2


def _notify(source: Source, object_type: ObjectType, seen: tuple[Seen, ...]) -> None:
    observer = recorder.get()
    if observer is not None:
        observer.object_detected(source=source, object_type=object_type, seen=seen, node=current_node.get())


def _visibility(robot: CurrentRobot, camera: Pose, obj: Object) -> tuple[float, str | None]:
    """Return the object's visible share, and the reason why it is not perceived, or None if it is."""
    if not in_field_of_view(camera, robot.description.camera_view_rad, obj.bounding_box().centre):
        return 0.0, "is outside the camera's field of view"
    hits = obj.world.met_towards(obj, camera.position, ignore=robot.with_load())
    if not hits:
        return 0.0, "has no shape that could be seen"
    counts = Counter("the floor" if each is None else each.name for each in hits)
    share = counts.pop(obj.name, 0) / len(hits)
    if share >= SEEN_SHARE_MIN:
        return share, None
    hiding = ", ".join(f"{name} hides {count / len(hits):.0%}" for name, count in counts.most_common())
    return share, f"is hidden: {hiding} of it"
