"""Make a case (`recall.case`) of each action of one episode when it ends: its situation at the start, its outcome.

>>> cases = EpisodeCases()
>>> [case for event in events for case in cases.read(event, declarations.get)]

The fold is pure, and its memory grows with the nodes that run and the objects in the world. Besides the features of
`situation` a case has `inside`, the type of the nearest action around it, and `after` and `after_status`, type and
status of the action that ended last inside the same action. All features are known before the action runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from pycrorm_async.bulk_records import make
from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
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
from pycrorm_async.projections.fold.column_values import is_missing, microseconds
from pycrorm_async.projections.fold.fold import happening_of
from pycrorm_async.projections.fold.world_fold import WorldFold
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.cases.situation import FeatureFields, Numbers, Symbols, situation
from pycrorm_async.store.stored import StoredEvent

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


DeclarationOf: TypeAlias = Callable[[str], DesignatorTypeDeclared | None]
"""Returns the designator type of a fingerprint; None if it was never declared, or by a newer version."""


@dataclass(slots=True)
class _Action:
    """An action that runs, with the situation in which it started.

    Attributes:
        scope: the nearest action around it; None outside any.
        after: type and status of the action that ended last inside it.
    """

    node: int
    time_us: int
    monotonic_ns: int
    type: str
    scope: _Action | None
    symbols: Symbols
    numbers: Numbers
    simulated: bool
    after: tuple[str, str] | None = None
    has_ended: bool = False

    def case(self, number: int, status: str, reason: str | None = None, duration_s: float | None = None) -> Case:
        """Return its case in the episode of this number."""
        node, parent = row_id(number, self.node, SLOT_NODE), None
        if self.scope is not None:
            parent = row_id(number, self.scope.node, SLOT_NODE)
        situation = self.time_us, self.type, self.symbols, self.numbers
        return make(Case, (node, *situation, status, reason, duration_s, parent, self.simulated))


class EpisodeCases:
    """The cases of one episode, event by event.

    Args:
        types: the feature fields by fingerprint, which the folds of several episodes share.
    """

    def __init__(self, types: dict[str, FeatureFields] | None = None) -> None:
        self._types = {} if types is None else types
        self._world = WorldFold()
        self._scopes: dict[int, _Action | None] = {}
        """The nearest action of each node that runs, itself included; None outside any."""
        self._after: tuple[str, str] | None = None
        self._simulated = False

    def read(self, event: StoredEvent, declaration_of: DeclarationOf) -> Sequence[Case]:
        """Apply the next event; return the cases of the actions that it ends. Raises `CannotFold`."""
        match happening_of(event):
            case NodeStarted() as started:
                self._start(event, started, declaration_of)
            case NodeEnded() as ended:
                return self._end(event, ended)
            case EpisodeStarted(simulated=simulated):
                self._simulated = simulated
            case EpisodeEnded(status=status):
                running = [each for node, each in self._scopes.items() if each is not None and each.node == node]
                self._scopes.clear()
                return [each.case(event.number, status) for each in running] if status == "LOST" else ()
            case happening:
                self._world.read(event.sequence, happening)
        return ()

    def _start(self, event: StoredEvent, started: NodeStarted, declaration_of: DeclarationOf) -> None:
        node = event.sequence
        scope = self._scopes.get(started.parent) if started.parent is not None else None
        self._scopes[node] = scope
        if started.kind != "action" or started.designator is None:
            return
        fields = self._types.get(started.designator)
        if fields is None:
            declaration = declaration_of(started.designator)
            if declaration is None:
                return
            fields = self._types[started.designator] = FeatureFields.of(declaration)
        parameters = started.parameters
        if b'"missing"' in event.payload:
            parameters = {name: each for name, each in parameters.items() if not is_missing(each)}
        symbols, numbers = situation(fields, parameters, started.robot, self._world)
        after = self._after
        if scope is not None:
            after = scope.after
            if scope.has_ended:  # before this branch of it, so nothing in it came before
                after = None
            else:
                symbols["inside"] = scope.type
        if after is not None:
            symbols["after"], symbols["after_status"] = after
        simulated = self._simulated or started.simulated
        self._scopes[node] = _Action(
            node,
            microseconds(event.wall_ns),
            event.monotonic_ns,
            fields.dtype,
            scope,
            symbols,
            numbers,
            simulated,
        )

    def _end(self, event: StoredEvent, ended: NodeEnded) -> Sequence[Case]:
        action = self._scopes.pop(ended.node, None)
        if action is None or action.node != ended.node:
            return ()
        action.has_ended = True
        if action.scope is None:
            self._after = action.type, ended.status
        else:
            action.scope.after = action.type, ended.status
        duration_s = (event.monotonic_ns - action.monotonic_ns) / 1e9 if ended.status != "LOST" else None
        reason = ended.failure.type.rpartition(".")[2] if ended.failure is not None else None
        return (action.case(event.number, ended.status, reason, duration_s),)
