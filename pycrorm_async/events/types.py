"""What can happen, as frozen values: the payloads of the log.

Each class is one event type; its name is the type's name in the log and its `version` counts its shapes. Fields that
are null or empty are left out of the JSON. World objects are named by the sequence of their `ObjectAdded`; nodes by the
sequence of their `NodeStarted`; times come from the envelope.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, TypeAlias

import msgspec

__all__ = [
    "Happening",
    "PoseValue",
    "ObjectReference",
    "ObjectValue",
    "RobotValue",
    "FailureValue",
    "MissingValue",
    "CandidateValue",
    "SeenValue",
    "NodeReference",
    "FieldType",
    "ItemType",
    "FieldDeclared",
    "NodeKind",
    "NodeStatus",
    "EpisodeStatus",
    "EpisodeStarted",
    "EpisodeEnded",
    "DesignatorTypeDeclared",
    "ObjectAdded",
    "ObjectRemoved",
    "ObjectMoved",
    "ObjectAttached",
    "ObjectDetached",
    "JointsMoved",
    "NodeStarted",
    "NodeEnded",
    "LocationResolved",
    "ObjectDetected",
    "StateSampled",
    "EVENT_TYPES",
]

NodeKind: TypeAlias = Literal["root", "action", "motion", "language"]
NodeStatus: TypeAlias = Literal["RUNNING", "SUCCEEDED", "FAILED", "ERROR", "CANCELLED", "INTERRUPTED", "LOST"]
EpisodeStatus: TypeAlias = Literal["RUNNING", "SUCCEEDED", "FAILED", "ERROR", "INTERRUPTED", "LOST"]

FieldType: TypeAlias = Literal[
    "integer", "real", "text", "boolean", "datetime", "enum", "pose", "object", "list", "dict"
]
ItemType: TypeAlias = Literal["integer", "real", "text", "boolean", "datetime", "enum", "pose", "object"]


class _Value(msgspec.Struct, frozen=True, omit_defaults=True):
    """A part of a payload."""


class PoseValue(_Value, frozen=True):
    """A pose as it was: metres, unit quaternion xyzw, frame name, moment it was made (UTC, ns)."""

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    frame: str
    time_ns: int


class ObjectReference(_Value, frozen=True):
    """A world object at a moment: `object` is the sequence of its ObjectAdded, `row` that of the ObjectAdded or
    ObjectMoved in force."""

    object: int
    row: int


class ObjectValue(_Value, frozen=True):
    """An object that has no row of its own yet: a part of one, a believed one, one outside the recorded world.

    `part_of` is the whole of an ObjectPart, and what the place of a LocatedObject is told relative to.
    """

    dtype: Literal["Object", "ObjectPart", "BelieveObject", "LocatedObject"]
    name: str
    object_type: str | None = None
    pose: PoseValue | None = None
    part_of: ObjectReference | None = None


class RobotValue(_Value, frozen=True):
    """The robot at the start of a node: base pose, torso joint position in metres (None without a torso)."""

    pose: PoseValue
    object_type: str
    torso_height: float | None = None
    object: ObjectReference | None = None


class FailureValue(_Value, frozen=True):
    """Why something failed: qualified class, message, constructor arguments as JSON where they can be recorded."""

    type: str
    message: str
    arguments: list[Any] = []


class MissingValue(_Value, frozen=True):
    """Stands where a value could not be recorded: the reason, and a cut, cleaned repr."""

    missing: str
    repr: str = ""


class CandidateValue(_Value, frozen=True):
    """A pose that a location designator offered, with the arms that reach from there (names).

    A place that comes from experience also says with which grasp and torso height (m) it went well.
    """

    pose: PoseValue
    arms: tuple[str, ...] = ()
    grasp: str | None = None
    torso_height: float | None = None


class SeenValue(_Value, frozen=True):
    """An object that was perceived: as it was, and the share of it that was seen, 0 to 1 (None: not looked at)."""

    name: str
    object_type: str
    pose: PoseValue
    object: ObjectReference | None = None
    visible: float | None = None


class NodeReference(_Value, frozen=True):
    """A node of another episode: the episode's UUID as text, the sequence of its NodeStarted."""

    episode: str
    node: int


class FieldDeclared(_Value, frozen=True):
    """One field of a designator type.

    Attributes:
        name: its key in `NodeStarted.parameters`; a nested dataclass' field is `outer_inner`.
        column: its column in the leaf table (`<name>_id` for poses and objects; unused for list and dict).
        type: see `FieldType`.
        slot: 2 to 31, the same for the life of the declaration.
        optional: whether null is a legal value.
        enum: for an enum, the qualified name of its class (for people; members are stored by name).
        item: for list and dict, the type of the values.
    """

    name: str
    column: str
    type: FieldType
    slot: int
    optional: bool = False
    enum: str | None = None
    item: ItemType | None = None


class Happening(_Value, frozen=True):
    """The root of all events."""

    version: ClassVar[int] = 1


class EpisodeStarted(Happening, frozen=True):
    """The first event of an episode: who, why, with what.

    Attributes:
        plan, seed: its name, that of its random numbers.
        world: described in a line.
        simulated: it is thought through in a copy of the world, and nothing of it happens.
        thought_by: the node that thinks it through.
        continues: UUID of the episode that reached its last sequence, and of which this one is the rest.
    """

    description: str
    created_by: str
    host: str
    software: str
    python: str
    plan: str | None = None
    world: str | None = None
    seed: int | None = None
    simulated: bool = False
    thought_by: NodeReference | None = None
    continues: str | None = None


