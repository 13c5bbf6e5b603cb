"""An `EpisodeWriter` writes the events of one open episode.

Theory of operation. The writer does not know the executive: `N` is an executive's own record of a node. `_open_nodes`
holds every node that started and whose end is not written. The call that removes a node writes its end, so no node has
two; if it raises before the end is written, it restores the node, which then ends with the episode. Ctrl-C can
come at any call, also after the event is written: a `Receipt` shows that, and the lines that update the state by it
make no call. `_ending` holds a node while a thread writes its end. The ends of episodes wait, for a limited time, until
it is empty, because the end of a node must precede the end of its episode. The end of a node never waits, because the
garbage collector may cause it.
"""

from __future__ import annotations

import asyncio
import getpass
import html
import logging
import os
import platform
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

from msgspec.structs import replace

from pycrorm_async.clock import SYSTEM_CLOCK, Clock, clock_quality
from pycrorm_async.errors import CallerError, EpisodeFull, FilesError, SpoolFull, SpoolStuck, Unrecordable
from pycrorm_async.events.codec import Heading, NotEncodable, Receipt, encode, encoded_bytes
from pycrorm_async.events.fields import changed_tags, checked_tags
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.events.types import (
    BlobReference,
    EpisodeEnded,
    EpisodeStarted,
    EpisodeStatus,
    EpisodeTagged,
    FailureValue,
    Happening,
    NodeEnded,
    NodeKind,
    NodeReference,
    NodeStarted,
    NodeStatus,
    ObjectDetected,
    ObjectReference,
    Observed,
    RobotValue,
)
from pycrorm_async.plan.failures import is_plan_failure
from pycrorm_async.record.event_feed import EventFeed
from pycrorm_async.record.geometry import Descriptions
from pycrorm_async.record.parameters import (
    EPISODE_TEXT_MAX,
    ROBOT,
    DeclaredType,
    fit_detection,
    fit_episode_end,
    fit_episode_start,
    fit_node_end,
    fit_node_start,
)
from pycrorm_async.record.values import (
    NO_REFERENCES,
    MissingValues,
    ObservedReader,
    clean,
    clean_repr,
    cut,
    failure_value,
    message_of,
    missing_in,
)
from pycrorm_async.settings import Settings
from pycrorm_async.world.bullet import Object

_LAST_ENDS_S = 1.0
"""Bounds the wait of an episode's end for ends of nodes in other threads; each takes microseconds."""
_DESCRIPTION_MAX = 200
"""Bounds the characters of the description in a notebook."""

N = TypeVar("N")


