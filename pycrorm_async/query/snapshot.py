"""An episode at one moment: its task tree and its world as they were then, as plain values.

>>> moment = await memory.as_of("last", time=12.5)
>>> [node.dtype for node in moment.running]
[None, 'PickUpAction', 'MoveTCPMotion']
>>> moment.world.object("milk").pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
>>> world.restore_state(moment.world.state)  # in a world with the same objects: all of them are as they were then
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.query.named_queries import NodeSummary
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.state import ObjectState, WorldState

__all__ = ["Moment", "NodeThen", "WorldThen", "ObjectThen", "RobotThen", "AttachmentThen"]


@dataclass(frozen=True, kw_only=True)
class NodeThen(NodeSummary):
    """A node as it was then: RUNNING, without an end, if it ended later. `thoughts` is empty.

    Attributes:
        sequence: of its NodeStarted.
        start_s, end_s: since the episode's start; `end_s` is None while it runs, and if it was LOST.
    """

    sequence: int
    start_s: float
    end_s: float | None


@dataclass(frozen=True)
class ObjectThen:
    """An object as it was then.

    Attributes:
        id, identity_id: of its row in force and of its first row in `orm.Object`. An object that comes back under its
            old name is another one.
        object_type: name of the member of `ObjectType`.
        pose: of its root link's frame, in "map".
        joints: rad or m, by name.
        attached_to: what it moves with: the name of that object, and of its link (None: the root link).
    """

    id: int
    identity_id: int
    name: str
    object_type: str
    pose: Pose
    joints: Mapping[str, float]
    attached_to: tuple[str, str | None] | None


@dataclass(frozen=True)
class RobotThen:
    """The robot then: base pose, torso joint position in m (None for a robot not known here)."""

    name: str
    pose: Pose
    torso_height: float | None


class AttachmentThen(NamedTuple):
    """`child` moves with `link` of `parent` (None: the root link); objects by name."""

    parent: str
    child: str
    link: str | None


@dataclass(frozen=True)
class WorldThen:
    """The world then. `objects` are in the order they were added; `robot` is the first of type ROBOT."""

    objects: tuple[ObjectThen, ...]
    robot: RobotThen | None

    def object(self, name: str) -> ObjectThen:
        """The object of that name. Raises `CallerError` if there was none."""
        for each in self.objects:
            if each.name == name:
                return each
        present = ", ".join(each.name for each in self.objects) or "nothing"
        raise CallerError(f"there was no object {name!r} in the world then, but {present}")

    @property
    def attachments(self) -> tuple[AttachmentThen, ...]:
        """What moved with what."""
        held = [(each.name, each.attached_to) for each in self.objects]
        return tuple(AttachmentThen(to[0], name, to[1]) for name, to in held if to is not None)

    @property
    def state(self) -> WorldState:
        """The same as a world itself saves it, for `BulletWorld.restore_state`."""
        return WorldState({each.name: ObjectState(each.pose, each.joints, each.attached_to) for each in self.objects})


@dataclass(frozen=True)
class Moment:
    """An episode after one of its events, and until its next one.

    Attributes:
        number, id: of the episode: in this database, its UUID.
        simulated: it was thought through in a copy of the world, and nothing of it happened.
        sequence: of that event, the last one that had happened.
        time_s: when, since the episode's start by the monotonic clock.
        at: when, by the wall clock.
        status: of the episode then.
        tree: the nodes that had started, each before its children, children in the order they started.
    """

    number: int
    id: str
    description: str
    created_by: str
    started_at: datetime
    simulated: bool
    sequence: int
    time_s: float
    at: datetime
    status: str
    tree: tuple[NodeThen, ...]
    world: WorldThen

    @property
    def running(self) -> tuple[NodeThen, ...]:
        """The nodes that were running: the way down to what was being done, or several ways."""
        return tuple(each for each in self.tree if each.status == "RUNNING")

    def __str__(self) -> str:
        lines = [f"episode {self.number} at {self.time_s:.3f} s, event {self.sequence}: {self.status}"]
        lines += [f"{'  ' * (each.depth + 1)}{each.dtype or 'root'} {each.status}" for each in self.tree]
        lines += [f"{each.name} {each.pose!r}" for each in self.world.objects]
        return "\n".join(lines)
