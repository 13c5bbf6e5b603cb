"""A named question: its select, its SQL, and its answer as a frame or as rows."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Coroutine, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from sqlalchemy import CompoundSelect, Row, Select, func, select

from pycrorm_async.errors import CallerError, InternalError, QueryRefused, UnknownEpisode
from pycrorm_async.orm import ProcessMetaData
from pycrorm_async.query.asking.columns import EpisodeNumber
from pycrorm_async.query.asking.ports import EpisodeReader
from pycrorm_async.query.asking.unknown_names import unknown_name
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.value_html import NotebookValue
from pycrorm_async.store.log import EventLog

if TYPE_CHECKING:
    from pycrorm_async.hooks.episode import Episode
    from pycrorm_async.query.frames.dataframe import Library

T = TypeVar("T")

AskedEpisode: TypeAlias = "int | str | Episode | EpisodeSummary"
"""An episode by its number, its id or the first digits of it, `last`, or as an `Episode` or `EpisodeSummary`."""
FrameQuery: TypeAlias = "Select[*tuple[Any, ...]] | CompoundSelect[*tuple[Any, ...]] | type[Any] | Question"
"""A query that has a frame: a select, a union of selects, a mapped class, whose rows are all meant, or a question."""
_DIGITS_MAX = 7
"""The largest number of an episode has seven digits."""
_DIGITS_OF_ID = 4
"""Fewer digits are a number and not the first ones of an id, as in `store.episode_lookup`."""


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

        It has no row if no id, or more than one, begins with these digits, because a select cannot raise errors on all
        databases; `rows` and `frame` raise `UnknownEpisode` then. It raises that itself for a text of fewer than four
        characters that is no number or begins with a zero: to name an id takes four.
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
        """Return a line about an argument, such as an object, that is nowhere in the memory; empty without one."""
        return await unknown_name(self._reading, self._plan.names)

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
    from pycrorm_async.hooks.episode import Episode  # here, because it loads the plan layer

    if isinstance(episode, Episode):
        return str(episode)
    raise CallerError(f"episode must be a number, an id, 'last', an Episode or an EpisodeSummary, got {episode!r}")


def _number_by_query(episode: AskedEpisode) -> EpisodeNumber:
    name, numbered = episode_name(episode), ProcessMetaData
    if name == "last":
        return select(func.max(numbered.id)).where(~numbered.simulated).scalar_subquery()
    is_number = name.isdecimal() and name.isascii() and len(name) <= _DIGITS_MAX
    if is_number and (isinstance(episode, int) or len(name) < _DIGITS_OF_ID) and name == str(int(name)):
        return int(name)
    if len(name) < _DIGITS_OF_ID:
        raise UnknownEpisode(f"there is no episode {name!r}; `pycrorm episodes` lists all")
    is_named = numbered.uuid.startswith(name.lower(), autoescape=True)
    # Without HAVING, SQLite would take the first of several episodes, and PostgreSQL refuse the select.
    begins = select(func.min(numbered.id)).where(is_named).having(func.count() == 1).scalar_subquery()
    if not is_number or name.startswith("0"):
        return begins
    return func.coalesce(select(numbered.id).where(numbered.id == int(name)).scalar_subquery(), begins)
