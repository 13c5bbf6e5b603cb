"""Make cases from the events of episodes, and store them as blocks beside the memory's tables.

**Situation.** Describe the situation in which an action starts, as symbols and numbers by feature.

| feature | |
|---|---|
| `robot` | name of the robot that acts |
| `object_type`, `object_name` | of the object of its first parameter that is an object; of others `<field>_type` |
| `near` | types of the objects within 0.5 m of this object |
| `held` | types of the objects attached to the robot |
| texts, enum members, booleans | by field; `True` and `False` for a boolean |
| `stand_x`, `stand_y`, `stand_yaw` | pose of the robot in the frame of an upright object |
| `torso`, `object_z`, `height` | position of the torso, height of the object, and over the torso |
| integers, reals | by field |
| `<field>_x`, `_y`, `_z`, `_yaw` | a pose in the robot's frame |

A parameter with a reserved name, such as `status`, becomes the feature `status_parameter`. Times, lists and dicts are
not features. `near` never contains the robot or the environment.

**Episode cases.** Make a case (`recall.columns`) of each action of one episode when it ends: its situation at the
start, its outcome.

>>> cases: list[Case] = []
>>> EpisodeCases().read(zip(events, happenings, strict=True), declarations.get, cases)

The fold is pure, and its memory grows with the nodes that run and the objects in the world. Besides the features of
`situation` a case has `inside`, the type of the nearest action around it, and `after` and `after_status`, type and
status of the action that ended last inside the same action. All features are known before the action runs.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import atan2
from typing import Any, ClassVar, Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
from sqlalchemy import Select, TableClause, column, delete, select, table, true
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import DamageError
from pycrorm_async.events import types as event_types
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_id, row_key
from pycrorm_async.events.reasons import reason_of
from pycrorm_async.projections.columns import OWN, physical_name
from pycrorm_async.projections.custom import EpisodeFolds, PackedProjection, ProjectedBatch, Projection, Refused
from pycrorm_async.projections.findings import Comparison, EpisodeRange, TableCheck, TableDifference, VerifyResult
from pycrorm_async.projections.fold import Batch
from pycrorm_async.projections.generations import select_generation
from pycrorm_async.projections.row_batch import row_of
from pycrorm_async.projections.verify import ProjectionCheck
from pycrorm_async.query.replay import ReplayedWorld, WorldObject
from pycrorm_async.recall.blocks import EPISODE_SHIFT, CaseBlock, decode, encode, is_same, merge
from pycrorm_async.recall.columns import RESERVED, Case
from pycrorm_async.store.dialect import Insertion, RowsByTable
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.stored import StoredEvent

# === case batch ===============================================================================================
#
# Collect the cases of a batch of events, and write them as one block.


class CaseBatch(ProjectedBatch):
    """The cases of one batch of events, which it writes as one block. Implements `Batch`."""

    def __init__(
        self,
        projection: PackedProjection,
        declared: Mapping[str, event_types.DesignatorTypeDeclared],
        folds: EpisodeFolds,
    ) -> None:
        super().__init__(projection, declared, folds)
        self.cases: list[Case] = []
        self._insertion: Insertion = None

    def add(
        self, fold: EpisodeCases, events: Iterable[tuple[StoredEvent, event_types.Happening]], *, kept: bool
    ) -> Refused | None:
        return fold.read(events, self._declared.get, self.cases if kept else [])

    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        await super().ready(engine, generation)
        if self.cases:
            rows = rows_of(CaseBlock.of(self.cases), generation)
            self._insertion = await dialect_of(engine).insertion(rows)

    async def write(self, connection: AsyncConnection, generation: int) -> None:
        if self.cases:
            await dialect_of(connection).insert(connection, self._insertion)
            await merge_blocks(connection, generation)


# === case check ===============================================================================================
#
# Compare the stored cases with those that the log makes, episode by episode.

_BLOCKS_KEPT: Final = 20
"""Bounds the blocks that are kept decoded between parts, because a full one has the cases of many parts: 5 MB each."""


class CaseCheck(ProjectionCheck):
    """The check of the blocks of cases. Implements `TableCheck`."""

    def __init__(self, projection: Projection, result: VerifyResult) -> None:
        super().__init__(projection, result)
        self._blocks: dict[int, CaseBlock | None] = {}

    async def differences(
        self, connection: AsyncConnection, comparison: Comparison, rows: Batch, episodes: EpisodeRange
    ) -> Sequence[TableDifference]:
        assert isinstance(rows, CaseBatch)
        number = comparison.generation.number
        end = EPISODE_NUMBER_MAX + 1 if episodes.end is None else episodes.end
        headings = [
            each
            for each in await read_headings(connection, number)
            if each.episode_min < end and each.episode_max >= episodes.first
        ]
        blocks = [block for each in headings if (block := await self._block(connection, number, each)) is not None]
        left_out = frozenset().union(*(each.left_out for each in blocks))
        folded = CaseBlock.of(rows.cases)
        blocks = [each.of_episodes(episodes.first, end) for each in blocks]
        self.result.rows += sum(map(len, blocks))
        if not left_out and is_same(folded, merge(blocks)):
            return []
        expected = {each.node: each for each in _without(left_out, folded.cases())}
        stored: dict[int, Case] = {}
        differences: list[TableDifference] = []
        for block in blocks:
            for case in _without(left_out, block.cases()):
                if case.node in stored:
                    differences.append(_difference(case.node, "blocks with it", 2, 1))
                stored[case.node] = case
        for node in sorted(expected.keys() | stored.keys()):
            differences += _compared(node, stored.get(node), expected.get(node))
        return differences

    async def _block(self, connection: AsyncConnection, generation: int, heading: BlockHeading) -> CaseBlock | None:
        """Read a block, once for all parts whose cases it contains. A damaged one is reported, and counts as empty."""
        kept = self._blocks
        if heading.number not in kept:
            block: CaseBlock | None = None
            try:
                block = (await read_blocks(connection, generation, [heading.number])).get(heading.number)
                if block is None or len(block) != heading.cases:
                    cases = 0 if block is None else len(block)
                    self._report(heading, f"has {cases} cases, and should have {heading.cases}")
            except DamageError as fault:
                self._report(heading, str(fault))
            kept[heading.number] = block
            if len(kept) > _BLOCKS_KEPT:
                kept.pop(next(iter(kept)))
        return kept[heading.number]

    def _report(self, heading: BlockHeading, fault: str) -> None:
        self.result.add_difference(
            TableDifference(heading.episode_min, 1, BLOCKS, f"block {heading.number}", fault, "as it was written")
        )


def _compared(node: int, stored: Case | None, expected: Case | None) -> Iterator[TableDifference]:
    if stored == expected:
        return
    if stored is None or expected is None:
        yield _difference(node, None, stored, expected)
        return
    fields: list[Mapping[str, Any]] = [each._replace(symbols={}, numbers={})._asdict() for each in (stored, expected)]
    for was, should in (fields, (stored.symbols, expected.symbols), (stored.numbers, expected.numbers)):
        for name in sorted(was.keys() | should.keys()):
            if was.get(name) != should.get(name):
                yield _difference(node, name, was.get(name), should.get(name))


def _difference(node: int, column: str | None, stored: Any, expected: Any) -> TableDifference:
    number, sequence, _ = row_key(node)
    return TableDifference(number, sequence, BLOCKS, column, stored, expected)


def _without(features: frozenset[str], cases: Iterable[Case]) -> Iterator[Case]:
    """Return the cases without the features that a block has left out, because their dictionaries are too long."""
    for case in cases:
        symbols = {name: value for name, value in case.symbols.items() if name not in features}
        yield case if len(symbols) == len(case.symbols) else case._replace(symbols=symbols)


# === situation ================================================================================================

Symbols: TypeAlias = dict[str, str | tuple[str, ...]]
Numbers: TypeAlias = dict[str, float]

_NEAR_M = 0.5
"""The distance within which another object counts as near."""
_UPRIGHT_MIN: Final = 0.99
"""The cosine of 8 degrees: the x-y plane of an object that leans more does not lie on the floor."""
_OBJECTS_MAX: Final = 1_000
"""Bounds the objects that are compared for each action. In a world with more objects `near` is empty."""
_NUMBER_MAX: Final = 1e300
"""Bounds the magnitude of a number. An integer may have any number of digits, and then has no float."""
_NEVER_NEAR = frozenset({"ROBOT", "ENVIRONMENT"})
_COMPUTED = RESERVED | frozenset(
    "inside after after_status robot object_type object_name near held stand_x stand_y stand_yaw torso object_z"
    " height".split()
)


class FeatureFields(NamedTuple):
    """The fields of a designator type that are features, each with its feature, and the type itself."""

    dtype: str
    texts: tuple[tuple[str, str], ...]
    numbers: tuple[tuple[str, str], ...]
    poses: tuple[tuple[str, tuple[str, str, str, str]], ...]
    objects: tuple[str, ...]
    kind: str

    @classmethod
    def of(cls, declaration: event_types.DesignatorTypeDeclared) -> FeatureFields:
        named: dict[str, list[str]] = {}
        for each in declaration.fields:
            named.setdefault(each.type, []).append(each.name)

        def features(*types: str) -> tuple[tuple[str, str], ...]:
            names = [name for type_ in types for name in named.get(type_, ())]
            return tuple((name, f"{name}_parameter" if name in _COMPUTED else name) for name in names)

        objects = tuple(named.get("object", ()))
        poses = tuple((name, (f"{each}_x", f"{each}_y", f"{each}_z", f"{each}_yaw")) for name, each in features("pose"))
        texts, numbers = features("text", "enum", "boolean"), features("integer", "real")
        return cls(declaration.dtype, texts, numbers, poses, objects, declaration.kind)


def situation(
    fields: FeatureFields, parameters: Mapping[str, Any], robot: event_types.RobotValue | None, world: ReplayedWorld
) -> tuple[Symbols, Numbers]:
    """Return the features of an action that starts with these parameters, for this robot and in this world."""
    symbols: Symbols = {}
    numbers: Numbers = {}
    _add_parameters(symbols, numbers, fields, parameters)
    stands = world.pose_of(robot) if robot is not None else None
    if robot is not None:
        _add_robot(symbols, numbers, fields, parameters, robot, stands)
    identity = None
    if fields.objects and (value := parameters.get(fields.objects[0])) is not None:
        identity = value.get("object")
        _add_object(symbols, numbers, _seen(value, world), robot, stands)
    for name in fields.objects[1:]:
        if (value := parameters.get(name)) is not None and (type_ := _seen(value, world).type) is not None:
            symbols[f"{name}_type"] = type_
    if len(world.objects) <= _OBJECTS_MAX:
        _add_surroundings(symbols, identity, robot, world.objects)
    return symbols, numbers


def _add_parameters(symbols: Symbols, numbers: Numbers, fields: FeatureFields, parameters: Mapping[str, Any]) -> None:
    for name, feature in fields.texts:
        if (value := parameters.get(name)) is not None:
            symbols[feature] = value if isinstance(value, str) else str(value)
    for name, feature in fields.numbers:
        if (value := parameters.get(name)) is not None and abs(value) < _NUMBER_MAX:
            numbers[feature] = float(value)


def _add_robot(
    symbols: Symbols,
    numbers: Numbers,
    fields: FeatureFields,
    parameters: Mapping[str, Any],
    robot: event_types.RobotValue,
    stands: event_types.PoseValue | None,
) -> None:
    if robot.name is not None:
        symbols["robot"] = robot.name
    if robot.torso_height is not None:
        numbers["torso"] = robot.torso_height
    if stands is None:
        return
    for name, features in fields.poses:
        if (value := parameters.get(name)) is not None and value.get("frame") == stands.frame:
            x, y, z, yaw = features
            numbers[x], numbers[y], numbers[z], numbers[yaw] = _pose_in(value["position"], value["orientation"], stands)


class _Seen(NamedTuple):
    """Name, type and pose of a parameter's object, as far as they are known."""

    name: str | None
    type: str | None
    pose: event_types.PoseValue | None


