"""Fold one event into rows. The fold is pure: it reads no clock and no table, and its only state is the batch's rows.

The same events give the same rows, live or rebuilt, in one batch or one by one. An event that cannot be folded raises
`CannotFold` before it has added any row, so that its episode can be parked at this event and the others continue.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from pycrorm_async.events.codec import Decoder, UnknownShape
from pycrorm_async.events.ids import SLOT_ROBOT_POSE
from pycrorm_async.events.types import (
    EVENT_TYPES,
    EpisodeEnded,
    EpisodeStarted,
    EpisodeTagged,
    Happening,
    JointsMoved,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectRemoved,
    Observed,
    StateSampled,
)
from pycrorm_async.events.upcasters import UPCASTERS
from pycrorm_async.projections.fold.column_values import (
    POSE_COLUMNS,
    CannotFold,
    json_text,
    microseconds,
    pose_columns,
    pose_row,
    row,
)
from pycrorm_async.projections.fold.node_row import (
    DTYPE,
    ID,
    KIND,
    PARAMETERS,
    PARENT_ID,
    PROCESS_METADATA_ID,
    ROBOT,
    ROBOT_OBJECT_ID,
    ROBOT_POSE_ID,
    ROBOT_TYPE,
    RUNNING,
    SIMULATED,
    START_NS,
    START_TIME,
    TORSO_HEIGHT,
)
from pycrorm_async.projections.fold.object_row import object_row
from pycrorm_async.projections.fold.observed_values import value_rows
from pycrorm_async.projections.fold.parameters import Designators, ParameterRows
from pycrorm_async.projections.fold.row_batch import EpisodeEnd, Row, Rows
from pycrorm_async.projections.schema.core_columns import COLUMNS
from pycrorm_async.store.stored import StoredEvent

_NO_OUTCOME: Row = (None, None, None, None)


class UndecodablePayload(CannotFold):
    """The payload does not decode as its own type and version, so the log is damaged."""


def fold(event: StoredEvent, designators: Designators, rows: Rows) -> None:
    """Add the rows of this event to `rows`. Raises `CannotFold`, and then has added none."""
    happening = happening_of(event)
    _FOLDS[event.type](event, happening, designators, rows)


def fold_happening(event: StoredEvent, happening: Happening, designators: Designators, rows: Rows) -> None:
    """Add the rows of an event whose payload is decoded already; as `fold`."""
    _FOLDS[event.type](event, happening, designators, rows)


def happening_of(event: StoredEvent) -> Happening:
    """Decode the payload of an episode's event, for every fold. Raises `CannotFold`, `UndecodablePayload`."""
    try:
        return _decode(event.type, event.payload, event.version)
    except UnknownShape as reason:
        raise CannotFold(str(reason)) from None
    except msgspec.DecodeError as error:
        raise UndecodablePayload(f"{event.type} cannot be decoded: {error}") from None


# --- episodes -------------------------------------------------------------------------------------------------


def _episode_started(event: StoredEvent, started: EpisodeStarted, _designators: Designators, rows: Rows) -> None:
    if event.number in rows.episodes:
        raise CannotFold("the episode starts a second time")
    by = started.thought_by
    rows.episodes[event.number] = {
        "id": event.number,
        "uuid": None,  # `name_episodes` sets it
        "created_at": microseconds(event.wall_ns),
        "created_by": started.created_by,
        "description": started.description,
        "version": started.software,
        "host": started.host,
        "python": started.python,
        "plan": started.plan,
        "world": started.world,
        "seed": started.seed,
        "status": "RUNNING",
        "ended_at": None,
        "end_sequence": None,
        "failure_type": None,
        "failure_message": None,
        "simulated": started.simulated,
        "thought_by": by.episode if by else None,
        "thought_by_node": by.node if by else None,
        "continues": started.continues,
        "continued_in": None,
        "plan_sha256": started.plan_sha256,
        "git_commit": started.git_commit,
        "git_dirty": started.git_dirty,
        "libraries": json_text(started.libraries) if started.libraries else None,
        "settings": json_text(started.settings) if started.settings else None,
        "clock_synchronized": started.clock_synchronized,
        "clock_error_us": started.clock_error_us,
        "entered_world": None,
        "metadata": json_text(started.metadata) if started.metadata else None,
    }
    _tagging(event, started.tags, (), rows)
    if started.simulated:
        rows.inserts["simulated_episode"].append((event.number,))


