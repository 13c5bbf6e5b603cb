"""Recall past actions: `memory.recall(...)` takes a cue and returns the cases most like it.

>>> answer = await memory.recall(type=PickUpAction, has={"object_type": ObjectType.MILK}, near={"height": 0.93})
>>> answer.success, answer.reasons, answer.never_seen
>>> await answer[0].moment()                                             # the world as it was then
>>> await memory.recall.similar_to_now(milk, PickUpAction)               # cue: the world as it is
>>> await memory.recall.follows(PickUpAction, reason=IKError)            # what came next, and how that ended
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from inspect import isawaitable
from numbers import Real
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, and_, select

from pycrorm_async import errors
from pycrorm_async.clock import SYSTEM_CLOCK, Clock, microseconds_of
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX, SLOT_NODE, row_id, row_id_min, row_key
from pycrorm_async.orm import BatchRolloutAction, EpisodeRobot, EpisodeTag, TaskTreeNode
from pycrorm_async.plan.language import ActionDescription, Designator
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.projections.generations import PROJECTION, read_generation
from pycrorm_async.query.frames import imported, member_of
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.question import AskedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.recall import cases as case_rows
from pycrorm_async.recall import prediction, search
from pycrorm_async.recall.answer import Answer, Following, RecalledCase, Relation, Sequences, answer
from pycrorm_async.recall.blocks import CaseBlock, CaseLibrary, merge
from pycrorm_async.recall.columns import RESERVED, Case
from pycrorm_async.recall.search import dtype_of
from pycrorm_async.store.log import EventLog, episode_named
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.bullet import Object

if TYPE_CHECKING:
    import pandas as pd


_NOTHING: Mapping[str, Any] = MappingProxyType({})


class Recall:
    """The recall of one memory, for one event loop.

    Args:
        reader: of the cases.
        reading: of the same memory, for episodes and past moments.
    """

    def __init__(self, reader: CaseReader, reading: Reading, clock: Clock = SYSTEM_CLOCK) -> None:
        self._reader = reader
        self._reading = reading
        self._clock = clock
        self._batches: tuple[int, Sequence[tuple[int, int, str | None]]] = (0, ())

    @property
    def reader(self) -> CaseReader:
        """The cases that are searched."""
        return self._reader

    @classmethod
    def of(cls, reading: Reading) -> Recall:
        """Return the recall of a memory that is open for reading."""
        return cls(CaseReader(DatabaseSource(reading)), reading)

    async def __call__(
        self,
        type: str | type | None = None,  # noqa: A002  the feature's name
        *,
        has: Mapping[str, Any] = _NOTHING,
        near: Mapping[str, Any] = _NOTHING,
        lacks: Mapping[str, Any] = _NOTHING,
        only: Mapping[str, Any] = _NOTHING,
        before: TimeReference | None = None,
        after: TimeReference | None = None,
        during: AnyCase | tuple[TimeReference, TimeReference] | None = None,
        as_of: TimeReference | None = None,
        prohibit: Iterable[AnyCase] = (),
        episode: AskedEpisode | Iterable[AskedEpisode] | None = None,
        robot: str | None = None,
        tag: str | None = None,
        simulated: bool = False,
        k: int = 20,
        minimum: float = 0.0,
    ) -> Answer:
        """Return the past actions most like a cue, the best first and among equals the newest.

        `has` and `near` make actions similar. The others are conditions, which every action of the answer fulfils. An
        action of this process is included as soon as it has ended, one of another process once it is in the tables.

        Args:
            type: a designator class or its dtype; subclasses are types of their own. One that was renamed is found by
                each name, with the cases of all. A type that never occurred gives an empty answer.
            has: values by feature, as `{"arm": Arms.LEFT, "near": ["BOWL", "CUP"]}`: enums, texts, booleans, classes.
                `status`, `reason` and `duration` of the outcome are compared only if they are given.
            near: numbers by feature: the wanted one, or a pair of it and the tolerance, from which on nothing is alike.
                Without one it is the number's standard deviation among the actions of the type, 0.5 rad for angles.
            lacks, only: values that the action must not have, and that it must have.
            before, after: it started before this moment, or before this case; at or after it, or after its end.
            during: it started and ended in this interval, or during this case in the same episode.
            as_of: the answer at this moment: it had ended by then.
            prohibit: cases that are left out, such as the one that the cue describes.
            episode, robot, tag: it belongs to this episode or one of these; the robot's name; the episode has the tag.
                A robot without a case gives an empty answer, because a plan may ask before its robot has ever acted.
            simulated: simulations are included.
            k: the number of actions, 1 to 10,000.
            minimum: the lowest score, 0 to 1.

        Raises:
            CallerError: for a cue that cannot be answered, in one line with the nearest name. `UnknownEpisode`.
        """
        conditions = Conditions(
            before, after, during, as_of, prohibit, only, episode, robot, tag, simulated=simulated, k=k, minimum=minimum
        )
        library = await self._reader.library(dtype_of(type), aliases_of(type))
        words = search.symbols_of(has), search.numbers_of(near), search.symbols_of(lacks)
        cue = await make_cue(library, self._reading, dtype_of(type), *words, conditions)
        return self._answer(cue, library)

    async def like(self, case: AnyCase, *, k: int = 20, simulated: bool = False) -> Answer:
        """Return the actions whose situation was most like that of a case, which is left out itself.

        The name of its object is not compared. Of more than 256 words and numbers, those that weigh least are left out,
        and the answer has their number. Raises `CallerError` for a node without a case.
        """
        library = await self._reader.library()
        original = case_of(case, library)
        cue = cue_like(original, library)
        cue = replace(cue, prohibit=frozenset({original.node}), k=k, simulated=simulated or original.simulated)
        return self._answer(cue, library)

    async def similar_to_now(
        self,
        target: Object | ObjectDesignator,
        action: str | type,
        *,
        has: Mapping[str, Any] = _NOTHING,
        near: Mapping[str, Any] = _NOTHING,
        k: int = 50,
        **conditions: Any,
    ) -> Answer:
        """Return the actions of a class whose situation was most like the present one of an object.

        Compares the object's type, neighbourhood and height, and the base pose and torso of the acting robot.

        Args:
            target: an object in a world, or its designator.
            action: a designator class, or a built-in type as `PickUpAction`, also by its name.
            has, near: further features, and others than the present ones, as the arm that is to be used.
            conditions: those of the call, as `only` and `episode`.
        """
        dtype = dtype_of(action)
        library = await self._reader.library(dtype, aliases_of(action))
        symbols, numbers = prediction.present_situation(target, action)
        features = library.texts(dtype) | library.numbers(dtype)
        symbols = {name: each for name, each in symbols.items() if name in features and name != "object_name"}
        wanted = {name: each for name, each in numbers.items() if name in features}
        words = search.symbols_of({**symbols, **has}), search.numbers_of({**wanted, **near})
        cue = await make_cue(library, self._reading, dtype, *words, (), Conditions(k=k, **conditions))
        return self._answer(cue, library)

    async def predict(
        self,
        action: ActionDescription[Any] | Designator | str | type,
        *,
        has: Mapping[str, Any] = _NOTHING,
        near: Mapping[str, Any] = _NOTHING,
    ) -> prediction.Prediction:
        """Predict the outcome of an action that would begin now, from the tries most like it (`recall.prediction`).

        Args:
            action: a designator, or a description, of which the first alternative is predicted; or a type, in the
                situation that `has` and `near` give.
            has, near: of a type only, the words that a try must have, and the numbers, as in the call.

        Raises `CallerError` for what is no action, for features that no action of the type has, and for those of a
        designator.
        """
        if not isinstance(action, str | type):
            if has or near:
                raise errors.CallerError("`has` and `near` belong to a type; an action has a situation of its own")
            if not isinstance(action, ActionDescription | Designator):
                raise errors.CallerError(f"{search.shortened(action)} is no action: give one, or a type of actions")
            first: Any = action.resolve() if isinstance(action, ActionDescription) else action
            return (await self.predictions([await first if isawaitable(first) else first]))[0]
        dtype = dtype_of(action)
        if dtype is None:
            raise errors.CallerError("give the type of the action, as in `predict(PickUpAction)`")
        library = await self._reader.library(dtype, aliases_of(action))
        words, numbers = search.symbols_of(has), search.numbers_of(near)
        search.check_cue(search.Cue(type=dtype, has=words, near=numbers), library)
        return prediction.predict(library, [prediction.Situation(dtype, dict(words), numbers)])[0]

    async def predictions(self, actions: Sequence[Designator]) -> list[prediction.Prediction]:
        """Predict the outcome of each of these designators, as if it began now."""
        situations = prediction.situations_of(actions)
        library = CaseLibrary()
        for dtype, kind in {each.type: type(action) for each, action in zip(situations, actions, strict=True)}.items():
            aliases = aliases_of(kind) if kind.__dtype__ == dtype else ()
            library = await self._reader.library(dtype, aliases)
        return prediction.predict(library, situations, prediction.unlike_rollouts(await self._rollouts(library)))

    async def _rollouts(self, library: CaseLibrary) -> Sequence[tuple[int, int, str | None]]:
        """Return the stored batches of rollouts: the node, the lowest id after its end, and the scene."""
        batch, node, count = BatchRolloutAction, TaskTreeNode, library.size("BatchRolloutAction")
        if count != self._batches[0]:
            same = and_(node.id == batch.id, node.process_metadata_id == batch.process_metadata_id)
            rows = await self._reading.rows(select(batch.id, node.end_sequence, batch.scene).join(node, same))
            ids = [each for each, _, _ in rows]
            is_whole = all(np.isin(each.nodes, ids).all() for each in library.groups("BatchRolloutAction"))
            self._batches = (
                count if is_whole else -1,
                [(each, row_id_min(row_key(each).number, end or SEQUENCE_MAX), scene) for each, end, scene in rows],
            )
        return self._batches[1]

    def _answer(self, cue: search.Cue, library: CaseLibrary) -> Answer:
        search.check_cue(cue, library)
        return answer(cue, library, self)

    async def frame(self, type: str | type | None = None, **cue: Any) -> pd.DataFrame:  # noqa: A002
        """Return an answer as a data frame: a row for each action, with its score and a column for each feature.

        The arguments are those of the call. Raises `MissingExtra` without pandas.
        """
        return frame_of(await self(type, **cue))

    async def forget(self, activation: float, *, dry_run: bool = False) -> search.Forgotten:
        """Hide the actions in ways that were not used enough lately, from this object only; nothing is deleted.

        A way is a type with all its texts, as the same object, arm and grasp. Each call replaces the one before it:
        `forget(float("-inf"))` hides nothing.

        Args:
            activation: the lowest base-level activation in the sense of ACT-R; that of one use is 0 after 1 s, -2.3
                after 100 s, -5.7 after a day.
            dry_run: only count.
        """
        if isinstance(activation, bool) or not isinstance(activation, Real) or activation != activation:
            raise errors.CallerError(f"activation must be a number, got {search.shortened(activation)}")
        return await self._reader.forget(activation, self._clock.wall_ns() // 1_000, dry_run=dry_run)

    async def types(self) -> tuple[str, ...]:
        """Return the types of the actions that have ended, those that were renamed by each name."""
        library = await self._reader.library()
        return tuple(sorted({*library.types, *library.recorded_types}))

    async def reasons(self, type: str | type) -> tuple[str, ...]:  # noqa: A002
        """Return the classes of the failures with which actions of a type have ended, in alphabetical order."""
        dtype = dtype_of(type)
        library = await self._reader.library(dtype, aliases_of(type))
        return tuple(
            sorted(each for each in library.words("reason").codes_by_word if library.seen(dtype, "reason", each))
        )

    # --- around a case ----------------------------------------------------------------------------------------

    async def case(self, case: AnyCase) -> Case:
        """Return the case of a node. Raises `CallerError` if it has none."""
        return case_of(case, await self._reader.library())

    async def next(self, case: AnyCase) -> Case | None:
        """Return the action that started next under the same parent."""
        return (await self._reader.sequences()).next(await self.case(case))

    async def previous(self, case: AnyCase) -> Case | None:
        """Return the action that started before it under the same parent."""
        return (await self._reader.sequences()).previous(await self.case(case))

    async def parent(self, case: AnyCase) -> Case | None:
        """Return the nearest action around it; None outside any, and while that runs."""
        return (await self._reader.sequences()).parent(await self.case(case))

    async def related(self, case: AnyCase, relation: Relation | str) -> list[Case]:
        """Return the actions of the case's episode that have this relation of Allen to it, ordered by their start."""
        try:
            wanted = Relation(relation)
        except ValueError:
            names = ", ".join(each.value for each in Relation)
            raise errors.CallerError(f"{relation!r} is not a relation: give one of {names}") from None
        return (await self._reader.sequences()).related(await self.case(case), wanted)

    async def moment(self, case: AnyCase) -> Moment:
        """Return the task tree and the world as they were when an action started; see `Reading.as_of`."""
        action = await self.case(case)
        return await self._reading.as_of(action.episode, sequence=action.sequence)

    async def outcomes(self, nodes: Sequence[int]) -> dict[int, str]:
        """Return how plans went on after those of these nodes that failed, by node id; see `RootFailure.outcome`.

        Leaves out a node that is not in the tables yet.
        """
        failed = TaskTreeNode.id.in_(nodes), TaskTreeNode.status.in_((TaskStatus.FAILED, TaskStatus.ERROR))
        rows = await self._reading.rows(select(TaskTreeNode.id, TaskTreeNode.outcome).where(*failed), simulated=True)
        return {each.id: each.outcome for each in rows}

    async def follows(
        self,
        type: str | type,  # noqa: A002
        *,
        status: object = None,
        reason: str | type | None = None,
    ) -> Following:
        """Count the actions that came next after the actions of a type, with their success rates.

        Args:
            type: a designator class or its dtype.
            status, reason: how they ended, and the class of the failure or its name; by default any.

        Raises `CallerError` for a status that is none.
        """
        dtype = dtype_of(type)
        if dtype is None:
            raise errors.CallerError("give the type of the actions, as in `follows(PickUpAction)`")
        if status is not None:
            status = member_of(TaskStatus, search.word(status), "status")
        wanted = {
            name: search.word(each) for name, each in (("status", status), ("reason", reason)) if each is not None
        }
        sequences = await self._reader.sequences(dtype, aliases_of(type))
        return sequences.follows(dtype, **wanted)


