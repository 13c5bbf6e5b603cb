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
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from pycrorm_async.world.bounding_boxes import BoundingBox, Frame, Solid, box_around, rotation_matrix, solids_of
from pycrorm_async.world.pose import (
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
    product,
    rotated,
)
from pycrorm_async.world.urdf import Joint, along, chains, divided

Color = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""

_ROOT = -1  # Bullet's number of a body's first link
_MOVABLE = (JointType.REVOLUTE, JointType.CONTINUOUS, JointType.PRISMATIC)
_ENDLESS = (-math.inf, math.inf)
_STATES_MAX = 127
"""Bullet returns no frames of links for a body with more joints than this, but it moves the links."""
_AT_ORIGIN: Frame = (Vector(0.0, 0.0, 0.0), IDENTITY)


class Body:
    """One body: its links and joints by name, its pose, its joint positions.

    Args:
        pose: of the base link's frame; None means that the root link's frame is at the origin.
        base: the base link; empty for the root link.
    """

    def __init__(
        self, name: str, urdf: str, client: int, pose: Pose | None, color: Color | None, base: str = ""
    ) -> None:
        self.client = client
        self.number = _load(name, urdf, client)
        self.positions: dict[str, float] = {}
        self.limits: dict[str, tuple[float, float]] = {}
        self.joint_types: dict[str, JointType] = {}
        self.movable_above: dict[str, tuple[str, ...]] = {}
        self._joint_numbers: dict[str, int] = {}
        self._link_numbers: dict[str, int] = {}
        self._inertial: dict[int, Frame] = {}  # Bullet places a link by its centre of mass, in the link's frame
        self._inertial_back: dict[int, Frame] = {}
        self._read()
        self._chains = chains(urdf) if len(self._joint_numbers) > _STATES_MAX else {}
        self.base = base or self.root
        """The link whose frame is the body's pose."""
        if self.base not in self._link_numbers:
            self.unload()
            raise UnknownLink(name, self.base, self.links)
        self._to_base: tuple[Joint, ...] = divided(urdf, "", base)[1] if self.base != self.root else ()
        self.pose = self.root_pose = Pose()
        self.solids: dict[str, tuple[Solid, ...]] = {
            link: solids_of(engine(), client, self.number, number, self._inertial[number], self._placed_at_load(link))
            for link, number in self._link_numbers.items()
        }
        if color is not None:
            self._paint(color)
        self.place(along(self._to_base, self.positions) if pose is None else pose)

    @property
    def root(self) -> str:
        """The name of the description's root link."""
        return next(iter(self._link_numbers))

    @property
    def links(self) -> tuple[str, ...]:
        """The names of all links, the root first."""
        return tuple(self._link_numbers)

    def link_number(self, link: str) -> int:
        """Return Bullet's number of the link."""
        return self._link_numbers[link]

    def place(self, pose: Pose) -> None:
        """Move the base link's frame to this pose."""
        root = self.root_at(pose)
        position, orientation = _compose((root.position, root.orientation), self._inertial[_ROOT])
        engine().resetBasePositionAndOrientation(self.number, position, orientation, physicsClientId=self.client)
        self.pose, self.root_pose = pose, root

    def root_at(self, pose: Pose) -> Pose:
        """Return the pose that the root link's frame has when the base link's frame is at this pose."""
        return pose @ along(self._to_base, self.positions).inverse() if self._to_base else pose

    def turn(self, positions: Mapping[str, float]) -> None:
        """Set these joints together, rad or m; the root link keeps its pose."""
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
        if self._chains:
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
        if self._chains:
            return box_around((self._frame_by_chain(link, self.positions), self.solids[link]) for link in shaped)
        numbers = [number for link in shaped if (number := self._link_numbers[link]) != _ROOT]
        states: Sequence[Any] = ()
        if numbers:
            states = engine().getLinkStates(
                self.number, numbers, computeForwardKinematics=True, physicsClientId=self.client
            )
        frames = {_ROOT: (self.root_pose.position, self.root_pose.orientation)}
        for number, state in zip(numbers, states, strict=True):
            frames[number] = self._link_frame(number, state)
        return box_around((frames[self._link_numbers[link]], self.solids[link]) for link in shaped)

    def box_in_link(self, link: str) -> BoundingBox | None:
        """Return the box along the axes of the link's own frame around its shapes; None if it has none."""
        return box_around([(_AT_ORIGIN, self.solids[link])])

    def label(self, text: str) -> None:
        """Show a text above the origin of the root link, in a window only."""
        engine().addUserDebugText(text, (0.0, 0.0, 0.03), parentObjectUniqueId=self.number, physicsClientId=self.client)

    def unload(self) -> None:
        """Remove the body from Bullet; pose and positions stay readable."""
        engine().removeBody(self.number, physicsClientId=self.client)

    def _turn_in_bullet(self, positions: Mapping[str, float]) -> None:
        numbers = [self._joint_numbers[joint] for joint in positions]
        values = [[position] for position in positions.values()]
        engine().resetJointStatesMultiDof(self.number, numbers, values, physicsClientId=self.client)

    def _frame_in_bullet(self, link: str) -> Frame:
        if self._chains:
            return self._frame_by_chain(link, self.positions)
        number = self._link_numbers[link]
        if number == _ROOT:
            return self.root_pose.position, self.root_pose.orientation
        state = engine().getLinkState(self.number, number, computeForwardKinematics=True, physicsClientId=self.client)
        return self._link_frame(number, state)

    def _frame_by_chain(self, link: str, positions: Mapping[str, float]) -> Frame:
        placed = self.root_pose @ along(self._chains[link], positions)
        return placed.position, placed.orientation

    def _placed_at_load(self, link: str) -> Frame | None:
        """Compute the frame of a link after loading, with the root link at the origin; None if Bullet returns it."""
        if not self._chains:
            return None
        frame = along(self._chains[link], {})
        return _compose((frame.position, frame.orientation), self._inertial[self._link_numbers[link]])

    def _link_frame(self, number: int, state: Sequence[Any]) -> Frame:
        # Bullet returns the link's own frame in single precision; its inertial frame has double precision.
        return _compose((state[0], state[1]), self._inertial_back[number])

    def _read(self) -> None:
        """Read names, limits and inertial frames from Bullet, parents before their children."""
        bullet, client = engine(), self.client
        root = bullet.getBodyInfo(self.number, physicsClientId=client)[0].decode()
        names = {_ROOT: root}
        self.movable_above[root] = ()
        for number in range(bullet.getNumJoints(self.number, physicsClientId=client)):
            joint = bullet.getJointInfo(self.number, number, physicsClientId=client)
            name, link, above = joint[1].decode(), joint[12].decode(), self.movable_above[names[joint[16]]]
            names[number] = link
            self._joint_numbers[name] = number
            self.joint_types[name] = kind = _joint_type(joint[2], lower=joint[8], upper=joint[9])
            if kind in _MOVABLE:
                above = (name, *above)
                self.limits[name] = (joint[8], joint[9]) if kind is not JointType.CONTINUOUS else _ENDLESS
                self.positions[name] = 0.0
            self.movable_above[link] = above
        self._link_numbers = {link: number for number, link in names.items()}
        for number in names:
            dynamics = bullet.getDynamicsInfo(self.number, number, physicsClientId=client)
            self._inertial[number] = Vector(*dynamics[3]), Quaternion(*dynamics[4])
            self._inertial_back[number] = _invert(self._inertial[number])

    def _paint(self, color: Color) -> None:
        for number in self._link_numbers.values():
            engine().changeVisualShape(self.number, number, rgbaColor=color, physicsClientId=self.client)