class EpisodeWriter(ABC, Generic[N]):
    """An open or closed episode.

    Attributes:
        emitter: puts the events into the queue and counts faults.
        id: 16 bytes of a UUIDv7; `str(episode)` is its text.
        closed: whether the last event has been written, or its writing has begun.
        simulated: whether the episode is a simulation.
    """

    def __init__(self, emitter: Emitter, episode: EpisodeId, opening: EpisodeOpening) -> None:
        self.id = episode
        self.closed = False
        self.simulated: Final = opening.simulated
        self.emitter = emitter
        self._opening = opening
        self._open_nodes: dict[int, N] = {}
        self._ending: set[N] = set()
        self._is_begun = False
        self._root = 0
        self._root_ended = False
        self._end_interrupted = False

    def __str__(self) -> str:
        return episode_text(self.id)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self}{' closed' if self.closed else ''}>"

    def _repr_html_(self) -> str:
        """Return the view of a notebook; it has no number, because only the database knows that."""
        description = html.escape(" ".join(clean(self._opening.description).split())[:_DESCRIPTION_MAX])
        running = '<span style="color:#2f7fd1;font-weight:bold">▶</span> RUNNING'
        kind = "Simulated episode" if self.simulated else "Episode"
        return (
            f'<div style="font-family:system-ui,sans-serif"><b>{kind} · <bdi>{description}</bdi></b>'
            f" · {'ended' if self.closed else running}"
            f'<div style="opacity:.7">id {self}; to look at it: '
            '<span style="font-family:monospace">await memory.flush(); await memory.tree(episode)</span>, '
            "where episode is this object</div></div>"
        )

    # --- what an executive adds -------------------------------------------------------------------------------

    @abstractmethod
    def reference(self, world_object: Object) -> ObjectReference | None:
        """Return the object's current row in this episode; None without a row."""

    @abstractmethod
    def node_or_root(self, node: Any) -> int:
        """Return the sequence of this node or of its nearest recorded ancestor; None gives the root."""

    @abstractmethod
    def _leave_world(self) -> None:
        """Write no more changes of the world."""

    @abstractmethod
    def _described_world(self) -> str | None:
        """Return the description of the world that was entered inside the episode; None if none was."""

    # --- the episode ------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Write the start of the episode and of its root node."""
        started = episode_started(self._opening)
        started, shortened = fit_episode_start(started, self.emitter.settings.record_bytes_max)
        for name in shortened:
            self.emitter.missing.note("Episode", name, "its text is too long for an episode and was cut")
        begun, root_started = Receipt(), Receipt()
        try:
            self.emitter.put(self.id, started, begun)
            self.emitter.put(self.id, NodeStarted("root", simulated=self.simulated), root_started)
        finally:
            self._is_begun = begun.sequence > 0
            self._root = root_started.sequence

    def change_tags(self, added: Sequence[str], removed: Sequence[str]) -> None:
        """Write a change of the episode's tags. Raises `CallerError` for a removed tag that it does not have."""
        tags = changed_tags(self._opening.labels.tags, added, removed)
        self.emitter.put(self.id, EpisodeTagged(tuple(added), tuple(removed)))
        self._opening = self._opening.with_tags(tags)

    def end_episode(self, failure: BaseException | None) -> None:
        """Write the end of the episode, and of nodes that are still open, because no later end can be recorded.

        They end LOST; if the episode was interrupted, CANCELLED: Ctrl-C may come before a node's end is written.

        After a call that raised before the last event was written, the next call writes what is missing.
        """
        if self.closed and not self._end_interrupted:
            return
        receipt = Receipt()
        self.closed, self._end_interrupted = True, False
        try:
            self._put_last_events(failure, receipt)
        except BaseException:
            self._end_interrupted = not receipt.sequence
            raise

    def _put_last_events(self, failure: BaseException | None, receipt: Receipt) -> None:
        if not self._is_begun:
            return
        self._leave_world()
        status, root_status = self._end_statuses(failure)
        node_status = root_status if status == "INTERRUPTED" else "LOST"
        for sequence in sorted(self._open_nodes, reverse=True):
            self._close_node(NodeEnded(sequence, node_status), "Episode")
        self._wait_for_ends()
        value = failure_value(failure, self) if failure is not None else None
        self._end_root(root_status, value)
        ended = EpisodeEnded(status, value, world=self._described_world())
        try:
            self.emitter.put(self.id, ended, receipt)
        except NotEncodable:
            self.emitter.put(self.id, fit_episode_end(ended, self.emitter.settings.record_bytes_max), receipt)

    def _end_root(self, status: NodeStatus, failure: FailureValue | None) -> None:
        """Write the end of the root; no effect if it is written, or if Ctrl-C came before the root started."""
        if self._root_ended or not self._root:
            return
        receipt = Receipt()
        try:
            self._put_end(NodeEnded(self._root, status, failure), "Episode", receipt)
        finally:
            self._root_ended = receipt.sequence > 0

    def _end_statuses(self, failure: BaseException | None) -> tuple[EpisodeStatus, NodeStatus]:
        """Return the statuses of the episode and of its root node; a plan that exits the program has failed."""
        return ("ERROR", "ERROR") if isinstance(failure, SystemExit) else end_statuses(failure)

    # --- nodes and perception -----------------------------------------------------------------------------------

    def _put_start(
        self, node: N, declared: DeclaredType, kind: NodeKind, parent: int, parameters: dict[str, Any],
        robot: RobotValue | None, *, missing: Mapping[str, str], may_refuse: bool,
    ) -> int:  # fmt: skip
        """Write the start of a node and return its sequence. `missing` has the reason for each missing value.

        Raises `Unrecordable` if `may_refuse` and the settings ask for it.
        """
        owner = declared.dtype
        event = NodeStarted(
            kind=kind,
            parent=parent,
            designator=declared.fingerprint or None,
            parameters=parameters,
            robot=robot,
            simulated=self.simulated,
        )
        if missing:
            self._note_parameters(owner, missing, may_refuse=may_refuse)
        receipt = Receipt()
        try:
            try:
                self.emitter.put(self.id, event, receipt)
            except NotEncodable:
                unfitting: dict[str, str] = {}
                event = fit_node_start(event, self.emitter.settings.record_bytes_max, unfitting)
                self._note_parameters(owner, unfitting, may_refuse=may_refuse)
                self.emitter.put(self.id, event, receipt)
        finally:
            if receipt.sequence:
                self._open_nodes[receipt.sequence] = node
        return receipt.sequence

    def _note_parameters(self, owner: str, missing: Mapping[str, str], *, may_refuse: bool) -> None:
        parameters = [name for name in missing if name != ROBOT]
        if may_refuse and parameters and self.emitter.settings.on_unrecordable == "refuse":
            raise Unrecordable(owner, " and ".join(parameters), missing[parameters[0]])
        for name, reason in missing.items():
            self.emitter.missing.note(owner, name, reason)

    def _close_node(self, event: NodeEnded, owner: str) -> None:
        """Remove the node and write its end; no effect if it was removed, as the garbage collector may do meanwhile."""
        receipt = Receipt()
        try:
            node = self._open_nodes[event.node]
            del self._open_nodes[event.node]  # no call since the line before, so Ctrl-C cannot separate the two
        except KeyError:
            return
        try:
            self._put_end(event, owner, receipt)
        except BaseException:
            if not receipt.sequence:
                self._open_nodes[event.node] = node  # so that it ends with the episode
            raise

    def _wait_for_ends(self) -> None:
        """Wait until other threads have written the ends of nodes that they are ending, for a limited time."""
        deadline = time.monotonic() + _LAST_ENDS_S
        while self._ending and time.monotonic() < deadline:
            time.sleep(0.001)

    def _put_end(self, event: NodeEnded, owner: str, receipt: Receipt) -> None:
        if event.failure is not None or event.result is not None:
            for field, value in (("failure", event.failure and event.failure.arguments), ("result", event.result)):
                for each in missing_in(value):
                    self.emitter.missing.note(owner, field, each.missing)
        try:
            self.emitter.put(self.id, event, receipt)
        except NotEncodable as error:
            self.emitter.missing.note(owner, "failure" if event.failure is not None else "result", error.reason)
            self.emitter.put(self.id, fit_node_end(event, self.emitter.settings.record_bytes_max), receipt)

    def _put_detection(self, detected: ObjectDetected) -> int:
        try:
            return self.emitter.put(self.id, detected)
        except NotEncodable as error:
            self.emitter.missing.note("ObjectDetected", "seen", error.reason)
            return self.emitter.put(self.id, fit_detection(detected, self.emitter.settings.record_bytes_max))