def frame_of(recalled: Answer) -> pd.DataFrame:
    """Return an answer as a data frame. Raises `MissingExtra` without pandas."""
    columns = "score node episode sequence type started status reason duration".split()
    rows = []
    for each in recalled:
        case = each.case
        place = case.node, case.episode, case.sequence, case.type, case.started_at
        own = each.score, *place, case.status, case.reason, case.duration_s
        rows.append({**dict(zip(columns, own, strict=True)), **case.symbols, **case.numbers})
    frame: pd.DataFrame = imported("pandas").DataFrame(rows, columns=None if rows else columns)
    return frame


# === case reader ==============================================================================================
#
# Keep the cases of a memory in this process: the stored blocks, and its own cases that are not stored yet.
#
# Theory of operation. Before each recall the reader asks the source for the numbers of the blocks, and reads those that
# it does not have. A merge replaces blocks by one with a new number; the source returns both in one snapshot, so that
# no case is missing or doubled. In another generation, which a rebuild has made, all blocks are new. A case of this
# process is included as soon as its action has ended; once a stored block has it too, that of the block is used.

_NO_NODES: Final = np.zeros(0, np.int64)


class StoredBlocks(NamedTuple):
    """The blocks that a memory has at one moment.

    Attributes:
        generation: of the tables; a block's number means another block in another generation.
        numbers: of all blocks.
        added: those that the reader did not have, by number.
    """

    generation: int
    numbers: frozenset[int]
    added: Mapping[int, CaseBlock]


