"""An `EpisodeWriter` writes the events of one open episode.

Theory of operation. The writer does not know the executive: it names nodes by the sequences of their starts, and
objects by whatever the executive uses. `NodeEvents._open` holds every node that started and whose end is not written,
with the name of its type. The call that removes a node writes its end, so no node has two. Ctrl-C can come at any call:
a node whose start or end it interrupted may have no end, and ends with its episode. `NodeEvents._ending` holds a node
while a thread writes its end. The ends of episodes wait, for a limited time, until it is empty, because the end of a
node must precede the end of its episode. The end of a node never waits, because the garbage collector may cause it.
"""

from __future__ import annotations

import html
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, cast

import msgspec
from msgspec.structs import replace

from pycrorm_async.clock import Clock
from pycrorm_async.errors import CallerError, EpisodeFull, FilesError, SpoolFull, SpoolStuck, Unrecordable
from pycrorm_async.events import types as event_types
from pycrorm_async.events.codec import Heading, NotEncodable, encode, encoded_bytes, short_name
from pycrorm_async.events.fields import changed_tags
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.events.reasons import UNNAMED
from pycrorm_async.record import values as live_values
from pycrorm_async.record.declarations import Declared, DeclaredType
from pycrorm_async.record.event_feed import EventFeed
from pycrorm_async.record.opening import EPISODE_TEXT_MAX, EpisodeOpening, end_statuses, episode_started
from pycrorm_async.record.recorded_before import RecordedBefore
from pycrorm_async.recorded_names import class_name

if TYPE_CHECKING:
    from pycrorm_async.record.geometry import Descriptions
from pycrorm_async.settings import Settings

_LAST_ENDS_S = 1.0
"""Bounds the wait of an episode's end for ends of nodes in other threads; each takes microseconds."""
_DESCRIPTION_MAX = 200
"""Bounds the characters of the description in a notebook."""


class ActingRobot(NamedTuple):
    """The robot that acts at the start of a node.

    Attributes:
        state: with its pose, for observers.
        written: the state for the log, encoded once for all nodes until it changes; without the pose if the current row
            of the robot's object has it.
    """

    state: event_types.RobotValue
    written: msgspec.Raw | event_types.RobotValue