def _seen(value: Mapping[str, Any], world: ReplayedWorld) -> _Seen:
    """Return the state of a parameter's object, which may have been removed, or be outside of the recorded world."""
    identity = value.get("object")
    if identity is None:
        pose = value.get("pose")
        return _Seen(value.get("name"), value.get("object_type"), pose and msgspec.convert(pose, event_types.PoseValue))
    present = world.objects.get(identity)
    if present is None:
        return _Seen(world.name_of(identity), None, None)
    return _Seen(present.added.name, present.added.object_type, present.pose)


def _add_object(
    symbols: Symbols,
    numbers: Numbers,
    seen: _Seen,
    robot: event_types.RobotValue | None,
    stands: event_types.PoseValue | None,
) -> None:
    if seen.type is not None:
        symbols["object_type"] = seen.type
    if seen.name is not None:
        symbols["object_name"] = seen.name
    if seen.pose is None:
        return
    height = seen.pose.position[2]
    numbers["object_z"] = height
    if robot is None or stands is None or stands.frame != seen.pose.frame:
        return
    if robot.torso_height is not None:
        numbers["height"] = height - stands.position[2] - robot.torso_height
    x, y, _, _ = seen.pose.orientation
    if 1 - 2 * (x * x + y * y) >= _UPRIGHT_MIN:
        numbers["stand_x"], numbers["stand_y"], _, numbers["stand_yaw"] = _pose_in(
            stands.position, stands.orientation, seen.pose
        )


