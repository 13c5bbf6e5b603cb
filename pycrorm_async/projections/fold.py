"""Turn events into rows, without reading a table."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import ParseError, fromstring

import msgspec
from sqlalchemy import select, text
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.events.codec import UPCASTERS, Decoder, UnknownShape, description_of, fingerprint
from pycrorm_async.events.ids import SLOT_ROBOT_POSE
from pycrorm_async.events.reasons import reason_of
from pycrorm_async.events.types import (
    EVENT_TYPES,
    DescriptionDeclared,
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
from pycrorm_async.projections.columns import (
    COLUMNS,
    CORE,
    EPISODE,
    LINK_BOX,
    OF_NO_EPISODE,
    column_type,
    make_table,
    physical_name,
)
from pycrorm_async.projections.row_batch import (
    NO_OUTCOME,
    NOT_FIRST,
    OBJECT_COLUMNS,
    POSE_COLUMNS,
    CannotFold,
    Designators,
    EpisodeEnd,
    NodeEnd,
    ParameterRows,
    Row,
    Rows,
    json_text,
    microseconds,
    pose_columns,
    pose_row,
    row_of,
    value_rows,
)
from pycrorm_async.store.dialect import Insertion, RowsByTable
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.schema import SELECT_IDS
from pycrorm_async.store.stored import Span, StoredEvent

# === fold =====================================================================================================
#
# Fold one event into rows. The fold is pure: it reads no clock and no table, and its only state is the batch's rows.
#
# The same events give the same rows, live or rebuilt, in one batch or one by one. An event that cannot be folded raises
# `CannotFold` before it has added any row, so that its episode can be parked at this event and the others continue.


class UndecodablePayload(CannotFold):
    """The payload does not decode as its own type and version, so the log is damaged."""


def fold_happening(event: StoredEvent, happening: Happening, designators: Designators, rows: Rows) -> None:
    """Add the rows of an event and its decoded payload to `rows`. Raises `CannotFold`, and then has added none."""
    _FOLDS[event.type](event, happening, designators, rows)


def happening_of(event: StoredEvent) -> Happening:
    """Decode the payload of an episode's event, for every fold. Raises `CannotFold`, `UndecodablePayload`."""
    try:
        return _decode(event.type, event.payload, event.version)
    except UnknownShape as reason:
        raise CannotFold(str(reason)) from None
    except msgspec.DecodeError as error:
        raise UndecodablePayload(f"{event.type} cannot be decoded: {error}") from None


def decode_events(
    events: Iterable[StoredEvent], reads: Collection[str] | None = None
) -> tuple[list[Happening | None], CannotFold | None]:
    """Decode payloads up to the first that cannot be decoded; return them with the reason why that one cannot be.

    With `reads`, those of events of other types are None.
    """
    happenings: list[Happening | None] = []
    try:
        for event in events:
            happening = happening_of(event) if reads is None or event.type in reads else None
            happenings.append(happening)
    except CannotFold as reason:
        return happenings, reason
    return happenings, None


# --- episodes -------------------------------------------------------------------------------------------------


_RECORDED_OF_EPISODE = (
    *("created_by", "description", "host", "python", "plan", "world", "seed", "simulated", "continues"),
    *("plan_sha256", "git_commit", "git_dirty", "clock_synchronized", "clock_error_us"),
)
"""The columns of an episode that are fields of its start."""


