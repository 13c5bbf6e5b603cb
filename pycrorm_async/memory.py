"""Open a memory, wire its parts, drain and close it. This is the composition root of the package.

>>> async with Memory.open("sqlite:///memory.db") as memory:
...     async with memory.episode(description="Tutorial"):
...         await plan()
...     await memory.flush()
...     async with memory.session() as session:
...         actions = (await session.scalars(select(Action))).all()

**Sync memory.** `SyncMemory` is a memory for code without asyncio: one thread of its own holds the asynchronous one.

>>> with Memory.sync("sqlite:///memory.db") as memory:
...     with memory.recording.episode(description="Tutorial") as episode:
...         executive.run(observer=episode)
...     memory.flush()

The thread ends with the process if the memory is never closed; its events are then in the spool, and the next memory
of that database stores them.

**Loading.** Importing this module loads what records events. The packages that read memories, recall and report are
loaded when a memory is first asked, the plan layer when a plan is first recorded, and the projections when a memory is
opened with a writer thread (`lazy_names`).
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import AsyncIterable, AsyncIterator, Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, AsyncExitStack, asynccontextmanager, contextmanager
from contextvars import copy_context
from dataclasses import replace
from functools import partial, wraps
from importlib import import_module
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self, TypeVar, cast

from pycrorm_async import __version__, operations
from pycrorm_async import projections as folding
from pycrorm_async import query as reading_side
from pycrorm_async import report as reporting
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.connected_var import set_inside
from pycrorm_async.errors import CallerError, EpisodeParked, FlushTimeout, PycrormError, TablesForeign, TablesPending
from pycrorm_async.events.codec import declaration_of
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.events.ids import episode_id
from pycrorm_async.memory_parts import MemoryStatus as MemoryStatus
from pycrorm_async.memory_parts import Parts, built_in_declaration
from pycrorm_async.queue.locks import call_in_forked_child
from pycrorm_async.queue.recorder_queue import RecorderQueue
from pycrorm_async.queue.spool import Spool
from pycrorm_async.record.declarations import KnownTypes
from pycrorm_async.record.episode_writer import Emitter, OpenEpisodes
from pycrorm_async.record.event_feed import BUFFER_EVENTS, EventStream, RecordedEvent, Subscription
from pycrorm_async.record.opening import PlanSource, Provenance, read_labels
from pycrorm_async.record.recording import Recording
from pycrorm_async.settings import Settings, Writer
from pycrorm_async.store.address import DatabaseAddress, check_replica
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.plan_writer import DelegatedWriter, WriterThread

if TYPE_CHECKING:
    from pycrorm_async.export import export as exporting
    from pycrorm_async.plan.language import ActionDescription, Designator
    from pycrorm_async.plan.task import TaskTreeNode
    from pycrorm_async.projections import Projection, UserView
    from pycrorm_async.query import Ask, AskedEpisode, Question, Reading, SyncQuestion
    from pycrorm_async.query import picture as pictures
    from pycrorm_async.recall import Answer, Prediction, Recall
    from pycrorm_async.record import Episode
    from pycrorm_async.record.camera import CameraStream


# === memory ===================================================================================================

_log = logging.getLogger("pycrorm_async")
T = TypeVar("T")
_P = ParamSpec("_P")


class _Method:
    """A method that is made when it is first read, because that loads the class it delegates to."""

    def __init__(self, make: Callable[[], Callable[..., Any]]) -> None:
        self._make = make

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object, owner: type) -> Any:
        setattr(owner, self._name, self._make())
        return getattr(owner if instance is None else instance, self._name)


if TYPE_CHECKING:

    def _as_read(method: Callable[Concatenate[Reading, _P], T]) -> Callable[Concatenate[Memory, _P], T]: ...


def _reading(find: Callable[[], Callable[Concatenate[Reading, _P], T]]) -> Callable[Concatenate[Memory, _P], T]:
    """Return the method of `Reading` that `find` returns as one of an open memory."""

    def make() -> Callable[..., T]:
        method = find()

        @wraps(method)
        def read(memory: Memory, *arguments: _P.args, **named: _P.kwargs) -> T:
            return method(memory.reading, *arguments, **named)

        return read

    return cast("Callable[Concatenate[Memory, _P], T]", _Method(make))


class Memory:
    """The memory of one process in one database. Use `Memory.open` as an async context manager.

    While it is open, it records every plan performed in its context: in the open episode, or in one of the plan's own.
    Of several open memories the one whose episode is open records, or else the one opened last.

    Its questions are those of `Reading`, up to the last flush: events recorded since may be missing from an answer.
    Each method raises `CallerError` while the memory is not open.
    """

    _parts: Parts | None = None
    _forked_parts: Parts | None = None
    _last_status: Callable[[], MemoryStatus] | None = None

    def __init__(
        self,
        address: DatabaseAddress,
        *,
        spool: Path | None,
        views: Sequence[UserView],
        projections: Sequence[Projection],
        settings: Settings,
        clock: Clock,
        plan_source: PlanSource | None = None,
        replica: DatabaseAddress | None = None,
    ) -> None:
        self._address = self._located = address
        self._replica = replica
        self._spool = spool
        self._views = tuple(views)
        self._projections = tuple(projections)
        self._settings = settings
        self._clock = clock
        self._plan_source = plan_source
        self._unadopted: dict[str, PycrormError] = {}
        self._stack = AsyncExitStack()
        self._reported: set[str] = set()
        call_in_forked_child(self._forked)

    def __repr__(self) -> str:
        return f"<Memory {self._address}, {'open' if self._parts is not None else 'not open'}>"

    def _repr_html_(self) -> str:
        return reading_side.memory_html(self._address, self._located if self._parts is not None else None)

    @classmethod
    def open(
        cls,
        url: str,
        *,
        spool: Path | str | None = None,
        views: Sequence[UserView] = (),
        projections: Sequence[Projection] = (),
        writer: Writer | None = None,
        settings: Settings | None = None,
        clock: Clock = SYSTEM_CLOCK,
        plan_source: PlanSource | None = None,
        read_url: str | None = None,
    ) -> Memory:
        """Return a memory to enter with `async with`, once.

        Args:
            url: `sqlite:///memory.db`, `sqlite:////absolute/path.db`, or `sqlite://` for one that exists in this
                process only and is deleted when it is closed.
            spool: folder of the write-ahead queue; by default `memory.db.spool` beside `memory.db`.
            views: named queries to create beside the tables.
            projections: custom projections to fold besides the installed ones. An event that one cannot fold parks the
                episode in that projection only: `flush` does not raise, `pycrorm status` shows the reason.
            writer: `thread` for a thread of this process that moves events to the database, `process` for a process
                that the memory starts and ends, or `daemon` for a `pycrorm writer` with the same URL and spool; by
                default as in the settings. With a daemon this process has no connection for writing, the database may
                not exist yet, and `session()`, `dataframe()` and `reading` open their own connection at the first
                query.
            settings, clock: limits and intervals; the time source.
            plan_source: recorded with each episode; `pycrorm run` passes hash and commit of the plan's file.
            read_url: a streaming replica of the PostgreSQL server, which answers the questions. After a flush they wait
                up to 5 s until it shows what was flushed; while it does not, the memory itself answers, with a warning.

        Raises:
            UnknownUrl: at once. `CallerError`: at once, for a private database, or views or projections of this
                process, with a daemon or a process, and for a `read_url` that cannot be a replica.
                On entering: `DatabaseUnavailable`, `DatabaseForeign`, `SpoolUnavailable`, `SpoolForeign`.
        """
        address, settings = DatabaseAddress.parse(url), settings or Settings()
        replica = DatabaseAddress.parse(read_url) if read_url else None
        if replica is not None:
            check_replica(replica, address)
        keep_s = 0.0 if address.is_private else settings.keep_stored_s  # sqlite:// is never restored
        settings = replace(settings, writer=writer or settings.writer, keep_stored_s=keep_s)
        if settings.writer != "thread":
            other = "daemon" if settings.writer == "daemon" else "other process"
            if address.is_private:
                raise CallerError(
                    f"sqlite:// is private to this process, so no {other} can write it: use writer='thread'"
                )
            if views or projections:
                unused = "views" if views else "projections"
                raise CallerError(
                    f"the {other} creates the tables, without the {unused} of this process: use writer='thread'"
                )
        return cls(
            address,
            spool=Path(spool) if spool is not None else None,
            views=views,
            projections=folding.validate_projections(projections) if projections else (),
            settings=settings,
            clock=clock,
            plan_source=plan_source,
            replica=replica,
        )

    @classmethod
    async def connect(
        cls,
        url: str,
        *,
        spool: Path | str | None = None,
        views: Sequence[UserView] = (),
        projections: Sequence[Projection] = (),
        writer: Writer | None = None,
        settings: Settings | None = None,
        read_url: str | None = None,
    ) -> Memory:
        """Open a memory for all contexts of this process that have none of their own, until `close`; see `open`.

        It is meant for notebooks, where each cell has a context of its own: actions of the following cells are
        recorded, each in an episode of its own or in that of its cell, also in threads that the user starts. If several
        memories are connected, the last one records. Events that are not stored when the process ends without `close`
        stay in the spool, and the next memory of that database stores them.
        """
        memory = cls.open(
            url,
            spool=spool,
            views=views,
            projections=projections,
            writer=writer,
            settings=settings,
            read_url=read_url,
        )
        return await memory._enter(Parts.in_process)  # noqa: SLF001  its own class

    @classmethod
    def sync(cls, url: str, **options: Any) -> SyncMemory:
        """Return a memory to enter with `with`, for code without asyncio; the arguments are those of `open`."""
        return SyncMemory(cls.open(url, **options))

    async def close(self) -> None:
        """Store and fold all recorded events; open episodes end as INTERRUPTED. A second call has no effect."""
        await self.__aexit__(None, None, None)

    @property
    def status(self) -> MemoryStatus:
        """The present state of the memory; after it was closed, the last one."""
        if self._parts is None and self._last_status is not None:
            return self._last_status()
        return MemoryStatus.of(self._open_parts, self._unadopted)

    @property
    def is_open(self) -> bool:
        """True while the memory is open."""
        return self._parts is not None

    # --- episodes ---------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def episode(
        self,
        *,
        description: str | None = None,
        plan: str | None = None,
        seed: int | None = None,
        tags: Sequence[str] = (),
        metadata: Mapping[str, Any] = MappingProxyType({}),
    ) -> AsyncIterator[Episode]:
        """Record an episode: plans performed inside, and the world that was entered before or is entered inside.

        If the spool is full, waits for space or raises `SpoolFull`, according to `Settings.on_full`.

        Args:
            description: the purpose; default: the plan's name.
            plan: the plan's name.
            seed: of the plan's random numbers, 64 bits, so that it can be repeated.
            tags: short texts to find the episode by; `tag` changes them later.
            metadata: JSON values of your own, at most 64 KiB.

        Raises:
            EpisodeRefused: an episode is open in this task already. A child task may open its own.
            CallerError: for an argument of the wrong type, and a tag that is not a text of 1 to 100 characters.
        """
        parts = self._open_parts
        text = description or plan or "an episode"
        labels = read_labels(tags, metadata, self._settings, parts.emitter.missing)
        with parts.in_context():
            async with parts.recorder.episode(description=text, plan=plan, seed=seed, **labels) as episode:
                yield episode

    async def tag(self, episode: AskedEpisode, *tags: str, remove: Sequence[str] = ()) -> None:
        """Add and remove tags of an episode of this database: a number, id, `last`, or object.

        Tags of an episode that is open in this memory are recorded in it; those of one that has ended are written
        directly to the log, after a flush.

        Raises `CallerError` for an episode that another process still records, and for a removed tag that the episode
        does not have; `UnknownEpisode`; `DatabaseUnavailable`, also if this login may not append.
        """
        parts = self._open_parts
        added, removed = checked_tags(tags), checked_tags(remove)
        name = str(episode.id if isinstance(episode, reading_side.EpisodeSummary) else episode)
        for each in parts.episodes.all:
            if str(each) == name:
                each.change_tags(added, removed)
                return
        await self.flush()
        await operations.tag_episode(self._located, name, added, removed, clock=self._clock)

    async def synced(self) -> None:
        """Wait until all events recorded so far survive a power loss.

        Raises `SpoolUnavailable` if the disk failed, or files of the spool were deleted or replaced. Since then nothing
        is recorded, and `status` has the reason.
        """
        await self._open_parts.queue.synced_to(self._open_parts.queue.written)

    async def flush(self) -> None:
        """Wait until all events recorded so far are stored and visible in the tables.

        Raises:
            EpisodeParked: an episode could not be stored or folded, with the reason; each episode is reported once.
            TablesOutdated: all is stored, but an older version made the tables; reported once.
            TablesWithheld: all is stored, but this login may not change the tables; reported once.
            TablesUntrusted: all is stored, but the tables belong to a role with fewer rights than this login.
            FlushTimeout: nothing was stored or folded for `flush_timeout_s`. The events are safe in the spool.
        """
        parts = self._open_parts
        try:
            await parts.flush()
        except (EpisodeParked, TablesPending) as fault:
            unreported = self._unreported(fault)
            if unreported is not None:
                raise unreported from fault
        reading: Reading | None = parts.made("reading")
        if reading is not None and reading.is_open:
            await reading.follow()
            await reading.refresh(maps=False)

    def _unreported(self, fault: PycrormError) -> PycrormError | None:
        """Return the fault less the parked episodes or outdated tables that a flush reported; None if that is all."""
        if isinstance(fault, TablesPending):
            is_reported = "tables" in self._reported
            self._reported.add("tables")
            return None if is_reported else fault
        if not isinstance(fault, EpisodeParked):
            return fault
        reasons = {episode: reason for episode, reason in fault.reasons.items() if episode not in self._reported}
        self._reported.update(reasons)
        return EpisodeParked(reasons) if reasons else None

    # --- other executives and programs ------------------------------------------------------------------------

    @property
    def recording(self) -> Recording:
        """Writes episodes of an executive that is not ours, from any thread and without asyncio.

        In a forked child it records nothing, so that an executive continues there.
        """
        return (self._forked_parts or self._open_parts).recording

    @property
    def recent_episodes(self) -> tuple[str, ...]:
        """The ids of the last hundred episodes this memory opened."""
        return self._open_parts.episodes.recent

    @property
    def opened_count(self) -> int:
        """The number of episodes this memory opened."""
        return self._open_parts.episodes.opened_count

    def observe(self, name: str, values: object, *, node: TaskTreeNode | None = None) -> None:
        """Record an observation of your own in the open episode: a measurement, a message, an image.

        >>> memory.observe("wrist force", {"x": 1.5, "y": -0.25, "contact": True})
        >>> memory.observe("camera", Blob(png, "image/png"))

        May be called from any thread. A thread outside the plan's context observes for the episode opened last. A value
        that cannot be recorded, or finds no space in the spool, is recorded as missing and counted; a plan never waits.

        Args:
            name: by which observations are queried.
            values: a number, bool, text, array or `Blob`, or a dict or list of these. An array of more than 64 elements
                is stored as a blob of the media type `application/x-npy`.
            node: the node that observed it; by default the current one, or the root of the episode.

        Raises `Unrecordable` with `on_unrecordable="refuse"` only.
        """
        (self._forked_parts or self._open_parts).recorder.observe(name, values, node=node)

    def observe_camera(
        self,
        name: str,
        frames: AsyncIterable[object] | None = None,
        *,
        hz: float = 2.0,
        bytes_per_s: float = 4e6,
        node: TaskTreeNode | None = None,
    ) -> CameraStream:
        """Record the images of a camera as observations, without slowing the plan.

        >>> with memory.observe_camera("front", camera.frames(), hz=2):
        ...     await plan()
        >>> front = memory.observe_camera("front")
        >>> driver.on_image(front.put)

        Images between two episodes are not recorded. One that is due and finds no room, because images take more than
        `bytes_per_s` or half of the spool, or come faster than they are recorded, is left out; the oldest first.

        Args:
            name: by which observations are queried.
            frames: an async iterator of images, which a task of this loop reads until the block ends; without it, give
                each image to `put`, from any thread. `CameraStream.put` lists what can be an image.
            hz, bytes_per_s: at most so many images and bytes are recorded in a second.
            node: the node that observes; by default the current one, or the root of the episode.

        Raises `CallerError` for an argument that does not fit.
        """
        from pycrorm_async.record.camera import CameraStream

        parts = self._forked_parts or self._open_parts
        context, recorder = copy_context(), parts.recorder

        def record_image(image: object) -> bool:
            return context.run(recorder.record_image, name, node, image)

        stream = CameraStream(name, record_image, parts.emitter, self._clock, hz, bytes_per_s)
        return stream if frames is None else stream.read(frames)

    # --- subscribing ------------------------------------------------------------------------------------------

    def subscribe(self, callback: Callable[[RecordedEvent], object], *, buffer: int = BUFFER_EVENTS) -> Subscription:
        """Call `callback` with each event from now on, in a thread of its own, until closed or the memory is closed.

        Use the result as a context manager, or call its `close()`. The plan never waits: an event that finds more than
        `buffer` others waiting is left out, and `left_out` counts it. Exceptions of the callback are counted in
        `failed`, and the first is logged.
        """
        return self._open_parts.emitter.feed.subscribe(callback, buffer=buffer)

    def events(self, *, buffer: int = BUFFER_EVENTS) -> EventStream:
        """Return each event from now on as an asynchronous iterator in this loop, which ends when the memory is closed.

        A plan that never suspends lets no other task of its loop run: observe it from a thread, or after the plan.
        """
        return self._open_parts.emitter.feed.stream(buffer=buffer)

    # --- what was recorded ------------------------------------------------------------------------------------

    @property
    def reading(self) -> Reading:
        """The reading side of this memory: named queries, sessions, data frames."""
        return self._open_parts.reading

    session = _reading(lambda: reading_side.Reading.session)
    if TYPE_CHECKING:  # a lambda would lose the overloads, or load what most memories do not use
        dataframe = _as_read(Reading.dataframe)
        export = _as_read(exporting.export)
        export_again = _as_read(exporting.export_again)
        picture = _as_read(pictures.picture)
    else:
        dataframe = _reading(lambda: reading_side.Reading.dataframe)
        export = _reading(lambda: import_module("pycrorm_async.export.export").export)
        export_again = _reading(lambda: import_module("pycrorm_async.export.export").export_again)
        picture = _reading(lambda: import_module("pycrorm_async.query.picture").picture)
    batches = _reading(lambda: reading_side.Reading.batches)
    query = _reading(lambda: reading_side.Reading.query)
    mapped = _reading(lambda: reading_side.Reading.mapped)
    episodes = _reading(lambda: reading_side.Reading.episodes)
    tree = _reading(lambda: reading_side.Reading.tree)
    as_of = _reading(lambda: reading_side.Reading.as_of)
    diff = _reading(lambda: reading_side.Reading.diff)
    blob = _reading(lambda: reading_side.Reading.blob)
    lake = _reading(lambda: reading_side.Reading.lake)
    number_of = _reading(lambda: reading_side.Reading.number_of)
    plot_success = _reading(lambda: reading_side.plot_success)
    samples = _reading(lambda: reading_side.read_samples)
    report = _reading(lambda: reporting.report)

    @property
    def ask(self) -> Ask[Question]:
        """The named questions: `await memory.ask.root_failures(object="milk")` is a frame."""
        return self._open_parts.reading.ask

    @property
    def recall(self) -> Recall:
        """The past actions most like a cue: `await memory.recall(type=PickUpAction, has={"arm": Arms.LEFT})`."""
        return self._open_parts.recall

    async def predict(
        self, /, action: ActionDescription[Any] | Designator | str | type, **situation: Mapping[str, Any]
    ) -> Prediction:
        """Predict the outcome of an action from the remembered tries most like it; see `Recall.predict`.

        >>> prediction = await memory.predict(PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]))
        >>> print(prediction)
        82 % (61-93 %) from 14.2 tries like it; if it fails, most likely by IKError
        """
        return await self.recall.predict(action, **situation)

    @contextmanager
    def advising(self, minimum: float = 0.3, *, explore: bool = True) -> Iterator[None]:
        """Advise the plans of this context: they try the alternatives that are likeliest to succeed first.

        >>> with memory.advising(minimum=0.3):
        ...     await Retry(MoveAndPickUp(milk), max_tries=5).perform()

        Each expression that performs a description, such as `Retry`, predicts the outcome of its alternatives, again
        after each failure. It leaves out those that succeed with less than `minimum`, and raises `RefusedByPrediction`
        if no other is left. An observation `advice` of its node has the predicted chance and the number of those left
        out. A plan that chooses itself, by `resolve()` or in a loop, asks `predict`.

        Args:
            minimum: the least chance with which an alternative is tried, 0 to 1.
            explore: whether alternatives are tried of which too little is known; False saves failures where much is
                remembered, and tries nothing where nothing is.

        If the prediction fails or takes more than 5 s, as without the database, the plan goes on unadvised and the log
        says so once.

        Raises `CallerError` for a minimum that is not from 0 to 1.
        """
        if not 0 <= minimum <= 1:
            raise CallerError(f"minimum must be a chance from 0 to 1, got {minimum!r}")
        from pycrorm_async.plan.advice import adviser  # here, because most memories advise no plan
        from pycrorm_async.recall.prediction import MemoryAdviser

        adviser_ = MemoryAdviser(self.recall.predictions, self.observe, minimum, explore=explore)
        try:
            with set_inside(adviser, adviser_):
                yield
        finally:
            adviser_.close()

    # --- opening and closing ----------------------------------------------------------------------------------

    async def __aenter__(self) -> Self:
        return await self._enter(Parts.in_context)

    async def _enter(self, connect: Callable[[Parts], AbstractContextManager[None]]) -> Self:
        try:
            self._parts = await self._open()
            self._stack.enter_context(connect(self._parts))
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    @property
    def _open_parts(self) -> Parts:
        if self._forked_parts is not None:
            raise CallerError("this memory is open in the process that forked this one: open another one here")
        if self._parts is None:
            raise CallerError("this memory is not open: use `async with Memory.open(url) as memory`")
        return self._parts

    async def _open(self) -> Parts:
        address = self._located = self._stack.enter_context(self._address.located())
        by_daemon, by_thread, declared = self._settings.writer == "daemon", self._settings.writer == "thread", []
        spool = Spool(self._spool or address.default_spool, self._settings.file_access)
        if not by_daemon:
            # Open the database before making a spool, and bind the spool before this recorder adds its folder to it.
            access, expected = spool.access, operations.expected_log(address, spool)
            log = await EventLog.open(address, create=True, clock=self._clock, file_access=access, belongs_to=expected)
            try:
                declared = [declaration_of(each) for each in await log.declarations()]
                async with log.reading() as connection:
                    await folding.current_generation(connection)
            except TablesForeign:  # recording works without tables; those that cannot be rebuilt are left as they are
                await operations.rebuild_outdated(address, clock=self._clock)
            finally:
                await log.close()
            spool.bind(log.log_id)
        recorder_id = episode_id(self._clock.wall_ns(), os.urandom(10))
        queue = RecorderQueue.create(
            spool.path, settings=self._settings, clock=self._clock, recorder=recorder_id, offered=not by_thread
        )
        self._stack.callback(queue.release)
        writer: WriterThread | DelegatedWriter
        process = None
        if not by_thread:
            if not by_daemon:
                async with operations.open_destination(address, spool, clock=self._clock, settings=self._settings):
                    pass  # makes the tables of a new database, so that it can be queried before the process is ready
                where = operations.WriterAssignment(address, spool.path.absolute(), queue.name, self._settings)
                process = operations.WriterProcess(where)
                process.start()
            writer = DelegatedWriter(queue, self._settings, process)
        else:
            open_ = partial(operations.open_destination, address, spool, clock=self._clock, settings=self._settings)
            writer = WriterThread(
                source=queue,
                open_destination=partial(open_, views=self._views, projections=self._projections),
                adopt=lambda: operations.dead_queues(spool, self._unadopted, settings=self._settings),
                settings=self._settings,
                local=address.is_sqlite,
            )
            await writer.start()
        self._stack.push_async_exit(partial(self._drain, queue, writer))
        emitter = Emitter(queue, self._settings)
        provenance = Provenance.of(self._plan_source, self._settings, self._clock)
        episodes = OpenEpisodes(emitter, self._clock)
        known = KnownTypes(built_in_declaration)
        wait_s = self._settings.flush_timeout_s
        stored = operations.LogEpisodes(address, spool, queue, self._unadopted, timeout_s=wait_s)
        recording = Recording(
            emitter, episodes, known, declared, software=__version__, provenance=provenance, stored_episodes=stored
        )
        parts = Parts(address, queue, writer, recording, self._clock, process, self._replica)
        self._stack.push_async_callback(parts.close_reading)
        return parts

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._parts is None:  # in a forked child the memory belongs to the parent
            return
        self._parts.close(error)
        await self._parts.emitter.feed.close()
        await self._stack.__aexit__(kind, error, traceback)

    async def _drain(
        self,
        queue: RecorderQueue,
        writer: WriterThread | DelegatedWriter,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        """Store and fold all recorded events. An error in doing so is logged, not raised, if the plan failed itself.

        A parked episode is logged and does not make closing fail; `pycrorm status` lists it, and `flush` raises for it.
        Nor do tables that an older version made or another login folds: all events are stored.
        """
        parts, self._parts = self._parts, None
        queue.close()
        try:
            await writer.close()
        except PycrormError as fault:
            unreported = self._unreported(fault)
            if unreported is not None and error is None and not isinstance(unreported, EpisodeParked | TablesPending):
                raise unreported from fault
            if unreported is not None and not isinstance(unreported, TablesPending):  # opening them logged that
                _log.error("when closing the memory: %s", unreported)
        finally:
            if parts is not None:  # else it could not be opened
                status, emitter = MemoryStatus.of(parts, self._unadopted), parts.emitter
                self._last_status = lambda: status._replace(unrecorded=emitter.unrecorded)

    def _forked(self) -> None:
        """Disconnect a forked child: the memory belongs to its parent, and plans of the child are not recorded."""
        if (parts := self._parts) is not None:
            parts.disconnect("this process was forked from the one that opened the memory: open a memory in it")
            self._parts, self._forked_parts = None, parts
            self._last_status = lambda: MemoryStatus.of(parts, self._unadopted)


ReadableMemory = Memory  # its name in 0.1, for one release


# === sync memory ==============================================================================================


def _awaited(
    find: Callable[[], Callable[Concatenate[Memory, _P], Coroutine[Any, Any, T]]],
) -> Callable[Concatenate[SyncMemory, _P], T]:
    """Return the method of a memory that `find` returns as one of `SyncMemory`, which waits for its result."""

    def make() -> Callable[..., T]:
        method = find()

        @wraps(method)
        def awaited(memory: SyncMemory, *arguments: _P.args, **named: _P.kwargs) -> T:
            return memory._await(method(memory._memory, *arguments, **named))  # noqa: SLF001  its own class

        return awaited

    return cast("Callable[Concatenate[SyncMemory, _P], T]", _Method(make))


class SyncMemory:
    """A memory to use with `with`, once; `Memory.sync` makes it. Its methods may be called from any thread."""

    def __init__(self, memory: Memory) -> None:
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

    def flush(self, timeout_s: float | None = None) -> None:
        """Wait until all events recorded so far are visible in the tables. Raises the errors of `Memory.flush`.

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

        def asked(plan: Any) -> SyncQuestion:
            return reading_side.SyncQuestion(reading_side.Question(reading, plan), self._await)

        return reading_side.Ask(asked)

    def recall(self, type: str | type | None = None, **cue: Any) -> Answer:  # noqa: A002  the feature's name
        """Return the past actions most like a cue; see `Recall.__call__`."""
        return self._await(self._memory.recall(type, **cue))

    synced = _awaited(lambda: Memory.synced)
    predict = _awaited(lambda: Memory.predict)
    episodes = _awaited(lambda: Memory.episodes)
    tree = _awaited(lambda: Memory.tree)
    as_of = _awaited(lambda: Memory.as_of)
    diff = _awaited(lambda: Memory.diff)
    query = _awaited(lambda: Memory.query)
    dataframe = _awaited(lambda: Memory.dataframe)
    report = _awaited(lambda: Memory.report)
    picture = _awaited(lambda: Memory.picture)
    plot_success = _awaited(lambda: Memory.plot_success)
    samples = _awaited(lambda: Memory.samples)
    export = _awaited(lambda: Memory.export)
