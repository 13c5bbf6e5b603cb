"""Event types are frozen values, the payloads of the log.

Each `Happening` class is an event type, named as in the log; `version` counts its shapes. The JSON omits each field
that has its default value, except in `PoseValue`; most defaults are null or empty. The number of an event in its
episode is its sequence: that of `ObjectAdded` identifies an object, that of `NodeStarted` a node. The envelope of an
event contains its times.
"""

from __future__ import annotations

import hashlib
import re
import zlib
from base64 import b64decode
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final, Literal, NamedTuple, TypeAlias

import msgspec

# === values ===================================================================================================
#
# Values are the frozen parts of events: poses, references to objects and nodes, failures, fields of a declaration.

NodeKind: TypeAlias = Literal["root", "action", "motion", "language"]
NodeStatus: TypeAlias = Literal[
    "RUNNING", "SUCCEEDED", "FAILED", "ERROR", "CANCELLED", "INTERRUPTED", "LOST", "UNKNOWN"
]
"""The names of `TaskStatus`."""
EpisodeStatus: TypeAlias = Literal["RUNNING", "SUCCEEDED", "FAILED", "ERROR", "INTERRUPTED", "LOST", "UNKNOWN"]
LOSES_OPEN_NODES: Final[frozenset[EpisodeStatus]] = frozenset({"INTERRUPTED", "LOST"})
"""The statuses of an episode whose nodes without an end are LOST: Ctrl-C came inside a hook, or the process died."""

FieldType: TypeAlias = Literal[
    "integer", "real", "text", "boolean", "datetime", "enum", "pose", "object", "list", "dict"
]
"""The type of a designator's field; the fields of a nested dataclass are fields of their own."""
ItemType: TypeAlias = Literal["integer", "real", "text", "boolean", "datetime", "enum", "pose", "object"]
"""The type of the values in a list or dict."""


class _Value(msgspec.Struct, frozen=True, omit_defaults=True):
    """The base of all parts of a payload."""


UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
"""The quaternion of no rotation."""
MAP: Final = "map"
"""The frame of nearly all poses."""


class PoseValue(_Value, frozen=True, omit_defaults=False):
    """A copy of a pose: metres, unit quaternion xyzw, frame name, and the time it was created (UTC, ns).

    Its JSON has all fields, because poses in parameters, results and arguments of failures are read by key.
    """

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = UPRIGHT
    frame: str = MAP
    time_ns: int = 0


class PoseReference(_Value, frozen=True):
    """A parameter with the same pose as one of a node around its own: the target of a motion is that of its action.

    Attributes:
        pose_of: the sequence of the NodeStarted of the node around it, which has the pose itself.
        field, slot: the name and the slot of that node's parameter.
    """

    pose_of: int
    field: str
    slot: int

    @classmethod
    def of(cls, value: Any) -> PoseReference | None:
        """Return the reference that a parameter is; None if it is none."""
        if not isinstance(value, dict) or "pose_of" not in value or value.keys() != {"pose_of", "field", "slot"}:
            return None
        try:
            return msgspec.convert(value, cls)
        except msgspec.ValidationError:
            return None


def with_poses(parameters: Mapping[str, Any], of_node: Callable[[int], Mapping[str, Any] | None]) -> dict[str, Any]:
    """Return parameters with the poses that they refer to; `of_node` returns those of a node, None for an unknown one.

    >>> named = {"target": {"pose_of": 4, "field": "place", "slot": 2}}
    >>> with_poses(named, {4: {"place": {"position": [1, 0, 0]}}}.get)
    {'target': {'position': [1, 0, 0]}}
    """
    whole = dict(parameters)
    for name, value in parameters.items():
        if (reference := PoseReference.of(value)) is not None:
            whole[name] = (of_node(reference.pose_of) or {}).get(reference.field, value)
    return whole


class BriefPose(PoseValue, frozen=True, omit_defaults=True):
    """A pose whose JSON omits the defaults, for the fields of events whose type is a pose."""

    @classmethod
    def of(cls, pose: PoseValue) -> BriefPose:
        """Copy a pose. The encoder omits an object that is the default, not one that is equal to it."""
        position, orientation, frame, time_ns = pose.position, pose.orientation, pose.frame, pose.time_ns
        if orientation == UPRIGHT and "-" not in repr(orientation):  # -0.0 is equal to 0.0 and not the same number
            orientation = UPRIGHT
        return cls(position, orientation, MAP if frame == MAP else frame, time_ns)


