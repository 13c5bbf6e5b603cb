"""A body is one loaded description in one Bullet client, with its pose and joint positions.

Poses and joint positions are kept here exactly as they were set; Bullet gets a copy and computes the frames of the
links. A body notifies no observer, checks no limits and ignores attachments: `objects.Object` does that, and code
outside this package uses `Object` only.

The pose is that of one link, the base, which is the root of the description unless a robot has another one. The pose of
the root follows from the base's pose and the joints between them, so pose and joint positions are the whole state. A
joint above the base moves the base, and the root keeps its pose.
"""

from __future__ import annotations

import ctypes
import math
import re
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from pycrorm_async.world.bounding_boxes import BoundingBox, Frame, Solid, box_around, rotation_matrix, solids_of
from pycrorm_async.world.meshes import is_read_by_bullet, mesh_points, points_as_stl
from pycrorm_async.world.pose import (
    COORDINATE_MAX,
    IDENTITY,
    BulletMissing,
    DescriptionNotLoadable,
    JointLimitExceeded,
    JointType,
    Pose,
    PoseRefused,
    Quaternion,
    UnknownJoint,
    UnknownLink,
    Vector,
)
from pycrorm_async.world.urdf_model import Joint, Model, Shape, along

Color = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""

_ROOT = -1  # Bullet's number of a body's first link
_STATES_MAX = 127
"""Bullet returns no frames of links for a body with more joints than this, but it moves the links."""
_AT_ORIGIN: Frame = (Vector(0.0, 0.0, 0.0), IDENTITY)


