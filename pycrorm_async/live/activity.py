"""Fold the events of an episode into the present activity of its robot, and into its row in the list of episodes.

Events of motion are skipped undecoded, so that an episode of a million events is read in seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, NodeEnded, NodeStarted, ObjectAdded
from pycrorm_async.projections.fold.fold import happening_of
from pycrorm_async.query.parameter_text import parameters_text, with_object_names
from pycrorm_async.store.stored import EpisodeRow, StoredEvent

_READ = frozenset({"EpisodeStarted", "EpisodeEnded", "NodeStarted", "NodeEnded", "ObjectAdded"})
_FAILED = frozenset({"FAILED", "ERROR"})
_TEXT_MAX = 200
"""Bounds the characters of a description, and of the text of the running nodes."""
_NODES_IN_FULL = 2
"""Bounds the innermost nodes that are shown with parameters."""


class Activity:
    """The present activity of an episode, up to the last event that was read.

    Attributes:
        last: sequence of the last event that was read.
        simulated: True for a simulation, performed in a copy of the world.
        fault: the reason for which its events cannot be read any further, or None.
    """

    def __init__(self, row: EpisodeRow) -> None:
        self.row = row
        self.last = 0
        self.simulated = False
        self.fault: str | None = None
        self._description = ""
        self._status = "RUNNING"
        self._nodes = self._failed = 0
        self._parents: dict[int, int | None] = {}
        self._running: dict[int, str] = {}
        self._actions: set[int] = set()
        """The running nodes that are actions."""
        self._latest = ""
        """The action that ended last."""
        self._causes: set[int] = set()
        """The running nodes below which a node failed."""
        self._reasons: dict[str, int] = {}
        self._robots: dict[str, None] = {}
        self._names: dict[int, str] = {}
        self._ended_wall_ns: int | None = None

    @property
    def has_ended(self) -> bool:
        return self._status != "RUNNING"

    def read(self, event: StoredEvent, designators: Mapping[str, str]) -> None:
        """Apply the next event. Raises `CannotFold`."""
        self.last = event.sequence
        if event.type not in _READ:
            return
        match happening_of(event):
            case EpisodeStarted() as started:
                self._description, self.simulated = started.description[:_TEXT_MAX], started.simulated
            case NodeStarted() as started:
                self._nodes += 1
                dtype = designators.get(started.designator or "", "")
                parameters = with_object_names(started.parameters, lambda each: self._names.get(each["object"]))
                self._parents[event.sequence] = started.parent
                if started.kind == "action":
                    self._actions.add(event.sequence)
                self._running[event.sequence] = f"{dtype or started.kind} {parameters_text(parameters)}".strip()
            case NodeEnded() as ended:
                self._node_ended(ended)
            case ObjectAdded() as added:
                self._names[event.sequence] = added.name
                if added.object_type == "ROBOT":
                    self._robots[added.name] = None
            case EpisodeEnded() as ended_episode:
                self._status, self._ended_wall_ns = ended_episode.status, event.wall_ns
                if ended_episode.status == "LOST":
                    self._failed += len(self._running)
                self._running.clear()
            case _:
                pass

    def _node_ended(self, ended: NodeEnded) -> None:
        text = self._running.pop(ended.node, "")
        self._latest = text if ended.node in self._actions else self._latest
        self._actions.discard(ended.node)
        parent = self._parents.pop(ended.node, None)
        if ended.status not in _FAILED:
            return
        self._failed += 1
        if ended.node not in self._causes:
            reason = ended.failure.type.rpartition(".")[2] if ended.failure is not None else "no reason"
            self._reasons[reason] = self._reasons.get(reason, 0) + 1
        self._causes.discard(ended.node)
        if parent is not None:
            self._causes.add(parent)

    @property
    def now(self) -> list[str]:
        """The nodes from the root's child down to the one that started last, the innermost ones with parameters."""
        path: list[str] = []
        node: int | None = max(self._running, default=None)
        while node is not None and (parent := self._parents.get(node)) is not None:
            text = self._running.get(node, "")
            path.append(text if len(path) < _NODES_IN_FULL else text.partition(" ")[0])
            node = parent
        return [each[:_TEXT_MAX] for each in reversed(path) if each]

    def entry(self) -> dict[str, Any]:
        """Return its row, with the keys of `report.overview_data`; its times are those of the tables, in µs."""
        ended = self._ended_wall_ns
        return {
            "number": self.row.number,
            "started": f"{datetime.fromtimestamp(self.row.started_wall_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S}",
            "description": self._description,
            "status": self._status,
            "seconds": None if ended is None else (ended // 1000 - self.row.started_wall_ns // 1000) / 1e6,
            "nodes": self._nodes,
            "failed": self._failed,
            "reasons": dict(self._reasons),
            "page": f"episode/{self.row.number}",
            "unreadable": self.row.refused or self.fault or "",
            "robots": list(self._robots),
            "now": self.now,
            "after": "" if self.now else self._latest[:_TEXT_MAX],
        }
