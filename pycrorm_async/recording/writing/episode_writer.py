"""An `EpisodeWriter` writes the events of one open episode and continues it in a follow-up when it gets too long.

Theory of operation. The writer does not know the executive: `N` is an executive's own record of a node. `_open_nodes`
holds every node that started and whose end is not written. The call that removes a node writes its end, so no node has
two; if it raises before the end is written, it restores the node, which then ends with the episode. Ctrl-C can
come at any call, also after the event is written: a `Receipt` shows that, and the lines that update the state by it
make no call. `_ending` holds a node while a thread writes its end. The ends of episodes wait, for a limited time, until
it is empty, because the end of a node must precede the end of its episode. The end of a node never waits, because the
garbage collector may cause it.

A sequence has 26 bits, so an episode can run out of sequences. When one reaches `continue_at`, `continue_as` ends it,
and the same `EpisodeWriter` continues under a new id, so that whatever refers to it stays valid. Every open node ends
INTERRUPTED with the reason EpisodeContinued, innermost first, then the root and the episode itself. The follow-up
begins with EpisodeStarted, which names the former episode, then a root, the world as it is then, and a start of each
interrupted node, outermost first. Such a start names the sequence that it continues and holds the node's parameters
and the robot's state as they are then. So each perform has exactly one row whose status is its outcome, and the
duration of a node is the sum of its parts.

Only a start, an observation or a change of the world triggers a follow-up, after it has been recorded itself. An end
never does, because the garbage collector may cause it. Until the next start, events use the reserve of sequences behind
`continue_at`. If an end cannot be written, the next event tries again; `_interrupted` then holds the nodes that have an
end and, if they still run then, are started again in the follow-up.
"""

from __future__ import annotations

import html
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Final, Generic, TypeVar

from pycrorm_async.errors import Unrecordable
from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.envelope import Receipt
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.events.tags import changed_tags
from pycrorm_async.events.types import EpisodeEnded, EpisodeTagged, NodeEnded, NodeStarted, ObjectDetected
from pycrorm_async.events.values import EpisodeStatus, FailureValue, NodeKind, NodeStatus, ObjectReference, RobotValue
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.values.event_fitting import (
    fit_detection,
    fit_episode_end,
    fit_episode_start,
    fit_node_end,
)
from pycrorm_async.recording.values.failure_values import failure_value
from pycrorm_async.recording.values.parameters import ROBOT, fit_node_start
from pycrorm_async.recording.values.texts import clean
from pycrorm_async.recording.values.value_snapshot import missing_in
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_opening import EpisodeOpening, end_statuses, episode_started
from pycrorm_async.world.objects import Object

CONTINUED: Final = "EpisodeContinued"
"""The failure type of nodes and episodes that ended because a follow-up episode continues them."""

_RESERVE_EVENTS_MAX = 2**20
"""Bounds the sequences reserved behind `continue_at`: more open nodes than fit into a process' memory."""
_LAST_ENDS_S = 1.0
"""Bounds the wait of an episode's end for ends of nodes in other threads; each takes microseconds."""
_DESCRIPTION_MAX = 200
"""Bounds the characters of the description in a notebook."""

N = TypeVar("N")


class EpisodeWriter(ABC, Generic[N]):
    """An open or closed episode.

    Attributes:
        emitter: puts the events into the queue and counts faults.
        id: 16 bytes of a UUIDv7; `str(episode)` is its text. A continued episode has the id of its latest follow-up.
        continue_at: the first sequence that triggers a follow-up episode.
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
        self._interrupted: dict[int, N] = {}
        self._ending: set[N] = set()
        events_max = emitter.settings.episode_events_max
        self._continue_at: Final = events_max - min(events_max // 8, _RESERVE_EVENTS_MAX)
        self.continue_at = self._continue_at
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
    def _has_ended(self, node: N) -> bool:
        """Return whether the executive has ended a node whose end is not written yet."""

    @abstractmethod
    def _restart_node(self, node: N, sequence: int) -> int:
        """Write the start of a node that continues `sequence` of the former episode; return its new sequence."""

    @abstractmethod
    def _restart_world(self) -> int:
        """Write the world as it is now; return the last sequence, 0 without a world."""

    @abstractmethod
    def _leave_world(self) -> None:
        """Write no more changes of the world."""

    @abstractmethod
    def _described_world(self) -> str | None:
        """Return the description of the world that was entered inside the episode; None if none was."""

    # --- the episode ------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Write the start of the episode."""
        self._start(None, None)

    def _start(self, continues: EpisodeId | None, root: int | None) -> None:
        """Write the start of the episode and of its root node; after an interrupted call, what is missing."""
        started = episode_started(self._opening, continues)
        started, shortened = fit_episode_start(started, self.emitter.settings.record_bytes_max)
        for name in shortened:
            self.emitter.missing.note("Episode", name, "its text is too long for an episode and was cut")
        begun, root_started = Receipt(), Receipt()
        try:
            if not self._is_begun:
                self.emitter.put(self.id, started, begun)
            if not self._root:
                self.emitter.put(self.id, NodeStarted("root", simulated=self.simulated, continues=root), root_started)
        finally:
            self._is_begun = self._is_begun or begun.sequence > 0
            self._root = self._root or root_started.sequence

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

    def continue_as(self, follow_up: EpisodeId) -> dict[int, int]:
        """End the episode and continue it under the id `follow_up`; map the old sequences of open nodes to the new."""
        former, root = self.id, self._root
        self._interrupted.update(self._open_nodes)
        open_nodes = sorted(self._interrupted.items(), key=lambda item: item[0])
        reason = FailureValue(CONTINUED, f"the episode continues in episode {episode_text(follow_up)}")
        for sequence, node in reversed(open_nodes):
            interrupted = NodeEnded(sequence, "INTERRUPTED", reason)
            self._close_node(NodeEnded(sequence, "LOST") if self._has_ended(node) else interrupted, "Episode")
        self._wait_for_ends()
        self._end_root("INTERRUPTED", reason)
        ended = EpisodeEnded("INTERRUPTED", reason, episode_text(follow_up), self._described_world())
        receipt = Receipt()
        try:
            self.emitter.put(former, ended, receipt)
        finally:
            if receipt.sequence:
                self.id, self._is_begun, self._root, self._root_ended = follow_up, False, 0, False
        try:
            self._start(former, root)
        except (KeyboardInterrupt, SystemExit):
            self._start(former, root)  # otherwise no further event would have an episode
            raise
        self._interrupted.clear()
        last = max(self._root, self._restart_world())
        renumbered: dict[int, int] = {}
        for sequence, node in open_nodes:
            if self._has_ended(node):
                continue
            try:
                last = renumbered[sequence] = self._restart_node(node, sequence)
            except Exception as error:  # noqa: BLE001  the other nodes continue nevertheless
                self.emitter.note_fault("NodeStarted", error)
        # The world and the tree may reach the limit at once; doubling it prevents an endless chain of follow-ups.
        self.continue_at = max(self._continue_at, 2 * last)
        return renumbered

    # --- nodes and perception -----------------------------------------------------------------------------------

    def _put_start(
        self, node: N, declared: DeclaredType, kind: NodeKind, parent: int, parameters: dict[str, Any],
        robot: RobotValue | None, *, missing: Mapping[str, str], continues: int | None, may_refuse: bool,
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
            continues=continues,
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
