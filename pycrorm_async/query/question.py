"""A named question: its select, its SQL, and its answer as a frame or as rows."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Coroutine, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar, Union

from sqlalchemy import CompoundSelect, Dialect, Row, Select, func, select

from pycrorm_async.errors import CallerError, InternalError, QueryRefused
from pycrorm_async.events.ids import is_episode_id, number_in
from pycrorm_async.orm import DesignatorType, Detection, EpisodeRobot, EpisodeTag, Object, ProcessMetaData, TaskTreeNode
from pycrorm_async.orm.base import EPISODE
from pycrorm_async.query.frames import EpisodeNumber, is_named
from pycrorm_async.query.named_queries import EpisodeChoice, EpisodeSummary
from pycrorm_async.query.text import NotebookValue, nearest
from pycrorm_async.store.log import EventLog
from pycrorm_async.world.pose import Arms

if TYPE_CHECKING:
    from pycrorm_async.query.frames import Library
    from pycrorm_async.query.named_queries import NodeSummary
    from pycrorm_async.record.plan_recorder import Episode


T = TypeVar("T")

AskedEpisode: TypeAlias = Union[int, str, "Episode", EpisodeSummary]
"""An episode by its number, its id or the first digits of it, `last`, or as an `Episode` or `EpisodeSummary`."""
FrameQuery: TypeAlias = (
    "Select[*tuple[Any, ...]] | CompoundSelect[*tuple[Any, ...]] | type[Any] | Question | SyncQuestion"
)
"""A query that has a frame: a select, a union of selects, a mapped class, whose rows are all meant, or a question."""


@dataclass(frozen=True)
class QuestionPlan:
    """The parts of a question: its name, the episode it is about, and the function that makes its select.

    `select_of` takes an `EpisodeNumber` as `episode`; None makes the select about all episodes. `names` are the
    arguments that name what a memory has or has not, such as an object.
    """

    name: str
    episode: AskedEpisode | None
    select_of: Callable[..., Select[*tuple[Any, ...]]]
    names: Mapping[str, str] = field(default_factory=dict)


class Question(NotebookValue):
    """One question to a memory. Nothing is read until it is awaited.

    >>> question = memory.ask.root_failures(object="milk", episode="last")
    >>> print(question.sql)
    >>> frame = await question
    >>> polars = await question.frame(to="polars")
    >>> for row in await question.rows():
    ...     print(row.path, row.message)

    Attributes:
        name: of the method that made it.
    """

    def __init__(self, reading: EpisodeReader, plan: QuestionPlan) -> None:
        self.name = plan.name
        self._reading = reading
        self._plan = plan

    @property
    def statement(self) -> Select[*tuple[Any, ...]]:
        """The select, to change or to join. It contains the subquery that finds the named episode.

        Raises `CallerError` for the first digits of an id, which only `rows` and `frame` look up.
        """
        episode = self._plan.episode
        return self._plan.select_of(episode=None if episode is None else _number_by_query(episode))

    @property
    def episode(self) -> AskedEpisode | None:
        """The episode that it names; None for a question about all episodes."""
        return self._plan.episode

    def select_among(self, numbers: Sequence[int]) -> Select[*tuple[Any, ...]]:
        """Return the select about the episodes of these numbers, instead of about those that the question names."""
        return self._plan.select_of(episode=numbers)

    @property
    def sql(self) -> str:
        """The statement in the SQL of this memory's database, with all values written out."""
        dialect = self._reading.dialect
        return str(self.statement.compile(dialect=dialect, compile_kwargs={"literal_binds": True}))

    async def frame(self, *, to: Library = "pandas", simulated: bool = False) -> Any:
        """Return the answer as a frame; see `Reading.dataframe`. Raises `UnknownEpisode`, `MissingExtra`."""
        frame = await self._reading.dataframe(await self.resolved(), to=to, simulated=simulated)
        if not len(frame):
            _warn(await self.unknown_name())
        return frame

    async def rows(self, *, simulated: bool = False) -> list[Row[*tuple[Any, ...]]]:
        """Return the answer as named tuples, which needs no extra. Raises `UnknownEpisode`."""
        rows, unknown = await self.rows_or_unknown_name(simulated=simulated)
        _warn(unknown)
        return rows

    async def rows_or_unknown_name(self, *, simulated: bool = False) -> tuple[list[Row[*tuple[Any, ...]]], str]:
        """Return the answer as named tuples and, if it is empty, what `unknown_name` returns."""
        rows = await self._reading.rows(await self.resolved(), simulated=simulated)
        return rows, "" if rows else await self.unknown_name()

    async def unknown_name(self) -> str:
        """Return a line about an argument, such as an object, that is nowhere in the memory; empty if there is none.

        A question about one episode is compared with the names of that episode, so that it reads no others.
        """
        episode = self.episode
        number = None if episode is None else (await self._reading.episode(episode_name(episode))).number
        return await unknown_name(self._reading, self._plan.names, number)

    def __await__(self) -> Generator[Any, Any, Any]:
        return self.frame().__await__()

    async def resolved(self) -> Select[*tuple[Any, ...]]:
        """Return the select with the number of the episode in place of a subquery, so that databases plan better."""
        if self.episode is None:
            return self._plan.select_of(episode=None)
        return self._plan.select_of(episode=(await self._reading.episode(episode_name(self.episode))).number)

    def __str__(self) -> str:
        return self.sql

    def __repr__(self) -> str:
        return f"<question {self.name}: await it for a frame, print it for its SQL>"