# === emitter ==================================================================================================
#
# The `Emitter` puts events into the queue and counts faults of the hooks, so that they do not reach a plan.

_log = logging.getLogger("pycrorm_async")
_BLOCK_S = 1.0
"""Bounds one wait for room. `put_payload` then tries again, so the value limits only the delay of a missed wake-up."""
THREAD_NAME_PREFIX = "pycrorm "
"""The names of all threads of the memory begin with this."""
_REASON_MAX = 2_000
"""Bounds the characters of the last fault's message in `status`."""
_HEADINGS_MAX = 1_000
"""Bounds the headings kept for reuse: an episode has one for each event type. When it is reached all are dropped."""
UNAWAITED_MAX = 100
"""Bounds the designator types listed with a perform that was never awaited; the latest are kept."""


class BlobRefused(ValueError):
    """The queue does not take a blob; the message is the reason."""


class Faults(NamedTuple):
    """The number of events the hooks failed to record, and the last reason; `status` shows both."""

    total: int
    last: str | None


class Emitter:
    """Puts the events of one memory into its queue.

    Only the start of a node or an episode waits for room, before it is written (`must_wait`). All other events,
    including the start of a simulation, must not wait, so `put` may use the spool's reserve. If the reserve is used up
    as well, `put` blocks the calling thread until a record was stored. It drops no event.

    Attributes:
        is_closed: whether the memory is closed, or belongs to the process that forked this one; hooks then only count.
        unrecorded: the number of nodes, episodes and other reports that came after it was closed.
        feed: the observers of this memory, to which recorded events are published.
        missing: counts the values that could not be recorded.
        descriptions: declares the descriptions of objects.
        unawaited: for each designator type whose perform was called and never awaited, a sentence for the user.
    """

    def __init__(self, sink: EventSink, settings: Settings) -> None:
        self.sink = sink
        self.settings = settings
        self.is_closed = False
        self.unrecorded = 0
        self.feed = EventFeed()
        self.missing = MissingValues()
        self.descriptions = Descriptions(self, settings, self.missing)
        self.unawaited: tuple[str, ...] = ()
        self._headings: dict[tuple[EpisodeId, type[Happening]], Heading] = {}
        self._fault_count = 0
        self._last_fault: str | None = None

    @property
    def faults(self) -> Faults:
        return Faults(self._fault_count, self._last_fault)

    def put(self, episode: EpisodeId, event: Happening, receipt: Receipt | None = None) -> int:
        """Append an event and return its sequence. Raises `NotEncodable` before anything is written.

        The sequence of the receipt shows after any exception whether the event was written.
        """
        payload = encode(event, bytes_max=self.settings.record_bytes_max)
        heading = self._heading(episode, type(event))
        try:
            sequence = self.sink.put_nowait(heading, payload, reserved=True, receipt=receipt)
        except SpoolFull:
            sequence = self.put_payload(heading, payload, receipt)
        if self.feed.observers:
            self.feed.publish(episode, sequence, event)
        return sequence

    def put_payload(self, heading: Heading, payload: bytes, receipt: Receipt | None = None) -> int:
        """Append an encoded event and return its sequence."""
        while True:
            try:
                return self.sink.put_nowait(heading, payload, reserved=True, receipt=receipt)
            except SpoolFull:
                # The garbage collector may close a dropped plan in a thread of the memory. Such a thread must not
                # block here, because these threads are the ones that free space.
                if threading.current_thread().name.startswith(THREAD_NAME_PREFIX):
                    raise
                self.sink.block_until_room(_BLOCK_S)

    def must_wait(self) -> bool:
        """Return if a node has to wait for room before it starts. Raises `SpoolFull` with `on_full="fail"`."""
        if not self.sink.full:
            return False
        if self.settings.on_full == "fail":
            raise SpoolFull("the spool is full (spool_bytes_max) and on_full is 'fail': start a writer to drain it")
        return True

    def put_declaration(self, declared: DeclaredType) -> None:
        """Append the declaration of a designator type."""
        kind = type(declared.declaration)
        self.put_payload(Heading(None, kind.__name__, kind.version), declared.payload)
        self.feed.note_type(declared.fingerprint, declared.declaration)

    def offer(self, episode: EpisodeId, event: Happening) -> int:
        """Append an event without using the reserve and without waiting; raise `SpoolFull` if there is no room."""
        payload = encode(event, bytes_max=self.settings.record_bytes_max)
        sequence = self.sink.put_nowait(self._heading(episode, type(event)), payload)
        if self.feed.observers:
            self.feed.publish(episode, sequence, event)
        return sequence

    def put_blob(self, content: bytes, media_type: str) -> BlobReference:
        """Write a blob; return the reference for events put afterwards. Never waits.

        The blob is kept beside the queue as long as these events, until `release_blob`, and for the life of the queue
        without it, as a declaration needs. Raises `BlobRefused` with the reason for a blob that is too large or finds
        no space; the caller records it as missing.
        """
        limit = self.settings.blob_bytes_max
        if len(content) > limit:
            raise BlobRefused(f"the blob takes {len(content):,} bytes, {limit:,} are allowed (blob_bytes_max)")
        try:
            return BlobReference(self.sink.put_blob(content), media_type, len(content))
        except FilesError as error:
            raise BlobRefused(str(error)) from error

    def release_blob(self, reference: BlobReference) -> None:
        """State that no event put from now on refers to this blob because of one of its puts."""
        self.sink.release_blob(reference.hash)

    def _heading(self, episode: EpisodeId, kind: type[Happening]) -> Heading:
        """Return the heading of an event; kept for the next one, because making it takes three times as long."""
        key = (episode, kind)
        heading = self._headings.get(key)
        if heading is None:
            if len(self._headings) >= _HEADINGS_MAX:
                self._headings.clear()
            heading = self._headings[key] = Heading(episode, kind.__name__, kind.version)
        return heading

    def close(self, because: str = "the memory is closed") -> None:
        """Record nothing from now on; further reports are counted."""
        self._closed_because, self.is_closed = because, True

    def note_unrecorded(self, what: str) -> None:
        """Count a report that came after `close`, and log a warning for the first."""
        self.unrecorded += 1
        if self.unrecorded == 1:
            why = f"{self._closed_because} (all further ones are only counted, in `status.unrecorded`)"
            _log.warning("%s leaves no record, because %s", cut(clean(what), _REASON_MAX), why)

    def note_unawaited(self, dtype: str) -> None:
        """Count a perform that was called and never awaited as a fault, and log a warning for the first of a type."""
        text = f"{dtype}.perform() was called and never awaited, so it did not run: write `await`"
        self._fault_count += 1
        self._last_fault = text
        if text not in self.unawaited:
            self.unawaited = (*self.unawaited[1 - UNAWAITED_MAX :], text)
            _log.warning("%s", text)

    def note_fault(self, where: str, error: BaseException) -> None:
        """Count an exception of the hooks, and log it when the count is a power of two, so that the log stays short."""
        self._fault_count += 1
        self._last_fault = f"{where}: {type(error).__name__}: {cut(clean(message_of(error)), _REASON_MAX)}"
        if self._fault_count & (self._fault_count - 1) == 0:
            _log.error("a fault of recording (%d so far): %s", self._fault_count, self._last_fault)
            _log.debug("traceback of the fault of recording", exc_info=error)