class BlockSource(Protocol):
    """The blocks of a memory."""

    async def read(self, generation: int, block_numbers: Collection[int]) -> StoredBlocks:
        """Return the numbers of all blocks, and the blocks that a reader lacks.

        The reader has the blocks with these numbers of this generation; of another generation it gets all blocks.
        """
        ...

    async def present_names(self) -> Mapping[str, str]:
        """Return the present name of each type that the memory knows, by all the names that it had."""
        ...


class RunningCases(Protocol):
    """The cases of this process, stored or not."""

    async def new(self) -> tuple[Sequence[Case], Sequence[Case]]:
        """Return the new cases of actions that have ended, and all cases whose episodes have no number yet."""
        ...


class CaseReader:
    """The cases of one memory, for one event loop."""

    def __init__(self, source: BlockSource, running: RunningCases | None = None) -> None:
        self._source = source
        self._running = running
        self._generation = -1
        self._blocks: dict[int, CaseBlock] = {}
        self._unstored = CaseBlock.of(())
        self._unnumbered: Sequence[Case] = ()
        self._hidden: NDArray[np.int64] = _NO_NODES
        self._library = CaseLibrary()
        self._names: Mapping[str, str] = {}
        self._aliases: dict[str, str] = {}
        self._sequences: tuple[CaseLibrary, Sequences] | None = None
        self._reading = asyncio.Lock()

    async def library(self, type: str | None = None, aliases: Collection[str] = ()) -> CaseLibrary:  # noqa: A002
        """Return all cases that are not hidden, under the present names of their types.

        Args:
            type: the type of the next cue, because the memory may know it by another name.
            aliases: former names of this type, also if the memory does not know them yet.
        """
        async with self._reading:
            library = await self._read()
            unknown = {*library.recorded_types, *([] if type is None else [type])} - self._names.keys()
            if unknown or not self._aliases.keys() >= {*aliases}:
                self._aliases |= {alias: type for alias in aliases if type is not None}
                names = dict(await self._source.present_names())
                names |= {alias: each for alias, each in self._aliases.items() if names.get(alias, alias) == alias}
                if names != self._names:
                    self._library = CaseLibrary(library.blocks, names)
                self._names = names
            return self._library

    async def sequences(self, type: str | None = None, aliases: Collection[str] = ()) -> Sequences:  # noqa: A002
        """Return these cases in the order in which they happened."""
        library = await self.library(type, aliases)
        if self._sequences is None or self._sequences[0] is not library:
            self._sequences = library, Sequences(library)
        return self._sequences[1]

    async def forget(self, threshold: float, now_us: int, *, dry_run: bool) -> search.Forgotten:
        """Hide from this reader the cases of every way whose activation is now below the threshold; show all others."""
        async with self._reading:
            hidden, self._hidden = self._hidden, _NO_NODES
            cases = search.forgotten(await self._read(changed=hidden.size > 0), threshold=threshold, now_us=now_us)
            self._hidden = hidden if dry_run else cases.nodes
            if self._hidden.size:
                await self._read(changed=True)
            return cases

    async def _read(self, *, changed: bool = False) -> CaseLibrary:
        running, unnumbered = await self._running.new() if self._running is not None else ((), ())
        stored = await self._source.read(self._generation, self._blocks.keys())
        self._generation = stored.generation  # of another generation the source has returned all blocks
        gone = self._blocks.keys() - stored.numbers
        for number in gone:
            del self._blocks[number]
        self._blocks.update(stored.added)
        if running:
            self._unstored = merge([self._unstored, CaseBlock.of(running)])
        if len(self._unstored) and (running or stored.added):
            first = self._unstored.nodes.min()
            nodes = [_NO_NODES, *(each.nodes[each.nodes >= first] for each in self._blocks.values())]
            self._unstored = self._unstored.without(np.concatenate(nodes))
        if changed or gone or stored.added or running or [*unnumbered] != [*self._unnumbered]:
            self._unnumbered = unnumbered
            self._library = CaseLibrary(self._visible(), self._names)
        return self._library

    def _visible(self) -> list[CaseBlock]:
        blocks = [*self._blocks.values(), self._unstored, CaseBlock.of(self._unnumbered)]
        if self._hidden.size:
            blocks = [each.without(self._hidden) for each in blocks]
        return [each for each in blocks if len(each)]