class ObjectReference(_Value, frozen=True):
    """A world object at one moment.

    `object` is the sequence of its ObjectAdded; `row` is the sequence of its latest ObjectAdded or ObjectMoved.
    """

    object: int
    row: int


class ObjectValue(_Value, frozen=True):
    """A copy of an object without an ObjectAdded: a part of one, a believed one, or one outside the recorded world.

    The fold adds a row to the table `object` for each parameter that is an `ObjectValue`. `part_of` is the object that
    an ObjectPart belongs to, or the one relative to which a LocatedObject is located.
    """

    dtype: Literal["Object", "ObjectPart", "BelieveObject", "LocatedObject"]
    name: str
    object_type: str | None = None
    pose: PoseValue | None = None
    part_of: ObjectReference | None = None


class RobotValue(_Value, frozen=True):
    """The robot that acted at the start of a node: base pose, torso joint position in metres (None without torso).

    `pose` is None if the robot is in the recorded world: then the event that `object.row` names has its pose, which is
    not written again for every node. `name` is that of its object in the world; None in events of older versions.
    """

    pose: PoseValue | None = None
    object_type: str = "ROBOT"
    torso_height: float | None = None
    object: ObjectReference | None = None
    name: str | None = None


class EndReference(_Value, frozen=True):
    """The end of a node: the sequences of its NodeStarted and of its NodeEnded."""

    node: int
    end: int


class FailureValue(_Value, frozen=True):
    """The exception behind a failure: qualified class, message, and those arguments that JSON can hold.

    A failure that several nodes pass on is written once: at the others, `of` names the end that has message and
    arguments, and the message is empty. It is None where the value has them itself.
    """

    type: str
    message: str
    arguments: list[Any] = []
    of: EndReference | None = None


class MissingValue(_Value, frozen=True):
    """The substitute for a value that could not be recorded: the reason, and a shortened repr of the value."""

    missing: str
    repr: str = ""


def is_missing(value: Any) -> bool:
    """Return whether a JSON value is a `MissingValue`."""
    if not isinstance(value, dict) or "missing" not in value:
        return False
    return isinstance(value["missing"], str) and value.keys() <= {"missing", "repr"}


class BlobReference(_Value, frozen=True):
    """A reference to a blob, a content that is stored beside the log: its SHA-256, media type and size in bytes.

    An array also has its `dtype` and `shape`.
    """

    hash: str = msgspec.field(name="$blob")
    media_type: str
    size: int
    dtype: str | None = None
    shape: tuple[int, ...] | None = None


class MeshValue(_Value, frozen=True):
    """A mesh file of a description.

    Attributes:
        name: of the file, without its folder.
        sha256: hash of its content, as hexadecimal digits; None if the file could not be read.
        size: bytes of its content.
        content: the blob with its content, with `record_meshes="files"`.
        missing: the reason why the file, or its content with `record_meshes="files"`, is not recorded.
    """

    name: str
    sha256: str | None = None
    size: int | None = None
    content: BlobReference | None = None
    missing: str | None = None

    @property
    def reference(self) -> str:
        """The mesh's file name in the recorded URDF."""
        return f"missing:{self.name}" if self.sha256 is None else f"sha256:{self.sha256}"


class BoxValue(_Value, frozen=True):
    """A box along the axes of a link's frame: its lowest and its highest corner, m."""

    min: tuple[float, float, float]
    max: tuple[float, float, float]


class LinkBoxValue(_Value, frozen=True):
    """The box around a link's collision shapes along the axes of the root link's frame, with every joint at 0.

    Attributes:
        center, half: its centre and half of its edges, m.
        joint, axis: the prismatic joint that slides the link, and its direction; None and 0 for a link that is fixed.
    """

    link: str
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    joint: str | None = None
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0)


class CandidateValue(_Value, frozen=True):
    """A pose that a location designator offered, with the names of the arms that reach the target from there.

    A place taken from experience also holds the grasp and the torso height (m) that succeeded there.
    """

    pose: PoseValue
    arms: tuple[str, ...] = ()
    grasp: str | None = None
    torso_height: float | None = None


class RefusalValue(_Value, frozen=True):
    """A pose that a location designator tried and did not offer, with the reason."""

    pose: PoseValue
    reason: str