def _add_surroundings(
    symbols: Symbols, identity: int | None, robot: event_types.RobotValue | None, objects: Mapping[int, WorldObject]
) -> None:
    target = objects.get(identity) if identity is not None else None
    holder = robot.object.object if robot is not None and robot.object is not None else None
    if target is None and holder is None:
        return
    near, held = set(), set()
    for each in objects.values():
        if each.attached_to is not None and each.attached_to[0] == holder:
            held.add(each.added.object_type)
        if target is not None and each is not target and _is_near(each, target):
            near.add(each.added.object_type)
    if near:
        symbols["near"] = tuple(sorted(near))
    if held:
        symbols["held"] = tuple(sorted(held))


def _is_near(each: WorldObject, target: WorldObject) -> bool:
    if each.added.object_type in _NEVER_NEAR:
        return False
    x, y, z = each.pose.position
    to_x, to_y, to_z = target.pose.position
    return (x - to_x) ** 2 + (y - to_y) ** 2 + (z - to_z) ** 2 <= _NEAR_M**2


def _pose_in(
    position: Sequence[float], orientation: Sequence[float], frame: event_types.PoseValue
) -> tuple[float, float, float, float]:
    """Return x, y, z and yaw of a pose in the frame of another; orientations are quaternions xyzw."""
    (fx, fy, fz, fw), (at_x, at_y, at_z) = frame.orientation, frame.position
    dx, dy, dz = position[0] - at_x, position[1] - at_y, position[2] - at_z
    turned_x, turned_y, turned_z = fy * dz - fz * dy - fw * dx, fz * dx - fx * dz - fw * dy, fx * dy - fy * dx - fw * dz
    x, y, z, w = orientation
    qx = fw * x - fx * w - fy * z + fz * y
    qy = fw * y + fx * z - fy * w - fz * x
    qz = fw * z - fx * y + fy * x - fz * w
    qw = fw * w + fx * x + fy * y + fz * z
    return (
        dx + 2 * (fy * turned_z - fz * turned_y),
        dy + 2 * (fz * turned_x - fx * turned_z),
        dz + 2 * (fx * turned_y - fy * turned_x),
        atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)),
    )