# === cue arguments ============================================================================================
#
# Make a cue from a caller's arguments: designator classes, enums, datetimes, cases, names of episodes and tags.

AnyCase: TypeAlias = "Case | RecalledCase | int"
"""A case, or the id of its task-tree node."""
TimeReference: TypeAlias = "datetime | str | AnyCase"
"""A moment: an aware datetime, or a text in ISO 8601, UTC where it has no zone; or a case, for its start or its end."""
_OF_EACH_CASE = frozenset({"object_name"})
"""The texts of a case that `cue_like` leaves out: they name one object of many alike."""


class Conditions(NamedTuple):
    """The conditions of a cue, as `Recall` takes them."""

    before: TimeReference | None = None
    after: TimeReference | None = None
    during: AnyCase | tuple[TimeReference, TimeReference] | None = None
    as_of: TimeReference | None = None
    prohibit: Iterable[AnyCase] = ()
    only: Mapping[str, Any] | None = None
    episode: AskedEpisode | Iterable[AskedEpisode] | None = None
    robot: str | None = None
    tag: str | None = None
    simulated: bool = False
    k: int = 20
    minimum: float = 0.0


async def check_robot(reading: Reading, robot: str) -> None:
    """Raise `CallerError` if no robot of this name took part in any episode."""
    async with reading.session(simulated=True) as session:
        names = set((await session.scalars(select(EpisodeRobot.name).distinct())).all())
    if robot not in names:
        raise errors.CallerError(f"no episode has the robot {robot!r}{search.closest(robot, names)}")


