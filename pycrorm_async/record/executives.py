"""Record executives that tick or have run ids: `Activations`, `Runs`, and changes of values.

**Activations.** `Activations` records an executive that ticks: each activation of a behaviour or state is a node.

>>> with Activations(memory.recording, "my_executive 1.0", reader) as activations:
...     activations.begin_tick()
...     activations.visit(grasp, "busy", "closing")  # each behaviour after its tick, children before parents
...     activations.end_tick()

Theory of operation. A behaviour is visited after its tick, children before parents, so a composite starts with its
first child. An activation ends when the behaviour is not RUNNING any more. A behaviour that repeats its outcome, status
and feedback, at once, tick after tick, as a condition does, remains one node; so a tick that changes nothing writes
nothing, except that numbers of repeats are written now and then, so that a killed process loses few. `_pending` holds
behaviours that repeat their outcome after the activation of their parent has ended: the visit of the parent shows that
it repeats its outcome too, or a change shows that they belong to a new activation of it. An executive does not visit a
behaviour that it stops, so the open activations are searched for those that are not RUNNING any more, before each tick
and after a tick with a change.

**Runs.** `Runs` records an executive that names each run by an id, and that declares no types: an agent, a workflow
engine.

>>> with Runs(memory.recording, "my_engine 1.0", description="Bring milk") as runs:
...     runs.start("run 1", "action", "pick_up", {"object_name": "milk", "force_n": 5})
...     runs.end("run 1", result="picked milk")

**Value changes.** `ValueChanges` observes a store of values by key, as the blackboard of a behaviour tree: each change
once.

>>> changes = ValueChanges(lambda: blackboard, "blackboard/")
>>> blackboard["battery_v"] = 24.0
>>> changes.observe(episode)  # an observation `blackboard/battery_v`
>>> changes.observe(episode)  # none
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final, Generic, Self, TypeAlias, TypeVar

from pycrorm_async.events.types import NodeStatus
from pycrorm_async.record.declarations import FieldSpec, RecordedKind
from pycrorm_async.record.recorded_episode import FailureCause, RecordedEpisode
from pycrorm_async.record.recording import EpisodeBlock, Recording
from pycrorm_async.record.values import RefusedValue, json_text, plain_value, reading_fault

B = TypeVar("B")
NodeType: TypeAlias = tuple[RecordedKind, str, Mapping[str, FieldSpec]]
"""The kind, the dtype and the fields of a node, as for `Recording.type`."""

_KNOWN_MAX: Final = 10_000
"""Bounds the activations kept, because a program may replace subtrees; beyond it those that ended are dropped."""
_UNWRITTEN_TICKS: Final = 50
_UNWRITTEN_SHARE: Final = 0.1
"""Bound the repeats that a killed process loses: this many ticks, or this share of them, which keeps the events of a
tree that idles for a night few."""
_NO_STATUS: Final = object()
"""The status of an activation without a visit, or that was stopped; `None` may be one of the executive's own."""


@dataclass(frozen=True)
class BehaviourReader(Generic[B]):
    """The functions that read a behaviour of an executive, and its statuses. What one raises is counted as a fault.

    Attributes:
        node_type: the kind, the dtype and the fields of its nodes.
        parent: the behaviour that ticks it; None for the root.
        status, feedback: as for `Activations.visit`, of a behaviour that may have been stopped without a visit.
        statuses: for each of these statuses the one that is recorded, also `RUNNING`; ERROR for any other.
        parameter: the value of one of its fields; by default the attribute of this name.
        raised_by: the class of behaviours, to find the one whose method raised; None if no method of one is called.
    """

    node_type: Callable[[B], NodeType]
    parent: Callable[[B], B | None]
    status: Callable[[B], object]
    statuses: Mapping[Any, NodeStatus]
    feedback: Callable[[B], object] = lambda _behaviour: ""
    parameter: Callable[[B, str], object] = lambda behaviour, name: getattr(behaviour, name, None)
    raised_by: type[B] | None = None


