"""Objects of a world: poses, joints and attachments. Each motion notifies the observers once per changed object.

>>> with BulletWorld() as world:
...     milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
...     milk.set_pose(Pose([1.3, 1.2, 0.9]))
...     round(milk.bounding_box().size.z, 3)
0.194
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pycrorm_async.world.bullet_body import Body, Color, visual_boxes
from pycrorm_async.world.enums import Arms, JointType, ObjectType
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
from pycrorm_async.world.models.catalog import built_in_urdf
from pycrorm_async.world.models.inertia import described_mass_kg
from pycrorm_async.world.models.mesh_boxes import visuals_as_collisions
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.pose import COORDINATE_MAX, Pose
from pycrorm_async.world.queries.bounding_boxes import BoundingBox
from pycrorm_async.world.robots.robot_description import RobotDescription, robot_description
from pycrorm_async.world.urdf_checks import urdf_text

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.robots.chain_ik import Chain

_PAST_LIMIT_MAX = 1e-6  # rad or m; tolerates positions that rounding puts past a limit


class Object:
    """One object of one world, compared by identity.

    Args:
        name: unique in its world.
        object_type: the kind of object; the first one of type ROBOT becomes `world.robot`.
        description: URDF text, or the path of a .urdf file; None means the built-in shape for that name and type.
        pose: pose of the base link's frame, in "map"; None means the root link's at the origin. `reset` restores it.
        world: the world to add it to; None means the current world of this context.
        color: red, green, blue, opacity, 0 to 1.
        mass_kg: None means the sum of the masses in the description, if it has any; unknown for a robot or environment.
        robot: the description of a robot; None means the built-in or registered one with the object's name. Without
            `description` the model is that of the robot's description, or the built-in one of its name.
        base_link: the link whose pose is the robot's pose, empty for the root link; None means that of the robot's
            description. The base link of any other object is its root link.

    Raises:
        ObjectRefused, NoWorld, WorldClosed, DuplicateName, DescriptionNotLoadable, PoseRefused, UnknownLink.
    """

    name: str
    object_type: ObjectType
    world: BulletWorld
    original_pose: Pose
    description_text: str
    color: Color | None
    robot_description: RobotDescription | None
    chains: dict[Arms, Chain]
    """The chains of a robot's arms that were needed so far, for `robots.kinematics`."""
    body: Body
    """The body in Bullet, for this package only: moving it notifies no observer."""
    copy_of: Object | None
    """The object of the original world of which this one is a copy; None outside copied worlds."""

    def __init__(
        self,
        name: str,
        object_type: ObjectType,
        description: str | Path | None = None,
        pose: Pose | None = None,
        *,
        world: BulletWorld | None = None,
        color: Color | None = None,
        mass_kg: float | None = None,
        robot: RobotDescription | None = None,
        base_link: str | None = None,
    ) -> None:
        _check_identity(name, object_type)
        _check_mass(name, mass_kg)
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
        if pose is not None:
            _check_pose(name, pose)
        is_robot = object_type is ObjectType.ROBOT
        if base_link and not is_robot:
            raise ObjectRefused(f"only a robot has a base link other than its root, but {name!r} is {object_type.name}")
        if robot is None and is_robot:
            robot = robot_description(name)
        if base_link is None and is_robot and robot is not None:
            base_link = robot.base_link
        if description is None and robot is not None:
            description = robot.urdf
        if description is None:
            description = built_in_urdf(name if robot is None else robot.name, object_type)
        self.description_text = urdf_text(name, description)
        self.robot_description = robot
        self.color = color
        self._mass_kg = mass_kg
        self.chains = {}
        self.body = Body(name, self.description_text, client, pose, color, base_link or "")
        self.original_pose = self.body.pose
        world.add(self)

    def __repr__(self) -> str:
        return f"Object({self.name!r}, {self.object_type.name}, {self.pose!r})"

    # --- pose and extent --------------------------------------------------------------------------------------

    @property
    def pose(self) -> Pose:
        """The pose that was set last, or to which the object was carried, unrounded. Readable after removal."""
        return self.body.pose

    def set_pose(self, pose: Pose) -> None:
        """Move the base link's frame to this pose, together with the objects attached to this one.

        An object that is attached to a parent stays attached, at its new pose relative to the parent.

        Raises:
            PoseRefused, WorldClosed, ObjectNotInWorld: before anything is moved.
        """
        self.check_present()
        self.body.place(_check_pose(self.name, pose))
        self._keep_attached()
        self.world.notify_moved([self, *self.world.attachments.carry(self)])

    @property
    def base_link(self) -> str:
        """The link whose frame is a robot's pose; empty for the root link."""
        return "" if self.body.base == self.body.root else self.body.base

    def root_pose(self, pose: Pose | None = None) -> Pose:
        """Return the pose of the root link's frame, now or with the object at `pose` and its joints as they are."""
        return self.body.root_pose if pose is None else self.body.root_at(pose)

    def link_pose(self, link: str | None = None) -> Pose:
        """Return the pose of a link's frame in "map"; None means the base link. Raises `UnknownLink`."""
        if link is None or link == self.body.base:
            return self.body.pose
        if link == self.body.root:
            return self.body.root_pose
        self._check_link(link)
        self.check_present()
        position, orientation = self.body.link_frame(link)
        return Pose(position, orientation)

    def link_pose_at(self, link: str, positions: Mapping[str, float]) -> Pose:
        """Return the pose that a link's frame would have in "map" at these joint positions (rad or m).

        Nothing is moved and limits are not checked. Raises `UnknownLink`, `UnknownJoint`.
        """
        self._check_link(link)
        for joint in positions:
            self.joint_position(joint)
        self.check_present()
        position, orientation = self.body.link_frame_at(link, positions)
        return Pose(position, orientation)

    def bounding_box(self, link: str | None = None) -> BoundingBox:
        """Return the box along the axes of "map" around the whole object or one link, without margin.

        Without a collision shape it is a box of size zero at the frame's origin. Raises `UnknownLink`.
        """
        links = self.body.links if link is None else (self._check_link(link),)
        self.check_present()
        box = self.body.box(links)
        if box is None:
            position = self.link_pose(link).position
            return BoundingBox(position, position)
        return box

    def box_in_link(self, link: str) -> BoundingBox | None:
        """Return the box around a link's collision shapes, in its own frame; None without any. Raises `UnknownLink`."""
        return self.body.box_in_link(self._check_link(link))

    def visual_boxes(self, links: Collection[str]) -> dict[str, BoundingBox]:
        """Return the boxes around the visual shapes of links, in their frames, where Bullet can load the shapes."""
        return visual_boxes(visuals_as_collisions(self.description_text, links), self.body.client)

    @property
    def mass_kg(self) -> float | None:
        """The given mass, else that of the description; None if it is not known.

        The description counts for objects that grippers lift, not for robots and environments, whose models often have
        guessed masses.
        """
        if self._mass_kg is not None or self.object_type in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
            return self._mass_kg
        return described_mass_kg(self.description_text)

    def label(self, text: str) -> None:
        """Show a text at the object, if the world has a window."""
        self.check_present()
        self.body.label(text)

    # --- joints -----------------------------------------------------------------------------------------------

    @property
    def joints(self) -> tuple[str, ...]:
        """The names of the movable joints."""
        return tuple(self.body.positions)

    @property
    def links(self) -> tuple[str, ...]:
        """The names of all links, the root first."""
        return self.body.links

    def joint_position(self, joint: str) -> float:
        """Return the position that was set last, rad or m. Raises `UnknownJoint`."""
        try:
            return self.body.positions[joint]
        except KeyError:
            raise UnknownJoint(self.name, joint, self.joints) from None

    def joint_positions(self) -> dict[str, float]:
        """Return the positions of all movable joints by name, rad or m; a copy."""
        return dict(self.body.positions)

    def joint_limits(self, joint: str) -> tuple[float, float]:
        """Return the lower and upper hard limit, rad or m; infinite for a continuous joint. Raises `UnknownJoint`."""
        try:
            return self.body.limits[joint]
        except KeyError:
            raise UnknownJoint(self.name, joint, self.joints) from None

    def joint_type(self, joint: str) -> JointType:
        """Return the type of a joint, also of a fixed one. Raises `UnknownJoint`."""
        try:
            return self.body.joint_types[joint]
        except KeyError:
            raise UnknownJoint(self.name, joint, self.joints) from None

    def joints_above(self, link: str | None) -> tuple[str, ...]:
        """Return the movable joints between a link (None: the base link) and the root, nearest first.

        Raises `UnknownLink`.
        """
        return self.body.movable_above[self.body.base if link is None else self._check_link(link)]

    def set_joint_position(self, joint: str, position: float) -> None:
        """Set one joint; see `set_joint_positions`."""
        self.set_joint_positions({joint: position})

    def set_joint_positions(self, positions: Mapping[str, float]) -> None:
        """Set joints, rad or m, in one motion, and carry along the objects attached to the links they move.

        A joint above the base link moves the base too. All errors are raised before anything is moved.

        Raises:
            JointLimitExceeded: a position is outside its hard limits (by more than 1e-6) or not finite.
            UnknownJoint, WorldClosed, ObjectNotInWorld.
        """
        self.check_present()
        targets = {joint: float(position) for joint, position in positions.items()}
        for joint, position in targets.items():
            lower, upper = self.joint_limits(joint)
            within = lower - _PAST_LIMIT_MAX <= position <= upper + _PAST_LIMIT_MAX
            if not (within and abs(position) <= COORDINATE_MAX):
                raise JointLimitExceeded(self.name, joint, position, (lower, upper))
        if targets:
            before = self.body.pose
            self.body.turn(targets)
            moved = [self] if self.body.pose != before else []
            if moved:
                self._keep_attached()
            moved += self.world.attachments.carry(self, targets)
            self.world.notify_joints(self, targets)
            self.world.notify_moved(moved)

    # --- attachments ------------------------------------------------------------------------------------------

    @property
    def attachments(self) -> dict[Object, str | None]:
        """The attached objects, each with the link it moves with (None: the base link)."""
        return {each.child: each.link for each in self.world.attachments.on(self)}

    @property
    def attached_to(self) -> Object | None:
        """The object that this one is attached to."""
        attachment = self.world.attachments.of(self)
        return None if attachment is None else attachment.parent

    def attach(self, child: Object, link: str | None = None) -> None:
        """Attach `child` at its current pose to `link` (None: the base link), so that it moves with it.

        Raises:
            AttachmentRefused: the child is attached already, to this or another object, or it carries this one.
            UnknownLink, WorldClosed, ObjectNotInWorld.
        """
        self.check_present()
        if not isinstance(child, Object):
            raise AttachmentRefused(f"only an Object can be attached to {self.name!r}, got {child!r}")
        child.check_present()
        if link is not None:
            self._check_link(link)
        self.world.attachments.add(self, child, link)
        for observer in self.world.observers:
            observer.object_attached(self, child, link)

    def detach(self, child: Object) -> None:
        """Detach `child`, which keeps its pose. Raises `AttachmentRefused` if it is not attached to this object."""
        self.check_present()
        attachment = self.world.attachments.remove(self, child)
        for observer in self.world.observers:
            observer.object_detached(self, child, attachment.link)

    def detach_all(self) -> None:
        """Detach all children, and the object itself from its parent."""
        for child in self.attachments:
            self.detach(child)
        if (parent := self.attached_to) is not None:
            parent.detach(self)

    # --- reset and removal ------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Detach the object, set its joints to 0, and move it to its original pose; notify of differences only."""
        self.check_present()
        self.detach_all()
        joints = {joint: 0.0 for joint, position in self.body.positions.items() if position != 0.0}
        before = self.body.pose
        if joints:
            self.body.turn(joints)
        if self.body.pose != self.original_pose:
            self.body.place(self.original_pose)
        if joints:
            self.world.notify_joints(self, joints)
        if self.body.pose != before:
            self.world.notify_moved([self])

    def remove(self) -> None:
        """Detach the object and remove it from the world; its last pose and joints can still be read."""
        self.world.remove(self)

    def check_present(self) -> None:
        """Raise `WorldClosed` if the world is closed, `ObjectNotInWorld` if the object was removed."""
        _ = self.world.client
        if not self.world.has(self):
            raise ObjectNotInWorld(self.name, tuple(present.name for present in self.world.objects))

    def _keep_attached(self) -> None:
        """Keep the attachment to the parent at the object's new pose."""
        attachments = self.world.attachments
        if (attachment := attachments.of(self)) is not None:
            attachments.put(attachment.parent, self, attachment.link)

    def _check_link(self, link: str) -> str:
        if link not in self.body.movable_above:
            raise UnknownLink(self.name, link, self.links)
        return link