class Body:
    """One body: its links and joints by name, its pose, its joint positions.

    Args:
        model: of the URDF; the mesh files of its collision shapes exist.
        pose: of the base link's frame; None means that the root link's frame is at the origin.
        base: the base link; empty for the root link.

    Attributes:
        start: for each joint the position nearest to 0 within its limits; followers follow.
        remarks: what Bullet printed about the description, and the visual meshes that it does not draw.
    """

    def __init__(
        self, name: str, model: Model, client: int, pose: Pose | None, color: Color | None, base: str = ""
    ) -> None:
        self.client = client
        self.base = base or model.root
        """The link whose frame is the body's pose."""
        if self.base not in model.paths:
            raise UnknownLink(name, self.base, tuple(model.paths))
        self.solids: dict[str, tuple[Solid, ...]] = {}
        for link, each in model.links.items():
            try:
                self.solids[link] = solids_of(each.collisions)
            except ValueError as fault:
                raise DescriptionNotLoadable(name, f"collision of link {link!r}: {fault}") from fault
        self.number, self.remarks = _load(name, model, client)
        self._model = model
        self._joint_numbers: dict[str, int] = {}
        self._link_numbers: dict[str, int] = {model.root: _ROOT}
        bullet = engine()
        for number in range(bullet.getNumJoints(self.number, physicsClientId=client)):
            info = bullet.getJointInfo(self.number, number, physicsClientId=client)
            self._joint_numbers[info[1].decode()] = self._link_numbers[info[12].decode()] = number
        self.joint_types = {joint: model.joints[joint].kind for joint in self._joint_numbers}
        self.limits: dict[str, tuple[float, float]] = {
            joint: model.joints[joint].bounds for joint, kind in self.joint_types.items() if kind is not JointType.FIXED
        }
        self.movable_above = {
            link: tuple(each.name for each in reversed(model.paths[link]) if each.kind is not JointType.FIXED)
            for link in self._link_numbers
        }
        self._followers: dict[str, list[Joint]] = {}
        for joint in model.joints.values():
            if joint.mimic is not None and joint.kind is not JointType.FIXED:
                self._followers.setdefault(joint.mimic.joint, []).append(joint)
        self._by_chain = len(self._joint_numbers) > _STATES_MAX
        nearest = {joint: min(max(0.0, lower), upper) for joint, (lower, upper) in self.limits.items()}
        self.start = {joint: model.joints[joint].position(nearest) for joint in nearest}
        self.positions = dict(self.start)
        self._to_base = model.paths[self.base]
        self.pose = self.root_pose = Pose()
        if color is not None:
            self._paint(color)
        if moved := {joint: position for joint, position in self.start.items() if position}:
            self._turn_in_bullet(moved)
        self.place(along(self._to_base, self.positions) if pose is None else pose)

    @property
    def root(self) -> str:
        """The name of the description's root link."""
        return self._model.root

    @property
    def links(self) -> tuple[str, ...]:
        """The names of all links, the root first."""
        return tuple(self._link_numbers)

    def link_number(self, link: str) -> int:
        """Return Bullet's number of the link."""
        return self._link_numbers[link]

    def leader(self, joint: str) -> str | None:
        """Return the joint that this one follows; None if it moves freely."""
        mimic = self._model.joints[joint].mimic
        return None if mimic is None else mimic.joint

    def followed(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Return the positions of these joints and of those that follow them; of a follower alone, nothing."""
        free = {joint: position for joint, position in positions.items() if self.leader(joint) is None}
        following = [each for joint in free for each in self._followers.get(joint, ())]
        return {**free, **{each.name: each.position(free) for each in following}}

    def place(self, pose: Pose) -> None:
        """Move the base link's frame to this pose."""
        root = self.root_at(pose)
        engine().resetBasePositionAndOrientation(
            self.number, root.position, root.orientation, physicsClientId=self.client
        )
        self.pose, self.root_pose = pose, root

    def root_at(self, pose: Pose) -> Pose:
        """Return the pose that the root link's frame has when the base link's frame is at this pose."""
        return pose @ along(self._to_base, self.positions).inverse() if self._to_base else pose

    def turn(self, positions: Mapping[str, float]) -> None:
        """Set these joints together with their followers, rad or m; the root link keeps its pose."""
        positions = self.followed(positions)
        above = [joint for joint in self.movable_above[self.base] if joint in positions]
        moves_base = any(positions[joint] != self.positions[joint] for joint in above)
        self._turn_in_bullet(positions)
        self.positions.update(positions)
        if moves_base:
            self.place(self.root_pose @ along(self._to_base, self.positions))

    def link_frame(self, link: str) -> Frame:
        """Return the link's frame in "map"."""
        if link == self.base:
            return self.pose.position, self.pose.orientation
        return self._frame_in_bullet(link)

    def link_frame_at(self, link: str, positions: Mapping[str, float]) -> Frame:
        """Return the link's frame in "map" at these joint positions; sets the joints in Bullet and restores them."""
        positions = self.followed(positions)
        if self._by_chain:
            return self._frame_by_chain(link, {**self.positions, **positions})
        current = {joint: self.positions[joint] for joint in positions}
        try:
            self._turn_in_bullet(positions)
            return self._frame_in_bullet(link)
        finally:
            self._turn_in_bullet(current)

    def box(self, links: Iterable[str]) -> BoundingBox | None:
        """Return the box around the shapes of these links; None if they have no shapes."""
        shaped = [link for link in links if self.solids[link]]
        if self._by_chain:
            return box_around((self._frame_by_chain(link, self.positions), self.solids[link]) for link in shaped)
        numbers = [number for link in shaped if (number := self._link_numbers[link]) != _ROOT]
        states: Sequence[Any] = ()
        if numbers:
            states = engine().getLinkStates(
                self.number, numbers, computeForwardKinematics=True, physicsClientId=self.client
            )
        frames: dict[int, Frame] = {_ROOT: (self.root_pose.position, self.root_pose.orientation)}
        for number, state in zip(numbers, states, strict=True):
            frames[number] = _frame(state)
        return box_around((frames[self._link_numbers[link]], self.solids[link]) for link in shaped)

    def box_in_link(self, link: str) -> BoundingBox | None:
        """Return the box along the axes of the link's own frame around its shapes; None if it has none."""
        return box_around([(_AT_ORIGIN, self.solids[link])])

    def label(self, text: str) -> None:
        """Show a text at the origin of the root link, in a window only."""
        engine().addUserDebugText(text, (0.0, 0.0, 0.03), parentObjectUniqueId=self.number, physicsClientId=self.client)

    def unload(self) -> None:
        """Remove the body from Bullet; pose and positions stay readable."""
        engine().removeBody(self.number, physicsClientId=self.client)

    def _turn_in_bullet(self, positions: Mapping[str, float]) -> None:
        numbers = [self._joint_numbers[joint] for joint in positions]
        values = [[position] for position in positions.values()]
        engine().resetJointStatesMultiDof(self.number, numbers, values, physicsClientId=self.client)

    def _frame_in_bullet(self, link: str) -> Frame:
        if self._by_chain:
            return self._frame_by_chain(link, self.positions)
        number = self._link_numbers[link]
        if number == _ROOT:
            return self.root_pose.position, self.root_pose.orientation
        return _frame(
            engine().getLinkState(self.number, number, computeForwardKinematics=True, physicsClientId=self.client)
        )

    def _frame_by_chain(self, link: str, positions: Mapping[str, float]) -> Frame:
        placed = self.root_pose @ along(self._model.paths[link], positions)
        return placed.position, placed.orientation

    def _paint(self, color: Color) -> None:
        for number in self._link_numbers.values():
            engine().changeVisualShape(self.number, number, rgbaColor=color, physicsClientId=self.client)


def _frame(state: Sequence[Any]) -> Frame:
    """Return the frame of a link's centre of mass, which is in the link's own frame, but in double precision."""
    return Vector(*state[0]), Quaternion(*state[1])


def _load(name: str, model: Model, client: int) -> tuple[int, tuple[str, ...]]:
    """Load a model with all its links and a fixed base; return Bullet's number of the body, and its remarks."""
    bullet = engine()
    with tempfile.TemporaryDirectory(prefix="pycrorm-urdf-") as folder:
        urdf, remarks = _written(model, Path(folder))
        path = Path(folder, "model.urdf")
        path.write_text(urdf, encoding="utf-8")
        with captured() as output:
            try:
                number: int | None = bullet.loadURDF(
                    str(path),
                    useFixedBase=True,
                    flags=bullet.URDF_USE_IMPLICIT_CYLINDER,
                    physicsClientId=client,
                )
            except bullet.error:
                number = None
    printed = "".join(output)
    if number is None:
        raise DescriptionNotLoadable(name, " ".join(_messages(printed, "Error")) or "Bullet printed no reason")
    return number, (*remarks, *_messages(printed, "Warning"), *_messages(printed, "Error"))


def _written(model: Model, folder: Path) -> tuple[str, tuple[str, ...]]:
    """Return a URDF of what the reader understood, with one element a line, and what Bullet does not draw.

    Bullet reads no line of more than 1,023 characters. The links have their centres of mass in their origins, because
    nothing falls, and Bullet computes the frames of these centres in double precision. Collision meshes that Bullet
    does not read are written to the folder as the points of their hulls.
    """
    lines, remarks = ["<robot name='model'>"], []
    copies: dict[str, str] = {}
    for name, link in model.links.items():
        lines.append(f"<link name={quoteattr(name)}>\n{_INERTIAL}")
        for kind, shapes in (("collision", link.collisions), ("visual", link.visuals)):
            for shape in shapes:
                file = shape.file
                if shape.kind == "mesh" and not is_read_by_bullet(file, collision=kind == "collision"):
                    if kind == "visual":
                        fault = "Bullet does not draw" if Path(file).is_file() else "there is no file"
                        remarks.append(f"visual of link {name!r}: {fault} {file}")
                        continue
                    if file not in copies:
                        copies[file] = str(folder / f"{len(copies)}.stl")
                        Path(copies[file]).write_bytes(points_as_stl(mesh_points(file)))
                    file = copies[file]
                lines += [
                    f"<{kind}>",
                    _origin_tag(shape.xyz, shape.rpy),
                    "<geometry>",
                    _geometry(shape, file),
                    "</geometry>",
                ]
                if shape.color is not None and kind == "visual":
                    rgba = _text(shape.color)
                    lines.append(f"<material name='{rgba}'>\n<color rgba='{rgba}'/>\n</material>")
                lines.append(f"</{kind}>")
        lines.append("</link>")
    for joint in model.joints.values():
        lower, upper = (min(max(each, -COORDINATE_MAX), COORDINATE_MAX) for each in joint.bounds)
        endless = joint.kind is JointType.REVOLUTE and math.isinf(joint.bounds.upper - joint.bounds.lower)
        lines += [
            f"<joint name={quoteattr(joint.name)} type='{'continuous' if endless else joint.kind.name.lower()}'>",
            f"<parent link={quoteattr(joint.parent)}/>",
            f"<child link={quoteattr(joint.child)}/>",
            _origin_tag(joint.origin.position, joint.rpy),
            f"<axis xyz='{_text(joint.axis)}'/>",
            f"<limit lower='{lower!r}' upper='{upper!r}' effort='100' velocity='3'/>",
            "</joint>",
        ]
    return "\n".join([*lines, "</robot>"]), tuple(remarks)


_INERTIAL = "<inertial>\n<mass value='1'/>\n<inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/>\n</inertial>"


def _origin_tag(xyz: Sequence[float], rpy: Sequence[float]) -> str:
    return f"<origin xyz='{_text(xyz)}' rpy='{_text(rpy)}'/>"


def _geometry(shape: Shape, file: str) -> str:
    match shape.kind:
        case "mesh":
            return f"<mesh filename={quoteattr(file)} scale='{_text(shape.sizes)}'/>"
        case "box":
            return f"<box size='{_text(shape.sizes)}'/>"
        case "sphere":
            return f"<sphere radius='{shape.sizes[0]!r}'/>"
    return f"<{shape.kind} radius='{shape.sizes[0]!r}' length='{shape.sizes[1]!r}'/>"


def _text(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, numbers))