# === event sink ===============================================================================================
#
# `EventSink` is the port of `recording` that a queue implements: put an event from any thread, without awaiting.


class EventSink(Protocol):
    """The producing end of a queue."""

    def put_nowait(
        self, heading: Heading, payload: bytes, *, reserved: bool = False, receipt: Receipt | None = None
    ) -> int:
        """Append one event and return its sequence in its episode (0 for a recorder-level record).

        Writing the event sets the sequence of the receipt as well, even if Ctrl-C interrupts the call afterwards.

        Any thread may call it. Once it returns, the event survives the death of the process. Raises `SpoolFull` if
        there is no room; with `reserved`, only if the reserve for ends and world observations is used up as well.
        Raises `SpoolClosed` after closing or in a forked child. A refused event leaves no gap in the sequence.
        """
        ...

    def put_blob(self, content: bytes) -> str:
        """Write a blob and return its name, the SHA-256 of the content, for events put afterwards to refer to.

        Any thread may call it. Raises `SpoolFull` without waiting if there is no room, and other errors of the spool.
        """
        ...

    def release_blob(self, name: str) -> None:
        """State that no event put from now on refers to this blob because of one of its puts."""
        ...

    @property
    def full(self) -> bool:
        """True if the queue would refuse an event without `reserved` now."""
        ...

    def room(self) -> Awaitable[None]:
        """Wait until an event without `reserved` fits again."""
        ...

    def block_until_room(self, timeout_s: float, *, reserved: bool = True) -> bool:
        """Block the calling thread until an event fits; return False after `timeout_s` seconds.

        Logs a warning if it waits for more than two seconds. Raises `SpoolStuck` when waiting cannot help.
        """
        ...