class SyncQuestion(NotebookValue):
    """One question to a memory of `Memory.sync`. Its methods may be called from any thread.

    >>> frame = memory.ask.durations().frame()
    """

    def __init__(self, question: Question, run: Callable[[Coroutine[Any, Any, Any]], Any]) -> None:
        self.name = question.name
        self.question = question
        self._run = run

    @property
    def statement(self) -> Select[*tuple[Any, ...]]:
        """The select; see `Question.statement`."""
        return self.question.statement

    @property
    def sql(self) -> str:
        """The statement in the SQL of this memory's database, with all values written out."""
        return self.question.sql

    def frame(self, *, to: Library = "pandas", simulated: bool = False) -> Any:
        """Return the answer as a frame; see `Question.frame`."""
        return self._run(self.question.frame(to=to, simulated=simulated))

    def rows(self, *, simulated: bool = False) -> list[Row[*tuple[Any, ...]]]:
        """Return the answer as named tuples, which needs no extra."""
        rows: list[Row[*tuple[Any, ...]]] = self._run(self.question.rows(simulated=simulated))
        return rows

    def __str__(self) -> str:
        return self.sql

    def __repr__(self) -> str:
        return f"<question {self.name}: call frame() or rows(), print it for its SQL>"


@contextmanager
def translated_errors(log: EventLog, query: FrameQuery) -> Iterator[None]:
    """Translate errors of the driver; raise `QueryRefused` where the database refuses a select of the caller's own.

    A question and a mapped class are selects of this package, so what it refuses in them stays an `InternalError`.
    """
    try:
        with log.translated():
            yield
    except InternalError as error:
        if isinstance(query, Question | type):
            raise
        refusal = str(error).removeprefix(f"{log.address}: ")
        raise QueryRefused(f"the query is refused: {refusal}") from error


def _warn(unknown: str) -> None:
    if "did you mean" in unknown:
        warnings.warn(f"no row answers: {unknown}", stacklevel=3)


def episode_name(episode: AskedEpisode) -> str:
    """Return the name by which `Reading.episode` finds it. Raises `CallerError` for another type."""
    if isinstance(episode, EpisodeSummary):
        return episode.id
    if isinstance(episode, int | str) and not isinstance(episode, bool):
        return str(episode)
    from pycrorm_async.record.plan_recorder import Episode  # here, because it loads the plan layer

    if isinstance(episode, Episode):
        return str(episode)
    raise CallerError(f"episode must be a number, an id, 'last', an Episode or an EpisodeSummary, got {episode!r}")


