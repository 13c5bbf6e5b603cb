"""Values are the frozen parts of events: poses, references to objects and nodes, failures, fields of a declaration.

The JSON omits each field that has its default value; most defaults are null or empty.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import msgspec

__all__ = [
    "PoseValue",
    "ObjectReference",
    "ObjectValue",
    "RobotValue",
    "FailureValue",
    "MissingValue",
    "BlobReference",
    "MeshValue",
    "BoxValue",
    "LinkBoxValue",
    "CandidateValue",
    "RefusalValue",
    "CellsValue",
    "SeenValue",
    "NodeReference",
    "FieldType",
    "ItemType",
    "FieldDeclared",
    "NodeKind",
    "NodeStatus",
    "EpisodeStatus",
]

NodeKind: TypeAlias = Literal["root", "action", "motion", "language"]
NodeStatus: TypeAlias = Literal["RUNNING", "SUCCEEDED", "FAILED", "ERROR", "CANCELLED", "INTERRUPTED", "LOST"]
"""The names of `TaskStatus`."""
EpisodeStatus: TypeAlias = Literal["RUNNING", "SUCCEEDED", "FAILED", "ERROR", "INTERRUPTED", "LOST"]

FieldType: TypeAlias = Literal[
    "integer", "real", "text", "boolean", "datetime", "enum", "pose", "object", "list", "dict"
]
"""The type of a designator's field; the fields of a nested dataclass are fields of their own."""
ItemType: TypeAlias = Literal["integer", "real", "text", "boolean", "datetime", "enum", "pose", "object"]
"""The type of the values in a list or dict."""


class _Value(msgspec.Struct, frozen=True, omit_defaults=True):
    """The base of all parts of a payload."""


class PoseValue(_Value, frozen=True):
    """A copy of a pose: metres, unit quaternion xyzw, frame name, and the time it was created (UTC, ns)."""

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    frame: str
    time_ns: int


class ObjectReference(_Value, frozen=True):
    """A world object at one moment.

    `object` is the sequence of its ObjectAdded; `row` is the sequence of its latest ObjectAdded or ObjectMoved.
    """

    object: int
    row: int


class ObjectValue(_Value, frozen=True):
    """A copy of an object without an ObjectAdded: a part of one, a believed one, or one outside the recorded world.

    The fold makes a row of `object` from it for each parameter that is one. `part_of` is the object that an ObjectPart
    belongs to, or the one relative to which a LocatedObject is located.
    """

    dtype: Literal["Object", "ObjectPart", "BelieveObject", "LocatedObject"]
    name: str
    object_type: str | None = None
    pose: PoseValue | None = None
    part_of: ObjectReference | None = None


class RobotValue(_Value, frozen=True):
    """The robot that acted at the start of a node: base pose, torso joint position in metres (None without a torso).

    `name` is that of its object in the world; None in events of older versions.
    """

    pose: PoseValue
    object_type: str
    torso_height: float | None = None
    object: ObjectReference | None = None
    name: str | None = None


class FailureValue(_Value, frozen=True):
    """The exception behind a failure: qualified class, message, and those arguments that JSON can hold."""

    type: str
    message: str
    arguments: list[Any] = []


class MissingValue(_Value, frozen=True):
    """The substitute for a value that could not be recorded: the reason, and a shortened repr of the value."""

    missing: str
    repr: str = ""


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
        visible: the visible share of the object, 0 to 1; None without a camera.
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
