"""Describe the world as it is, as if an action with an object began now: the features that its case would have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import ObjectReference, RobotValue
from pycrorm_async.hooks.declaration import built_in_declaration, declared_type
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.object_designators import ObjectDesignator
from pycrorm_async.projections.fold.world_fold import WorldFold, WorldObject
from pycrorm_async.recall.cases.situation import FeatureFields, Numbers, Symbols, situation
from pycrorm_async.recall.reading.cue_arguments import dtype_of
from pycrorm_async.recording.values.value_snapshot import pose_value
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.objects import Object
from pycrorm_async.world.robots.acting_robot import acting_robot


def present_situation(target: Object | ObjectDesignator, action: str | type) -> tuple[Symbols, Numbers]:
    """Return the features of an action that would start now, without those of parameters other than the object.

    `action` is a designator class, or a built-in type by its description or its dtype.

    Raises `CallerError` for an object that is in no world, and for another class.
    """
    body = target.world_object if isinstance(target, ObjectDesignator) else target
    if not isinstance(body, Object) or body not in body.world.objects:
        raise CallerError(f"{target!r} is not an object in a world, so it has no situation: add it to a world first")
    fields = FeatureFields.of(_declaration(action))
    # Events refer to objects by the sequence that added them: number the objects as an episode that began now would.
    sequences = {each: number for number, each in enumerate(body.world.objects, 1)}
    parameters: dict[str, Any] = {}
    if fields.objects:
        parameters[fields.objects[0]] = {"object": sequences[body], "row": sequences[body]}
    return situation(fields, parameters, _robot(body.world, sequences), _world(body.world, sequences))


def _declaration(action: str | type) -> DesignatorTypeDeclared:
    if isinstance(action, type) and issubclass(action, Designator):
        return declared_type(action, strict=False).declaration
    declaration = built_in_declaration(dtype_of(action) or "")
    if declaration is None:
        raise CallerError(f"{action!r} is not a designator class: give one, such as PickUpAction")
    return declaration


def _robot(world: BulletWorld, sequences: Mapping[Object, int]) -> RobotValue | None:
    robot = acting_robot(world)
    if robot is None or robot not in sequences:
        return None
    torso = robot.robot_description.torso_joint if robot.robot_description is not None else None
    reference = ObjectReference(sequences[robot], sequences[robot])
    height = robot.joint_position(torso) if torso is not None else None
    return RobotValue(pose_value(robot.pose), robot.object_type.name, height, reference, robot.name)


def _world(world: BulletWorld, sequences: Mapping[Object, int]) -> WorldFold:
    fold = WorldFold()
    for each, sequence in sequences.items():
        attachment = world.attachments.of(each)
        present = WorldObject(each.name, each.object_type.name, pose_value(each.pose), sequence)
        if attachment is not None:
            present.attached_to = sequences[attachment.parent], attachment.link
        fold.objects[sequence], fold.names[sequence] = present, each.name
    return fold