def _number_by_query(episode: AskedEpisode) -> EpisodeNumber:
    name, numbered = episode_name(episode), ProcessMetaData
    if name == "last":
        return select(func.max(numbered.id)).where(~numbered.simulated).scalar_subquery()
    if (number := number_in(name)) is not None:
        return number
    if not is_episode_id(name.lower()):
        raise CallerError(f"a statement names an episode by its number, its whole id or `last`, got {name!r}")
    return select(numbered.id).where(numbered.uuid == name.lower()).scalar_subquery()


# === ports ====================================================================================================
#
# The port through which questions and comparisons read a memory; `query.reading.Reading` implements it.


class EpisodeReader(Protocol):
    """Reads the rows of selects, and episodes by their names."""

    @property
    def dialect(self) -> Dialect:
        """The dialect of the database, to write a statement in its SQL."""
        ...

    async def rows(
        self, statement: Select[*tuple[Any, ...]], *, simulated: bool = False
    ) -> list[Row[*tuple[Any, ...]]]:
        """Return the rows of a select over columns as named tuples."""
        ...

    async def dataframe(self, statement: Select[*tuple[Any, ...]], *, to: Library, simulated: bool = False) -> Any:
        """Return the rows of a select as a frame. Raises `MissingExtra`."""
        ...

    async def episode(self, name: str) -> EpisodeSummary:
        """Return the episode with this number, id, or first digits of its id. Raises `UnknownEpisode`."""
        ...

    async def tree(self, episode: EpisodeSummary) -> Sequence[NodeSummary]:
        """Return the nodes of an episode, each before its children."""
        ...


# === failure words ============================================================================================
#
# Map search words to failure classes, because no word stem connects `cannot reach` with `unreachable`.
#
# A failure is searched by its columns (object, arm, reason, message), not by one bag of words: the milk's failure must
# not answer to `cereal` because the episode's description names both.

_WORDS: dict[str, tuple[str, ...]] = {
    "unreachable, out of reach, cannot reach, too far, ik, inverse kinematics": (
        "IKError",
        "ReachabilityFailure",
        "ManipulationPoseUnreachable",
        "NavigationPoseUnreachable",
        "ObjectUnreachable",
        "EnvironmentUnreachable",
        "TorsoGoalUnreachable",
    ),
    "not reached, stopped short, missed": (
        "ManipulationGoalNotReached",
        "EnvironmentManipulationGoalNotReached",
        "GripperGoalNotReached",
        "NavigationGoalNotReached",
        "TorsoGoalNotReached",
        "ConfigurationNotReached",
    ),
    "collision, collided, bumped, hit, blocked, obstacle, in the way": (
        "CollisionError",
        "ManipulationGoalInCollision",
        "NavigationGoalInCollision",
    ),
    "not found, not seen, invisible, perception, missing, nowhere": (
        "PerceptionObjectNotFound",
        "PerceptionObjectNotInWorld",
        "ObjectNowhereToBeFound",
        "ObjectNotFound",
        "ObjectUnavailable",
        "SearchingFailed",
        "LookingHighLevelFailure",
    ),
    "dropped, slipped, lost, fell": ("ObjectLost", "GripperClosedCompletely"),
    "gripper, hand, grasp": (
        "GripperLowLevelFailure",
        "GripperClosedCompletely",
        "GripperGoalNotReached",
        "EndEffectorFailure",
        "Grasping",
    ),
    "too slow, too long, took too long, timed out, hung": ("Timeout", "ActionlibActionTimeout"),
    "too heavy, payload, no arm, no gripper, not able, incapable": ("CapabilityAbsenceFailure",),
    "drive, driving, base, navigation": (
        "NavigationLowLevelFailure",
        "NavigationHighLevelFailure",
        "NavigationGoalNotReached",
        "NavigationPoseUnreachable",
        "NavigationGoalInCollision",
        "LocomotorFailure",
    ),
    "delivery, bring, transport": ("DeliveringFailed", "ObjectUndeliverable", "FetchingFailed", "ObjectUnfetchable"),
    "deadlock, stuck, waiting": ("ResourceDeadlock",),
    "crash, crashed, bug, exception": ("ValueError", "TypeError", "KeyError", "AttributeError", "RuntimeError"),
}
"""The failure classes by the words for them."""
SEARCH_WORDS = tuple(dict.fromkeys(word for synonyms in _WORDS for word in synonyms.split(", ")))
"""All these words."""