# === episode cases ============================================================================================

READS: Final = (
    event_types.EpisodeStarted,
    event_types.EpisodeEnded,
    event_types.NodeStarted,
    event_types.NodeEnded,
    event_types.ObjectAdded,
    event_types.ObjectRemoved,
    event_types.ObjectMoved,
    event_types.ObjectAttached,
    event_types.ObjectDetached,
)
"""The types of events that cases are made from."""


DeclarationOf: TypeAlias = Callable[[str], event_types.DesignatorTypeDeclared | None]
"""Returns the designator type that a node names; None if it was never declared, or by a newer version."""


@dataclass(slots=True)
class _Action:
    """An action that runs, with the situation in which it started.

    Attributes:
        node: id of its node.
        scope: the nearest action around it; None outside any.
        poses: its parameters that are poses, to which those of nodes inside it may refer.
        after: type and status of the action that ended last inside it.
    """

    node: int
    time_us: int
    monotonic_ns: int
    type: str
    scope: _Action | None
    symbols: Symbols
    numbers: Numbers
    simulated: bool
    poses: Mapping[str, Any]
    after: tuple[str, str] | None = None
    has_ended: bool = False

    def case(self, status: str, reason: str | None = None, duration_s: float | None = None) -> Case:
        """Return its case."""
        scope = self.scope
        parent = scope.node if scope is not None else None
        outcome = status, reason, duration_s, parent, self.simulated
        return make(Case, (self.node, self.time_us, self.type, self.symbols, self.numbers, *outcome))