def _messages(output: str, kind: str) -> list[str]:
    """Extract the errors or the warnings from Bullet's output, without its file names and line numbers."""
    parts = re.split(r"b3(Error|Warning|Printf)\[[^\]]*\]:\n?", output)
    return list(
        dict.fromkeys(
            text.strip() for of, text in zip(parts[1::2], parts[2::2], strict=True) if of == kind and text.strip()
        )
    )


# === bullet loader ============================================================================================
#
# Load Bullet when the first world is entered, and keep its output away from stdout and stderr.
#
# Three packages ship the same Bullet: pybullet has wheels up to Python 3.11; pycram-bullet, the fork of the institute
# behind PyCRAM, has wheels for 3.11 and 3.12 and calls its module `pycram_bullet`; pybullet-arm64, a fork that is kept
# up to date, has wheels for 3.12 and 3.13 on x86-64 too. Each one works; no other module of this package imports one.
#
# Bullet prints with C's `printf`, which cannot be switched off: a greeting at import, warnings when it loads a body.
# Meanwhile this module points C's own `stdout` and `stderr` to a buffer in memory. Python and child processes write to
# the file descriptors and not through those pointers, so their output is not affected. The buffer holds Bullet's error
# message if a description does not load.

_MODULES = ("pybullet", "pycram_bullet")
_STREAMS_LOCK = Lock()  # a process has one C stdout


