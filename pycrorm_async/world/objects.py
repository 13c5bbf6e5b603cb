"""A thing in the world: where it is, how its joints are, what it carries; every change is told to the observers once.

>>> with BulletWorld() as world:
...     milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
...     milk.set_pose(Pose([1.3, 1.2, 0.9]))
...     round(milk.bounding_box().size.z, 3)
0.194
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pycrorm_async.world.bullet_body import Body, Color
from pycrorm_async.world.enums import JointType, ObjectType
from pycrorm_async.world.errors import (
    AttachmentRefused,
    DuplicateName,
    JointLimitExceeded,
    NoWorld,
    ObjectNotInWorld,
    ObjectRefused,
    PoseRefused,
    UnknownJoint,
    UnknownLink,
)
from pycrorm_async.world.models.primitives import built_in_urdf
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.pose import COORDINATE_MAX, Pose
from pycrorm_async.world.queries.bounding_boxes import BoundingBox
from pycrorm_async.world.robots.robot_description import RobotDescription, robot_description
from pycrorm_async.world.urdf_checks import urdf_text

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld

__all__ = ["Object"]

_PAST_LIMIT_MAX = 1e-6  # rad or m: what rounding may put a joint past its limit


class Object:
    """One object of one world. Two objects are equal only if they are the same.

    Args:
        name: unique in its world.
        object_type: what kind of thing it is; ROBOT also makes it `world.robot`.
        description: URDF text, or the path of a .urdf file; left out, the built-in shape for that name and type.
        pose: of the root link's frame, in "map"; the origin, if left out. `reset` brings it back there.
        world: the world it is put into; the entered one of this context, if left out.
        color: red, green, blue, opacity, 0 to 1.

    Raises:
        ObjectRefused, NoWorld, WorldClosed, DuplicateName, DescriptionNotLoadable, PoseRefused.
    """

    name: str
    object_type: ObjectType
    world: BulletWorld
    original_pose: Pose
    description_text: str
    robot_description: RobotDescription | None
    body: Body
    """For the world's own parts only: moving it tells nobody."""
    copy_of: Object | None
    """In a copied world: the object of the other world that this one was made from."""

    def __init__(
        self,
        name: str,
        object_type: ObjectType,
        description: str | Path | None = None,
        pose: Pose | None = None,
        *,
        world: BulletWorld | None = None,
        color: Color | None = None,
    ) -> None:
        _check_identity(name, object_type)
        world = world if world is not None else current_world.get()
        if world is None:
            raise NoWorld(f"object {name!r}")
        client = world.client
        if any(present.name == name for present in world.objects):
            raise DuplicateName(name)
        self.name = name
        self.object_type = object_type
        self.world = world
        self.copy_of = None
        self.original_pose = _accepted(name, pose if pose is not None else Pose())
        self.description_text = urdf_text(
            name, built_in_urdf(name, object_type) if description is None else description
        )
        self.robot_description = robot_description(name) if object_type is ObjectType.ROBOT else None
        self.body = Body(name, self.description_text, client, self.original_pose, color)
        world.add(self)

    def __repr__(self) -> str:
        return f"Object({self.name!r}, {self.object_type.name}, {self.pose!r})"

    # --- where it is ------------------------------------------------------------------------------------------

    @property
    def pose(self) -> Pose:
        """The very pose that was set last, or that it was carried to. Costs nothing; also readable later."""
        return self.body.pose

    def set_pose(self, pose: Pose) -> None:
        """Put the root link's frame there; what is attached comes along.

        An object that is itself attached stays so, at its new place relative to the parent.

        Raises:
            PoseRefused, WorldClosed, ObjectNotInWorld: nothing was moved.
        """
        self.check_present()
        self.body.place(_accepted(self.name, pose))
        attachments = self.world.attachments
        if (held := attachments.of(self)) is not None:
            attachments.put(held.parent, self, held.link)
        self.world.tell_moved([self, *attachments.carry(self)])

    def link_pose(self, link: str | None = None) -> Pose:
        """Where a link's frame is in "map"; that of the root link, without a name. Raises `UnknownLink`."""
        if link is None or link == self.body.root:
            return self.body.pose
        self._check_link(link)
        self.check_present()
        position, orientation = self.body.link_frame(link)
        return Pose(position, orientation)

    def link_pose_at(self, link: str, positions: Mapping[str, float]) -> Pose:
        """Where a link's frame would be in "map" if these joints (rad or m) stood there; moves nothing.

        Limits are not looked at. Raises `UnknownLink`, `UnknownJoint`.
        """
        self._check_link(link)
        for joint in positions:
            self.joint_position(joint)
        self.check_present()
        position, orientation = self.body.link_frame_at(link, positions)
        return Pose(position, orientation)

    def bounding_box(self, link: str | None = None) -> BoundingBox:
        """The box along map's axes around the whole object, or around one link, without margin.

        What has no collision shape has a box of size zero where its frame is. Raises `UnknownLink`.
        """
        links = self.body.links if link is None else (self._check_link(link),)
        self.check_present()
        box = self.body.box(links)
        if box is None:
            position = self.link_pose(link).position
            return BoundingBox(position, position)
        return box

    # --- its joints -------------------------------------------------------------------------------------------

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that can be moved."""
        return tuple(self.body.positions)

    @property
    def links(self) -> tuple[str, ...]:
        """All links, the root first."""
        return self.body.links

    def joint_position(self, joint: str) -> float:
        """As it was set last, rad or m. Costs nothing. Raises `UnknownJoint`."""
        try:
            return self.body.positions[joint]
        except KeyError:
            raise UnknownJoint(self.name, joint, self.joints) from None

    def joint_positions(self) -> dict[str, float]:
        """All of them, a copy."""
        return dict(self.body.positions)

    def joint_limits(self, joint: str) -> tuple[float, float]:
        """Lower and upper hard limit, rad or m; infinite for a continuous joint. Raises `UnknownJoint`."""
        try:
            return self.body.limits[joint]
        except KeyError:
            raise UnknownJoint(self.name, joint, self.joints) from None

    def joint_type(self, joint: str) -> JointType:
        """How it moves; fixed joints are known here too. Raises `UnknownJoint`."""
        try:
            return self.body.joint_types[joint]
        except KeyError:
            raise UnknownJoint(self.name, joint, self.joints) from None

    def joints_above(self, link: str | None) -> tuple[str, ...]:
        """The movable joints between a link and the root, nearest first. Raises `UnknownLink`."""
        return () if link is None else self.body.movable_above[self._check_link(link)]

    def set_joint_position(self, joint: str, position: float) -> None:
        """One joint; see `set_joint_positions`."""
        self.set_joint_positions({joint: position})

    def set_joint_positions(self, positions: Mapping[str, float]) -> None:
        """Set joints, rad or m, in one motion; what is attached to the links they move comes along.

        Raises:
            JointLimitExceeded: one is outside its hard limits (by more than 1e-6) or not finite.
            UnknownJoint, WorldClosed, ObjectNotInWorld: nothing was moved, in all cases.
        """
        self.check_present()
        wanted = {joint: float(position) for joint, position in positions.items()}
        for joint, position in wanted.items():
            lower, upper = self.joint_limits(joint)
            within = lower - _PAST_LIMIT_MAX <= position <= upper + _PAST_LIMIT_MAX
            if not (within and abs(position) <= COORDINATE_MAX):
                raise JointLimitExceeded(self.name, joint, position, (lower, upper))
        if wanted:
            self.body.turn(wanted)
            carried = self.world.attachments.carry(self, wanted)
            self.world.tell_turned(self, wanted)
            self.world.tell_moved(carried)

    # --- what it carries --------------------------------------------------------------------------------------

    @property
    def attachments(self) -> dict[Object, str | None]:
        """What is attached to it, each with the link it moves with (None: the root link)."""
        return {each.child: each.link for each in self.world.attachments.on(self)}

    @property
    def attached_to(self) -> Object | None:
        """What it is attached to."""
        held = self.world.attachments.of(self)
        return None if held is None else held.parent

    def attach(self, child: Object, link: str | None = None) -> None:
        """From now on `child`, where it is, moves with `link` (None: the root link).

        Raises:
            AttachmentRefused: it is attached already, to this or another object, or it carries this one.
            UnknownLink, WorldClosed, ObjectNotInWorld.
        """
        self.check_present()
        if not isinstance(child, Object):
            raise AttachmentRefused(f"what is attached to {self.name!r} is an Object, not {child!r}")
        child.check_present()
        if link is not None:
            self._check_link(link)
        self.world.attachments.add(self, child, link)
        for observer in self.world.observers:
            observer.object_attached(self, child, link)

    def detach(self, child: Object) -> None:
        """It no longer moves with this object and stays where it is. Raises `AttachmentRefused` if it did not."""
        self.check_present()
        ended = self.world.attachments.remove(self, child)
        for observer in self.world.observers:
            observer.object_detached(self, child, ended.link)

    def detach_all(self) -> None:
        """Detach all it carries, and itself from what it hangs on."""
        for child in self.attachments:
            self.detach(child)
        if (parent := self.attached_to) is not None:
            parent.detach(self)

    # --- beginning again, and the end -------------------------------------------------------------------------

    def reset(self) -> None:
        """Detached from everything, joints 0, at its original pose; what is so already is neither touched nor told."""
        self.check_present()
        self.detach_all()
        turned = {joint: 0.0 for joint, position in self.body.positions.items() if position != 0.0}
        if turned:
            self.body.turn(turned)
        moved = self.body.pose != self.original_pose
        if moved:
            self.body.place(self.original_pose)
        if turned:
            self.world.tell_turned(self, turned)
        if moved:
            self.world.tell_moved([self])

    def remove(self) -> None:
        """Take it out of the world, detached first; its last pose and joints can still be read."""
        self.world.remove(self)

    def check_present(self) -> None:
        """Raise `WorldClosed` or, once it is removed, `ObjectNotInWorld`: then it can only be read."""
        _ = self.world.client
        if not self.world.has(self):
            raise ObjectNotInWorld(self.name, tuple(present.name for present in self.world.objects))

    def _check_link(self, link: str) -> str:
        if link not in self.body.movable_above:
            raise UnknownLink(self.name, link, self.links)
        return link


def _check_identity(name: object, object_type: object) -> None:
    """Raise `ObjectRefused`. What is written down of an object begins with these two."""
    if not isinstance(name, str):
        raise ObjectRefused(f"the name of an object is a str, not {name!r}")
    if not isinstance(object_type, ObjectType):
        raise ObjectRefused(f"the type of object {name!r} is one of ObjectType, not {object_type!r}")


def _accepted(name: str, pose: Pose) -> Pose:
    """The same pose, if the thing of that name can be put there."""
    if not isinstance(pose, Pose):
        raise PoseRefused(name, pose, "it is no Pose")
    if pose.frame != "map":
        raise PoseRefused(name, pose, f"it is given in {pose.frame!r}: transform it into 'map' first")
    if not all(abs(value) <= COORDINATE_MAX for value in (*pose.position, *pose.orientation)):
        raise PoseRefused(name, pose, f"its numbers must be finite, and none larger than {COORDINATE_MAX:g}")
    return pose
