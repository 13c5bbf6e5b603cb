"""A `KeyedEpisode` writes an episode whose executive names nodes and objects by keys, one call after the other."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from msgspec.structs import replace

from pycrorm_async.errors import CallerError
from pycrorm_async.events import types as event_types
from pycrorm_async.events.ids import EpisodeId, is_named
from pycrorm_async.events.reasons import UNNAMED, template_of
from pycrorm_async.record.arguments import struct_of
from pycrorm_async.record.declarations import DeclaredType
from pycrorm_async.record.episode_writer import Emitter, EpisodeWriter, OpenEpisodes, is_of_memory, put_observation
from pycrorm_async.record.event_times import At, EventTimes
from pycrorm_async.record.objects import RecordedObjects
from pycrorm_async.record.opening import EpisodeOpening, Failures, end_statuses
from pycrorm_async.record.recorded_before import RecordedBefore, StoredEpisode, StoredEpisodes
from pycrorm_async.record.values import clean_repr, message_of

if TYPE_CHECKING:
    from pycrorm_async.record.samples import SampleBlocks

# === ordered calls ============================================================================================
#
# `OrderedCalls` runs the calls of one memory one after the other, whichever threads make them.
#
# Theory of operation. A thread runs its call under the lock, so its call has run when it returns. The garbage
# collector, or a method of a key, may make a call in the middle of another one, in the thread that holds the lock: the
# lock is reentrant, `_is_running` shows this, and the call is left in `_left` for the outer one. A thread of the memory
# must not wait for the lock, because its holder may wait for the room in the spool that this thread makes: it takes the
# lock only if it is free, and otherwise leaves the call to the holder.
#
# A signal handler may raise KeyboardInterrupt in the main thread when any call returns. `with` on the lock itself
# cannot be interrupted between taking the lock and entering the block, nor before the lock is released; `acquire` and
# `release` in a `try` can. Only threads of the memory, which run no signal handlers, use these. A handler may also run
# where a loop begins its next round, and there Python 3.12 and 3.13 leave the block without releasing the lock, because
# they take the jump back for one that cannot raise. So no loop, and no comprehension, is directly in such a block.

P = ParamSpec("P")
R = TypeVar("R")


class OrderedCalls:
    """The calls of one memory."""

    def __init__(self) -> None:
        self._left: deque[Callable[[], object]] = deque()
        self._lock = threading.RLock()
        self._is_running = False

    def run(self, call: Callable[[], object]) -> None:
        """Run a call, which must not raise, after all earlier ones."""
        if is_of_memory():
            self._left.append(call)
            while self._left and self._lock.acquire(blocking=False):
                try:
                    if self._is_running:  # as below
                        return
                    self._run(_nothing)
                finally:
                    self._lock.release()
            return
        with self._lock:
            if self._is_running:  # in a call that this thread runs, which is followed by this one
                self._left.append(call)
                return
            self._run(call)
        while self._left:  # a thread of the memory came before the lock was released
            with self._lock:
                self._run(_nothing)

    def _run(self, call: Callable[[], object]) -> None:
        self._is_running = True  # followed by `try` without a call, so that Ctrl-C cannot separate the two
        try:
            self._run_left()
            call()
            self._run_left()
        finally:
            self._is_running = False

    def _run_left(self) -> None:
        while self._left:
            self._left.popleft()()


def _nothing() -> None:
    """Write nothing."""


def noted(emitter: Any, event_type: str, read: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R | None:
    """Call `read` with these arguments and return its result; if it raises, count the exception and return None."""
    try:
        return read(*args, **kwargs)
    except Exception as error:  # noqa: BLE001  the code of an executive's values may raise anything
        emitter.note_fault(event_type, error)
        return None


# === keyed episode ============================================================================================

_ENDED_MAX = 1_000
"""Bounds the keys of ended nodes that a child can still name as its parent."""


class Node:
    """A node that an executive started.

    `parent` is the parent, or, when this node has ended, the nearest node above it that was open then.
    """

    __slots__ = ("declared", "episode", "key", "parameters", "parent", "sequence")

    def __init__(self, key: Hashable, declared: DeclaredType, parameters: dict[str, Any]) -> None:
        self.key = key
        self.declared = declared
        self.parameters = parameters
        self.parent: Node | None = None
        self.sequence = 0
        self.episode: KeyedEpisode | None = None

    def is_below(self, ancestor: Node) -> bool:
        """Return whether `ancestor` is among the nodes above this one."""
        above = self.parent
        while above is not None and above is not ancestor:
            above = above.parent
        return above is not None


class KeyedEpisode(EpisodeWriter):
    """The writer of a `RecordedEpisode`: its methods run inside `write`, with values that are copied already.

    `_nodes` holds the open nodes by key, `_ended` the last ones that ended, because a child may start after the end of
    its parent.

    Attributes:
        is_recorded: whether the log has this episode with its end already; nothing is recorded then.
        refusal: why nothing, or nothing more, is recorded; None without a reason.
        objects: its objects by key.
        end: the status and the time that the executive gave its end, each None if not given.
    """

    def __init__(
        self,
        emitter: Emitter,
        episodes: OpenEpisodes,
        calls: OrderedCalls,
        opening: EpisodeOpening,
        failures: Failures,
        id: EpisodeId | None,  # noqa: A002  the field's word
        at: At | None,
    ) -> None:
        super().__init__(emitter, episodes.new_id() if id is None else id, opening)
        self._times = EventTimes(episodes.clock, at)
        self.events.time = self._times.began
        self.is_recorded = False
        self.refusal: str | None = None
        self.objects = RecordedObjects(self)
        self.end: tuple[event_types.EpisodeStatus | None, At | None] = None, None
        self._episodes = episodes
        self._failures = failures
        self._calls = calls
        self._nodes: dict[Hashable, Node] = {}
        self._ended: OrderedDict[Hashable, Node] = OrderedDict()
        self._samples: SampleBlocks | None = None

    # --- calls ------------------------------------------------------------------------------------------------

    def write(self, event_type: str, write: Callable[[], object], at: At | None = None) -> None:
        """Call `write` after all earlier calls, unless the episode has ended; count its exceptions."""

        def run() -> None:
            if self.closed:
                if not self.is_recorded and self.refusal is None:
                    self.note(event_type, f"episode {self} has ended")
                return
            try:  # not `noted`, because this is called for each event
                self.set_time(event_type, at)
                write()
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                self.emitter.note_fault(event_type, error)

        self._calls.run(run)

    def set_time(self, event_type: str, at: At | None) -> None:
        """Set the time of the next event; a wrong one is counted, and the event happens as without it."""
        try:
            self.events.time, warning = self._times.next(at)
        except CallerError as error:
            self.emitter.note_fault(event_type, error)
            self.events.time, warning = self._times.next(None)
        if warning is not None:
            self.note(event_type, warning)

    def now_ns(self) -> int:
        """Return the wall time of an event that happens now."""
        time = self.events.time
        return self._episodes.clock.wall_ns() if time is None else time[0]

    def note(self, event_type: str, reason: str) -> None:
        """Count a fault of the executive."""
        self.emitter.note_fault(event_type, CallerError(reason))

    # --- nodes ------------------------------------------------------------------------------------------------

    def start_node(self, node: Node, parent: Hashable | None, robot: object, missing: dict[str, str]) -> None:
        """Write the start of a node; an open one of the same key ends first."""
        key = node.key
        if key in self._nodes:
            self.note("NodeStarted", f"the key {clean_repr(key)} starts a second node before the first has ended")
            self._end_node(self._nodes[key], "LOST")
        node.parent = self.find(parent, "NodeStarted")
        declared, state = node.declared, noted(self.emitter, "NodeStarted", self._robot, robot)
        acting = self.objects.acting(state) if state is not None else None
        above = self.node_or_root(node.parent)
        node.sequence = self.nodes.start(declared, declared.declaration.kind, above, node.parameters, acting, missing)
        node.episode = self
        self._nodes[key] = node
        self._ended.pop(key, None)

    def _robot(self, robot: Any) -> event_types.RobotValue | None:
        if robot is None:
            return None
        if isinstance(robot, event_types.RobotValue):
            state = struct_of(robot, event_types.RobotValue)
            if state.pose is not None:
                state = replace(state, pose=self.objects.frames.in_map(state.pose))
            return state if self.objects.holds(state.object) else replace(state, object=None)
        if (acting := self.objects.robot(robot)) is None:
            raise CallerError(f"no object has the key {clean_repr(robot)}, so the robot's state is not recorded")
        return acting

    def open_node(self, key: Hashable) -> Node | None:
        """Return the open node of this key."""
        return self._nodes.get(key)

    def end_node(
        self,
        key: Hashable,
        status: event_types.NodeStatus,
        failure: event_types.FailureValue | None,
        result: Any,
        below: event_types.NodeStatus | None,
        *,
        untimed: bool,
    ) -> None:
        """Write the end of an open node, after those of the open nodes below it if `below` is their status."""
        node = self._nodes.get(key)
        if node is None:
            raise CallerError(f"no open node has the key {clean_repr(key)}")
        if below is not None:
            for each in [each for each in reversed(self._nodes.values()) if each.is_below(node)]:
                self._end_node(each, below, untimed=untimed)
        if failure is not None and failure.type == UNNAMED:
            parameters = (each for each in node.parameters.values() if isinstance(each, str))
            template = template_of(failure.message, (*parameters, *self.objects.names()))
            failure = replace(failure, type=template or UNNAMED)
        self._end_node(node, status, failure, result, untimed=untimed)

    def _end_node(
        self,
        node: Node,
        status: event_types.NodeStatus,
        failure: event_types.FailureValue | None = None,
        result: Any = None,
        *,
        untimed: bool = False,
    ) -> None:
        self.nodes.end(node.sequence, status, failure, result, untimed=untimed)
        self._nodes.pop(node.key, None)
        node.parameters = {}
        while node.parent is not None and self._nodes.get(node.parent.key) is not node.parent:
            node.parent = node.parent.parent
        self._ended[node.key] = node
        while len(self._ended) > _ENDED_MAX:
            self._ended.popitem(last=False)

    def find(self, key: Hashable | None, event_type: str) -> Node | None:
        """Return the node of a key, or of a value that `start` returned; count a key that no node has."""
        if key is None or isinstance(key, Node):
            return key
        node = noted(self.emitter, event_type, lambda: self._nodes.get(key) or self._ended.get(key))
        if node is None:
            self.note(event_type, f"no node has the key {clean_repr(key)}; the root of the episode takes its place")
        return node

    def node_or_root(self, node: Any) -> int:
        """Return the sequence of this node or of its nearest ancestor in this episode; without a node, of the root."""
        while isinstance(node, Node):
            if node.episode is self:
                return node.sequence
            node = node.parent
        return self.nodes.root

    # --- objects and observations -----------------------------------------------------------------------------

    def reference(self, key: Hashable) -> event_types.ObjectReference | None:
        """Return the current row of an object; None if there is none of this key."""
        return noted(self.emitter, "ObjectAdded", self.objects.reference, key)

    def known(self, key: Hashable) -> Hashable:
        """Return the key of an object. Raises `CallerError` if none has it."""
        if self.objects.reference(key) is None:
            raise CallerError(f"no object has the key {clean_repr(key)}: add it with `object_added` first")
        return key

    def cause(self, key: Hashable | None) -> int | None:
        """Return the sequence of the node that changes the world; None for one of another episode."""
        node = self.find(key, "a change of the world")
        return node.sequence if node is not None and node.episode is self else None

    def observe(self, name: str, values: object, node: Hashable | None) -> None:
        """Write an observation."""
        put_observation(self, name, values, self.node_or_root(self.find(node, "Observed")), may_refuse=False)

    def sample(self, name: str, channels: tuple[str, ...], values: Any, times: Any, node: Hashable | None) -> None:
        """Write the blocks of a stream that these samples fill."""
        last = int(times[-1]) if len(times) else 0
        if self.events.time is not None and last > self.events.time[0]:  # streams overlap: others may be ahead
            self.set_time("Observed", last)
        if self._samples is None:
            from pycrorm_async.record import samples  # here, because it loads numpy and few executives have streams

            self._samples = samples.SampleBlocks()
        for sampling, block in self._samples.add(name, channels, values, times, node):
            self.observe(name, block, sampling)

    def detect(
        self,
        event: event_types.ObjectDetected,
        percepts: Sequence[event_types.SeenValue],
        node: Hashable | None,
    ) -> None:
        """Write a result of perception; an object that this episode does not have is left out."""
        acting = self.find(node, "ObjectDetected")
        number = self.node_or_root(acting) if acting is not None else None
        placed = (replace(each, pose=self.objects.frames.in_map(each.pose)) for each in percepts)
        held = (each if self.objects.holds(each.object) else replace(each, object=None) for each in placed)
        self.events.put(replace(event, seen=tuple(held), node=number))

    # --- start and end ----------------------------------------------------------------------------------------

    def open(self, stored: StoredEpisodes | None = None) -> None:
        """Write the start of the episode; if that fails, count the fault, and record nothing.

        With `stored`, continue the episode behind the events that the log has of it; see `is_recorded`.
        """
        before = None
        if stored is not None and self.id not in self._episodes.by_id:
            try:
                before = stored.find(self.id)
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                self.emitter.note_fault("EpisodeStarted", error)
                self._refuse(error)
                return
        if before is not None and before.has_ended:
            self.closed = self.is_recorded = True
        else:
            self._calls.run(lambda: self._open_now(before))

    def _open_now(self, before: StoredEpisode | None) -> None:
        is_added = False
        try:
            self._episodes.add(self)
            is_added = True
            if before is not None:
                self.events.continue_behind(RecordedBefore(self.id, before), self._refuse)
            super().open()
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self.emitter.note_fault("EpisodeStarted", error)
            if is_added:
                self._episodes.by_id.pop(self.id, None)
            self.closed = True
            if is_named(self.id):  # of any other episode the calls that are lost are counted
                self.refusal = message_of(error)

    def _refuse(self, error: Exception) -> None:
        """Record nothing, or nothing more."""
        self.refusal = message_of(error)
        self.closed = self._is_ended = True

    def end_episode(self, failure: BaseException | None, world: str | None = None) -> None:
        """Write the end of the episode; leave a named one that is interrupted without an end."""
        self._calls.run(lambda: noted(self.emitter, "EpisodeEnded", self._end_now, failure, world))

    def _end_now(self, failure: BaseException | None, world: str | None) -> None:
        status, at = self.end
        is_interrupted = status is None and self._end_statuses(failure)[0] == "INTERRUPTED"
        if is_named(self.id) and not self.closed and is_interrupted:
            self.closed = self._is_ended = True
            return
        if not self.closed:
            self.set_time("EpisodeEnded", at)
            for name, node, block in self._samples.take_all() if self._samples is not None else ():
                self.observe(name, block, node)
        if (left := len(self._nodes)) and failure is None and not self.closed and status != "UNKNOWN":
            self.note("EpisodeEnded", f"nodes open at the end of episode {self}, which end LOST: {left}")
        super().end_episode(failure, world)
        self._nodes.clear()
        self._ended.clear()

    def change_tags(self, added: Sequence[str], removed: Sequence[str]) -> None:
        """Write a change of the episode's tags, for `Memory.tag`. Raises what `EpisodeWriter.change_tags` raises."""
        raised: list[BaseException] = []

        def change() -> None:
            try:
                EpisodeWriter.change_tags(self, added, removed)
            except Exception as error:  # noqa: BLE001  raised to the caller below
                raised.append(error)

        self._calls.run(change)
        for each in raised:
            raise each

    def _end_statuses(self, failure: BaseException | None) -> tuple[event_types.EpisodeStatus, event_types.NodeStatus]:
        status = self.end[0]
        if status is None:
            return end_statuses(failure, self._failures)
        return status, ("CANCELLED" if status == "INTERRUPTED" else status)
