"""A body is one loaded description in one world, with its pose and joint positions.

Poses and joint positions are kept here exactly as they were set; the engine gets a copy and computes the frames of the
links. A body notifies no observer, checks no limits and ignores attachments: `bullet.Object` does that, and code
outside this package uses `Object` only.

The pose is that of one link, the base, which is the root of the description unless a robot has another one. The pose of
the root follows from the base's pose and the joints between them, so pose and joint positions are the whole state. A
joint above the base moves the base, and the root keeps its pose.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pycrorm_async.world import pose as poses
from pycrorm_async.world.bounding_boxes import BoundingBox, Frame, Solid, box_around, rotation_matrix, solids_of
from pycrorm_async.world.engines import Color, Engine
from pycrorm_async.world.urdf_model import Joint, Model, along


class Body:
    """One body: its links and joints by name, its pose, its joint positions.

    Args:
        model: of the URDF; the mesh files of its collision shapes exist.
        pose: of the base link's frame; None means that the root link's frame is at the origin.
        base: the base link; empty for the root link.

    Attributes:
        start: for each joint the position nearest to 0 within its limits; followers follow.
        number: of the body in the engine.
        remarks: of the engine about the description.
    """

    def __init__(
        self, name: str, model: Model, engine: Engine, pose: poses.Pose | None, color: Color | None, base: str = ""
    ) -> None:
        self._engine = engine
        self.base = base or model.root
        """The link whose frame is the body's pose."""
        if self.base not in model.paths:
            raise poses.UnknownLink(name, self.base, tuple(model.paths))
        self.solids: dict[str, tuple[Solid, ...]] = {}
        for link, each in model.links.items():
            try:
                self.solids[link] = solids_of(each.collisions)
            except ValueError as fault:
                raise poses.DescriptionNotLoadable(name, f"collision of link {link!r}: {fault}") from fault
        self.number, self.remarks = engine.load(name, model)
        self._model = model
        joints = tuple(_joints_below(model, model.root))
        self.links = (model.root, *(each.child for each in joints))
        """The names of all links, the root first, each before the links below it."""
        self.joint_types = {each.name: each.kind for each in joints}
        self.limits: dict[str, tuple[float, float]] = {
            joint: model.joints[joint].bounds
            for joint, kind in self.joint_types.items()
            if kind is not poses.JointType.FIXED
        }
        self.movable_above = {
            link: tuple(each.name for each in reversed(model.paths[link]) if each.kind is not poses.JointType.FIXED)
            for link in self.links
        }
        self._followers: dict[str, list[Joint]] = {}
        for joint in model.joints.values():
            if joint.mimic is not None and joint.kind is not poses.JointType.FIXED:
                self._followers.setdefault(joint.mimic.joint, []).append(joint)
        nearest = {joint: min(max(0.0, lower), upper) for joint, (lower, upper) in self.limits.items()}
        free = {joint: start for joint, start in nearest.items() if model.joints[joint].mimic is None}
        self.start = {joint: model.joints[joint].position(free) for joint in nearest}
        self.positions = dict(self.start)
        self._to_base = model.paths[self.base]
        self.pose = self.root_pose = poses.Pose()
        if color is not None:
            engine.paint(self.number, color)
        if moved := {joint: position for joint, position in self.start.items() if position}:
            engine.turn(self.number, moved)
        self.place(along(self._to_base, self.positions) if pose is None else pose)

    @property
    def root(self) -> str:
        """The name of the description's root link."""
        return self._model.root

    def leader(self, joint: str) -> str | None:
        """Return the joint that this one follows; None if it moves freely."""
        mimic = self._model.joints[joint].mimic
        return None if mimic is None else mimic.joint

    def followed(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Return the positions of these joints and of those that follow them; of a follower alone, nothing."""
        free = {joint: position for joint, position in positions.items() if self.leader(joint) is None}
        following = [each for joint in free for each in self._followers.get(joint, ())]
        return {**free, **{each.name: each.position(free) for each in following}}

    def place(self, pose: poses.Pose) -> None:
        """Move the base link's frame to this pose."""
        root = self.root_at(pose)
        self._engine.place(self.number, root)
        self.pose, self.root_pose = pose, root

    def root_at(self, pose: poses.Pose) -> poses.Pose:
        """Return the pose that the root link's frame has when the base link's frame is at this pose."""
        return pose @ along(self._to_base, self.positions).inverse() if self._to_base else pose

    def turn(self, positions: Mapping[str, float]) -> None:
        """Set these joints together with their followers, rad or m; the root link keeps its pose."""
        positions = self.followed(positions)
        above = [joint for joint in self.movable_above[self.base] if joint in positions]
        moves_base = any(positions[joint] != self.positions[joint] for joint in above)
        self._engine.turn(self.number, positions)
        self.positions.update(positions)
        if moves_base:
            self.place(self.root_pose @ along(self._to_base, self.positions))

    def link_frame(self, link: str) -> Frame:
        """Return the link's frame in "map"."""
        if link == self.base:
            return self.pose.position, self.pose.orientation
        return self._frame(link)

    def link_frame_at(self, link: str, positions: Mapping[str, float]) -> Frame:
        """Return the link's frame in "map" at these joint positions; turns the joints and restores them."""
        positions = self.followed(positions)
        current = {joint: self.positions[joint] for joint in positions}
        try:
            self._engine.turn(self.number, positions)
            return self._frame(link)
        finally:
            self._engine.turn(self.number, current)

    def box(self, links: Iterable[str]) -> BoundingBox | None:
        """Return the box around the shapes of these links; None if they have no shapes."""
        shaped = [link for link in links if self.solids[link]]
        frames = self._engine.frames(self.number, shaped) if shaped else []
        return box_around((frame, self.solids[link]) for link, frame in zip(shaped, frames, strict=True))

    def _frame(self, link: str) -> Frame:
        if link == self.root:
            return self.root_pose.position, self.root_pose.orientation
        return self._engine.frames(self.number, (link,))[0]


def _joints_below(model: Model, root: str) -> Iterator[Joint]:
    """Yield the joints below a link, each before those below it, in the order of the file."""
    children: dict[str, list[Joint]] = {}
    for joint in model.joints.values():
        children.setdefault(joint.parent, []).append(joint)
    pending = children.get(root, [])[::-1]
    while pending:
        joint = pending.pop()
        yield joint
        pending += children.get(joint.child, [])[::-1]


def inner_points(body: Body) -> list[list[float]]:
    """Return points in "map", m, that are spread through the shapes of a body; none for a body without shapes."""
    points: list[list[float]] = []
    for link, solids in body.solids.items():
        if solids:
            position, turn = body.link_frame(link)
            inner = np.concatenate([solid.inner_points for solid in solids])
            points += (inner @ rotation_matrix(turn).T + np.array(position)).tolist()
    return points


# === arguments ================================================================================================


def check_arguments(name: object, object_type: object, mass_kg: object, color: Iterable[Any] | None) -> None:
    """Raise `ObjectRefused` for an argument of an object that is none."""
    if not isinstance(name, str):
        raise poses.ObjectRefused(f"an object's name must be a str, got {name!r}")
    if not isinstance(object_type, poses.ObjectType):
        raise poses.ObjectRefused(f"the type of object {name!r} must be an ObjectType, got {object_type!r}")
    if mass_kg is not None and not 0 < number_or_nan(mass_kg) < math.inf:
        raise poses.ObjectRefused(f"the mass of object {name!r} must be a number of kg > 0, got {mass_kg!r:.100}")
    try:  # an engine would ignore another color
        is_color = color is None or len([float(each) for each in color]) == 4
    except (TypeError, ValueError, OverflowError):
        is_color = False
    if not is_color:
        raise poses.ObjectRefused(f"the color of object {name!r} must be four numbers from 0 to 1, got {color!r:.100}")


def number_or_nan(value: object) -> float:
    """Return a number as a float, and NaN for what is none or has no float, which every check of a range refuses."""
    try:
        return math.nan if isinstance(value, str | bytes) else float(value)  # type: ignore[arg-type]  # raises TypeError
    except (TypeError, ValueError, OverflowError):
        return math.nan


# === state ====================================================================================================
#
# Save the state of a world as a frozen value and restore it: poses, joint positions and attachments by object name.
#
# `BulletWorld.restore_state` sets the states of bodies by the functions here, and restores the attachments itself.
#
# The engine's own saving of states is not used: Bullet's costs ten times as much and does not include attachments.


@dataclass(frozen=True, slots=True)
class ObjectState:
    """The state of one object: pose, joint positions (rad or m), and parent's name and link if it was attached."""

    pose: poses.Pose
    joints: Mapping[str, float]
    attached_to: tuple[str, str | None] | None


@dataclass(frozen=True, slots=True)
class WorldState:
    """The states of all objects by name; later changes of the world do not affect it."""

    objects: Mapping[str, ObjectState]


def check_state(name: str, body: Body, state: ObjectState) -> None:
    """Raise `UnknownJoint`, `PoseRefused` or `JointLimitExceeded` if the body of that object cannot take this state."""
    if not all(map(math.isfinite, (*state.pose.position, *state.pose.orientation))):
        raise poses.PoseRefused(name, state.pose, "its numbers must be finite")
    for joint, position in state.joints.items():
        if joint not in body.limits:
            raise poses.UnknownJoint(name, joint, tuple(body.positions))
        if not math.isfinite(position):
            raise poses.JointLimitExceeded(name, joint, position, body.limits[joint])


def set_state(body: Body, pose: poses.Pose, joints: Mapping[str, float]) -> tuple[dict[str, float], bool]:
    """Set pose and joint positions of a body, those of followers too.

    Returns the joints that got another position, and whether the pose has changed.
    """
    before = body.pose
    turned = {joint: value for joint, value in joints.items() if body.positions[joint] != value}
    if turned:
        body.turn(turned)
    if body.pose != pose:
        body.place(pose)
    return turned, body.pose != before