class EpisodeWriter:
    """An open or closed episode, of an executive that reports from one thread at a time.

    Attributes:
        emitter: has the queue, and counts faults.
        id: 16 bytes of a UUID; `str(episode)` is its text.
        events: writes its events.
        nodes: writes the starts and ends of its nodes.
        closed: whether the last event has been written, or its writing has begun.
        simulated: whether the episode is a simulation.
        failures: copies the exceptions with which its nodes end.
    """

    def __init__(self, emitter: Emitter, episode: EpisodeId, opening: EpisodeOpening) -> None:
        self.id = episode
        self.closed = False
        self.simulated: Final = opening.simulated
        self.emitter = emitter
        self.events: Final = EpisodeEvents(emitter, episode)
        self.nodes: Final = NodeEvents(self.events, simulated=opening.simulated)
        self.failures: Final = live_values.FailureCopies()
        self._opening = opening
        self._is_begun = False
        self._is_ended = False

    def __str__(self) -> str:
        return episode_text(self.id)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self}{' closed' if self.closed else ''}>"

    def _repr_html_(self) -> str:
        """Return the view of a notebook; it has no number, because only the database knows that."""
        description = html.escape(" ".join(live_values.clean(self._opening.description).split())[:_DESCRIPTION_MAX])
        running = '<span style="color:#2f7fd1;font-weight:bold">▶</span> RUNNING'
        kind = "Simulated episode" if self.simulated else "Episode"
        return (
            f'<div style="font-family:system-ui,sans-serif"><b>{kind} · <bdi>{description}</bdi></b>'
            f" · {'ended' if self.closed else running}"
            f'<div style="opacity:.7">id {self}; to look at it: '
            '<span style="font-family:monospace">await memory.flush(); await memory.tree(episode)</span>, '
            "where episode is this object</div></div>"
        )

    def reference(self, _key: Any, /) -> event_types.ObjectReference | None:
        """Return an object's current row; None, because an episode without a world has no objects."""
        return None

    def node_or_root(self, _node: Any, /) -> int:
        """Return the sequence of this node or of its nearest recorded ancestor; else that of the root."""
        return self.nodes.root

    def open(self) -> None:
        """Write the start of the episode and of its root node."""
        self._is_begun = True  # also if Ctrl-C comes before the next line returns
        try:
            self.events.put(_started(self._opening, self.emitter), "Episode")
        except Exception:
            self._is_begun = False
            raise
        self.nodes.start_root()

    def change_tags(self, added: Sequence[str], removed: Sequence[str]) -> None:
        """Write a change of the episode's tags. Raises `CallerError` for a removed tag that it does not have."""
        tags = changed_tags(self._opening.tags, added, removed)
        self.events.put(event_types.EpisodeTagged(tuple(added), tuple(removed)))
        self._opening = self._opening._replace(tags=tags)

    def end_episode(self, failure: BaseException | None, world: str | None = None) -> None:
        """Write the end of the episode, and of nodes that are still open, because no later end can be recorded.

        They end LOST; if the episode was interrupted, CANCELLED: Ctrl-C may come before a node's end is written; and if
        its own status is not known, UNKNOWN.

        After a call that Ctrl-C interrupted, the next call writes what is missing.
        """
        if self._is_ended or not self._is_begun:
            self.closed = True
            return
        self.closed = True
        status, root_status = self._end_statuses(failure)
        value = self.failures.copy(failure, self) if failure is not None else None
        is_same = status in ("INTERRUPTED", "UNKNOWN")
        self.nodes.end_all(root_status if is_same else "LOST", untimed=status == "UNKNOWN")
        self.nodes.end(self.nodes.root, root_status, value)
        self.events.put(event_types.EpisodeEnded(status, value, world=world), "Episode")
        self._is_ended = True

    def _end_statuses(self, failure: BaseException | None) -> tuple[event_types.EpisodeStatus, event_types.NodeStatus]:
        """Return the statuses of the episode and of its root node; a plan that exits the program has failed."""
        return ("ERROR", "ERROR") if isinstance(failure, SystemExit) else end_statuses(failure)


def _started(opening: EpisodeOpening, emitter: Emitter) -> event_types.Happening:
    """Return the first event of an episode, with texts that its columns can show."""
    started: event_types.Happening = episode_started(opening)
    reasons: dict[str, str] = {}
    if not fits(started, emitter.record_bytes_max):
        started, reasons = fitted(started, emitter.record_bytes_max)
    for name in ("description", "plan", "world"):
        text = getattr(started, name)
        if text is not None and len(text) > EPISODE_TEXT_MAX:
            started = replace(started, **{name: live_values.cut(text, EPISODE_TEXT_MAX)})
            reasons[name] = "its text is too long for an episode and was cut"
    emitter.note_missing("Episode", reasons)
    return started


# === events of an episode =====================================================================================
#
# `EpisodeEvents` encodes the events of one episode and puts them into the queue; `NodeEvents` sees to it that each node
# ends once.