async def make_cue(
    library: CaseLibrary,
    reading: Reading,
    dtype: str | None,
    has: tuple[tuple[str, str], ...],
    near: tuple[search.Wanted, ...],
    lacks: tuple[tuple[str, str], ...],
    conditions: Conditions,
) -> search.Cue:
    """Return the cue. Raises `CallerError` for a moment without a zone or an unknown node, `UnknownEpisode`."""
    numbers = await _episodes(reading, conditions)
    during = None
    if isinstance(conditions.during, tuple) and not isinstance(conditions.during, Case):
        if len(conditions.during) != 2:
            raise errors.CallerError(f"`during` takes a case, or two moments, got {len(conditions.during)}")
        first, last = conditions.during
        during = _start(first, library), _end(last, library)
    elif conditions.during is not None:
        case = case_of(conditions.during, library)
        if case.duration_s is None:
            raise errors.CallerError(f"{case.type} in episode {case.episode} has no end, so nothing happened during it")
        during = case.started_us, _end(case, library)
        numbers = frozenset({case.episode}) & (numbers if numbers is not None else {case.episode})
    only = dict(conditions.only or {})
    if conditions.robot is not None:
        only["robot"] = conditions.robot
    return search.Cue(
        type=dtype,
        has=has,
        near=near,
        lacks=lacks,
        requires=search.symbols_of(only),
        before_us=None if conditions.before is None else _start(conditions.before, library),
        after_us=None if conditions.after is None else _end(conditions.after, library),
        during_us=during,
        as_of_us=None if conditions.as_of is None else _start(conditions.as_of, library),
        episodes=numbers,
        prohibit=_nodes(conditions.prohibit),
        simulated=conditions.simulated,
        k=conditions.k,
        minimum=conditions.minimum,
    )


