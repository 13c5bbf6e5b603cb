"""`Moment` is the snapshot of an episode after one of its events: its task tree and its world, as plain values.

The classes named `…Then` are the parts of a `Moment`. Ids lead back to the tables: each change of an object is a row of
`orm.Object` with an `id` of its own, and all rows of one object share its `identity_id`, the id of the first.

>>> moment = await memory.as_of("last", time=12.5)
>>> [node.dtype for node in moment.running]
[None, 'PickUpAction', 'MoveTCPMotion']
>>> moment.world.object("milk").pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
>>> world.restore_state(moment.world.state)  # needs a world with the same objects
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.query.named_queries import NodeSummary
from pycrorm_async.query.percepts_and_places import Percept, PlaceSearch
from pycrorm_async.query.value_html import NotebookValue
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.state import ObjectState, WorldState

if TYPE_CHECKING:
    from pycrorm_async.query.notebook.markup import Drawing


@dataclass(frozen=True, kw_only=True)
class NodeThen(NodeSummary):
    """A node at that moment: RUNNING and without an end if it ended later.

    The inherited `thoughts`, the simulations that the node performed, is always empty: a snapshot reads one episode.

    Attributes:
        start_s, end_s: since the episode's start; `end_s` is None while it runs, and if it is LOST.
    """

    start_s: float
    end_s: float | None


@dataclass(frozen=True)
class ObjectThen:
    """An object at that moment.

    Attributes:
        id: of its row in `orm.Object` at that moment.
        identity_id: of its first row, from when it was added. An object that is removed and added again under its old
            name has a new identity.
        object_type: name of the member of `ObjectType`.
        pose: of its base link's frame, in "map".
        joints: rad or m, by name.
        attached_to: name and link of the object that it moves with; the link is None for the base link.
        description_fingerprint: of its description in `WorldThen.descriptions`; None in episodes of older versions.
        color: red, green, blue, opacity, 0 to 1; None if only the description has it.
        model, serial: of a robot with a `RobotDescription`; None in episodes of older versions.
        mass_kg: None if it is not known.
        base_link: None for the root link.
    """

    id: int
    identity_id: int
    name: str
    object_type: str
    pose: Pose
    joints: Mapping[str, float]
    attached_to: tuple[str, str | None] | None
    description_fingerprint: str | None = None
    color: tuple[float, float, float, float] | None = None
    model: str | None = None
    serial: str | None = None
    mass_kg: float | None = None
    base_link: str | None = None


@dataclass(frozen=True)
class RobotThen:
    """The robot at that moment: base pose, torso joint position in m (None for a robot without a description)."""

    name: str
    pose: Pose
    torso_height: float | None


class AttachmentThen(NamedTuple):
    """`child` moves with `link` of `parent` (None: the base link); objects by name."""

    parent: str
    child: str
    link: str | None


@dataclass(frozen=True)
class WorldThen(NotebookValue):
    """The world at that moment.

    Attributes:
        objects: in the order they were added.
        robot: the first of type ROBOT.
        descriptions: the descriptions of the objects, by fingerprint.
        meshes: contents of their recorded mesh files, by SHA-256; empty unless the snapshot was requested with them.
        robots: all of type ROBOT, in the order they were added.
    """

    objects: tuple[ObjectThen, ...]
    robot: RobotThen | None
    descriptions: Mapping[str, DescriptionDeclared] = field(default_factory=dict)
    meshes: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    robots: tuple[RobotThen, ...] = ()

    def object(self, name: str) -> ObjectThen:
        """Return the object with this name. Raises `CallerError` if the world had none."""
        for each in self.objects:
            if each.name == name:
                return each
        present = ", ".join(each.name for each in self.objects) or "none"
        raise CallerError(f"the world had no object {name!r} at this moment; its objects: {present}")

    @property
    def attachments(self) -> tuple[AttachmentThen, ...]:
        """All attachments of the world."""
        pairs = [(each.name, each.attached_to) for each in self.objects]
        return tuple(AttachmentThen(to[0], name, to[1]) for name, to in pairs if to is not None)

    @property
    def state(self) -> WorldState:
        """The world's state for `BulletWorld.restore_state`."""
        return WorldState({each.name: ObjectState(each.pose, each.joints, each.attached_to) for each in self.objects})

    def map(self) -> Drawing:
        """Return the world from above, as SVG that a notebook draws."""
        from pycrorm_async.query.notebook.world_map import world_map

        return world_map(self)


@dataclass(frozen=True)
class ObservationThen:
    """The latest observation of one name.

    Attributes:
        values: as recorded; a blob is a dict with its hash in `$blob`.
        sequence: of its event.
        time_s: since the episode's start.
        node: id of the node that observed it.
        missing: by path, why a value could not be recorded.
    """

    values: Any
    sequence: int
    time_s: float
    node: int | None
    missing: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Moment(NotebookValue):
    """The state of an episode after one of its events, until the next one.

    Attributes:
        number: of the episode in this database.
        id: the episode's UUID.
        simulated: True for a simulation, performed in a copy of the world.
        sequence: of that event, the last one included.
        time_s: of that event, in s since the episode's start by the monotonic clock.
        at: of that event, by the wall clock.
        status: of the episode at that moment.
        tree: the nodes that had started, each before its children, children in the order they started.
        observations: by name, the latest observation of a program.
        percepts, places: the latest 100 percepts and searches for a place up to that moment, in the order of events.
        tags: of the episode at that moment.
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
    observations: Mapping[str, ObservationThen] = field(default_factory=dict)
    tags: tuple[str, ...] = ()
    percepts: tuple[Percept, ...] = ()
    places: tuple[PlaceSearch, ...] = ()

    @property
    def running(self) -> tuple[NodeThen, ...]:
        """The running nodes: the path from the root to the current action, or several paths for concurrent ones."""
        return tuple(each for each in self.tree if each.status == "RUNNING")

    def __str__(self) -> str:
        lines = [f"episode {self.number} at {self.time_s:.3f} s, event {self.sequence}: {self.status}"]
        lines += [f"{'  ' * (each.depth + 1)}{each.dtype or each.kind} {each.status}" for each in self.tree]
        lines += [f"{each.name} {each.pose!r}" for each in self.world.objects]
        return "\n".join(lines)

    __repr__ = __str__

    def map(self) -> Drawing:
        """Return the world from above, as SVG that a notebook draws."""
        return self.world.map()
