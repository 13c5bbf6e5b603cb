"""Recall past actions: `memory.recall(...)` takes a cue and returns the cases most like it.

>>> answer = await memory.recall(type=PickUpAction, has={"object_type": ObjectType.MILK}, near={"height": 0.93})
>>> answer.success, answer.reasons, answer.never_seen
>>> await answer[0].moment()                                             # the world as it was then
>>> await memory.recall.similar_to_now(milk, PickUpAction)               # cue: the world as it is
>>> await memory.recall.follows(PickUpAction, reason=IKError)            # what came next, and how that ended
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import import_module
from numbers import Real
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.plan.object_designators import ObjectDesignator
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.asking.columns import member_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.recall.activation import Forgotten
from pycrorm_async.recall.answer import Answer, answer
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.cue import Cue, check_cue, numbers_of, shortened, symbols_of, word
from pycrorm_async.recall.following import Following, Relation
from pycrorm_async.recall.library import CaseLibrary
from pycrorm_async.recall.reading.case_reader import CaseReader
from pycrorm_async.recall.reading.cue_arguments import (
    AnyCase,
    Conditions,
    EpisodeNames,
    TimeReference,
    aliases_of,
    case_of,
    cue_like,
    dtype_of,
    make_cue,
)
from pycrorm_async.recall.reading.database_source import DatabaseSource
from pycrorm_async.recall.reading.present_situation import present_situation
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.objects import Object

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
        episode: AnyEpisode | Iterable[AnyEpisode] | None = None,
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
        words = symbols_of(has), numbers_of(near), symbols_of(lacks)
        cue = await make_cue(library, EpisodeNames(self._reading), dtype_of(type), *words, conditions)
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
        symbols, numbers = present_situation(target, action)
        features = library.texts(dtype) | library.numbers(dtype)
        symbols = {name: each for name, each in symbols.items() if name in features and name != "object_name"}
        wanted = {name: each for name, each in numbers.items() if name in features}
        words = symbols_of({**symbols, **has}), numbers_of({**wanted, **near})
        cue = await make_cue(library, EpisodeNames(self._reading), dtype, *words, (), Conditions(k=k, **conditions))
        return self._answer(cue, library)

    def _answer(self, cue: Cue, library: CaseLibrary) -> Answer:
        check_cue(cue, library)
        return answer(cue, library, self)

    async def frame(self, type: str | type | None = None, **cue: Any) -> pd.DataFrame:  # noqa: A002
        """Return an answer as a data frame: a row for each action, with its score and a column for each feature.

        The arguments are those of the call. Raises `MissingExtra` without pandas.
        """
        return frame_of(await self(type, **cue))

    async def forget(self, activation: float, *, dry_run: bool = False) -> Forgotten:
        """Hide the actions in ways that were not used enough lately, from this object only; nothing is deleted.

        A way is a type with all its texts, as the same object, arm and grasp. Each call replaces the one before it:
        `forget(float("-inf"))` hides nothing.

        Args:
            activation: the lowest base-level activation in the sense of ACT-R; that of one use is 0 after 1 s, -2.3
                after 100 s, -5.7 after a day.
            dry_run: only count.
        """
        if isinstance(activation, bool) or not isinstance(activation, Real) or activation != activation:
            raise CallerError(f"activation must be a number, got {shortened(activation)}")
        return await self._reader.forget(activation, self._clock.wall_ns() // 1_000, dry_run=dry_run)

    async def types(self) -> tuple[str, ...]:
        """Return the types of the actions that have ended, those that were renamed by each name."""
        library = await self._reader.library()
        return tuple(sorted({*library.types, *library.recorded_types}))

    async def reasons(self, type: str | type) -> tuple[str, ...]:  # noqa: A002
        """Return the classes of the failures with which actions of a type have ended, in alphabetical order."""
        dtype = dtype_of(type)
        library = await self._reader.library(dtype, aliases_of(type))
        return tuple(sorted(each for each in library.words("reason") if library.seen(dtype, "reason", each)))

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
            raise CallerError(f"{relation!r} is not a relation: give one of {names}") from None
        return (await self._reader.sequences()).related(await self.case(case), wanted)

    async def moment(self, case: AnyCase) -> Moment:
        """Return the task tree and the world as they were when an action started; see `Reading.as_of`."""
        action = await self.case(case)
        return await self._reading.as_of(action.episode, sequence=action.sequence)

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
            raise CallerError("give the type of the actions, as in `follows(PickUpAction)`")
        if status is not None:
            status = member_of(TaskStatus, word(status), "status")
        wanted = {name: word(each) for name, each in (("status", status), ("reason", reason)) if each is not None}
        sequences = await self._reader.sequences(dtype, aliases_of(type))
        return sequences.follows(dtype, **wanted)


def frame_of(recalled: Answer) -> pd.DataFrame:
    """Return an answer as a data frame. Raises `MissingExtra` without pandas."""
    try:
        pandas = import_module("pandas")
    except ImportError:
        raise MissingExtra("frames need pandas: pip install 'pycrorm-async[frames]'") from None
    rows = []
    for each in recalled:
        case = each.case
        outcome = {"status": case.status, "reason": case.reason, "duration": case.duration_s}
        place: dict[str, Any] = {
            "node": case.node,
            "episode": case.episode,
            "sequence": case.sequence,
            "type": case.type,
        }
        rows.append(
            {"score": each.score, **place, "started": case.started_at, **outcome, **case.symbols, **case.numbers}
        )
    columns = ["score", "node", "episode", "sequence", "type", "started", "status", "reason", "duration"]
    frame: pd.DataFrame = pandas.DataFrame(rows) if rows else pandas.DataFrame(columns=columns)
    return frame
