"""Make a case of each action of one episode when it ends, with the situation in which it started.

>>> cases = EpisodeCases()
>>> [case for event in events for case in cases.read(event)]

The fold is pure, and its memory grows with the nodes that run and the objects in the world. Besides the features of
`situation` a case has `inside`, the type of the nearest action around it, and `after` and `after_status`, type and
status of the action that ended last inside the same action. All features are known before the action runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
    ObjectRemoved,
)
from pycrorm_async.projections.custom.projection import Event
from pycrorm_async.projections.fold.world_fold import WorldFold
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.cases.situation import FeatureFields, Numbers, Symbols, situation

__all__ = ["EpisodeCases", "READS"]

READS: Final = (
    EpisodeStarted,
    EpisodeEnded,
    NodeStarted,
    NodeEnded,
    ObjectAdded,
    ObjectRemoved,
    ObjectMoved,
    ObjectAttached,
    ObjectDetached,
)
"""The types of events that cases are made from."""


@dataclass(slots=True)
class _Running:
    """A node that runs. `scope` is the sequence of the nearest action, itself included; 0 outside any."""

    scope: int
    action: _Action | None = None


@dataclass(slots=True)
class _Action:
    """An action that runs, with the situation in which it started."""

    node: int
    type: str
    time: int
    monotonic_ns: int
    parent: int
    simulated: bool
    symbols: Symbols
    numbers: Numbers


@dataclass(slots=True)
class _Scope:
    """What has happened inside an action: its type, and type and status of the action that ended last in it."""

    type: str | None = None
    after: tuple[str, str] | None = None


class EpisodeCases:
    """The cases of one episode, event by event."""

    def __init__(self) -> None:
        self._world = WorldFold()
        self._nodes: dict[int, _Running] = {}
        self._scopes: dict[int, _Scope] = {0: _Scope()}
        self._fields: dict[str, FeatureFields] = {}
        self._simulated = False

    def read(self, event: Event) -> list[Case]:
        """Apply the next event; return the cases of the actions that it ends. Raises `CannotFold`."""
        match event.happening:
            case NodeStarted() as started:
                self._started(event, started)
            case NodeEnded() as ended:
                return self._ended(event, ended)
            case EpisodeStarted(simulated=simulated):
                self._simulated = simulated
            case EpisodeEnded(status="LOST"):
                running = [each.action for each in self._nodes.values() if each.action is not None]
                self._nodes.clear()
                return [self._case(event.number, each, "LOST", None, None) for each in running]
            case EpisodeEnded():
                self._nodes.clear()
            case happening:
                self._world.read(event.sequence, happening)
        return []

    def _started(self, event: Event, started: NodeStarted) -> None:
        around = self._nodes.get(started.parent) if started.parent is not None else None
        parent = around.scope if around is not None else 0
        if started.kind != "action" or event.dtype is None:
            self._nodes[event.sequence] = _Running(parent)
            return
        assert started.designator is not None
        assert event.declaration is not None
        fields = self._fields.get(started.designator)
        if fields is None:
            fields = self._fields[started.designator] = FeatureFields.of(event.declaration)
        symbols, numbers = situation(fields, event.parameters, started.robot, self._world)
        scope = self._scopes.get(parent) or _Scope()  # one that ended before all that it started has ended
        if scope.type is not None:
            symbols["inside"] = scope.type
        if scope.after is not None:
            symbols["after"], symbols["after_status"] = scope.after
        simulated = self._simulated or started.simulated
        action = _Action(
            event.sequence, event.dtype, event.time, event.monotonic_ns, parent, simulated, symbols, numbers
        )
        self._nodes[event.sequence] = _Running(event.sequence, action)
        self._scopes[event.sequence] = _Scope(event.dtype)

    def _ended(self, event: Event, ended: NodeEnded) -> list[Case]:
        running = self._nodes.pop(ended.node, None)
        if running is None or (action := running.action) is None:
            return []
        del self._scopes[ended.node]
        if (around := self._scopes.get(action.parent)) is not None:
            around.after = action.type, ended.status
        duration_s = (event.monotonic_ns - action.monotonic_ns) / 1e9 if ended.status != "LOST" else None
        reason = ended.failure.type.rpartition(".")[2] if ended.failure is not None else None
        return [self._case(event.number, action, ended.status, reason, duration_s)]

    def _case(self, number: int, action: _Action, status: str, reason: str | None, duration_s: float | None) -> Case:
        return Case(
            row_id(number, action.node, SLOT_NODE),
            action.time,
            action.type,
            action.symbols,
            action.numbers,
            status,
            reason,
            duration_s,
            row_id(number, action.parent, SLOT_NODE) if action.parent else None,
            action.simulated,
        )
