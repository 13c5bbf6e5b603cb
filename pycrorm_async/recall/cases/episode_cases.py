"""Make a case (`recall.case`) of each action of one episode when it ends: its situation at the start, its outcome.

>>> cases: list[Case] = []
>>> EpisodeCases().read(events, declarations.get, cases)

The fold is pure, and its memory grows with the nodes that run and the objects in the world. Besides the features of
`situation` a case has `inside`, the type of the nearest action around it, and `after` and `after_status`, type and
status of the action that ended last inside the same action. All features are known before the action runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, TypeAlias

from pycrorm_async.bulk_records import make
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
from pycrorm_async.projections.custom.episode_folds import Refused
from pycrorm_async.projections.fold.column_values import is_missing, row
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
        node: id of its node.
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

    def case(self, status: str, reason: str | None = None, duration_s: float | None = None) -> Case:
        """Return its case."""
        scope = self.scope
        parent = scope.node if scope is not None else None
        outcome = status, reason, duration_s, parent, self.simulated
        return make(Case, (self.node, self.time_us, self.type, self.symbols, self.numbers, *outcome))


class EpisodeCases:
    """The cases of one episode, from its first event on.

    Args:
        types: the feature fields by fingerprint, which the folds of several episodes share.
    """

    def __init__(self, types: dict[str, FeatureFields] | None = None) -> None:
        self._types = {} if types is None else types
        self._world = WorldFold()
        self._running: dict[int, _Action] = {}
        """The actions that run."""
        self._scopes: dict[int, _Action] = {}
        """The nearest action around each other node that runs, without those outside any."""
        self._after: tuple[str, str] | None = None
        self._simulated = False

    def read(self, events: Iterable[StoredEvent], declaration_of: DeclarationOf, cases: list[Case]) -> Refused | None:
        """Apply the next events, of the types in `READS`; append the cases of the actions that they end to `cases`.

        Returns the first event that cannot be folded, with the exception; those behind it are not applied.
        """
        for event in events:
            try:
                happening = happening_of(event)
                if isinstance(happening, NodeStarted):
                    self._start(event, happening, declaration_of)
                elif isinstance(happening, NodeEnded):
                    action = self._running.pop(happening.node, None)
                    if action is not None:
                        cases.append(self._end(action, happening, event.monotonic_ns))
                    else:
                        self._scopes.pop(happening.node, None)
                elif isinstance(happening, EpisodeStarted):
                    self._simulated = happening.simulated
                elif isinstance(happening, EpisodeEnded):
                    if happening.status == "LOST":
                        cases += [each.case("LOST") for each in self._running.values()]
                    self._running.clear()
                    self._scopes.clear()
                else:
                    self._world.read(event.sequence, happening)
            except Exception as fault:  # noqa: BLE001 - of a payload of any content; the caller parks the episode
                return event.sequence, fault
        return None

    def _start(self, event: StoredEvent, started: NodeStarted, declaration_of: DeclarationOf) -> None:
        number, sequence, _, _, wall_ns, monotonic_ns, payload = event
        parent = started.parent
        scope = self._running.get(parent) or self._scopes.get(parent) if parent is not None else None
        fields = None
        if started.kind == "action" and started.designator is not None:
            fields = self._types.get(started.designator)
            if fields is None and (declaration := declaration_of(started.designator)) is not None:
                fields = self._types[started.designator] = FeatureFields.of(declaration)
        if fields is None:
            if scope is not None:
                self._scopes[sequence] = scope
            return
        parameters = started.parameters
        if b'"missing"' in payload:
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
        self._running[sequence] = _Action(
            row(number, sequence),
            wall_ns // 1000,
            monotonic_ns,
            fields.dtype,
            scope,
            symbols,
            numbers,
            simulated,
        )

    def _end(self, action: _Action, ended: NodeEnded, monotonic_ns: int) -> Case:
        status, failure = ended.status, ended.failure
        action.has_ended = True
        if action.scope is None:
            self._after = action.type, status
        else:
            action.scope.after = action.type, status
        duration_s = (monotonic_ns - action.monotonic_ns) / 1e9 if status != "LOST" else None
        reason = failure.type.rpartition(".")[2] if failure is not None else None
        return action.case(status, reason, duration_s)
