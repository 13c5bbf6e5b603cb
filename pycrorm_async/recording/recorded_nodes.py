"""`RecordedNodes` writes the nodes of an episode of any executive, its beginning, its end and its follow-ups.

Theory of operation. Each method first copies its arguments, which may run any code of the caller, and then has
`OrderedCalls` write them; so no other call comes between the events of one, and a node's parent has started before it,
whichever threads start them. If the episode is continued after the copy, `_now` replaces references to rows of the
former episode. No method raises into the caller: faults, and calls after the end of the episode, are counted in
`Memory.status`. `_nodes` holds the open nodes by key, `_ended` the last ones that ended, because a child may start
after the end of its parent.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import Any, ParamSpec, get_args

from msgspec.structs import replace

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import NodeEnded
from pycrorm_async.events.values import (
    EpisodeStatus,
    FailureValue,
    NodeReference,
    NodeStatus,
    RobotValue,
)
from pycrorm_async.recording.checked_arguments import END_STATUSES, ArgumentReader, struct_of
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.ordered_calls import OrderedCalls, counted, may_wait, noted
from pycrorm_async.recording.recorded_objects import RecordedObjects
from pycrorm_async.recording.recorded_values import Convert, RecordedValues
from pycrorm_async.recording.values.texts import clean_repr
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_opening import EpisodeOpening, Failures, end_statuses
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter
from pycrorm_async.recording.writing.open_episodes import OpenEpisodes

P = ParamSpec("P")
FOREVER_S = 1e8
"""The seconds that a start waits for room: three years, because a wait takes a number."""
_ENDED_MAX = 1_000
"""Bounds the keys of ended nodes that a child can still name as its parent."""


class _Node:
    """A node that an executive started, as it is written again when the episode is continued.

    `sequence` counts in the episode with the id `episode_id`. `parent` is the parent, or, when this node has ended, the
    nearest node above it that was open then.
    """

    __slots__ = ("declared", "episode_id", "key", "parameters", "parent", "robot", "sequence")

    def __init__(self, key: Hashable, declared: DeclaredType, parameters: dict[str, Any]) -> None:
        self.key = key
        self.declared = declared
        self.parameters = parameters
        self.parent: _Node | None = None
        self.robot: RobotValue | None = None
        self.sequence = 0
        self.episode_id: EpisodeId | None = None


class RecordedNodes(EpisodeWriter[_Node]):
    """The nodes of a `RecordedEpisode`, and its beginning, end and follow-ups."""

    def __init__(
        self,
        emitter: Emitter,
        episodes: OpenEpisodes,
        opening: EpisodeOpening,
        convert: Convert | None,
        failures: Failures = (),
    ) -> None:
        super().__init__(emitter, episodes.new_id(), opening)
        self._episodes = episodes
        self._failures = failures
        self._calls = OrderedCalls()
        self._end_status: EpisodeStatus | None = None
        self._nodes: dict[Hashable, _Node] = {}
        self._ended: OrderedDict[Hashable, _Node] = OrderedDict()
        self._objects = RecordedObjects(emitter, self.id)
        self._values = RecordedValues(convert, lambda: self._objects, self)
        self._arguments = ArgumentReader(emitter.missing)

    def close(self, failure: BaseException | None = None, status: EpisodeStatus | None = None) -> None:
        """End the episode. Without a failure it SUCCEEDED, and nodes that are still open are counted.

        They end LOST, or CANCELLED in an episode that was INTERRUPTED.
        `status` is FAILED, ERROR or INTERRUPTED, by default as for `end`.
        """
        if isinstance(status, str) and status in get_args(EpisodeStatus):
            self._end_status = status
        self._episodes.close(self, failure)

    def _write(self, event_type: str, write: Callable[P, int], *args: P.args, **kwargs: P.kwargs) -> None:
        """Call `write` after all earlier calls; it returns the sequence of the event that it wrote, 0 for none."""
        self._calls.run(partial(self._written, event_type, write, *args, **kwargs))

    def _written(self, event_type: str, write: Callable[P, int], *args: P.args, **kwargs: P.kwargs) -> None:
        if self.closed:
            self._note(event_type, f"episode {self} has ended")
            return
        try:  # not `noted`, because this is called for each event
            sequence = write(*args, **kwargs)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self.emitter.note_fault(event_type, error)
            return
        if sequence >= self.continue_at:
            self._episodes.continue_episode(self)

    def _now(self, value: Any, prepared: EpisodeId) -> Any:
        """Return a value that was copied when the episode had the id `prepared`, with references to current rows."""
        return value if prepared == self.id else self._objects.renewed(value)

    # --- nodes ------------------------------------------------------------------------------------------------

    @counted("NodeStarted")
    def start(
        self,
        key: Hashable,
        type: DeclaredType,  # noqa: A002  the field's word
        parameters: Mapping[str, Any] = {},
        *,
        parent: Hashable | None = None,
        robot: RobotValue | Hashable | None = None,
    ) -> Hashable:
        """Record that a node started; return it.

        Waits while the spool is full. With `on_full="fail"`, the node is counted as a fault then, and not recorded.

        The returned value can be passed as `parent` and `node` in place of the key, also long after the node has ended
        and its key names another one.

        Args:
            key: names the node from now on. If an open node has it, that one ends LOST, and is counted.
            type: from `Recording.type`.
            parameters: by field name, copied now.
            parent: key of the node it runs inside. One that never started is counted, and the root takes its place.
            robot: the state of the robot that acts, or the key of its object.
        """
        hash(key)
        if self.emitter.must_wait() and may_wait():
            self.emitter.sink.block_until_room(FOREVER_S, reserved=False)
        missing: dict[str, str] = {}
        prepared = self.id
        values = noted(self.emitter, "NodeStarted", self._values.parameters, type, parameters, missing) or {}
        node = _Node(key, type, values)
        self._write("NodeStarted", self._start_node, node, parent, robot, missing, prepared)
        return node

    def _start_node(
        self, node: _Node, parent: Hashable | None, robot: object, missing: dict[str, str], prepared: EpisodeId
    ) -> int:
        key = node.key
        if key in self._nodes:
            self._note("NodeStarted", f"the key {clean_repr(key)} starts a second node before the first has ended")
            self._end_node(self._nodes[key], NodeEnded(self._nodes[key].sequence, "LOST"))
        node.parent = self._find(parent, "NodeStarted")
        node.robot = noted(self.emitter, "NodeStarted", self._robot, robot)
        node.parameters = self._now(node.parameters, prepared)
        self._write_start(node, missing, continues=None)
        self._nodes[key] = node
        self._ended.pop(key, None)
        return node.sequence

    def _robot(self, robot: Any) -> RobotValue | None:
        if robot is None:
            return None
        if isinstance(robot, RobotValue):
            state = struct_of(robot, RobotValue)
            return state if self._objects.holds(state.object) else replace(state, object=None)
        if (acting := self._objects.robot(robot)) is None:
            raise CallerError(f"no object has the key {clean_repr(robot)}, so the robot's state is not recorded")
        return acting

    def _write_start(self, node: _Node, missing: Mapping[str, str], continues: int | None) -> None:
        declared, parent = node.declared, self.node_or_root(node.parent)
        node.sequence = self._put_start(
            node, declared, declared.declaration.kind, parent, node.parameters, node.robot,
            missing=missing, continues=continues, may_refuse=False,
        )  # fmt: skip
        node.episode_id = self.id

    @counted("NodeEnded")
    def end(
        self,
        key: Hashable,
        status: NodeStatus | None = None,
        failure: BaseException | FailureValue | str | None = None,
        result: Any = None,
        *,
        below: NodeStatus | None = None,
    ) -> None:
        """Record that a node ended. A key that no open node has is counted, and so is an unknown status, as ERROR.

        Args:
            status: by default SUCCEEDED without a failure, FAILED for a plan failure or a text, CANCELLED for a
                cancellation, Ctrl-C or an exit, and ERROR for any other exception.
            failure, result: why it failed; what it returned.
            below: first end the nodes that are open below this one, the innermost first, with this status.
        """
        key = key.key if isinstance(key, _Node) and self._nodes.get(key.key) is key else key
        hash(key)
        if status is None:
            status = "FAILED" if isinstance(failure, str | FailureValue) else end_statuses(failure, self._failures)[1]
        status, below = self._checked_status(status), self._checked_status(below) if below is not None else None
        prepared = self.id
        value = noted(self.emitter, "NodeEnded", self._values.failure, failure) if failure is not None else None
        encoded = self._values.any(result) if result is not None else None
        self._write("NodeEnded", self._end_open, key, status, value, encoded, below, prepared)

    def _checked_status(self, status: NodeStatus) -> NodeStatus:
        if status in END_STATUSES:
            return status
        self._note("NodeEnded", f"{clean_repr(status)} is not a status ({', '.join(END_STATUSES)})")
        return "ERROR"

    def _end_open(
        self, key: Hashable, status: NodeStatus, failure: FailureValue | None, result: Any, below: NodeStatus | None,
        prepared: EpisodeId,
    ) -> int:  # fmt: skip
        node = self._nodes.get(key)
        if node is None:
            raise CallerError(f"no open node has the key {clean_repr(key)}")
        if below is not None:
            for each in [each for each in reversed(self._nodes.values()) if _is_below(each, node)]:
                self._end_node(each, NodeEnded(each.sequence, below))
        self._end_node(node, NodeEnded(node.sequence, status, failure, self._now(result, prepared)))
        return 0  # an end continues no episode

    def _end_node(self, node: _Node, event: NodeEnded) -> None:
        self._close_node(event, node.declared.dtype)
        self._nodes.pop(node.key, None)
        node.parameters, node.robot = {}, None
        while node.parent is not None and self._nodes.get(node.parent.key) is not node.parent:
            node.parent = node.parent.parent
        self._ended[node.key] = node
        while len(self._ended) > _ENDED_MAX:
            self._ended.popitem(last=False)

    def is_open(self, key: Hashable) -> bool:
        """Return whether a node with this key has started and not ended."""
        return bool(noted(self.emitter, "NodeStarted", lambda: key in self._nodes))

    def node_reference(self, key: Hashable | None = None) -> NodeReference:
        """Return a reference to a node for `Recording.episode(thought_by=…)`; without a known key, to the root."""
        return NodeReference(str(self), self.node_or_root(self._find(key, "EpisodeStarted")))

    def node_or_root(self, node: Any) -> int:
        """Return the sequence of this node, or of the nearest above it that is in this episode; None gives the root."""
        while isinstance(node, _Node):
            if node.episode_id == self.id:
                return node.sequence
            node = node.parent
        return self._root

    def open(self) -> None:
        """Write the start of the episode; if that fails, count the fault, and record nothing."""
        self._calls.run(self._open_now)

    def _open_now(self) -> None:
        try:
            self._episodes.add(self)
            super().open()
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self.emitter.note_fault("EpisodeStarted", error)
            self._episodes.by_id.pop(self.id, None)
            self.closed = True

    def end_episode(self, failure: BaseException | None) -> None:
        """Write the end of the episode."""
        self._calls.run(lambda: noted(self.emitter, "EpisodeEnded", self._end_now, failure))

    def _end_now(self, failure: BaseException | None) -> None:
        if (left := len(self._open_nodes)) and failure is None and not self.closed:
            self._note("EpisodeEnded", f"nodes open at the end of episode {self}, which end LOST: {left}")
        super().end_episode(failure)
        self._nodes.clear()
        self._ended.clear()

    def change_tags(self, added: Sequence[str], removed: Sequence[str]) -> None:
        """Write a change of the episode's tags, for `Memory.tag`. Raises what `EpisodeWriter.change_tags` raises."""
        raised: list[BaseException] = []

        def change() -> None:
            try:
                super(RecordedNodes, self).change_tags(added, removed)
            except Exception as error:  # noqa: BLE001  raised to the caller below
                raised.append(error)

        self._calls.run(change)
        for each in raised:
            raise each

    def _end_statuses(self, failure: BaseException | None) -> tuple[EpisodeStatus, NodeStatus]:
        status = self._end_status
        if status is None:
            return end_statuses(failure, self._failures)
        return status, ("CANCELLED" if status == "INTERRUPTED" else status)

    def _has_ended(self, node: _Node) -> bool:
        return self._nodes.get(node.key) is not node

    def _restart_node(self, node: _Node, sequence: int) -> int:
        node.parameters = self._objects.renewed(node.parameters)
        if node.robot is not None:
            node.robot = replace(node.robot, object=self._objects.renewed(node.robot.object))
        self._write_start(node, {}, continues=sequence)
        return node.sequence

    def _restart_world(self) -> int:
        self._objects = RecordedObjects(self.emitter, self.id, self._objects)
        return self._objects.last

    def _leave_world(self) -> None:
        """Do nothing: the executive reports the objects, so no observer has to stop."""

    def _described_world(self) -> str | None:
        return None

    def _find(self, key: Hashable | None, event_type: str) -> _Node | None:
        """Return the node of a key, or of a value that `start` returned; count a key that no node has."""
        if key is None or isinstance(key, _Node):
            return key
        node = noted(self.emitter, event_type, lambda: self._nodes.get(key) or self._ended.get(key))
        if node is None:
            self._note(event_type, f"no node has the key {clean_repr(key)}; the root of the episode takes its place")
        return node

    def _known(self, key: Hashable) -> Hashable:
        if self._objects.reference(key) is None:
            raise CallerError(f"no object has the key {clean_repr(key)}: add it with `object_added` first")
        return key

    def _cause(self, key: Hashable | None) -> int | None:
        """Return the sequence of the node that changes the world; None for one of a former episode."""
        node = self._find(key, "a change of the world")
        return node.sequence if node is not None and node.episode_id == self.id else None

    def _note(self, event_type: str, reason: str) -> None:
        self.emitter.note_fault(event_type, CallerError(reason))


def _is_below(node: _Node, ancestor: _Node) -> bool:
    above = node.parent
    while above is not None and above is not ancestor:
        above = above.parent
    return above is not None