class EpisodeCases:
    """The cases of one episode, from its first event on.

    Args:
        types: the feature fields by the short names of types, which the folds of several episodes share.
    """

    def __init__(self, types: dict[str, FeatureFields] | None = None) -> None:
        self._types = {} if types is None else types
        self._world = ReplayedWorld()
        self._running: dict[int, _Action] = {}
        """The actions that run."""
        self._scopes: dict[int, _Action] = {}
        """The nearest action around each other node that runs, without those outside any."""
        self._after: tuple[str, str] | None = None
        self._simulated = False
        self._wall_at_zero_ns: int | None = None
        """The wall time at which the monotonic clock of the episode was zero, according to its first event. Starts are
        reckoned from it, so that actions keep their order when the wall clock is set meanwhile."""

    def read(
        self,
        events: Iterable[tuple[StoredEvent, event_types.Happening]],
        declaration_of: DeclarationOf,
        cases: list[Case],
    ) -> Refused | None:
        """Apply the next events, of the types in `READS`; append the cases of the actions that they end to `cases`.

        Returns the first event that cannot be folded, with the exception; those behind it are not applied.
        """
        for event, happening in events:
            try:
                if type(happening) is event_types.NodeStarted:
                    self._start(event, happening, declaration_of)
                elif type(happening) is event_types.NodeEnded:
                    action = self._running.pop(happening.node, None)
                    if action is not None:
                        cases.append(self._end(action, happening, event.monotonic_ns))
                    else:
                        self._scopes.pop(happening.node, None)
                elif isinstance(happening, event_types.EpisodeStarted):
                    self._simulated = happening.simulated
                    self._wall_at_zero_ns = event.wall_ns - event.monotonic_ns
                elif isinstance(happening, event_types.EpisodeEnded):
                    if happening.status in event_types.LOSES_OPEN_NODES:
                        cases += [each.case("LOST") for each in self._running.values()]
                    self._running.clear()
                    self._scopes.clear()
                else:
                    self._world.read(event.sequence, happening)
            except Exception as fault:  # noqa: BLE001 - of a payload of any content; the caller parks the episode
                return event.sequence, fault
        return None

    def _start(self, event: StoredEvent, started: event_types.NodeStarted, declaration_of: DeclarationOf) -> None:
        number, sequence, _, _, wall_ns, monotonic_ns, _ = event
        parent = started.parent
        scope = self._running.get(parent) or self._scopes.get(parent) if parent is not None else None
        fields = None
        if started.designator is not None:
            fields = self._types.get(started.designator)
            if fields is None and (declaration := declaration_of(started.designator)) is not None:
                fields = self._types[started.designator] = FeatureFields.of(declaration)
        if fields is None or fields.kind != "action":
            if scope is not None:
                self._scopes[sequence] = scope
            return
        parameters = started.parameters
        for value in parameters.values():
            if type(value) is dict and ("missing" in value or "pose_of" in value):
                present = {name: each for name, each in parameters.items() if not event_types.is_missing(each)}
                parameters = event_types.with_poses(present, self._poses_of)
                break
        symbols, numbers = situation(fields, parameters, started.robot, self._world)
        after = self._after
        if scope is not None:
            after = scope.after
            if scope.has_ended:  # before this branch of it, so nothing in it came before
                after = None
            else:
                symbols["inside"] = scope.type
        if after is not None:
            symbols["after"], symbols["after_status"] = after
        simulated = self._simulated or started.simulated
        self._running[sequence] = _Action(
            row_of(number, sequence),
            (wall_ns if self._wall_at_zero_ns is None else self._wall_at_zero_ns + monotonic_ns) // 1000,
            monotonic_ns,
            fields.dtype,
            scope,
            symbols,
            numbers,
            simulated,
            {name: parameters[name] for name, _ in fields.poses if name in parameters},
        )

    def _poses_of(self, sequence: int) -> Mapping[str, Any] | None:
        action = self._running.get(sequence)
        return action.poses if action is not None else None

    def _end(self, action: _Action, ended: event_types.NodeEnded, monotonic_ns: int) -> Case:
        status, failure = ended.status, ended.failure
        action.has_ended = True
        if action.scope is None:
            self._after = action.type, status
        else:
            action.scope.after = action.type, status
        duration_s = (monotonic_ns - action.monotonic_ns) / 1e9 if ended.has_time else None
        reason = reason_of(failure) if failure is not None else None
        return action.case(status, reason, duration_s)