class _Activation(Generic[B]):
    """An activation of a behaviour; `node` is its node in the episode.

    `ticks` counts the ticks of an open activation, then those that repeat its outcome, of which `written` are recorded.
    """

    __slots__ = ("behaviour", "feedback", "is_open", "node", "parent", "status", "ticks", "written")

    def __init__(self, behaviour: B, parent: _Activation[B] | None, node: Hashable) -> None:
        self.behaviour, self.parent, self.node = behaviour, parent, node
        self.status: object = _NO_STATUS
        self.is_open = True
        self.ticks = self.written = 0
        self.feedback = ""


class Activations(EpisodeBlock, Generic[B]):
    """Records the ticks of an executive while its `with` block is open, as one episode; RUNNING nodes end INTERRUPTED.

    The `result` of a node has its number of `ticks`; the last observation `repeated` of it has the number of further
    ticks with the same status and feedback. The feedback of a failed node is its message, that of a node that succeeded
    is in its `result`. If an exception of a behaviour leaves the block, that behaviour and its ancestors end with the
    exception. One thread ticks; no method raises.

    Args:
        executive, episode: see `EpisodeBlock`.
        instant_s: a tick of a behaviour that takes longer was work, which is a node even if the outcome is the same.
        observe: called with the episode after each tick and at the end; `ValueChanges.observe` for a blackboard.
    """

    def __init__(
        self,
        recording: Recording,
        executive: str,
        reader: BehaviourReader[B],
        *,
        instant_s: float = 0.05,
        observe: Callable[[RecordedEpisode], None] = lambda _episode: None,
        **episode: Any,
    ) -> None:
        super().__init__(recording, executive, **episode)
        self._reader, self._instant_s, self._observe = reader, instant_s, observe

    def __enter__(self) -> Self:
        self._latest: dict[int, _Activation[B]] = {}
        self._open: dict[int, _Activation[B]] = {}
        self._pending: list[_Activation[B]] = []
        self._visited_s, self._changed, self._ticks = 0.0, False, 0
        return super().__enter__()

    def __exit__(self, kind: object, error: BaseException | None, frames: object) -> None:
        self._guarded(self._end_all, error)
        super().__exit__(kind, error, frames)

    def begin_tick(self) -> None:
        """End what was stopped since the last tick; call it before the executive begins the next one."""
        self._pending.clear()
        self._guarded(self._end_stopped)
        self._visited_s = perf_counter()

    def visit(self, behaviour: B, status: object, feedback: object = "") -> None:
        """Visit a behaviour that was ticked, after those below it.

        The same object is the same behaviour. A hundred visits that change nothing take about 30 µs of CPU time.

        Args:
            status: its status, one of the executive's own.
            feedback: its message about the outcome. A visit with another message is another outcome.
        """
        try:
            visited_s = perf_counter()
            took_s, self._visited_s = visited_s - self._visited_s, visited_s
            latest = self._latest.get(id(behaviour))
            if latest is not None and (latest.status is status or latest.status == status):
                if latest.is_open:
                    latest.ticks += 1
                    return
                is_same = feedback is latest.feedback or str(feedback or "") == latest.feedback
                if is_same and took_s < self._instant_s:
                    parent = latest.parent
                    if parent is None or parent.is_open:
                        latest.ticks += 1
                        for each in self._pending:
                            each.ticks += 1
                        self._pending.clear()
                        return
                    if self._latest.get(id(parent.behaviour)) is parent:
                        self._pending.append(latest)
                        return
            self._changed = True
            pending, self._pending = self._pending, []
            for each in pending:
                self._record(each.behaviour, each.status)
            self._record(behaviour, status)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a tick
            self._recording.note_fault(self._executive, error)

    def end_tick(self) -> None:
        """End a tick."""
        if self._changed:
            self._changed = False
            self._guarded(self._end_stopped)
        self._guarded(self._observe, self.episode)
        self._ticks += 1
        if self._ticks % _UNWRITTEN_TICKS == 0:
            for each in self._latest.values():
                if each.ticks - each.written > each.ticks * _UNWRITTEN_SHARE:
                    self._put_repeated(each)

    def only_node(self, is_meant: Callable[[B], bool]) -> Hashable | None:
        """Return the last node of the only behaviour that is meant, for `RecordedEpisode`; None if there are others."""
        meant = [each.node for each in self._latest.values() if is_meant(each.behaviour)]
        return meant[0] if len(meant) == 1 else None

    def _guarded(self, method: Callable[..., None], *arguments: Any) -> None:
        try:
            method(*arguments)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a tick
            self._recording.note_fault(self._executive, error)

    def _record(self, behaviour: B, status: object) -> None:
        activation = self._enter(behaviour)
        activation.ticks += 1
        recorded = self._reader.statuses.get(status, "ERROR")
        if recorded != "RUNNING":
            self._end(activation, recorded)
        activation.status = status

    def _enter(self, behaviour: B) -> _Activation[B]:
        """Return the open activation of a behaviour; start it, and those above it, if there is none."""
        latest = self._latest.get(id(behaviour))
        if latest is not None:
            if latest.is_open:
                return latest
            self._put_repeated(latest)
        elif len(self._latest) >= _KNOWN_MAX:
            for each in [each for each in self._latest.values() if not each.is_open]:
                self._put_repeated(self._latest.pop(id(each.behaviour)))
        above = self._reader.parent(behaviour)
        parent = self._enter(above) if above is not None else None
        node: Hashable = id(behaviour)
        if not self.episode.is_open(node):  # it is open if Ctrl-C came directly after its start was written
            kind, dtype, fields = self._reader.node_type(behaviour)
            declared, parameters = self._recording.type(kind, dtype, fields), self._parameters(behaviour, fields)
            node = self.episode.start(node, declared, parameters, parent=parent.node if parent else None)
        activation = self._latest[id(behaviour)] = self._open[id(behaviour)] = _Activation(behaviour, parent, node)
        return activation

    def _end(
        self, activation: _Activation[B], status: NodeStatus | None, failure: BaseException | str | None = None
    ) -> None:
        """End an activation. Children that the executive stopped without visiting end first, as INTERRUPTED."""
        for child in [each for each in reversed(self._open.values()) if each.parent is activation]:
            self._end(child, "INTERRUPTED")
        feedback, result = self._feedback(activation.behaviour), dict[str, Any](ticks=activation.ticks)
        activation.feedback = feedback
        if feedback and status == "SUCCEEDED":
            result["feedback"] = feedback
        elif feedback and failure is None:
            failure = feedback
        self.episode.end(id(activation.behaviour), status, failure, result)
        del self._open[id(activation.behaviour)]
        activation.is_open, activation.ticks = False, 0
        activation.status = _NO_STATUS  # if it was stopped, its next tick is a new activation, with any status

    def _end_stopped(self) -> None:
        read_status = self._reader.status
        changed = [each for each in self._open.values() if read_status(each.behaviour) is not each.status]
        for each in reversed(changed):
            if each.is_open and self._reader.statuses.get(read_status(each.behaviour)) != "RUNNING":
                self._end(each, "INTERRUPTED")

    def _end_all(self, error: BaseException | None) -> None:
        raised_by = _raised_by(error, self._reader.raised_by)
        raising = self._enter(raised_by) if raised_by is not None else None
        above = set()
        while raising is not None:
            above.add(raising)
            raising = raising.parent
        for each in reversed(list(self._open.values())):
            if each in above:
                self._end(each, None, error)
            elif each.is_open:
                self._end(each, "INTERRUPTED")
        self._observe(self.episode)
        for each in self._latest.values():
            self._put_repeated(each)

    def _put_repeated(self, activation: _Activation[B]) -> None:
        if activation.ticks > activation.written and not activation.is_open:
            activation.written = activation.ticks
            self.episode.observe("repeated", {"ticks": activation.ticks}, node=activation.node)

    def _parameters(self, behaviour: B, names: Iterable[str]) -> dict[str, object]:
        values: dict[str, object] = {}
        for name in names:
            try:
                values[name] = self._reader.parameter(behaviour, name)
            except Exception as error:  # noqa: BLE001  a property may raise anything
                values[name] = RefusedValue(reading_fault(error))
        return values

    def _feedback(self, behaviour: B) -> str:
        try:
            return str(self._reader.feedback(behaviour) or "")
        except Exception as error:  # noqa: BLE001  a property may raise anything
            return reading_fault(error)