class CellsValue(_Value, frozen=True):
    """The numbers of places in the costmaps of a search.

    Attributes:
        occupied: places with an obstacle too near for any heading.
        hidden: further places from which the target is not visible.
        free: all others, the best of which the search examined.
    """

    occupied: int
    hidden: int
    free: int


class SeenValue(_Value, frozen=True):
    """A percept: an object as perception returned it.

    Attributes:
        object: the object of the recorded world that it matches; None if none does.
        visible: the visible share of the object, 0 to 1; None if there is no camera.
        source: of the percept; None if it is that of its `ObjectDetected`.
    """

    name: str
    object_type: str
    pose: PoseValue
    object: ObjectReference | None = None
    visible: float | None = None
    confidence: float | None = None
    source: str | None = None


class NodeReference(_Value, frozen=True):
    """A node of another episode: the episode's UUID as text, and the sequence of the node's NodeStarted."""

    episode: str
    node: int


class FieldDeclared(_Value, frozen=True):
    """One field of a designator type.

    Attributes:
        name: key in `NodeStarted.parameters`; the field of a nested dataclass is `outer_inner`.
        column: column in the leaf table (`<name>_id` for poses and objects; unused for list and dict).
        type: see `FieldType`.
        slot: 2 to 31, constant within one declaration.
        optional: whether null is a legal value.
        enum: for an enum, the qualified name of its class (documentation only; members are stored by name).
        item: for list and dict, the type of the values.
    """

    name: str
    column: str
    type: FieldType
    slot: int
    optional: bool = False
    enum: str | None = None
    item: ItemType | None = None


# === types ====================================================================================================

_URDF_BYTES_MAX = 2**28
"""Bounds the bytes of a decompressed URDF; `record_bytes_max` bounds those of a compressed one."""


class Happening(msgspec.Struct, frozen=True, omit_defaults=True):
    """The base class of all events."""

    version: ClassVar[int] = 1


class EpisodeStarted(Happening, frozen=True):
    """The first event of an episode: its description, user, host and versions.

    Attributes:
        plan: name of the plan.
        seed: seed of the plan's random numbers.
        world: description of the world in one line.
        simulated: whether the episode is a simulation, performed in a copy of the world.
        thought_by: the node that runs the simulation.
        continues: UUID of the episode that ran out of sequences and that this one continues.
        plan_sha256: SHA-256 of the plan's file.
        git_commit, git_dirty: the commit of the plan's repository, and whether the work tree differed from it.
        libraries: version by package.
        settings: the memory's settings that differ from their defaults, by name.
        clock_synchronized, clock_error_us: whether a time service kept the clock, and the estimated error.
        tags, metadata: given by the program that opened the episode; `EpisodeTagged` changes the tags.
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
    plan_sha256: str | None = None
    git_commit: str | None = None
    git_dirty: bool | None = None
    libraries: dict[str, str] = {}
    settings: dict[str, Any] = {}
    clock_synchronized: bool | None = None
    clock_error_us: int | None = None
    tags: tuple[str, ...] = ()
    metadata: dict[str, Any] = {}


class EpisodeEnded(Happening, frozen=True):
    """The last event of an episode. Only recovery writes the status LOST.

    `continued_in` is the UUID of the episode that continues this one, if this one ran out of sequences. `world`
    describes, in one line, the world that was entered inside the episode, in the state in which the plan left it.
    """

    status: EpisodeStatus
    failure: FailureValue | None = None
    continued_in: str | None = None
    world: str | None = None


class EpisodeTagged(Happening, frozen=True):
    """An episode got tags and lost others. The only event that may follow `EpisodeEnded`.

    An episode has a tag if the latest event that names the tag added it.
    """

    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()


class DesignatorTypeDeclared(Happening, frozen=True):
    """The declaration of a designator type by one process; the hash of its bytes identifies it (`fingerprint`).

    Attributes:
        kind: action, motion or language.
        dtype: the type's name in the memory, `SayingAction` for `SayingActionPerformable`.
        table: name of its leaf table, `saying_action`.
        concept: the SOMA concept, for types that have one.
        bases: dtypes of its recorded base classes, nearest first.
        fields: its fields in the order of declaration.
        aliases: dtypes the type had before it was renamed.
    """

    kind: NodeKind
    dtype: str
    table: str
    concept: str | None = None
    bases: tuple[str, ...] = ()
    fields: tuple[FieldDeclared, ...] = ()
    aliases: tuple[str, ...] = ()


class DescriptionDeclared(Happening, frozen=True):
    """The description that objects are made from; the hash of its bytes identifies it (`fingerprint`).

    `zlib.decompress(base64.b64decode(payload["urdf"])).decode()` is the URDF as text.

    Attributes:
        urdf: the URDF, compressed with zlib, in base64, without texture files. The name of a mesh file is `sha256:` and
            the hash of its content, or `missing:` and its own name; `MeshValue.reference` is the same text.
        meshes: the mesh files, each once.
        boxes: for each link with a mesh, the box around its collision shapes, in the link's frame; around its visual
            ones if it has none.
        link_boxes: for each link that is fixed or slides; links that turn have none.
        missing: the reason if the description could not be recorded; `urdf` is empty then.
    """

    urdf: str = ""
    meshes: tuple[MeshValue, ...] = ()
    boxes: dict[str, BoxValue] = {}
    link_boxes: tuple[LinkBoxValue, ...] = ()
    missing: str | None = None

    @property
    def text(self) -> str:
        """The URDF as text; empty if it is missing. Raises `ValueError` for content that no recorder wrote."""
        try:
            return zlib.decompressobj().decompress(b64decode(self.urdf), _URDF_BYTES_MAX).decode()
        except zlib.error as error:
            raise ValueError(f"the URDF cannot be decompressed: {error}") from error

    @property
    def text_sha256(self) -> str:
        """SHA-256 of the text, thus of the URDF and of its meshes' contents, however meshes and text were recorded."""
        return hashlib.sha256(self.text.encode()).hexdigest()