def _check_identity(name: object, object_type: object) -> None:
    """Raise `ObjectRefused` unless both have the right type; every record of an object holds them."""
    if not isinstance(name, str):
        raise ObjectRefused(f"an object's name must be a str, got {name!r}")
    if not isinstance(object_type, ObjectType):
        raise ObjectRefused(f"the type of object {name!r} must be an ObjectType, got {object_type!r}")


def _check_mass(name: str, mass_kg: object) -> None:
    """Raise `ObjectRefused` unless the mass is None or a finite number > 0."""
    if mass_kg is not None and not (isinstance(mass_kg, int | float) and 0 < mass_kg < math.inf):
        raise ObjectRefused(f"the mass of object {name!r} must be a number of kg > 0, got {mass_kg!r}")


def _check_pose(name: str, pose: Pose) -> Pose:
    """Return the pose. Raises `PoseRefused` if the object cannot be moved to it."""
    if not isinstance(pose, Pose):
        raise PoseRefused(name, pose, "it is not a Pose")
    if pose.frame != "map":
        raise PoseRefused(name, pose, f"its frame is {pose.frame!r}: transform it to 'map' first")
    if not all(abs(value) <= COORDINATE_MAX for value in (*pose.position, *pose.orientation)):
        raise PoseRefused(name, pose, f"its numbers must be finite and at most {COORDINATE_MAX:g}")
    return pose