def _raised_by(error: BaseException | None, behaviour_class: type[B] | None) -> B | None:
    """Return the innermost behaviour whose method the error left; None if there is none."""
    raised_by = None
    if error is not None and behaviour_class is not None:
        for frame, _line in traceback.walk_tb(error.__traceback__):
            if isinstance(behaviour := frame.f_locals.get("self"), behaviour_class):
                raised_by = behaviour
    return raised_by


# === runs =====================================================================================================

_NUMBERS: Final[Mapping[type, FieldSpec]] = {bool: "boolean", int: "real", float: "real"}
"""Field types of inputs that are not text. A program writes the same real number as 1 and as 1.0."""


class Runs(EpisodeBlock):
    """Records the runs that are reported while its `with` block is open, from any thread, as one episode.

    Some events of a run may go elsewhere, so a parent or a run that is not open is no fault. Models of pydantic,
    dataclasses, and mappings and sequences of them are recorded as dicts and lists.

    Attributes:
        episode: its keys of nodes are the ids of runs.
    """

    def __init__(self, recording: Recording, executive: str, **episode: Any) -> None:
        converted = {"convert": lambda value: plain_value(value, self.simplified), **episode}
        super().__init__(recording, executive, **converted)

    def start(
        self,
        run_id: Hashable,
        kind: RecordedKind,
        dtype: str,
        inputs: Mapping[str, Any] = {},
        *,
        parent: Hashable | None = None,
    ) -> None:
        """Record that a run started, below its parent if that is open.

        Args:
            inputs: the parameters. A number has a `real` field, a truth value a `boolean` one, all others a `text`,
                which is JSON unless they are texts; an input that is None declares no field.
        """
        inputs = {name: value for name, value in inputs.items() if value is not None}
        fields = {name: _NUMBERS.get(type(value), "text") for name, value in inputs.items()}
        parameters = {
            name: value if isinstance(value, str | int | float) else json_text(value, self.simplified)
            for name, value in inputs.items()
        }
        declared = self._recording.type(kind, dtype, fields)
        self.episode.start(run_id, declared, parameters, parent=parent if self.episode.is_open(parent) else None)

    def end(
        self,
        run_id: Hashable,
        status: NodeStatus | None = None,
        failure: FailureCause | None = None,
        result: Any = None,
    ) -> None:
        """Record that a run ended, if it is open; see `RecordedEpisode.end`."""
        if self.episode.is_open(run_id):
            self.episode.end(run_id, status, failure, result)

    def observe(self, name: str, values: Any, run_id: Hashable | None = None) -> None:
        """Record an observation of a run; of the episode if the run is not open."""
        node = run_id if self.episode.is_open(run_id) else None
        self.episode.observe(name, values, node=node)

    def simplified(self, value: Any) -> Any:
        """Return the scalar, dict or list that is recorded for a value; override it for classes with parts of no use.

        It is not called for a scalar, dict or list, but for each value inside one.
        """
        return value