def cue_like(case: Case, library: CaseLibrary) -> search.Cue:
    """Return the situation of a case as a cue, without its outcome and without the name of its object.

    If there are more features than a cue can have, those with the lowest weights are left out, and counted.
    """
    unused = RESERVED | _OF_EACH_CASE | library.left_out
    has = search.symbols_of({name: value for name, value in case.symbols.items() if name not in unused})
    near = tuple(search.Wanted(name, value) for name, value in sorted(case.numbers.items()))
    cue = search.Cue(type=case.type, has=has, near=near, simulated=case.simulated)
    features = [*has, *near]
    if len(features) <= search.FEATURES_MAX:
        return cue
    weights = [*search.weights_of(cue, library).words, *(1.0 for _ in near)]
    heaviest = sorted(range(len(features)), key=lambda index: -weights[index])[: search.FEATURES_MAX]
    kept = {features[index] for index in heaviest}
    return replace(
        cue,
        has=tuple(each for each in has if each in kept),
        near=tuple(each for each in near if each in kept),
        left_out=len(features) - search.FEATURES_MAX,
    )


def aliases_of(designator: str | type | None) -> tuple[str, ...]:
    """Return the former names that a designator class declares."""
    aliases = getattr(designator, "__aliases__", ())
    return tuple(aliases) if isinstance(aliases, tuple | list) else ()