# === episode arguments ========================================================================================
#
# Check the arguments with which a program opens an episode.

_METADATA_BYTES_MAX: Final = 64 * 2**10
"""Bounds the metadata of an episode, which is one column: a page of settings, not data."""


class Labels(NamedTuple):
    """The tags of an episode, and its metadata as JSON values."""

    tags: tuple[str, ...] = ()
    metadata: Mapping[str, Any] = {}


NO_LABELS: Final = Labels()


def check_arguments(*, description: object, plan: object, seed: object, strict: bool) -> None:
    """Check that an episode's arguments fit its columns. Raises `CallerError` naming the argument.

    In strict mode a text that is too long is refused; otherwise it is cut later.
    """
    for name, text in (("plan", plan), ("description", description)):
        if text is not None and not (isinstance(text, str) and (len(text) <= EPISODE_TEXT_MAX or not strict)):
            raise CallerError(f"the {name} of an episode must be a str of at most {EPISODE_TEXT_MAX:,} characters")
    if seed is not None and not (isinstance(seed, int) and -(2**63) <= seed < 2**63):
        raise CallerError(f"the seed of an episode must be an int of at most 64 bits, not {seed!r:.100}")


def read_labels(tags: Iterable[str], metadata: object, emitter: Emitter) -> Labels:
    """Check tags and copy metadata. A value that cannot be recorded is null, and counted as missing.

    Raises `CallerError` if the tags are not a list of short texts, and for metadata without text keys.
    """
    checked = checked_tags(tags)
    if not isinstance(metadata, Mapping) or not all(isinstance(key, str) for key in metadata):
        raise CallerError(f"the metadata of an episode must be a dict with text keys, not {metadata!r:.100}")
    reader = ObservedReader(NO_REFERENCES, _refuse_blob)
    values = reader.read(dict(metadata)) or {}
    for path, reason in reader.missing.items():
        emitter.missing.note("Episode.metadata", path or "metadata", reason)
    try:
        size = encoded_bytes(values)
    except NotEncodable:
        size = _METADATA_BYTES_MAX + 1
    if size > min(_METADATA_BYTES_MAX, emitter.settings.record_bytes_max // 4):
        emitter.missing.note("Episode", "metadata", f"it takes {size:,} bytes, {_METADATA_BYTES_MAX:,} are allowed")
        values = {}
    return Labels(checked, values)


def _refuse_blob(_content: bytes, _media_type: str) -> Any:
    raise BlobRefused("metadata holds no blobs and no large arrays: record them with `memory.observe`")


# === provenance ===============================================================================================
#
# Describe the origin of an episode: the plan's source, the libraries, the settings and the clock's quality.
#
# Reading the plan's source is left to the program that starts the plan (`pycrorm run`); a plan's process never does it
# on its own.

_LIBRARIES = (
    *"pycrorm-async pycram-robotics pybullet pycram-bullet pybullet-arm64 optik-py pyjpt".split(),
    *"numpy msgspec SQLAlchemy aiosqlite asyncpg".split(),
)
"""The packages whose versions are recorded: those that act in the world, learn, encode events and store them."""


class PlanSource(NamedTuple):
    """The source of a plan.

    Attributes:
        sha256: SHA-256 of the plan's file, hexadecimal.
        git_commit: the commit that is checked out where the file is; None outside a repository and without git.
        git_dirty: whether a tracked file differs from that commit, or the plan's file is not tracked.
    """

    sha256: str
    git_commit: str | None = None
    git_dirty: bool | None = None


class Provenance(NamedTuple):
    """The program, settings and clock with which the episodes of one memory are recorded.

    Attributes:
        source: the plan's source, if the program that started it has read it.
        libraries: version by package.
        settings: the settings that differ from their defaults, by name.
        clock: the clock that gives the times of events; only the system's has a known quality.
    """

    source: PlanSource | None
    libraries: dict[str, str]
    settings: dict[str, Any]
    clock: Clock

    @classmethod
    def of(cls, source: PlanSource | None, settings: Settings, clock: Clock) -> Provenance:
        """Read the versions of the installed libraries; takes 3 ms the first time."""
        versions = {name: installed for name in _LIBRARIES if (installed := _version(name)) is not None}
        return cls(source, versions, settings.changed(), clock)

    def fields(self) -> dict[str, Any]:
        """Return the fields of `EpisodeStarted`, with the clock's quality at this moment."""
        quality = clock_quality() if self.clock is SYSTEM_CLOCK else None
        return {
            "plan_sha256": self.source.sha256 if self.source else None,
            "git_commit": self.source.git_commit if self.source else None,
            "git_dirty": self.source.git_dirty if self.source else None,
            "libraries": self.libraries,
            "settings": self.settings,
            "clock_synchronized": quality.synchronized if quality else None,
            "clock_error_us": quality.error_us if quality else None,
        }


@cache
def _version(package: str) -> str | None:
    """Return the version of an installed package; None for a source tree that is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


# === episode opening ==========================================================================================
#
# Build the first event of an episode, and the statuses that an episode and its root end with.

Failures: TypeAlias = tuple[type[BaseException], ...]
"""The classes of an executive's own plan failures."""


class EpisodeOpening(NamedTuple):
    """The arguments an episode is opened with."""

    description: str
    software: str
    plan: str | None = None
    seed: int | None = None
    world: str | None = None
    simulated: bool = False
    thought_by: NodeReference | None = None
    provenance: Provenance | None = None
    labels: Labels = NO_LABELS

    def with_tags(self, tags: tuple[str, ...]) -> EpisodeOpening:
        """Return the arguments with these tags instead."""
        return self._replace(labels=self.labels._replace(tags=tags))


def episode_started(opening: EpisodeOpening) -> EpisodeStarted:
    """Build the first event of an episode."""
    return EpisodeStarted(
        description=clean(opening.description),
        created_by=clean(_user()),
        host=clean(platform.node()),
        software=opening.software,
        python=platform.python_version(),
        plan=clean(opening.plan) if opening.plan is not None else None,
        seed=opening.seed,
        world=clean(opening.world) if opening.world is not None else None,
        simulated=opening.simulated,
        thought_by=opening.thought_by,
        tags=opening.labels.tags,
        metadata=dict(opening.labels.metadata),
        **(opening.provenance.fields() if opening.provenance is not None else {}),
    )


def end_statuses(failure: BaseException | None, failures: Failures = ()) -> tuple[EpisodeStatus, NodeStatus]:
    """Return the statuses of an episode, and of a node, that this exception left."""
    if failure is None:
        return "SUCCEEDED", "SUCCEEDED"
    if is_plan_failure(failure) or isinstance(failure, failures):
        return "FAILED", "FAILED"
    if isinstance(failure, asyncio.CancelledError | KeyboardInterrupt | SystemExit):
        return "INTERRUPTED", "CANCELLED"
    return "ERROR", "ERROR"


def current_task() -> asyncio.Task[Any] | None:
    """Return the running asyncio task; None outside an event loop."""
    try:
        return asyncio.current_task()
    except RuntimeError:
        return None


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no entry for this uid, as in many containers
        return "unknown"


# === observing ================================================================================================
#
# Write the observations that a program makes itself, for an episode of any executive.
#
# An observation never waits: where the spool has no room beside its reserve, it is counted as missing, as the samples
# of the robot's state are left out.

_NAME_MAX = 1_000
"""Bounds the characters of a name, far above real names."""
_PATH_BYTES_MAX = 8_192
"""Bounds the bytes of paths and reasons in an event whose values did not fit."""


def put_observation(
    emitter: Emitter, episode: EpisodeWriter[Any], name: object, values: object, node: int, *, may_refuse: bool
) -> int:
    """Write values under this name, observed by the node with this sequence; return the sequence of the event.

    Returns 0 if the spool or the episode has no room; the observation is counted as missing then. Raises `Unrecordable`
    only if `may_refuse` and with `on_unrecordable="refuse"`.
    """
    name = name_of(name)
    reader = ObservedReader(episode, emitter.put_blob)
    event = Observed(name, reader.read(values), node, reader.missing)
    try:
        if reader.missing:
            _note_missing(emitter, name, reader.missing, may_refuse=may_refuse)
        return _put(emitter, episode, event, may_refuse=may_refuse)
    except (EpisodeFull, SpoolFull, SpoolStuck) as refusal:
        emitter.missing.note("observation", name, str(refusal))
        return 0
    finally:
        for reference in reader.blobs:
            emitter.release_blob(reference)


def _put(emitter: Emitter, episode: EpisodeWriter[Any], event: Observed, *, may_refuse: bool) -> int:
    try:
        return emitter.offer(episode.id, event)
    except NotEncodable as error:
        fitted = _fit(event, error, emitter.settings.record_bytes_max)
        new = {path: why for path, why in fitted.missing.items() if path not in event.missing}
        _note_missing(emitter, event.name, new, may_refuse=may_refuse)
        return emitter.offer(episode.id, fitted)


def _note_missing(emitter: Emitter, name: str, missing: dict[str, str], *, may_refuse: bool) -> None:
    if may_refuse and emitter.settings.on_unrecordable == "refuse":
        path, reason = next(iter(missing.items()))
        raise Unrecordable(f"observation {name!r}", path or "values", reason)
    for path, reason in missing.items():
        emitter.missing.note(f"observation {name}", path or "values", reason)


def name_of(name: object) -> str:
    """Return the text under which an observation of this name is recorded."""
    return cut(clean(name if isinstance(name, str) else clean_repr(name)), _NAME_MAX)


def _fit(event: Observed, error: NotEncodable, bytes_max: int) -> Observed:
    """Replace the largest values of a dict by null until the event fits; without a dict, the whole value."""
    values = event.values
    if not isinstance(values, dict) or len(event.missing) > len(values):
        return replace(event, values=None, missing={"": error.reason})
    sizes = {key: len(key) + encoded_bytes(each) for key, each in values.items()}
    room = bytes_max - _PATH_BYTES_MAX - len(event.name) * 6
    left, missing = dict(values), dict(event.missing)
    for key in sorted(sizes, key=sizes.__getitem__, reverse=True):
        if sum(sizes.values()) <= room:
            break
        reason = f"it takes {sizes.pop(key):,} bytes; {error.reason}"
        left[key], missing[key] = None, reason
    if encoded_bytes(left) + encoded_bytes(missing) > room:
        return replace(event, values=None, missing={"": error.reason})
    return replace(event, values=left, missing=missing)


# === open episodes ============================================================================================
#
# `OpenEpisodes` holds the open episodes of one memory, whichever executive writes them.

RECENT_MAX = 100
"""Bounds the ids in `recent`, because a process may open any number of episodes."""

AnyWriter = EpisodeWriter[Any]
"""The writer of an episode, whatever it identifies nodes by."""


class OpenEpisodes:
    """The open episodes of one memory, and the ids of those opened last.

    Attributes:
        by_id: the open episodes.
        opened_count: the number of episodes opened, without simulations.
    """

    def __init__(self, emitter: Emitter, clock: Clock, randomness: Callable[[int], bytes] = os.urandom) -> None:
        self._emitter = emitter
        self._clock = clock
        self._randomness = randomness
        self.by_id: dict[EpisodeId, AnyWriter] = {}
        self._recent: deque[EpisodeId] = deque(maxlen=RECENT_MAX)
        self._is_closing = False
        self._adding = threading.RLock()
        self.opened_count = 0

    def new_id(self) -> EpisodeId:
        """Make the id of a new episode."""
        return episode_id(self._clock.wall_ns(), self._randomness(10))

    def add(self, episode: AnyWriter) -> None:
        """Add an episode. Raises `CallerError` after `refuse_new`."""
        with self._adding:
            if self._is_closing:
                raise CallerError("the memory is being closed")
            self.by_id[episode.id] = episode
        if not episode.simulated:
            self._recent.append(episode.id)
            self.opened_count += 1

    def refuse_new(self) -> None:
        """Add no episode from now on, because the memory is being closed."""
        with self._adding:
            self._is_closing = True

    @property
    def all(self) -> tuple[AnyWriter, ...]:
        """The open episodes, oldest first."""
        return tuple(self.by_id.copy().values())

    @property
    def recent(self) -> tuple[str, ...]:
        """The ids of the last 100 episodes opened, including ended ones, without simulations."""
        return tuple(map(episode_text, self._recent.copy()))

    def last_opened(self) -> AnyWriter | None:
        """Return the open episode that was opened last in any context, without simulations; None without one."""
        return next((each for each in reversed(self.all) if not each.simulated and not each.closed), None)

    def close(self, episode: AnyWriter, failure: BaseException | None) -> None:
        """Write the end of an episode; `failure` is the exception that ended it, or None. Exceptions are counted."""
        if self._emitter.is_closed:
            return
        try:
            episode.end_episode(failure)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not replace the plan's outcome
            self._emitter.note_fault("EpisodeEnded", error)
        self.by_id.pop(episode.id, None)  # last, so that the memory ends an episode whose end Ctrl-C interrupted