# === stored blocks ============================================================================================
#
# Store blocks of cases in the table of a generation, merge them as they grow, and read them.
#
# Theory of operation. Each batch of folded events writes the cases of its actions as one block, in the transaction that
# advances the checkpoints. A block has a level, by the number of its cases: 1, 16, 256, 4,096 or 65,536 and more. In
# the same transaction, the blocks of a level are merged into one of the next level when there are 16 of them, or when
# they hold 65,536 cases. So a case is rewritten at most four times, a memory has at most some sixty blocks besides the
# full ones, and the full ones never change.
#
# Several processes may fold one memory. On PostgreSQL a merge locks the blocks that it takes, and is left to a later
# batch if another transaction has locked one of them, so that two merges never take the same block, and no process
# waits. A transaction that is rolled back, by a kill too, leaves the blocks as they were, with the checkpoints. A
# reader that reads the list of the blocks and then their bytes in one snapshot finds each case once.
#
# The number of a block is the greatest node id among its cases, plus its level: node ids end in five zero bits. A case
# moves to higher levels only, so a number is never used twice in a generation.

BLOCKS: Final = "recall_block"
BLOCK_COLUMNS: Final = {
    "level": "integer",
    "cases": "integer",
    "episode_min": "integer",
    "episode_max": "integer",
    "checksum": "integer",
    "left_out": "text",
    "data": "bytes",
}
"""The columns of `recall_block`. Its `id` is the block's number. The episodes are those of its cases. `data`
has the bytes of the block (`recall.blocks`), `checksum` their CRC-32. `left_out` is a JSON list of the features that
have more than `WORDS_MAX` words here; it is null if there are none."""
_MERGED: Final = 16
"""The number of blocks of one level that are merged into one of the next level."""
_FULL_LEVEL: Final = 4
"""The level of a block that is not merged any more, with 65,536 cases. It takes some 4 MB, and merging several
of them would hold the write lock of SQLite for long."""
_NODE: Final = row_id(0, 1, 0)
"""The difference of the ids of two consecutive nodes."""
_NO_EPISODE: Final = 0
"""The episode of the rows of blocks, because a block has cases of many."""