@cache
def engine() -> Any:
    """Return the module of Bullet, imported at the first call: `pybullet` or else `pycram_bullet`.

    Raises `BulletMissing` if neither is installed.
    """
    for name in _MODULES:
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            continue
        # Load the library before the streams are redirected: its C++ runtime keeps the streams it finds when it
        # starts, and would flush the freed memory buffer at exit.
        ctypes.CDLL(spec.origin)
        with captured():
            return import_module(name)
    raise BulletMissing


@contextmanager
def captured() -> Iterator[list[str]]:
    """Capture the output of C code inside the context; afterwards the list holds it as one string.

    One thread at a time can capture, others block; not reentrant. Without glibc nothing is captured.
    """
    output: list[str] = []
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):  # only glibc lets its streams be assigned
        yield output
        return
    libc.open_memstream.restype = ctypes.c_void_p
    text, size = ctypes.c_char_p(), ctypes.c_size_t()
    streams = [ctypes.c_void_p.in_dll(libc, name) for name in ("stdout", "stderr")]
    with _STREAMS_LOCK:
        memory: int | None = libc.open_memstream(ctypes.byref(text), ctypes.byref(size))
        if memory is None:
            raise MemoryError
        before = [stream.value for stream in streams]
        for stream in streams:
            stream.value = memory
        try:
            yield output
        finally:
            for stream, value in zip(streams, before, strict=True):
                stream.value = value
            libc.fclose(ctypes.c_void_p(memory))
            output.append((text.value or b"").decode(errors="replace"))
            libc.free(text)