class EpisodeEnded(Happening, frozen=True):
    """The last event of an episode. Status LOST is written by recovery, never by a plan.

    `continued_in` is the UUID of the episode that is its rest, if it reached its last sequence.
    """

    status: EpisodeStatus
    failure: FailureValue | None = None
    continued_in: str | None = None


class DesignatorTypeDeclared(Happening, frozen=True):
    """A designator type as it was declared in one process; named by the hash of its bytes (`fingerprint`).

    Attributes:
        kind: action, motion or language.
        dtype: the type's name in the memory, `SayingAction` for `SayingActionPerformable`.
        table: its leaf table, `saying_action`.
        concept: the SOMA concept, where one is known.
        bases: dtypes of the recorded classes it descends from, nearest first.
        fields: in the order of declaration.
        aliases: dtypes it had before it was renamed.
    """

    kind: NodeKind
    dtype: str
    table: str
    concept: str | None = None
    bases: tuple[str, ...] = ()
    fields: tuple[FieldDeclared, ...] = ()
    aliases: tuple[str, ...] = ()


class ObjectAdded(Happening, frozen=True):
    """An object is in the world. Its sequence is the object's identity in this episode. `joints` in rad or m.

    `node` put it there; None for what was there before, or came by no node.
    """

    name: str
    object_type: str
    pose: PoseValue
    joints: dict[str, float] = {}
    node: int | None = None


class ObjectRemoved(Happening, frozen=True):
    """An object left the world."""

    object: ObjectReference
    node: int | None = None


class ObjectMoved(Happening, frozen=True):
    """An object has a new pose, once per motion; also for every attached object that the motion carried."""

    object: int
    name: str
    object_type: str
    pose: PoseValue
    node: int | None = None


class ObjectAttached(Happening, frozen=True):
    """`child` moves with `link` of `parent` from now on."""

    parent: ObjectReference
    child: ObjectReference
    link: str | None = None
    node: int | None = None


class ObjectDetached(Happening, frozen=True):
    """`child` no longer moves with `parent`."""

    parent: ObjectReference
    child: ObjectReference
    link: str | None = None
    node: int | None = None


class JointsMoved(Happening, frozen=True):
    """Joints of an object have new positions (rad or m), all those that one motion set."""

    object: ObjectReference
    joints: dict[str, float]
    node: int | None = None


class NodeStarted(Happening, frozen=True):
    """A node of the task tree begins. Its sequence is the node's id in this episode.

    Attributes:
        kind: root, action, motion, language.
        parent: the parent's sequence; None for the root.
        designator: fingerprint of the `DesignatorTypeDeclared`; None for the root, and for a node whose class cannot be
            declared.
        parameters: by `FieldDeclared.name`: scalars; enum members by name; datetimes as RFC 3339 in UTC with µs;
            poses as `PoseValue`; objects as `ObjectReference` or `ObjectValue`; lists and dicts of these; a
            `MissingValue` for what cannot be recorded, also for fields that the declaration leaves out.
        robot: at this moment; None without a robot.
        simulated: thought through in a copy of the world; so are all nodes of its episode.
        continues: in an episode that continues another, the sequence there of the node of which this one is the rest.
    """

    kind: NodeKind
    parent: int | None = None
    designator: str | None = None
    parameters: dict[str, Any] = {}
    robot: RobotValue | None = None
    simulated: bool = False
    continues: int | None = None


class NodeEnded(Happening, frozen=True):
    """A node of the task tree is over. `result` is JSON, or a `MissingValue`."""

    node: int
    status: NodeStatus
    failure: FailureValue | None = None
    result: Any = None


class LocationResolved(Happening, frozen=True):
    """A location designator was asked for a place.

    Attributes:
        location: its class, e.g. `CostmapLocation`.
        offered: the candidates it gave, in order.
        taken: index into `offered` of the one the plan went on with; None if it found none good.
        considered: how many places it looked at to find them.
        node: the node that asked.
    """

    location: str
    offered: tuple[CandidateValue, ...] = ()
    taken: int | None = None
    considered: int = 0
    node: int | None = None


class ObjectDetected(Happening, frozen=True):
    """Perception answered.

    Attributes:
        source: the head camera, or the state of the world itself.
        object_type: what was looked for; None: anything.
        seen: what was found, best seen first; empty if nothing.
        node: the node that looked.
    """

    source: Literal["camera", "world_state"]
    object_type: str | None = None
    seen: tuple[SeenValue, ...] = ()
    node: int | None = None


class StateSampled(Happening, frozen=True):
    """How the robot was at a moment of a motion: those channels that changed since its last sample.

    Attributes:
        object: the robot.
        channels: `base.x`, `base.y`, `base.z` (m), `base.qx`, `base.qy`, `base.qz`, `base.qw`; joints by name (rad, m).
        node: the motion.
    """

    object: ObjectReference
    channels: dict[str, float]
    node: int | None = None


EVENT_TYPES: dict[str, type[Happening]] = {
    kind.__name__: kind
    for kind in (
        EpisodeStarted,
        EpisodeEnded,
        DesignatorTypeDeclared,
        ObjectAdded,
        ObjectRemoved,
        ObjectMoved,
        ObjectAttached,
        ObjectDetached,
        JointsMoved,
        NodeStarted,
        NodeEnded,
        LocationResolved,
        ObjectDetected,
        StateSampled,
    )
}
"""The catalogue of event types by name: what a log of this version may hold."""