_NAMED = re.compile(r"(?P<episode>.+)/e?(?P<sequence>\d+)")


async def case_named(reading: Reading, text: str, argument: str = "like") -> int:
    """Return the id of the node that EPISODE/EVENT names, as in `3/115` or `last/e115`. Raises `CallerError`."""
    match = _NAMED.fullmatch(text)
    if match is None or int(match["sequence"]) > SEQUENCE_MAX:
        raise errors.CallerError(
            f"{argument} {text[:60]!r} is not an action: write EPISODE/EVENT, as in 3/115 or last/e115"
        )
    return row_id((await reading.episode(match["episode"])).number, int(match["sequence"]), SLOT_NODE)


def node_of(case: AnyCase) -> int:
    """Return the id of the node of a case. Raises `CallerError` for anything else."""
    if not isinstance(case, int | Case | RecalledCase):
        raise errors.CallerError(
            f"{search.shortened(case)} is not a case: give one of an answer, or the id of its node"
        )
    return case if isinstance(case, int) else case.node


def _nodes(cases: object) -> frozenset[int]:
    if not isinstance(cases, Iterable) or isinstance(cases, Case | str):
        raise errors.CallerError("`prohibit` takes a list of cases")
    return frozenset(map(node_of, cases))


async def _episodes(reading: Reading, conditions: Conditions) -> frozenset[int] | None:
    """Return the numbers of the episodes with these names and this tag; None if neither is given.

    Raises `UnknownEpisode`, and `CallerError` if no episode has the tag.
    """
    numbers, episode, tag = None, conditions.episode, conditions.tag
    if episode is not None:
        is_one = isinstance(episode, EpisodeSummary) or not isinstance(episode, list | tuple | set | frozenset)
        several: Iterable[AskedEpisode] = [episode] if is_one else episode  # type: ignore[list-item,assignment]
        names = [str(each.number if isinstance(each, EpisodeSummary) else each) for each in several]
        log = await reading.log()
        numbers = frozenset([(await episode_named(log, name)).number for name in names])
    if tag is None:
        return numbers
    async with reading.session(simulated=True) as session:
        rows = (await session.execute(select(EpisodeTag.process_metadata_id, EpisodeTag.tag))).all()
    tagged = frozenset(number for number, each in rows if each == tag)
    if not tagged:
        raise errors.CallerError(f"no episode has the tag {tag!r}{search.closest(tag, {each for _, each in rows})}")
    return tagged if numbers is None else numbers & tagged