# === visibility ===============================================================================================
#
# Cast rays through a Bullet client, into the shapes of bodies and through transparent ones.

_RAYS_AT_ONCE = 16_000  # Bullet accepts at most 16,384 rays per call


def first_met(
    client: int,
    starts: Sequence[Sequence[float]],
    ends: Sequence[Sequence[float]],
    *,
    transparent: Collection[Body],
) -> list[int]:
    """Return Bullet's number of the first body on every ray, see `BulletWorld.ray_test`."""
    if len(starts) != len(ends):
        raise ValueError(f"every ray needs a start and an end, got {len(starts)} starts and {len(ends)} ends")
    numbers: list[int] = []
    with _without_collisions(transparent):
        for begin in range(0, len(starts), _RAYS_AT_ONCE):
            chunk = slice(begin, begin + _RAYS_AT_ONCE)
            numbers += [hit[0] for hit in engine().rayTestBatch(starts[chunk], ends[chunk], physicsClientId=client)]
    return numbers


@contextmanager
def _without_collisions(transparent: Collection[Body]) -> Iterator[None]:
    """Let rays pass through these bodies inside the context, by removing them from all of Bullet's collision groups.

    Casting a new ray from behind each hit would not work: Bullet may let a ray that starts just inside a shape hit the
    same shape again and again.
    """
    try:
        for body in transparent:
            _group(body, 0)
        yield
    finally:
        for body in transparent:
            _group(body, 1)


def _group(body: Body, group: int) -> None:
    for link in range(-1, len(body.links) - 1):
        engine().setCollisionFilterGroupMask(body.number, link, group, -1, physicsClientId=body.client)


def inner_points(body: Body) -> list[list[float]]:
    """Return points in "map", m, that are spread through the shapes of a body; none for a body without shapes."""
    points: list[list[float]] = []
    for link, solids in body.solids.items():
        if solids:
            position, turn = body.link_frame(link)
            inner = np.concatenate([solid.inner_points for solid in solids])
            points += (inner @ rotation_matrix(turn).T + np.array(position)).tolist()
    return points


# === state ====================================================================================================
#
# Save the state of a world as a frozen value and restore it: poses, joint positions and attachments by object name.
#
# `BulletWorld.restore_state` sets the states of bodies by the functions here, and restores the attachments itself.
#
# Bullet's own saving of states is not used: it costs ten times as much and does not include attachments.


@dataclass(frozen=True, slots=True)
class ObjectState:
    """The state of one object: pose, joint positions (rad or m), and parent's name and link if it was attached."""

    pose: Pose
    joints: Mapping[str, float]
    attached_to: tuple[str, str | None] | None


@dataclass(frozen=True, slots=True)
class WorldState:
    """The states of all objects by name; later changes of the world do not affect it."""

    objects: Mapping[str, ObjectState]


class StateChange(NamedTuple):
    """The differences that setting a state made: the joints that got another position, and whether the pose changed."""

    joints: dict[str, float]
    moved: bool


def check_state(name: str, body: Body, state: ObjectState) -> None:
    """Raise `UnknownJoint`, `PoseRefused` or `JointLimitExceeded` if the body of that object cannot take this state."""
    if not all(map(math.isfinite, (*state.pose.position, *state.pose.orientation))):
        raise PoseRefused(name, state.pose, "its numbers must be finite")
    for joint, position in state.joints.items():
        if joint not in body.limits:
            raise UnknownJoint(name, joint, tuple(body.positions))
        if not math.isfinite(position):
            raise JointLimitExceeded(name, joint, position, body.limits[joint])


def set_state(body: Body, state: ObjectState) -> StateChange:
    """Set pose and joint positions of a body, and return what has changed; followers follow, whatever was saved."""
    before = body.pose
    joints = {joint: value for joint, value in body.followed(state.joints).items() if body.positions[joint] != value}
    if joints:
        body.turn(joints)
    if body.pose != state.pose:
        body.place(state.pose)
    return StateChange(joints, body.pose != before)