class ObjectAdded(Happening, frozen=True):
    """An object entered the world. The event's sequence identifies the object in this episode.

    Attributes:
        joints: in rad or m.
        node: the node that added the object; None if no node did, or if it was in the world before the episode.
        description: fingerprint of the `DescriptionDeclared`; None in events of older versions.
        color: red, green, blue, opacity, 0 to 1; None if only the description has it.
        model, serial: of a robot with a `RobotDescription`: the model's name, and the serial number if it is known.
        mass_kg: as given, or the sum of the masses in the description; None if it is not known.
        base_link: of a robot: the link whose frame has the pose, in all events of this object; None: the root link.
    """

    version = 2

    name: str
    object_type: str
    pose: PoseValue
    joints: dict[str, float] = {}
    node: int | None = None
    description: str | None = None
    color: tuple[float, float, float, float] | None = None
    model: str | None = None
    serial: str | None = None
    mass_kg: float | None = None
    base_link: str | None = None


class ObjectRemoved(Happening, frozen=True):
    """An object left the world."""

    object: ObjectReference
    node: int | None = None


class ObjectMoved(Happening, frozen=True):
    """An object has a new pose. Recorded once per motion, and for every attached object that the motion carried."""

    version = 2

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
    """Joints of an object have new positions (rad or m). One event holds all joints that one motion set."""

    object: ObjectReference
    joints: dict[str, float]
    node: int | None = None


class NodeStarted(Happening, frozen=True):
    """A node of the task tree started. The event's sequence is the node's id in this episode.

    Attributes:
        kind: root, action, motion, language.
        parent: the parent's sequence; None for the root.
        designator: the first digits of the fingerprint of the `DesignatorTypeDeclared` (`codec.short_name`); None for
            the root, and if its class cannot be declared.
        parameters: by `FieldDeclared.name`: scalars; enum members by name; datetimes as RFC 3339 in UTC with µs;
            poses as `PoseValue` or `PoseReference`; objects as `ObjectReference` or `ObjectValue`; lists and dicts of
            these; a `MissingValue` for a value that cannot be recorded and for a field that the declaration omits.
        robot: the robot's state at this moment; None if there is no robot.
        simulated: whether the node is part of a simulation; the same for all nodes of an episode.
        continues: in a follow-up episode, the sequence that the continued node had in the former episode.
    """

    version = 3

    kind: NodeKind = "action"
    parent: int | None = None
    designator: str | None = None
    parameters: dict[str, Any] = {}
    robot: RobotValue | None = None
    simulated: bool = False
    continues: int | None = None