class EpisodeEvents:
    """Writes the events of one episode.

    Attributes:
        time: the wall time and the monotonic time of the next events, ns; None for those of the clock.
    """

    def __init__(self, emitter: Emitter, episode: EpisodeId) -> None:
        self.emitter = emitter
        self.time: tuple[int, int] | None = None
        self._episode = episode
        self._headings: dict[type[event_types.Happening], Heading] = {}
        self._recorded: RecordedBefore | None = None
        self._refused: Callable[[Exception], None] = lambda _error: None
        self._stored = 0

    def put(
        self,
        event: event_types.Happening,
        owner: str = "",
        *,
        may_refuse: bool = False,
        reserved: bool = True,
        shown: Mapping[str, Any] = {},
    ) -> int:
        """Append an event and return its sequence. Parts that cannot be recorded are left out, and counted.

        Args:
            owner: the type whose values are counted as missing; by default that of the event.
            may_refuse: raise `Unrecordable` for a missing parameter, if the settings ask for it.
            reserved: use the spool's reserve, and block when that is used up; otherwise raise `SpoolFull`.
            shown: for observers, the whole of fields that name what another event has.
        """
        emitter, kind, given = self.emitter, type(event), event
        try:
            payload = encode(event, bytes_max=emitter.record_bytes_max)
        except NotEncodable:
            event, reasons = fitted(event, emitter.record_bytes_max)
            emitter.note_missing(owner or kind.__name__, reasons, may_refuse=may_refuse)
            payload = encode(event, bytes_max=emitter.record_bytes_max)
            if isinstance(given, event_types.NodeStarted) and isinstance(event, event_types.NodeStarted):
                given.parameters.update(event.parameters)  # so that the caller sees what was left out
        heading = self._headings.get(kind)
        if heading is None:
            heading = self._headings[kind] = Heading(self._episode, kind.__name__, kind.version)
        if self._recorded is not None and (sequence := self._stored_before(self._recorded, heading, payload)):
            return sequence
        try:
            sequence = emitter.sink.put_nowait(heading, payload, reserved=reserved, at=self.time, after=self._stored)
        except SpoolFull:
            if not reserved:
                raise
            sequence = emitter.put_payload(heading, payload, at=self.time, after=self._stored)
        self._stored = 0  # the queue has the episode's sequence from now on
        if emitter.feed.observers:
            whole = {name: each for name, each in shown.items() if getattr(event, name) is getattr(given, name)}
            emitter.feed.publish(self._episode, sequence, replace(event, **whole) if whole else event)
        return sequence

    def continue_behind(self, recorded: RecordedBefore, refused: Callable[[Exception], None]) -> None:
        """Write only events behind the stored ones, with which the first events are compared instead.

        If one differs, `refused` is called with the error, which `put` then raises: nothing more may be put.
        """
        self._recorded, self._refused = recorded, refused

    def _stored_before(self, recorded: RecordedBefore, heading: Heading, payload: bytes) -> int:
        """Return the sequence that this event has in the log; 0 behind the last stored one, where writing continues."""
        try:
            sequence = recorded.sequence_of(heading, payload)
        except Exception as error:
            self._refused(error)
            raise
        if sequence == 0:
            self._stored, self._recorded = recorded.head, None
        return sequence