# === value changes ============================================================================================


class ValueChanges:
    """Compares the values of a store with those that it saw last. A change inside a value is not noticed.

    Args:
        values: returns the values of the store now.
        prefix: precedes the key in the name of an observation.
        is_observed: returns whether changes of a key are recorded.
        node: returns the key of the node that has changed a key; None for the root.
    """

    def __init__(
        self,
        values: Callable[[], Mapping[str, Any]],
        prefix: str = "",
        *,
        is_observed: Callable[[str], bool] = lambda _key: True,
        node: Callable[[str], Hashable | None] = lambda _key: None,
    ) -> None:
        self._read, self._prefix, self._is_observed, self._node = values, prefix, is_observed, node
        self._episode: RecordedEpisode | None = None
        self._values: dict[str, Any] = {}

    def observe(self, episode: RecordedEpisode) -> None:
        """Record each value that is new in this episode or has changed, and None for each that was removed.

        Raises what the functions of the store raise; the other changes are not recorded then.
        """
        if episode is not self._episode:
            self._episode, self._values = episode, {}
        values = self._read()
        if _are_equal(values, self._values):
            return
        before, self._values = self._values, dict(values)
        for key in {**before, **self._values}:
            value = self._values.get(key)  # None after it was removed
            if not _are_equal(value, before.get(key)) and self._is_observed(key):
                episode.observe(f"{self._prefix}{key}", value, node=self._node(key))


def _are_equal(value: object, other: object) -> bool:
    try:
        return value is other or bool(value == other)
    except Exception:  # noqa: BLE001  arrays have no truth value; a user's __eq__ may raise anything
        return False