class NodeEnded(Happening, frozen=True):
    """A node of the task tree ended. `result` is JSON, or a `MissingValue`.

    `untimed` is true if the time of the end is not known: that of the event says only when the end was reported.
    """

    version = 3

    node: int
    status: NodeStatus = "SUCCEEDED"
    failure: FailureValue | None = None
    result: Any = None
    untimed: bool = False

    @property
    def has_time(self) -> bool:
        """Whether the node ended at the time of the event: not if it is LOST, nor if its end was reported later."""
        return self.status != "LOST" and not self.untimed


class LocationResolved(Happening, frozen=True):
    """A location designator was resolved.

    Attributes:
        location: class of the location designator, e.g. `CostmapLocation`.
        offered: the first candidates it offered, in order, and the last one.
        taken: index into `offered` of the candidate that the plan used; None if it used none.
        considered: number of places the designator examined to find them.
        node: the node that resolved it.
        refused: the first examined places that it did not offer, in order; empty in events of older versions.
        offered_beyond: number of further candidates it offered.
        cells: the places in its costmaps; None if it has none, and in events of older versions.
    """

    version = 2

    location: str
    offered: tuple[CandidateValue, ...] = ()
    taken: int | None = None
    considered: int = 0
    node: int | None = None
    refused: tuple[RefusalValue, ...] = ()
    offered_beyond: int = 0
    cells: CellsValue | None = None


class ObjectDetected(Happening, frozen=True):
    """Perception returned a result.

    Attributes:
        source: the head camera, or the state of the world itself.
        object_type: type of the objects searched for; None: any type.
        seen: the perceived objects, most visible first.
        node: the node that made the request.
    """

    version = 2

    source: Literal["camera", "world_state"]
    object_type: str | None = None
    seen: tuple[SeenValue, ...] = ()
    node: int | None = None


class StateSampled(Happening, frozen=True):
    """A sample of the robot's state during a motion: the channels that changed since its previous sample.

    Attributes:
        object: the robot.
        channels: `base.x`, `base.y`, `base.z` (m), `base.qx`, `base.qy`, `base.qz`, `base.qw`; joints by name (rad, m).
        node: the motion's node.
    """

    object: ObjectReference
    channels: dict[str, float]
    node: int | None = None


class Observed(Happening, frozen=True):
    """A program made an observation of its own.

    Attributes:
        name: given by the program.
        values: JSON: scalars, dicts and lists of these; a `BlobReference` for a content that is stored as a blob.
        node: the node that observed it.
        missing: by the path of keys and indices, joined by dots, the reason why a value could not be recorded; the
            value there is null. The path of `values` itself is empty.
    """

    name: str
    values: Any = None
    node: int | None = None
    missing: dict[str, str] = {}


EVENT_TYPES: dict[str, type[Happening]] = {kind.__name__: kind for kind in Happening.__subclasses__()}
"""The event types by name, which are those above; a log of this version holds no others."""


# === blobs ====================================================================================================
#
# Find the blobs that an event refers to in its payload, without decoding it.
#
# The bytes of a `BlobReference` are unmistakable: inside a JSON string every quotation mark is escaped, and `observe`
# accepts no key that begins with `$`. The encoder writes its fields in the order of their declaration, without spaces.

BLOB_KEY: Final = "$blob"
"""Key of a reference's hash; marks a JSON object as a reference."""
REFERRING: Final = frozenset({"Observed", "DescriptionDeclared"})
"""The event types that may refer to blobs. Payloads of other types are not searched, because a plan's own parameters
may contain the key."""
_REFERENCE: Final = re.compile(
    rb'\{"\$blob":"([0-9a-f]{64})","media_type":("(?:[^"\\]|\\.)*"),"size":([0-9]{1,18})[,}]'
)


class Blob(NamedTuple):
    """A content that is stored beside the log, with its media type: an image, a point cloud, a sound."""

    content: bytes
    media_type: str = "application/octet-stream"


def references_in(type_name: str, payload: bytes) -> list[BlobReference]:
    """Return the references in an event's payload, in order, without `dtype` and `shape` of arrays.

    >>> [each.size for each in references_in("Observed", b'{"$blob":"%s","media_type":"a/b","size":3}' % (b"0" * 64))]
    [3]
    """
    if type_name not in REFERRING or b'"$blob"' not in payload:
        return []
    return [
        BlobReference(sha256.decode(), msgspec.json.decode(media_type, type=str), int(size))
        for sha256, media_type, size in _REFERENCE.findall(payload)
    ]