class NodeEvents:
    """Writes the starts and ends of one episode's nodes.

    Attributes:
        root: the sequence of the root's start; 0 before it.
    """

    def __init__(self, events: EpisodeEvents, *, simulated: bool) -> None:
        self.root = 0
        self._put, self._emitter = events.put, events.emitter
        self._simulated = simulated
        self._open: dict[int, str] = {}
        self._ending: set[int] = set()
        self._failed: tuple[bytes, event_types.EndReference] | None = None
        """The content of the failure that was written last, and the end that has it."""

    def start_root(self) -> None:
        """Write the start of the root."""
        self.root = self._put(event_types.NodeStarted("root", simulated=self._simulated))
        self._open[self.root] = "Episode"

    def start(
        self,
        declared: DeclaredType,
        kind: event_types.NodeKind,
        parent: int,
        parameters: dict[str, Any],
        robot: ActingRobot | None,
        missing: Mapping[str, str],
        *,
        whole: dict[str, Any] | None = None,
        may_refuse: bool = False,
    ) -> int:
        """Write the start of a node and return its sequence. `missing` has the reason for each missing value.

        `whole` are the parameters for observers, with the poses that `parameters` names in nodes around. Raises
        `Unrecordable` if `may_refuse` and the settings ask for it.
        """
        owner, emitter = declared.dtype, self._emitter
        if missing:
            emitter.note_missing(owner, missing, may_refuse=may_refuse)
        written = cast("event_types.RobotValue", robot.written) if robot is not None else None
        kind = "action" if kind == "action" else kind  # the encoder omits only the object that is the default
        event = event_types.NodeStarted(
            kind, parent, short_name(declared.fingerprint) or None, parameters, written, self._simulated
        )
        shown: dict[str, Any] = {}
        if emitter.feed.observers:
            shown = {} if robot is None else {"robot": robot.state}
            if whole is not None:
                shown["parameters"] = whole
        sequence = self._put(event, owner, may_refuse=may_refuse, shown=shown)
        self._open[sequence] = owner
        return sequence

    def end(
        self,
        node: int,
        status: event_types.NodeStatus,
        failure: event_types.FailureValue | None = None,
        result: Any = None,
        *,
        untimed: bool = False,
    ) -> None:
        """Write the end of a node; no effect if it has ended, as the garbage collector may cause meanwhile."""
        status = "SUCCEEDED" if status == "SUCCEEDED" else status  # as the kind of a start
        self._ending.add(node)  # before the removal, so that no thread that misses the node ends the episode
        try:
            owner = self._open.pop(node, None)
            if owner is not None:
                if failure is not None or result is not None:
                    parts = {"failure": failure.arguments if failure is not None else None, "result": result}
                    for name, value in parts.items():
                        for each in live_values.missing_in(value):
                            self._emitter.missing.note(owner, name, each.missing)
                if failure is None:
                    self._put(event_types.NodeEnded(node, status, None, result, untimed), owner)
                else:
                    self._put_failed(event_types.NodeEnded(node, status, failure, result, untimed), failure, owner)
        finally:
            self._ending.discard(node)

    def _put_failed(self, ended: event_types.NodeEnded, failure: event_types.FailureValue, owner: str) -> None:
        """Put the end of a node that failed. The failure names the latest end that has one, if it is the same."""
        content: bytes | None = None
        with suppress(NotEncodable):  # `put` may cut it then; one that fills less than half of a record stays whole
            content = encode(event_types.NodeEnded(0, "FAILED", failure), bytes_max=self._emitter.record_bytes_max // 2)
        written = self._failed  # read once, because the garbage collector ends nodes in any thread
        if content is not None and written is not None and written[0] == content and failure.type != UNNAMED:
            brief = event_types.FailureValue(failure.type, "", of=written[1])
            self._put(replace(ended, failure=brief), owner, shown={"failure": failure})
            return
        end = event_types.EndReference(ended.node, self._put(ended, owner))
        self._failed = (content, end) if content is not None else None

    def end_all(self, status: event_types.NodeStatus, *, untimed: bool) -> None:
        """Write the ends of all open nodes but the root, the last one first; wait for ends in other threads."""
        for node in sorted(self._open.keys() - {self.root}, reverse=True):
            self.end(node, status, untimed=untimed)
        deadline = time.monotonic() + _LAST_ENDS_S
        while self._ending and time.monotonic() < deadline:
            time.sleep(0.001)


# === emitter ==================================================================================================
#
# The `Emitter` holds the queue and counts faults of the hooks, so that they do not reach a plan.

_log = logging.getLogger("pycrorm_async")
_BLOCK_S = 1.0
"""Bounds one wait for room. `put_payload` then tries again, so the value limits only the delay of a missed wake-up."""
THREAD_NAME_PREFIX = "pycrorm "
"""The names of all threads of the memory begin with this."""
_REASON_MAX = 2_000
"""Bounds the characters of the last fault's message in `status`."""
UNAWAITED_MAX = 100
"""Bounds the designator types listed with a perform that was never awaited; the latest are kept."""


def is_of_memory() -> bool:
    """Return whether this is a thread of a memory. Such threads make room in the spool, so they must not wait for it.

    The garbage collector may close a dropped plan, and so record, in any thread.
    """
    return threading.current_thread().name.startswith(THREAD_NAME_PREFIX)


class BlobRefused(ValueError):
    """The queue does not take a blob; the message is the reason."""


class Faults(NamedTuple):
    """The number of events the hooks failed to record, and the last reason; `status` shows both."""

    total: int
    last: str | None


class Emitter:
    """The queue of one memory, its observers, and its counts of what was not recorded.

    Only the start of a node or an episode waits for room, before it is written (`must_wait`). All other events,
    including the start of a simulation, must not wait, so they may use the spool's reserve. If the reserve is used up
    as well, `put_payload` blocks the calling thread until a record was stored. No event is dropped.

    Attributes:
        is_closed: whether the memory is closed, or belongs to the process that forked this one; hooks then only count.
        unrecorded: the number of nodes, episodes and other reports that came after it was closed.
        feed: the observers of this memory, to which recorded events are published.
        missing: counts the values that could not be recorded.
        unawaited: for each designator type whose perform was called and never awaited, a sentence for the user.
    """

    def __init__(self, sink: EventSink, settings: Settings) -> None:
        self.sink = sink
        self.settings = settings
        self.record_bytes_max: Final = settings.record_bytes_max
        self.is_closed = False
        self.unrecorded = 0
        self.feed = EventFeed()
        self.missing = live_values.MissingValues()
        self.unawaited: tuple[str, ...] = ()
        self._fault_count = 0
        self._last_fault: str | None = None

    @cached_property
    def descriptions(self) -> Descriptions:
        """Declares the descriptions of objects; the first one loads the modules of the world that read URDFs."""
        from pycrorm_async.record.geometry import Descriptions

        return Descriptions(self, self.settings, self.missing)

    @property
    def faults(self) -> Faults:
        return Faults(self._fault_count, self._last_fault)

    def put_payload(
        self, heading: Heading, payload: bytes, *, at: tuple[int, int] | None = None, after: int = 0
    ) -> int:
        """Append an encoded event and return its sequence; block while the spool and its reserve are full."""
        while True:
            try:
                return self.sink.put_nowait(heading, payload, reserved=True, at=at, after=after)
            except SpoolFull:
                if is_of_memory():
                    raise
                self.sink.block_until_room(_BLOCK_S)

    def must_wait(self) -> bool:
        """Return if a node has to wait for room before it starts. Raises `SpoolFull` with `on_full="fail"`."""
        if not self.sink.full:
            return False
        if self.settings.on_full == "fail":
            raise SpoolFull("the spool is full (spool_bytes_max) and on_full is 'fail': start a writer to drain it")
        return True

    def put_declaration(self, declared: Declared) -> None:
        """Append the declaration of a designator type; count the fields that have another name."""
        own, kind = declared.type, type(declared.type.declaration)
        for name, renamed in declared.fields.items():
            self.missing.note_renamed(own.dtype, name, *renamed)
        if declared.dtype is not None:
            self.missing.note_renamed(own.dtype, "type", *declared.dtype)
        if own.payload:
            self.put_payload(Heading(None, kind.__name__, kind.version), own.payload)
            self.feed.note_type(short_name(own.fingerprint), own.declaration)

    def put_blob(self, content: bytes, media_type: str) -> event_types.BlobReference:
        """Write a blob; return the reference for events put afterwards. Never waits.

        The blob is kept beside the queue as long as these events, until `release_blob`, and for the life of the queue
        without it, as a declaration needs. Raises `BlobRefused` with the reason for a blob that is too large or finds
        no space; the caller records it as missing.
        """
        limit = self.settings.blob_bytes_max
        if len(content) > limit:
            raise BlobRefused(f"the blob takes {len(content):,} bytes, {limit:,} are allowed (blob_bytes_max)")
        try:
            return event_types.BlobReference(self.sink.put_blob(content), media_type, len(content))
        except FilesError as error:
            raise BlobRefused(str(error)) from error

    def close(self, because: str = "the memory is closed") -> None:
        """Record nothing from now on; further reports are counted."""
        self._closed_because, self.is_closed = because, True

    def note_missing(self, owner: str, reasons: Mapping[str, str], *, may_refuse: bool = False) -> None:
        """Count missing values. Raises `Unrecordable` if `may_refuse` and with `on_unrecordable="refuse"`."""
        refused = [name for name in reasons if name != "robot"]
        if may_refuse and refused and self.settings.on_unrecordable == "refuse":
            raise Unrecordable(owner, " and ".join(refused), reasons[refused[0]])
        for name, reason in reasons.items():
            self.missing.note(owner, name, reason)

    def note_unrecorded(self, what: str) -> None:
        """Count a report that came after `close`, and log a warning for the first."""
        self.unrecorded += 1
        if self.unrecorded == 1:
            why = f"{self._closed_because} (all further ones are only counted, in `status.unrecorded`)"
            _log.warning("%s leaves no record, because %s", live_values.cut(live_values.clean(what), _REASON_MAX), why)

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
        reason = live_values.cut(live_values.clean(live_values.message_of(error)), _REASON_MAX)
        self._last_fault = f"{where}: {class_name(type(error))}: {reason}"
        if self._fault_count & (self._fault_count - 1) == 0:
            _log.error("a fault of recording (%d so far): %s", self._fault_count, self._last_fault)
            _log.debug("traceback of the fault of recording", exc_info=error)


# === event sink ===============================================================================================
#
# `EventSink` is the port of `recording` that a queue implements: put an event from any thread, without awaiting.


class EventSink(Protocol):
    """The producing end of a queue."""

    def put_nowait(
        self,
        heading: Heading,
        payload: bytes,
        *,
        reserved: bool = False,
        at: tuple[int, int] | None = None,
        after: int = 0,
    ) -> int:
        """Append one event and return its sequence in its episode (0 for a recorder-level record).

        `at` is its wall time and its monotonic time, by default those of the clock. `after` is, of the first event of a
        named episode that earlier recorders began, the last sequence that they stored.

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

    @property
    def bytes_spooled(self) -> int:
        """Bytes of all that is not deleted yet."""
        ...

    def room(self) -> Awaitable[None]:
        """Wait until an event without `reserved` fits again."""
        ...

    def block_until_room(self, timeout_s: float, *, reserved: bool = True) -> bool:
        """Block the calling thread until an event fits; return False after `timeout_s` seconds.

        Logs a warning if it waits for more than two seconds. Raises `SpoolStuck` when waiting cannot help.
        """
        ...


# === events that do not fit ===================================================================================
#
# Leave out what JSON cannot hold, and then the largest parts of an event that is too large, each as a whole.

_CUT = 1_000
"""Characters that a text of an event that is too large is shortened to."""
_MISSING_BYTES = 400
"""Bounds from below the values worth leaving out: about the encoded size of the `MissingValue` that replaces one."""
_LEFT_OUT_MAX = 64
"""Bounds the parts that are left out of one event, because the rest is encoded again after each."""
ROBOT = "robot state"
"""The name under which a missing robot state is counted; the blank keeps it apart from every field's name."""


def episode_text_of(text: str) -> str:
    """Clean and shorten a text for a column of an episode."""
    return live_values.cut(live_values.clean(text), EPISODE_TEXT_MAX)


def fitted(event: event_types.Happening, bytes_max: int) -> tuple[event_types.Happening, dict[str, str]]:
    """Return the event without the parts that cannot be recorded, and the reason for each by its name.

    A parameter or a result becomes a `MissingValue`, an observed value null, a text is cut, and any other part gets the
    default of its field. An observation that is still too large, of very many small values, loses all of them. Raises
    `NotEncodable` if a part without default cannot be recorded.
    """
    reasons: dict[str, str] = {}
    for name in event.__struct_fields__:
        value = getattr(event, name)
        try:
            encoded_bytes(value)
        except NotEncodable as error:
            reasons[ROBOT if name == "robot" else name] = error.reason
            event = replace(event, **{name: _recordable(value, _defaults(event), name)})
    parts = _parts(event)
    sizes = {name: encoded_bytes(value) for name, value in parts.items()}
    for name in sorted(sizes, key=sizes.__getitem__, reverse=True)[:_LEFT_OUT_MAX]:
        if sizes[name] <= _MISSING_BYTES or fits(event, bytes_max):
            break
        reason = f"takes {sizes[name]:,} bytes, {bytes_max:,} are allowed for the record (record_bytes_max)"
        if isinstance(event, event_types.NodeStarted | event_types.Observed) or name == "result":
            smaller: Any = live_values.missing_value(reason, parts[name])
        else:
            smaller = _shorter(parts[name])
        reasons.setdefault(name or "values", reason)
        event = _with_part(event, name, smaller)
    if isinstance(event, event_types.Observed) and not fits(event, bytes_max):
        size = encoded_bytes(event.values)
        reason = f"its {len(parts):,} values take {size:,} bytes, {bytes_max:,} are allowed for the record"
        reasons = {"values": f"{reason} (record_bytes_max)"}
        event = replace(event, values=None, missing={"": reasons["values"]})
    return event, reasons


def _parts(event: event_types.Happening) -> dict[str, Any]:
    """Return the parts of an event that can be left out: its parameters, its observed values, or its fields."""
    if isinstance(event, event_types.NodeStarted):
        return event.parameters
    if isinstance(event, event_types.Observed):
        return event.values if isinstance(event.values, dict) else {"": event.values}
    return {name: value for name in event.__struct_fields__ if (value := getattr(event, name)) is not None}


def _with_part(event: event_types.Happening, name: str, part: Any) -> event_types.Happening:
    if isinstance(event, event_types.NodeStarted):
        return replace(event, parameters=event.parameters | {name: part})
    if isinstance(event, event_types.Observed):
        values = event.values | {name: None} if isinstance(event.values, dict) else None
        return replace(event, values=values, missing=event.missing | {name: part.missing})
    return replace(event, **{name: part})


def _shorter(part: Any) -> Any:
    if isinstance(part, str):
        return live_values.cut(part, _CUT)
    if isinstance(part, event_types.FailureValue):
        return event_types.FailureValue(live_values.cut(part.type, _CUT), live_values.cut(part.message, _CUT))
    return type(part)() if isinstance(part, tuple | dict) else part


def _defaults(value: msgspec.Struct) -> dict[str, Any]:
    fields, defaults = value.__struct_fields__, value.__struct_defaults__
    return dict(zip(fields[len(fields) - len(defaults) :], defaults, strict=True))


def _recordable(value: Any, defaults: Mapping[str, Any], name: str) -> Any:
    """Return the part of a field that JSON can hold, else its default. Raises `NotEncodable` if it has neither."""
    try:
        return _clean(value)
    except NotEncodable:
        if name not in defaults:
            raise
        return defaults[name]


def _clean(value: Any) -> Any:
    """Clean texts, and leave out items and entries that JSON cannot hold. Raises `NotEncodable` if none remain."""
    if isinstance(value, str):
        return live_values.clean(value)
    if isinstance(value, msgspec.Struct):
        # A pose is a whole: no part is left out. A robot without its pose would have that of its object's row.
        defaults = {} if isinstance(value, event_types.PoseValue) else _defaults(value)
        if isinstance(value, event_types.RobotValue):
            del defaults["pose"]
        names = value.__struct_fields__
        return replace(value, **{name: _recordable(getattr(value, name), defaults, name) for name in names})
    if isinstance(value, dict):
        entries = ((live_values.clean(key), _clean_or_none(each)) for key, each in value.items())
        return {key: each for key, each in entries if each is not None}
    if isinstance(value, list | tuple) and (
        isinstance(value, list) or isinstance(next(iter(value), 0), msgspec.Struct)
    ):
        return type(value)(each for each in map(_clean_or_none, value) if each is not None)
    encoded_bytes(value)
    return value


def _clean_or_none(value: Any) -> Any:
    try:
        return _clean(value)
    except NotEncodable:
        return None


def fits(event: event_types.Happening, bytes_max: int) -> bool:
    """Return whether the event can be encoded in `bytes_max` bytes."""
    try:
        encode(event, bytes_max=bytes_max)
    except NotEncodable:
        return False
    return True


# === observing ================================================================================================
#
# Write the observations that a program makes itself, for an episode of any executive.
#
# An observation never waits: where the spool has no room beside its reserve, it is counted as missing, as the samples
# of the robot's state are left out.

_NAME_MAX = 1_000
"""Bounds the characters of a name, far above real names."""


def put_observation(episode: EpisodeWriter, name: object, values: object, node: int, *, may_refuse: bool) -> int:
    """Write values under this name, observed by the node with this sequence; return the sequence of the event.

    Returns 0 if the spool or the episode has no room; the observation is counted as missing then. Raises `Unrecordable`
    only if `may_refuse` and with `on_unrecordable="refuse"`.
    """
    emitter, name = episode.emitter, name_of(name)
    reader = live_values.ValueReader(episode, emitter.put_blob)
    event = event_types.Observed(name, reader.read(values), node, reader.missing)
    owner = f"observation {name}"
    try:
        if reader.missing:
            reasons = {path or "values": reason for path, reason in reader.missing.items()}
            emitter.note_missing(owner, reasons, may_refuse=may_refuse)
        return episode.events.put(event, owner, may_refuse=may_refuse, reserved=False)
    except (EpisodeFull, SpoolFull, SpoolStuck) as refusal:
        emitter.missing.note("observation", name, str(refusal))
        return 0
    finally:
        for reference in reader.blobs:
            emitter.sink.release_blob(reference.hash)


def name_of(name: object) -> str:
    """Return the text under which an observation of this name is recorded."""
    return live_values.cut(
        live_values.clean(name if isinstance(name, str) else live_values.clean_repr(name)), _NAME_MAX
    )


# === open episodes ============================================================================================
#
# `OpenEpisodes` holds the open episodes of one memory, whichever executive writes them.

RECENT_MAX = 100
"""Bounds the ids in `recent`, because a process may open any number of episodes."""


class OpenEpisodes:
    """The open episodes of one memory, and the ids of those opened last.

    Attributes:
        by_id: the open episodes.
        opened_count: the number of episodes opened, without simulations.
        clock: the clock of the memory.
    """

    def __init__(self, emitter: Emitter, clock: Clock, randomness: Callable[[int], bytes] = os.urandom) -> None:
        self._emitter = emitter
        self.clock = clock
        self._randomness = randomness
        self.by_id: dict[EpisodeId, EpisodeWriter] = {}
        self._recent: deque[EpisodeId] = deque(maxlen=RECENT_MAX)
        self._is_closing = False
        self._adding = threading.RLock()
        self.opened_count = 0

    def new_id(self) -> EpisodeId:
        """Make the id of a new episode."""
        return episode_id(self.clock.wall_ns(), self._randomness(10))

    def add(self, episode: EpisodeWriter) -> None:
        """Add an episode. Raises `CallerError` after `refuse_new`."""
        with self._adding:
            if self._is_closing:
                raise CallerError("the memory is being closed")
            if episode.id in self.by_id:
                raise CallerError(f"the episode {episode} is open already")
            self.by_id[episode.id] = episode
        if not episode.simulated:
            self._recent.append(episode.id)
            self.opened_count += 1

    def refuse_new(self) -> None:
        """Add no episode from now on, because the memory is being closed."""
        with self._adding:
            self._is_closing = True

    @property
    def all(self) -> tuple[EpisodeWriter, ...]:
        """The open episodes, oldest first."""
        return tuple(self.by_id.copy().values())

    @property
    def recent(self) -> tuple[str, ...]:
        """The ids of the last 100 episodes opened, including ended ones, without simulations."""
        return tuple(map(episode_text, self._recent.copy()))

    def last_opened(self) -> EpisodeWriter | None:
        """Return the open episode that was opened last in any context, without simulations; None if there is none."""
        return next((each for each in reversed(self.all) if not each.simulated and not each.closed), None)

    def close(self, episode: EpisodeWriter, failure: BaseException | None) -> None:
        """Write the end of an episode; `failure` is the exception that ended it, or None. Exceptions are counted."""
        if self._emitter.is_closed:
            return
        try:
            episode.end_episode(failure)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not replace the plan's outcome
            self._emitter.note_fault("EpisodeEnded", error)
        self.by_id.pop(episode.id, None)  # last, so that the memory ends an episode whose end Ctrl-C interrupted