def classes_meant_by(words: str) -> list[str]:
    """Return the failure classes that these words mean.

    >>> classes_meant_by("Too heavy")
    ['CapabilityAbsenceFailure']
    """
    meant = " ".join(words.lower().replace("_", " ").replace("-", " ").split())
    classes = (classes for synonyms, classes in _WORDS.items() if meant in synonyms.split(", "))
    return list(dict.fromkeys(each for group in classes for each in group))


# === unknown names ============================================================================================
#
# Suggest the right name after an empty answer, where a question names what is nowhere in the memory.

_OBJECTS = Object.name, Detection.name
_RECORDED: dict[str, Sequence[Any]] = {
    "dtype": (DesignatorType.dtype,),
    "name": _OBJECTS,
    "object": _OBJECTS,
    "reason": (TaskTreeNode.reason,),
    "robot": (EpisodeRobot.name, EpisodeRobot.model),
    "tag": (EpisodeTag.tag,),
}
"""The columns with the names of an argument that a memory has."""
_FIXED: dict[str, tuple[str, ...]] = {"arm": tuple(Arms.__members__), "reason": SEARCH_WORDS}
"""The names of an argument that every memory has."""
_WHATS = {"dtype": "type", "name": "object"}
_IN_PARTS = ("object", "reason")
"""The arguments of which a part is enough."""
_AS_WRITTEN = ("dtype", "robot", "tag")
"""The arguments that are compared as they are written."""
CHECKED = frozenset((*_RECORDED, *_FIXED))
"""The arguments that are names."""


async def unknown_name(reading: EpisodeReader, names: Mapping[str, str], episode: int | None = None) -> str:
    """Return a line about the first of these arguments that the memory does not have; empty if it has them all.

    Without an episode it reads the names of the whole memory, so it is for questions without an answer only.
    """
    for argument, name in names.items():
        valid = list(_FIXED.get(argument, ()))
        where = "the memory"
        for each in _RECORDED.get(argument, ()):
            query = select(each).distinct()
            if episode is not None and (own := each.class_.__table__.c.get(EPISODE)) is not None:
                where, query = f"episode {episode}", query.where(own == episode)
            valid += [value for (value,) in await reading.rows(query, simulated=True) if value is not None]
        if not _is_one(argument, name, valid):
            absence = f"{where} has no {_WHATS.get(argument, argument)} {name or repr(name)}"
            for each in () if episode is None else _RECORDED.get(argument, ()):
                if await reading.rows(select(each).where(is_named(each, name)).limit(1), simulated=True):
                    return absence  # other episodes have it, so that it is no mistake
            return f"{absence}{nearest(name, valid)}"
    return ""


async def absence_of_episodes(reading: EpisodeReader, choice: EpisodeChoice) -> str:
    """Return the line that a verb prints when no episode fulfils a choice, with the nearest tag or robot."""
    if replace(choice, limit=None) == EpisodeChoice():
        return "no episode yet: record one with `pycrorm run` or `pycrorm demo`"
    names = [*([] if choice.robot is None else [("robot", choice.robot)]), *(("tag", each) for each in choice.tags)]
    for argument, name in names:
        if unknown := await unknown_name(reading, {argument: name}):
            return f"no episode matches these options; {unknown}"
    return "no episode matches these options; `pycrorm episodes` lists all"


def _is_one(argument: str, name: str, valid: list[str]) -> bool:
    if argument in _AS_WRITTEN:
        return name in valid
    wanted, lowered = name.encode().lower(), [each.encode().lower() for each in valid]  # bytes: A to Z, as in SQLite
    return any(wanted in each if argument in _IN_PARTS else wanted == each for each in lowered)