class BlockHeading(NamedTuple):
    """A stored block without its bytes: number, level, number of cases, and the first and last episode of them."""

    number: int
    level: int
    cases: int
    episode_min: int
    episode_max: int


def rows_of(block: CaseBlock, generation: int) -> RowsByTable:
    """Return the row of a block in the table of this generation."""
    cases = len(block)
    level = _level_of(cases)
    number = int(block.nodes.max()) + level
    data = encode(block)
    heading = (
        number,
        _NO_EPISODE,
        level,
        cases,
        int(block.nodes.min()) >> EPISODE_SHIFT,
        int(block.nodes.max()) >> EPISODE_SHIFT,
        zlib.crc32(data),
        msgspec.json.encode(sorted(block.left_out)).decode() if block.left_out else None,
        data,
    )
    name = physical_name(f"{OWN}{BLOCKS}", generation)
    return {(name, ("id", "process_metadata_id", *BLOCK_COLUMNS)): [heading]}


async def read_headings(connection: AsyncConnection, generation: int) -> list[BlockHeading]:
    """Read the list of the blocks, by number."""
    blocks = _blocks(generation)
    columns = blocks.c.id, blocks.c.level, blocks.c.cases, blocks.c.episode_min, blocks.c.episode_max
    return [BlockHeading(*row) for row in await connection.execute(select(*columns).order_by(blocks.c.id))]


def select_numbers(name: str, generation: int) -> Select[Any]:
    """Return the query of number and version of the generation under this key, and of the blocks of another one.

    The result has a row for each block, and at least one. Where the first number is that of `generation`, the tables
    were not replaced.
    """
    blocks = _blocks(generation)
    return select_generation(name).outerjoin(blocks, true()).add_columns(blocks.c.id)


async def read_blocks(connection: AsyncConnection, generation: int, numbers: Collection[int]) -> dict[int, CaseBlock]:
    """Read these blocks, by number; one that was merged in the meantime is left out.

    Raises `DamageError` for a block whose bytes were changed.
    """
    table = _blocks(generation)
    columns = table.c.id, table.c.checksum, table.c.data
    blocks: dict[int, CaseBlock] = {}
    for number, checksum, data in await connection.execute(select(*columns).where(table.c.id.in_([*numbers]))):
        if isinstance(data, str) or zlib.crc32(data) != checksum:  # SQLite keeps a value of any type in a column
            raise DamageError(f"block {number} of recall is damaged: its bytes were changed: {_ADVICE}")
        blocks[number] = decode(data)
    return blocks


async def read_left_out(connection: AsyncConnection, generation: int) -> list[str]:
    """Read the names of the features that a block has left out, because they have more than `WORDS_MAX` words."""
    column = _blocks(generation).c.left_out
    rows = await connection.scalars(select(column).where(column.is_not(None)))
    return sorted({name for each in rows for name in msgspec.json.decode(each)})


async def merge_blocks(connection: AsyncConnection, generation: int) -> None:
    """Merge the blocks of each level that has enough of them, in the caller's transaction. Raises `DamageError`."""
    blocks, dialect = _blocks(generation), dialect_of(connection)
    while chosen := await _lock_blocks(connection, generation):
        numbers, cases = [each.number for each in chosen], sum(each.cases for each in chosen)
        merged = merge([*(await read_blocks(connection, generation, numbers)).values()])
        if len(merged) != cases:
            raise DamageError(f"{len(numbers)} blocks of recall have {len(merged)} cases instead of {cases}: {_ADVICE}")
        await connection.execute(delete(blocks).where(blocks.c.id.in_(numbers)))
        await dialect.insert(connection, await dialect.insertion(rows_of(merged, generation)))