def _load(name: str, urdf: str, client: int) -> int:
    """Load URDF text with all its links and a fixed base, and return Bullet's number of the body."""
    bullet = engine()
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
        file.write(urdf.replace("><", ">\n<"))  # Bullet reads no line of more than 1,023 characters
        file.flush()
        with captured() as output:
            try:
                number: int | None = bullet.loadURDF(
                    file.name,
                    useFixedBase=True,
                    flags=bullet.URDF_USE_IMPLICIT_CYLINDER,
                    physicsClientId=client,
                )
            except bullet.error:
                number = None
    if number is None:
        raise DescriptionNotLoadable(name, _reason("".join(output)))
    return number


def _reason(output: str) -> str:
    """Extract the errors from Bullet's output, without its file names and line numbers."""
    errors = [part.partition("]:\n")[2].strip() for part in output.split("b3Error[")[1:]]
    return " ".join(part.split("b3Warning[")[0] for part in errors) or "Bullet printed no reason"


def _joint_type(number: int, *, lower: float, upper: float) -> JointType:
    """Return the joint's type; Bullet reports a continuous joint as a revolute one with an empty range."""
    kind = JointType(number) if number <= JointType.FIXED else JointType.UNKNOWN
    return JointType.CONTINUOUS if kind is JointType.REVOLUTE and lower > upper else kind


def _compose(outer: Frame | tuple[Sequence[float], Sequence[float]], inner: Frame) -> Frame:
    """Convert `inner`, a frame relative to `outer`, to the frame that `outer` is in."""
    (x, y, z), turn = outer
    if inner == _AT_ORIGIN:
        return Vector(x, y, z), Quaternion(*turn)
    moved = rotated(turn, inner[0])
    return Vector(x + moved.x, y + moved.y, z + moved.z), product(turn, inner[1])


def _invert(frame: Frame) -> Frame:
    position, (x, y, z, w) = frame
    back = Quaternion(-x, -y, -z, w)
    moved = rotated(back, position)
    return Vector(-moved.x, -moved.y, -moved.z), back


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
    with _without_collisions(transparent):
        return _hits(client, starts, ends)


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
    return [point for link, solids in body.solids.items() if solids for point in _inner_points(body, link)]


def _inner_points(body: Body, link: str) -> list[list[float]]:
    position, turn = body.link_frame(link)
    inner = np.concatenate([solid.inner_points for solid in body.solids[link]])
    placed: list[list[float]] = (inner @ rotation_matrix(turn).T + np.array(position)).tolist()
    return placed


def _hits(client: int, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]]) -> list[int]:
    """Return Bullet's number of the first body on every ray."""
    numbers: list[int] = []
    for begin in range(0, len(starts), _RAYS_AT_ONCE):
        chunk = slice(begin, begin + _RAYS_AT_ONCE)
        numbers += [hit[0] for hit in engine().rayTestBatch(starts[chunk], ends[chunk], physicsClientId=client)]
    return numbers


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
    """Set pose and joint positions of a body, and return what has changed."""
    before = body.pose
    joints = {joint: value for joint, value in state.joints.items() if body.positions[joint] != value}
    if joints:
        body.turn(joints)
    if body.pose != state.pose:
        body.place(state.pose)
    return StateChange(joints, body.pose != before)
