"""`SyncMemory` is a memory for code without asyncio: one thread of its own holds the asynchronous one.

>>> with Memory.sync("sqlite:///memory.db") as memory:
...     with memory.recording.episode(description="Tutorial") as episode:
...         executive.run(observer=episode)
...     memory.flush()

The thread ends with the process if the memory is never closed; its events are then in the spool, and the next memory
of that database stores them.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from datetime import datetime
from os import PathLike
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar, overload

from pycrorm_async.errors import CallerError, FlushTimeout
from pycrorm_async.memory_parts import MemoryStatus
from pycrorm_async.memory_recording import RecordingMemory
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.asking.ask import Ask
from pycrorm_async.query.asking.episode_diff import EpisodeDiff
from pycrorm_async.query.asking.question import AskedEpisode, FrameQuery, Question, SyncQuestion
from pycrorm_async.query.frames.dataframe import Library
from pycrorm_async.query.notebook.listings import Episodes, TaskTree
from pycrorm_async.query.snapshot import Moment
from pycrorm_async.query.sql.read_only import DEFAULT_LIMITS, SqlLimits, SqlResult
from pycrorm_async.recall.answer import Answer
from pycrorm_async.recording.recording import Recording

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from pycrorm_async.export.export import Exported
    from pycrorm_async.export.selection import Exportable
    from pycrorm_async.query.scene.picture import MomentReference
    from pycrorm_async.report.write import Report

__all__ = ["SyncMemory"]

T = TypeVar("T")


class SyncMemory:
    """A memory to use with `with`, once; `Memory.sync` makes it. Its methods may be called from any thread."""

    def __init__(self, memory: RecordingMemory) -> None:
        self._memory = memory
        self._thread: threading.Thread | None = None
        self._opened: Future[asyncio.AbstractEventLoop] = Future()
        self._closing: asyncio.Future[BaseException | None] | None = None
        self._closed: Future[None] = Future()

    def __repr__(self) -> str:
        return f"<Sync{repr(self._memory)[1:]}"

    def _repr_html_(self) -> str:
        return self._memory._repr_html_()

    def __enter__(self) -> Self:
        if self._thread is not None:
            raise CallerError("a memory can be entered once: call Memory.sync again")
        self._thread = threading.Thread(target=self._run, name="memory of pycrorm", daemon=True)
        try:
            self._thread.start()
            self._opened.result()
        except BaseException:  # Ctrl-C, which must not leave the memory open; or what opening raised
            self._opened.add_done_callback(self._close_unused)
            raise
        return self

    def _close_unused(self, opened: Future[asyncio.AbstractEventLoop]) -> None:
        if opened.exception() is None and self._closing is not None:
            opened.result().call_soon_threadsafe(self._closing.set_result, None)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if not self._memory.is_open:  # in a forked child it belongs to the parent
            return
        assert self._closing is not None
        self._opened.result().call_soon_threadsafe(self._closing.set_result, error)
        self._closed.result()

    def _run(self) -> None:
        try:
            asyncio.run(self._hold())
        except BaseException as error:  # noqa: BLE001  it is raised where the memory is used
            (self._closed if self._opened.done() else self._opened).set_exception(error)
        else:
            self._closed.set_result(None)

    async def _hold(self) -> None:
        """Hold the memory open, in one task, until it is closed."""
        loop = asyncio.get_running_loop()
        self._closing = loop.create_future()
        await self._memory.__aenter__()
        self._opened.set_result(loop)
        error = await self._closing
        await self._memory.__aexit__(type(error) if error is not None else None, error, None)

    def _await(self, coroutine: Coroutine[Any, Any, T], timeout_s: float | None = None) -> T:
        """Run a coroutine in the memory's thread and return its result. Raises `TimeoutError` after `timeout_s`."""
        if not self._memory.is_open:
            coroutine.close()
            raise CallerError("this memory is not open: use `with Memory.sync(url) as memory`")
        future = asyncio.run_coroutine_threadsafe(coroutine, self._opened.result())
        try:
            return future.result(timeout_s)
        except BaseException:  # also Ctrl-C, which must not leave the coroutine running
            future.cancel()
            raise

    @property
    def recording(self) -> Recording:
        """Writes episodes; see `Recording`."""
        return self._memory.recording

    @property
    def status(self) -> MemoryStatus:
        """The present state of the memory."""
        return self._memory.status

    @property
    def recent_episodes(self) -> tuple[str, ...]:
        """The ids of the last hundred episodes this memory opened."""
        return self._memory.recent_episodes

    def synced(self) -> None:
        """Wait until all events recorded so far survive a power loss; raises as `Memory.synced` does."""
        self._await(self._memory.synced())

    def flush(self, timeout_s: float | None = None) -> None:
        """Wait until all events recorded so far are visible in the tables; raises as `Memory.flush` does.

        Raises `FlushTimeout` also after `timeout_s`, if it is given. The events are safe in the spool.
        """
        try:
            self._await(self._memory.flush(), timeout_s)
        except TimeoutError as error:
            assert timeout_s is not None, "only a limited wait ends"
            raise FlushTimeout(timeout_s) from error

    @property
    def ask(self) -> Ask[SyncQuestion]:
        """The named questions: `memory.ask.root_failures(object="milk").frame()`."""
        reading = self._memory.reading
        return Ask(lambda plan: SyncQuestion(Question(reading, plan), self._await))

    def episodes(self, *, simulated: bool = False) -> Episodes:
        """Return every episode, the oldest first; see `Memory.episodes`."""
        return self._await(self._memory.episodes(simulated=simulated))

    def tree(self, episode: AnyEpisode) -> TaskTree:
        """Return the task tree of an episode; see `Memory.tree`."""
        return self._await(self._memory.tree(episode))

    def as_of(
        self, episode: AnyEpisode, *, time: float | datetime | None = None, sequence: int | None = None
    ) -> Moment:
        """Return the task tree and the world at any moment of an episode; see `Memory.as_of`."""
        return self._await(self._memory.as_of(episode, time=time, sequence=sequence))

    def picture(self, episode: AnyEpisode, *, at: MomentReference = None, **view: Any) -> bytes:
        """Return the scene of an episode at a moment as PNG; see `Memory.picture`."""
        return self._await(self._memory.picture(episode, at=at, **view))

    def report(self, episode: AnyEpisode, path: str | PathLike[str] | None = None, **options: Any) -> Report:
        """Write an episode as one HTML page that opens offline; see `Memory.report`, which has the same options."""
        return self._await(self._memory.report(episode, path, **options))

    def plot_success(self, x: str, y: str, **options: Any) -> Figure:
        """Draw how often the actions of a view succeeded over two of its columns; see `Memory.plot_success`."""
        return self._await(self._memory.plot_success(x, y, **options))

    def diff(self, first: AskedEpisode, second: AskedEpisode) -> EpisodeDiff:
        """Compare two episodes; see `Reading.diff`."""
        return self._await(self._memory.diff(first, second))

    def recall(self, type: str | type | None = None, **cue: Any) -> Answer:  # noqa: A002  the feature's name
        """Return the past actions most like a cue; see `Recall.__call__`."""
        return self._await(self._memory.recall(type, **cue))

    def query(self, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> SqlResult:
        """Return the rows of one query in SQL that can only read; see `Reading.query`."""
        return self._await(self._memory.query(sql, limits))

    @overload
    def dataframe(
        self,
        statement: FrameQuery | SyncQuestion,
        *,
        to: Literal["pandas"] = "pandas",
        simulated: bool = False,
        deferred: bool = False,
    ) -> pd.DataFrame: ...

    @overload
    def dataframe(
        self,
        statement: FrameQuery | SyncQuestion,
        *,
        to: Library,
        simulated: bool = False,
        deferred: bool = False,
    ) -> Any: ...

    def dataframe(
        self,
        statement: FrameQuery | SyncQuestion,
        *,
        to: Library = "pandas",
        simulated: bool = False,
        deferred: bool = False,
    ) -> Any:
        """Return the rows as a frame of pandas, polars or Arrow; see `Memory.dataframe`."""
        query = statement.question if isinstance(statement, SyncQuestion) else statement
        return self._await(self._memory.reading.dataframe(query, to=to, simulated=simulated, deferred=deferred))

    def export(self, what: Exportable | SyncQuestion, path: str | PathLike[str], **options: Any) -> Exported:
        """Write episodes or rows to a file; see `Memory.export`, which has the same options."""
        exported = what.question if isinstance(what, SyncQuestion) else what
        return self._await(self._memory.export(exported, path, **options))