def _episode_started(event: StoredEvent, started: EpisodeStarted, _designators: Designators, rows: Rows) -> None:
    if event.number in rows.episodes:
        raise CannotFold("the episode starts a second time")
    by = started.thought_by
    rows.episodes[event.number] = {
        **dict.fromkeys(COLUMNS["process_metadata"]),  # of these, `name_episodes` sets `uuid` and the end others
        **{name: getattr(started, name) for name in _RECORDED_OF_EPISODE},
        "id": event.number,
        "created_at": microseconds(event.wall_ns),
        "version": started.software,
        "status": "RUNNING",
        "start_ns": event.monotonic_ns,
        "thought_by": by.episode if by else None,
        "thought_by_node": by.node if by else None,
        "libraries": json_text(started.libraries) if started.libraries else None,
        "settings": json_text(started.settings) if started.settings else None,
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
            event.monotonic_ns,
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
    node = row_of(number, sequence)
    parameter_rows: ParameterRows = []
    designator = designators.of(started)
    kind, dtype, leaf = started.kind, None, ()
    if designator is not None:
        kind, dtype = designator.kind, designator.dtype
        leaf = designator.rows(event, node, started.parameters, parameter_rows)
    parent = row_of(number, started.parent) if started.parent is not None else None
    pose_id = torso_height = robot_type = robot_object = robot_name = None
    if (robot := started.robot) is not None:
        torso_height, robot_type, robot_name = robot.torso_height, robot.object_type, robot.name
        if robot.object is not None:
            robot_object = row_of(number, robot.object.row)
        # A row of an object and its pose have one id.
        pose_id = robot_object if robot.pose is None else node + SLOT_ROBOT_POSE
    # Nothing below raises, so that an event adds all of its rows or none.
    rows.nodes[node] = [
        node, number, parent, kind, dtype, "RUNNING", wall_ns // 1000, monotonic_ns, None, None, *NO_OUTCOME,
        pose_id, torso_height, robot_type, robot_object, robot_name, started.simulated,
    ]  # fmt: skip
    if robot is not None and robot.pose is not None:
        rows.inserts["pose"].append(pose_row(node + SLOT_ROBOT_POSE, number, robot.pose))
    if designator is not None:
        rows.leaves.setdefault(designator.leaf, []).append(leaf)
        for table, each in parameter_rows:
            rows.inserts[table].append(each)


def _node_ended(event: StoredEvent, ended: NodeEnded, _designators: Designators, rows: Rows) -> None:
    number, sequence, _, _, _, monotonic_ns, _ = event
    node, status = row_of(number, ended.node), ended.status
    outcome = _outcome(number, ended) if ended.failure is not None or ended.result is not None else NO_OUTCOME
    if ended.has_time:
        rows.end_node(node, status, monotonic_ns, sequence, outcome)
    else:
        rows.end_node(node, status, None, None, outcome)


def _outcome(number: int, ended: NodeEnded) -> Row:
    """Return a node's columns from reason to result."""
    failure, result = ended.failure, json_text(ended.result) if ended.result is not None else None
    if failure is None:
        return None, None, None, None, result
    if failure.of is not None:
        return reason_of(failure), None, None, row_of(number, failure.of.node), result
    arguments = json_text(failure.arguments) if failure.arguments else None
    return reason_of(failure), failure.message, arguments, None, result


# --- the world ------------------------------------------------------------------------------------------------


def _object_added(event: StoredEvent, added: ObjectAdded, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    node, time = _node(event, added.node), microseconds(event.wall_ns)
    joints = json_text(added.joints) if added.joints else None
    color = json_text(added.color) if added.color is not None else None
    if added.description is not None:
        rows.descriptions.add(added.description)
    rows.inserts["pose"].append(pose_row(own, number, added.pose))
    columns = (
        own, number, "Object", added.name, added.object_type, own, None, own, time, node,
        joints, added.description, color, added.model, added.serial, added.mass_kg, added.base_link,
    )  # fmt: skip
    rows.inserts["object"].append(columns)


def _object_moved(event: StoredEvent, moved: ObjectMoved, _designators: Designators, rows: Rows) -> None:
    identity, node = row_of(event.number, moved.object), _node(event, moved.node)
    own, number = _own(event)
    time = microseconds(event.wall_ns)
    rows.inserts["pose"].append(pose_row(own, number, moved.pose))
    rows.inserts["object"].append(
        (own, number, "Object", moved.name, moved.object_type, own, None, identity, time, node, *NOT_FIRST)
    )


def _object_removed(event: StoredEvent, removed: ObjectRemoved, _designators: Designators, rows: Rows) -> None:
    reference = removed.object
    object_id, identity_id = row_of(event.number, reference.row), row_of(event.number, reference.object)
    rows.inserts["object_removal"].append(
        (*_own(event), object_id, identity_id, microseconds(event.wall_ns), _node(event, removed.node))
    )


def _attachment(
    event: StoredEvent, change: ObjectAttached | ObjectDetached, _designators: Designators, rows: Rows
) -> None:
    kind = "attached" if isinstance(change, ObjectAttached) else "detached"
    parent_id, child_id = row_of(event.number, change.parent.row), row_of(event.number, change.child.row)
    rows.inserts["attachment"].append(
        (*_own(event), kind, parent_id, child_id, change.link, microseconds(event.wall_ns), _node(event, change.node))
    )


def _joints_moved(event: StoredEvent, moved: JointsMoved, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    object_id, node, time = row_of(number, moved.object.row), _node(event, moved.node), microseconds(event.wall_ns)
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
            row_of(number, each.object.row) if each.object is not None else None, each.name, each.object_type,
            *pose_columns(each.pose), each.visible, each.confidence, time,
        )
        for rank, each in enumerate(detected.seen)
    ]  # fmt: skip
    rows.inserts["detection"].extend(detections)


def _state_sampled(event: StoredEvent, sampled: StateSampled, _designators: Designators, rows: Rows) -> None:
    own, number = _own(event)
    object_id, node = row_of(number, sampled.object.row), _node(event, sampled.node)
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
    return row_of(event.number, event.sequence), event.number


def _node(event: StoredEvent, sequence: int | None) -> int | None:
    return row_of(event.number, sequence) if sequence is not None else None


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
    "task_tree_node": "id process_metadata_id parent_id kind dtype status start_time start_ns end_ns end_sequence"
    " reason failure_message failure_arguments failure_node_id result robot_pose_id torso_height robot_type"
    " robot_object_id robot simulated",
    "object": f"{OBJECT_COLUMNS} joints description_fingerprint color model serial mass_kg base_link",
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


# === link boxes ===============================================================================================
#
# Insert the boxes around the links of descriptions when an object is added that is made from one.
#
# The rows depend on the description alone, and every fold of an object makes the same ones. So the fold that comes
# first inserts them, in the transaction with the object's row, and later ones find them.

_COLUMNS = tuple(OF_NO_EPISODE[LINK_BOX])


async def insert_link_boxes(connection: AsyncConnection, generation: int, descriptions: Collection[str]) -> None:
    """Insert the boxes of those of these descriptions that have none in this generation."""
    table = make_table(LINK_BOX, OF_NO_EPISODE[LINK_BOX], generation, dialect_of(connection).stored_column)
    present = await connection.execute(select(table.c.model).distinct().where(table.c.model.in_(sorted(descriptions))))
    missing = set(descriptions).difference(present.scalars())
    boxes = await boxes_of(connection, missing) if missing else {}
    # In the order of the keys, so that two processes that insert the same boxes wait for each other in one direction.
    rows = [dict(zip(_COLUMNS, row, strict=True)) for _, each in sorted(boxes.items()) for row in each]
    if rows:
        statement = (
            f"INSERT INTO {physical_name(LINK_BOX, generation)} ({', '.join(_COLUMNS)})"  # noqa: S608
            f" VALUES ({', '.join(f':{each}' for each in _COLUMNS)}) ON CONFLICT DO NOTHING"
        )
        await connection.execute(text(statement), rows)


async def boxes_of(connection: AsyncConnection, descriptions: Collection[str]) -> dict[str, list[Row]]:
    """Return the rows of these descriptions, by fingerprint, without those that are not stored or cannot be read."""
    payloads = await dialect_of(connection).descriptions(connection, sorted(descriptions))
    rows: dict[str, list[Row]] = {}
    for payload in payloads:
        model = fingerprint(payload, "DescriptionDeclared")
        try:
            description = description_of(payload)
            boxes = description.link_boxes
        except (UnknownShape, msgspec.DecodeError):
            continue
        if model in descriptions:
            # The only link of a description has no name here, as that of a built-in model.
            is_named = len(boxes) > 1 or _has_further_links(description)
            rows[model] = [
                (model, position, each.link if is_named else None, each.joint, *each.center, *each.half, *each.axis)
                for position, each in enumerate(boxes)
                if not each.link.endswith("_handle")
            ]
    return rows


def _has_further_links(description: DescriptionDeclared) -> bool:
    """Return whether a description has several links, also such that turn or have no shape, and so no box."""
    try:
        return len(fromstring(description.text).findall("link")) > 1  # noqa: S314  it was loaded into a world
    except (ValueError, ParseError):  # its content is not a URDF, as no recorder writes
        return False


# === row writer ===============================================================================================
#
# Write the rows of a batch with one statement for each table, as far as the number of parameters allows.
#
# Values are bound or copied and never encoded as JSON, so that every double is stored exactly. `executemany` is not
# used, because it releases the GIL at every row: next to a busy plan it wrote 872 rows/s, one statement 123,000 rows/s.


def stored_rows(engine: AsyncEngine, rows: RowsByTable, generation: int) -> RowsByTable:
    """Rename tables and columns to the names that they have in this database and generation."""
    stored = dialect_of(engine).stored_column
    return {
        (physical_name(table, generation), (*map(stored, columns),)): some for (table, columns), some in rows.items()
    }


async def uuids_of(connection: AsyncConnection, numbers: Collection[int]) -> dict[int, str]:
    """Return the UUIDs of these episodes, by number: their events contain only the number."""
    return dict(await dialect_of(connection).rows(connection, tuple, SELECT_IDS, numbers=[(each,) for each in numbers]))


def name_episodes(rows: Rows, uuids: Mapping[int, str]) -> None:
    """Set the UUID of the episodes that start in these rows."""
    for number, row in rows.episodes.items():
        if number in uuids:
            row["uuid"] = uuids[number]


class Batch(ABC):
    """The rows of a batch of events.

    Attributes:
        reads: the types of the events that it folds; None: all types.
    """

    reads: frozenset[str] | None = None

    def continued(self, spans: Sequence[Span]) -> Sequence[Span]:
        """Return those of these spans before which `restore` needs to read no event."""
        return spans

    @abstractmethod
    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Prepare for folding these spans, by reading the facts that the fold needs of the events before them."""

    @abstractmethod
    def fold(self, events: Sequence[StoredEvent], happenings: Sequence[Happening | None]) -> tuple[int, str] | None:
        """Add the rows of consecutive events of an episode, at least one; `happenings` are their decoded payloads.

        Events of types that are not in `reads` may have no happening.

        Returns the first event that cannot be folded, with the reason; of it and those behind it, no row is added.
        """

    async def look_up(self, log: EventLog, events: Sequence[StoredEvent]) -> None:  # noqa: B027
        """Read what these events name in others, before they are folded."""

    @abstractmethod
    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        """Prepare the statements for this generation, after the last event and before the transaction."""

    @abstractmethod
    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Write the rows. Raises `RowRefused`."""


class TableRows(Batch):
    """The rows of a batch of events in the built-in tables. The id of a row that an event names follows from it."""

    def __init__(self, designators: Designators) -> None:
        self._designators = designators
        self._rows = Rows()
        self._uuids: dict[int, str] = {}
        self._insertion: Insertion = None

    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Read the UUIDs of the episodes that start in these spans. The caller may hold the write lock of SQLite."""
        starting = [span.number for span in spans if span.after == 0]
        if starting:
            async with log.reading() as connection:
                self._uuids = await uuids_of(connection, starting)

    def fold(self, events: Sequence[StoredEvent], happenings: Sequence[Happening | None]) -> tuple[int, str] | None:
        designators, rows = self._designators, self._rows
        for event, happening in zip(events, happenings, strict=True):
            try:
                _FOLDS[event.type](event, happening, designators, rows)
            except CannotFold as reason:
                return event.sequence, str(reason)
        return None

    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        name_episodes(self._rows, self._uuids)
        self._insertion = await dialect_of(engine).insertion(stored_rows(engine, self._rows.to_insert(), generation))

    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Insert and update the rows in the caller's transaction, which also writes the checkpoints.

        Raises `RowRefused` for a row whose id exists already: then the fold or the log is at fault.
        """
        dialect, rows = dialect_of(connection), self._rows
        await dialect.insert(connection, self._insertion)
        if rows.descriptions:
            await insert_link_boxes(connection, generation, rows.descriptions)
        for table, fields, ends in (
            ("task_tree_node", NodeEnd._fields, rows.node_ends),
            ("process_metadata", EpisodeEnd._fields, rows.episode_ends),
        ):
            if ends:
                kinds = {name: column_type(CORE[table][name]).compile(dialect=connection.dialect) for name in fields}
                episode = EPISODE if EPISODE in CORE[table] else None
                name = physical_name(table, generation)
                await dialect.update_rows(connection, name, kinds, ends, episode=episode)
        for number in rows.lost:
            await connection.execute(
                text(
                    f"UPDATE {physical_name('task_tree_node', generation)} SET status = 'LOST'"  # noqa: S608
                    " WHERE process_metadata_id = :number AND status = 'RUNNING'"
                ),
                {"number": number},
            )