async def remove_cases(connection: AsyncConnection, generation: int, episodes: Collection[int]) -> None:
    """Remove the cases of these episodes, in the caller's transaction, which excludes all folds. Raises `DamageError`.

    Readers keep blocks by number, so one that loses cases gets another: behind its greatest node id 5 to 31 in turn. It
    keeps its level, so that the number of the block that it is merged into is new too.
    """
    table, dialect = _blocks(generation), dialect_of(connection)
    for each in await read_headings(connection, generation):
        if not any(each.episode_min <= number <= each.episode_max for number in episodes):
            continue
        block = (await read_blocks(connection, generation, [each.number]))[each.number]
        kept = block.without(block.nodes[np.isin(block.nodes >> EPISODE_SHIFT, [*episodes])])
        if len(kept) == len(block):
            continue
        await connection.execute(delete(table).where(table.c.id == each.number))
        if len(kept):
            [(name, [row])] = rows_of(kept.pruned(), generation).items()
            turn = max(each.number % _NODE - _FULL_LEVEL, 0) % (_NODE - _FULL_LEVEL - 1)
            number = int(kept.nodes.max()) + _FULL_LEVEL + 1 + turn
            rows = [(number, _NO_EPISODE, each.level, *list(row)[3:])]
            await dialect.insert(connection, await dialect.insertion({name: rows}))


async def _lock_blocks(connection: AsyncConnection, generation: int) -> Sequence[BlockHeading]:
    """Lock the blocks to merge, of the lowest level that has enough; none if another transaction has one of them."""
    headings = await read_headings(connection, generation)
    levels = ([each for each in headings if each.level == level] for level in range(_FULL_LEVEL))
    chosen = next(filter(None, map(_enough, levels)), [])
    number = _blocks(generation).c.id
    query = select(number).where(number.in_([each.number for each in chosen])).with_for_update(skip_locked=True)
    return chosen if chosen and len((await connection.execute(query)).all()) == len(chosen) else []


def _enough(headings: Sequence[BlockHeading]) -> Sequence[BlockHeading]:
    """Return the first blocks of a level that are enough to be merged; none if all are not."""
    cases = 0
    for count, each in enumerate(headings, 1):
        cases += each.cases
        if count >= _MERGED or cases >= _MERGED**_FULL_LEVEL:
            return headings[:count]
    return []


_ADVICE = "run `pycrorm rebuild recall`"


def _level_of(cases: int) -> int:
    """Return the level of a block with this many cases.

    >>> [_level_of(cases) for cases in (1, 15, 16, 4_095, 4_096, 65_535, 65_536, 131_071)]
    [0, 0, 1, 2, 3, 3, 4, 4]
    """
    return max(level for level in range(_FULL_LEVEL + 1) if cases >= _MERGED**level)


def _blocks(generation: int) -> TableClause:
    return table(physical_name(f"{OWN}{BLOCKS}", generation), column("id"), *map(column, BLOCK_COLUMNS))


# === case projection ==========================================================================================
#
# Fold the events of episodes into cases, which are stored as blocks. Every memory has this projection, `recall`.


class CaseProjection(PackedProjection):
    """Makes a case of each action that ends. The row of a case is packed with others into a block."""

    name = "recall"
    version = 3
    tables: ClassVar[Any] = {BLOCKS: BLOCK_COLUMNS}
    reads = READS

    def __init__(self) -> None:
        self._types: dict[str, FeatureFields] = {}

    def episode(self) -> Any:
        return EpisodeCases(self._types)

    def batch(self, declared: Mapping[str, event_types.DesignatorTypeDeclared], folds: EpisodeFolds) -> ProjectedBatch:
        return CaseBatch(self, declared, folds)

    def check(self, result: VerifyResult) -> TableCheck:
        return CaseCheck(self, result)