def case_of(case: AnyCase, library: CaseLibrary) -> Case:
    """Return a case, by its node too. Raises `CallerError` for a node without one."""
    if isinstance(case, Case):
        return case
    if isinstance(case, RecalledCase):
        return case.case
    case = node_of(case)
    stored = library.find(case)
    if stored is None:
        key = row_key(case) if 0 < case < row_id_min(EPISODE_NUMBER_MAX + 1) else None
        place = f"event {key.sequence} of episode {key.number}" if key is not None else f"{case}"
        raise errors.CallerError(f"there is no case of {place}: it does not exist, is not an action, or has not ended")
    return stored


def _start(when: TimeReference, library: CaseLibrary) -> int:
    return _moment_us(when) if isinstance(when, datetime | str) else case_of(when, library).started_us


def _end(when: TimeReference, library: CaseLibrary) -> int:
    """Return the end of a case, rounded up; of a lost one, which has none, its start."""
    if isinstance(when, datetime | str):
        return _moment_us(when)
    case = case_of(when, library)
    return case.started_us + int(-(-(case.duration_s or 0.0) * 1e6 // 1))


def _moment_us(when: datetime | str) -> int:
    if isinstance(when, str):
        try:
            moment = datetime.fromisoformat(when)
        except ValueError:
            raise errors.CallerError(
                f"{when[:40]!r} is not a moment: give one as in 2026-11-20 or 2026-11-20T14:30+01:00"
            ) from None
        when = moment if moment.utcoffset() is not None else moment.replace(tzinfo=UTC)
    if when.utcoffset() is None:
        raise errors.CallerError(f"{when!r} has no time zone: add one, for example .replace(tzinfo=UTC)")
    return microseconds_of(when)


# === database source ==========================================================================================
#
# Read the stored blocks of a memory; one statement finds out whether any has changed.

_KEY: Final = f"{PROJECTION}{case_rows.CaseProjection.name}"


class DatabaseSource:
    """The blocks in the tables of a memory. Implements `BlockSource`."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        self._numbers: tuple[int, Select[Any]] | None = None

    async def read(self, generation: int, block_numbers: Collection[int]) -> StoredBlocks:
        """Return the blocks in one snapshot.

        Raises `DatabaseUnavailable` for a memory without a table of cases, `TablesOutdated` for one of another version,
        `DamageError` for a block whose bytes were changed.
        """
        log = await self._reading.log()
        if await self._is_unchanged(log, generation, block_numbers):
            return StoredBlocks(generation, frozenset(block_numbers), {})
        async with log.snapshot() as connection:
            tables = await read_generation(connection, _KEY)
            if tables is None:
                raise errors.DatabaseUnavailable(
                    f"{log.address} has no cases to recall yet (with Settings(recall=False) none are made): run"
                    " `pycrorm writer --once`"
                )
            cases = case_rows.CaseProjection
            if tables.version != cases.version:
                raise errors.TablesOutdated(
                    f"{log.address}: its cases have version {tables.version} instead of {cases.version}: run"
                    f" `pycrorm rebuild {cases.name}`"
                )
            numbers = frozenset(each.number for each in await case_rows.read_headings(connection, tables.number))
            wanted = numbers.difference(block_numbers if tables.number == generation else ())
            added = await case_rows.read_blocks(connection, tables.number, sorted(wanted)) if wanted else {}
        return StoredBlocks(tables.number, numbers, added)

    async def _is_unchanged(self, log: EventLog, generation: int, block_numbers: Collection[int]) -> bool:
        """Return whether this generation has exactly these blocks; False also if it was dropped."""
        if not block_numbers:
            return False
        if self._numbers is None or self._numbers[0] != generation:
            self._numbers = generation, case_rows.select_numbers(_KEY, generation)
        with suppress(errors.PycrormError):  # where a rebuild has dropped the table; another fault is met again
            async with log.reading() as connection:
                rows = (await connection.execute(self._numbers[1])).all()
            generations = {(number, version) for number, version, _ in rows}
            return generations == {(generation, case_rows.CaseProjection.version)} and {
                block for _, _, block in rows
            } == {*block_numbers}
        return False

    async def present_names(self) -> Mapping[str, str]:
        """Return the present name of each declared type, by all its names."""
        return await self._reading.present_names()