def _episode_tagged(event: StoredEvent, tagged: EpisodeTagged, _designators: Designators, rows: Rows) -> None:
    _tagging(event, tagged.added, tagged.removed, rows)


def _tagging(event: StoredEvent, added: tuple[str, ...], removed: tuple[str, ...], rows: Rows) -> None:
    own, number = _own(event)
    time = microseconds(event.wall_ns)
    changes = [*((tag, False) for tag in removed), *((tag, True) for tag in added)]
    rows.inserts["episode_tagging"].extend(
        (own, position, number, tag, is_added, time) for position, (tag, is_added) in enumerate(changes)
    )


def _episode_ended(event: StoredEvent, ended: EpisodeEnded, _designators: Designators, rows: Rows) -> None:
    failure = ended.failure
    rows.end_episode(
        EpisodeEnd(
            event.number,
            ended.status,
            microseconds(event.wall_ns),
            event.sequence,
            failure.type if failure else None,
            failure.message if failure else None,
            ended.continued_in,
            ended.world,
        )
    )


# --- nodes ----------------------------------------------------------------------------------------------------


def _node_started(event: StoredEvent, started: NodeStarted, designators: Designators, rows: Rows) -> None:
    number, sequence, _, _, wall_ns, monotonic_ns, _ = event
    node = row(number, sequence)
    parameter_rows: ParameterRows = []
    designator = designators.of(started)
    leaf = designator.rows(event, node, started.parameters, parameter_rows) if designator is not None else ()
    parameters = json_text(started.parameters) if started.parameters else None
    parent = row(number, started.parent) if started.parent is not None else None
    robot = started.robot
    robot_object = row(number, robot.object.row) if robot is not None and robot.object is not None else None
    # Nothing below raises, so that an event adds all of its rows or none.
    rows.nodes[node] = columns = [*RUNNING]
    columns[ID] = node
    columns[PROCESS_METADATA_ID] = number
    columns[PARENT_ID] = parent
    columns[KIND] = started.kind
    columns[START_TIME] = wall_ns // 1000
    columns[START_NS] = monotonic_ns
    if started.simulated:
        columns[SIMULATED] = True
    if robot is not None:
        rows.inserts["pose"].append(pose_row(node + SLOT_ROBOT_POSE, number, robot.pose))
        columns[ROBOT_POSE_ID] = node + SLOT_ROBOT_POSE
        columns[TORSO_HEIGHT] = robot.torso_height
        columns[ROBOT_TYPE] = robot.object_type
        columns[ROBOT_OBJECT_ID] = robot_object
        columns[ROBOT] = robot.name
    if designator is not None:
        columns[DTYPE] = designator.dtype
        columns[PARAMETERS] = parameters
        rows.leaves.setdefault(designator.leaf, []).append(leaf)
        for table, each in parameter_rows:
            rows.inserts[table].append(each)


def _node_ended(event: StoredEvent, ended: NodeEnded, _designators: Designators, rows: Rows) -> None:
    number, sequence, _, _, wall_ns, monotonic_ns, _ = event
    node, status = row(number, ended.node), ended.status
    outcome = _outcome(ended) if ended.failure is not None or ended.result is not None else _NO_OUTCOME
    if status == "LOST":  # recovery computed this end; the true end time was never recorded
        rows.end_node(node, status, None, None, None, outcome)
    else:
        rows.end_node(node, status, wall_ns // 1000, monotonic_ns, sequence, outcome)


def _outcome(ended: NodeEnded) -> Row:
    """Return a node's columns from reason to result."""
    failure = ended.failure
    return (
        failure.type.rpartition(".")[2] if failure else None,
        failure.message if failure else None,
        json_text(failure.arguments) if failure and failure.arguments else None,
        json_text(ended.result) if ended.result is not None else None,
    )


# --- the world ------------------------------------------------------------------------------------------------


def _object_added(event: StoredEvent, added: ObjectAdded, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    node, time = _node(event, added.node), microseconds(event.wall_ns)
    joints = json_text(added.joints) if added.joints else None
    color = json_text(added.color) if added.color is not None else None
    if added.description is not None:
        rows.descriptions.add(added.description)
    rows.inserts["pose"].append(pose_row(own, number, added.pose))
    columns = object_row(
        own, number, "Object", added.name, added.object_type, own, None, own, time, node,
        joints, added.description, color, added.model, added.serial, added.mass_kg, added.base_link,
    )  # fmt: skip
    rows.inserts["object"].append(columns)


def _object_moved(event: StoredEvent, moved: ObjectMoved, _designators: Designators, rows: Rows) -> None:
    identity, node = row(event.number, moved.object), _node(event, moved.node)
    own, number = _own(event)
    time = microseconds(event.wall_ns)
    rows.inserts["pose"].append(pose_row(own, number, moved.pose))
    rows.inserts["object"].append(
        object_row(own, number, "Object", moved.name, moved.object_type, own, None, identity, time, node)
    )


def _object_removed(event: StoredEvent, removed: ObjectRemoved, _designators: Designators, rows: Rows) -> None:
    reference = removed.object
    object_id, identity_id = row(event.number, reference.row), row(event.number, reference.object)
    rows.inserts["object_removal"].append(
        (*_own(event), object_id, identity_id, microseconds(event.wall_ns), _node(event, removed.node))
    )


def _attachment(
    event: StoredEvent, change: ObjectAttached | ObjectDetached, _designators: Designators, rows: Rows
) -> None:
    kind = "attached" if isinstance(change, ObjectAttached) else "detached"
    parent_id, child_id = row(event.number, change.parent.row), row(event.number, change.child.row)
    rows.inserts["attachment"].append(
        (*_own(event), kind, parent_id, child_id, change.link, microseconds(event.wall_ns), _node(event, change.node))
    )


def _joints_moved(event: StoredEvent, moved: JointsMoved, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    object_id, node, time = row(number, moved.object.row), _node(event, moved.node), microseconds(event.wall_ns)
    rows.inserts["joint_change"].extend(
        [(own, joint, number, object_id, position, time, node) for joint, position in moved.joints.items()]
    )


# --- locations ------------------------------------------------------------------------------------------------


def _location_resolved(event: StoredEvent, resolved: LocationResolved, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    offered, taken = resolved.offered, resolved.taken
    count = len(offered) + resolved.offered_beyond
    if taken is not None and not 0 <= taken < len(offered):
        raise CannotFold(f"candidate {taken} was taken, but only {len(offered)} were offered")
    node, time = _node(event, resolved.node), microseconds(event.wall_ns)
    pose_id = own if taken is not None else None
    if taken is not None:
        rows.inserts["pose"].append(pose_row(own, number, offered[taken].pose))
    cells = resolved.cells
    numbers = (cells.occupied, cells.hidden, cells.free) if cells is not None else (None, None, None)
    refused = max(resolved.considered - count, 0)
    rows.inserts["location_resolution"].append(
        (own, number, node, resolved.location, resolved.considered, count, taken, pose_id, time, refused, *numbers)
    )
    rows.inserts["location_candidate"].extend(
        (own, rank, number, *pose_columns(each.pose), ",".join(each.arms), rank == taken, each.grasp, each.torso_height)
        for rank, each in enumerate(offered)
    )
    rows.inserts["location_refusal"].extend(
        (own, rank, number, *pose_columns(each.pose), each.reason) for rank, each in enumerate(resolved.refused)
    )


# --- perception and the state stream --------------------------------------------------------------------------


def _object_detected(event: StoredEvent, detected: ObjectDetected, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    node, time = _node(event, detected.node), microseconds(event.wall_ns)
    detections = [  # complete before any row is added, because `row` may raise
        (
            own, rank, number, node, each.source if each.source is not None else detected.source, detected.object_type,
            row(number, each.object.row) if each.object is not None else None, each.name, each.object_type,
            *pose_columns(each.pose), each.visible, each.confidence, time,
        )
        for rank, each in enumerate(detected.seen)
    ]  # fmt: skip
    rows.inserts["detection"].extend(detections)


def _state_sampled(event: StoredEvent, sampled: StateSampled, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    object_id, node = row(number, sampled.object.row), _node(event, sampled.node)
    time, ns = microseconds(event.wall_ns), event.monotonic_ns
    rows.inserts["state_sample"].extend(
        [(own, channel, number, object_id, node, value, time, ns) for channel, value in sampled.channels.items()]
    )


def _observed(event: StoredEvent, observed: Observed, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    node, time = _node(event, observed.node), microseconds(event.wall_ns)
    values = [(own, position, number, *each) for position, each in enumerate(value_rows(observed))]
    rows.inserts["observation"].append((own, number, node, observed.name, time, event.monotonic_ns))
    rows.inserts["observation_value"].extend(values)


# --- parts ----------------------------------------------------------------------------------------------------


def _own(event: StoredEvent) -> tuple[int, int]:
    return row(event.number, event.sequence), event.number


def _node(event: StoredEvent, sequence: int | None) -> int | None:
    return row(event.number, sequence) if sequence is not None else None


_FOLDS: dict[str, Callable[[StoredEvent, Any, Designators, Rows], None]] = {
    "EpisodeStarted": _episode_started,
    "EpisodeEnded": _episode_ended,
    "EpisodeTagged": _episode_tagged,
    "NodeStarted": _node_started,
    "NodeEnded": _node_ended,
    "ObjectAdded": _object_added,
    "ObjectMoved": _object_moved,
    "ObjectRemoved": _object_removed,
    "ObjectAttached": _attachment,
    "ObjectDetached": _attachment,
    "JointsMoved": _joints_moved,
    "LocationResolved": _location_resolved,
    "ObjectDetected": _object_detected,
    "StateSampled": _state_sampled,
    "Observed": _observed,
}
_decode = Decoder(
    {name: EVENT_TYPES[name] for name in _FOLDS}, {key: each for key, each in UPCASTERS.items() if key[0] in _FOLDS}
).decode

for _table, _columns in {
    "episode_tagging": "id position process_metadata_id tag added time",
    "object_removal": "id process_metadata_id object_id identity_id time node_id",
    "attachment": "id process_metadata_id kind parent_id child_id link time node_id",
    "joint_change": "id joint process_metadata_id object_id position time node_id",
    "location_resolution": "id process_metadata_id node_id location considered offered taken pose_id time refused"
    " occupied_cells hidden_cells free_cells",
    "location_candidate": f"resolution_id position process_metadata_id {POSE_COLUMNS} arms taken grasp torso_height",
    "location_refusal": f"resolution_id position process_metadata_id {POSE_COLUMNS} reason",
    "detection": "id position process_metadata_id node_id source looked_for object_id name obj_type"
    f" {POSE_COLUMNS} visible confidence time",
    "state_sample": "id channel process_metadata_id object_id node_id value time ns",
    "observation": "id process_metadata_id node_id name time ns",
}.items():
    assert " ".join(COLUMNS[_table]) == _columns, f"the fold writes the columns of {_table} in another order"
