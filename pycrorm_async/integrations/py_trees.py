"""`RememberedTree` records a behaviour tree of py_trees: each activation of a behaviour is a node of the task tree.

>>> with Memory.sync(url, settings=Settings(fold="at_end")) as memory, RememberedTree(tree, memory.recording):
...     tree.tick_tock(period_ms=20)

Theory of operation. A visitor sees a behaviour after its tick, children before parents, so a composite starts with its
first child. An activation ends when the behaviour is not RUNNING any more. A behaviour that repeats its outcome, status
and feedback, at once, tick after tick, as a condition does, remains one node; so a tick that changes nothing writes
nothing, except that numbers of repeats are written now and then, so that a killed process loses few. `_pending` holds
behaviours that repeat their outcome after the activation of their parent has ended: the visit of the parent shows that
it repeats its outcome too, or a change shows that they belong to a new activation of it. py_trees does not visit a
behaviour that it stops, so the visitor searches the open activations for those that are not RUNNING any more, before
each tick and after a tick with a change.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Hashable, Mapping
from time import perf_counter
from types import TracebackType
from typing import Any, Final

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.events.values import NodeStatus
from pycrorm_async.recording.declarations.recorded_type import FieldSpec, RecordedKind
from pycrorm_async.recording.recorded_episode import RecordedEpisode
from pycrorm_async.recording.recording import Recording
from pycrorm_async.recording.values.texts import reading_fault
from pycrorm_async.recording.values.value_snapshot import RefusedValue

try:
    from py_trees.behaviour import Behaviour
    from py_trees.blackboard import Blackboard
    from py_trees.common import Status
    from py_trees.composites import Composite
    from py_trees.decorators import Decorator
    from py_trees.trees import BehaviourTree
    from py_trees.version import __version__
    from py_trees.visitors import VisitorBase
except ModuleNotFoundError as missing:
    raise MissingExtra(f"py_trees is not installed ({missing}): pip install 'pycrorm-async[py_trees]'") from None

__all__ = ["RememberedTree"]

_RUNNING: Final = Status.RUNNING
_STATUSES: Final[Mapping[Any, NodeStatus]] = {Status.SUCCESS: "SUCCEEDED", Status.FAILURE: "FAILED"}
_KNOWN_MAX: Final = 10_000
"""Bounds the activations kept, because a program may replace subtrees; beyond it those that ended are dropped."""
_UNWRITTEN_TICKS: Final = 50
_UNWRITTEN_SHARE: Final = 0.1
"""Bound the repeats that a killed process loses: this many ticks, or this share of them, which keeps the events of a
tree that idles for a night few."""


class _Activation:
    """An activation of a behaviour; `node` is its node in the episode.

    `ticks` counts the ticks of an open activation, then those that repeat its outcome, of which `written` are recorded.
    """

    __slots__ = ("behaviour", "feedback", "is_open", "node", "parent", "status", "ticks", "written")

    def __init__(self, behaviour: Behaviour, parent: _Activation | None, node: Hashable) -> None:
        self.behaviour, self.parent, self.node = behaviour, parent, node
        self.status: Status | None = None
        self.is_open = True
        self.ticks = self.written = 0
        self.feedback = ""


class RememberedTree(VisitorBase):
    """Records the ticks of a tree in a `with` block as one episode; nodes that are RUNNING at its end are INTERRUPTED.

    The block gets the `RecordedEpisode`. A node's `result` has its number of `ticks`; the last observation `repeated`
    of it has the number of further ticks with the same status and feedback.

    Args:
        fields: for a class of behaviours, the attributes that are recorded as parameters, and their types.
        blackboard: returns whether changes of a key are recorded. A change inside a value is not noticed.
        instant_s: a tick of a behaviour that takes longer was work, which is a node even if the outcome is the same.
        episode: the arguments of `Recording.episode`.

    Raises:
        CallerError: the version of py_trees is unknown.
    """

    def __init__(
        self,
        tree: BehaviourTree,
        recording: Recording,
        *,
        fields: Mapping[type[Behaviour], Mapping[str, FieldSpec]] = {},
        blackboard: Callable[[str], bool] = lambda _key: True,
        instant_s: float = 0.05,
        **episode: Any,
    ) -> None:
        if not __version__.startswith("2."):
            raise CallerError(f"py_trees {__version__} is unknown; run `pip install 'py_trees>=2.2,<3'`")
        super().__init__(full=False)
        self._tree, self._recording, self._fields = tree, recording, fields
        self._is_observed, self._instant_s = blackboard, instant_s
        own = {"description": f"behaviour tree {tree.root.name}", "metadata": {"executive": f"py_trees {__version__}"}}
        self._arguments: dict[str, Any] = own | episode

    def __enter__(self) -> RecordedEpisode:
        self._latest: dict[int, _Activation] = {}
        self._open: dict[int, _Activation] = {}
        self._pending: list[_Activation] = []
        self._values: dict[str, Any] = {}
        self._visited_s, self._changed, self._ticks = 0.0, False, 0
        self._episode = self._recording.episode(**self._arguments)
        self._tree.add_visitor(self)
        return self._episode

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, frames: TracebackType | None
    ) -> None:
        if self in self._tree.visitors:
            self._tree.visitors.remove(self)
        self._guarded(self._end_all, error)
        self._episode.close(error)

    def initialise(self) -> None:
        """Begin a tick."""
        self._pending.clear()
        self._guarded(self._end_stopped)
        self._visited_s = perf_counter()

    def run(self, behaviour: Behaviour) -> None:
        """Visit a behaviour that was ticked."""
        before, self._visited_s = self._visited_s, perf_counter()
        latest = self._latest.get(id(behaviour))
        if latest is not None and latest.status is behaviour.status:
            if latest.is_open:
                latest.ticks += 1
                return
            parent = latest.parent
            if self._visited_s - before >= self._instant_s or _feedback(behaviour) != latest.feedback:
                pass
            elif parent is None or parent.is_open:
                latest.ticks += 1
                if self._pending:
                    for each in self._pending:
                        each.ticks += 1
                    self._pending.clear()
                return
            elif self._latest.get(id(parent.behaviour)) is parent:
                self._pending.append(latest)
                return
        self._guarded(self._visit, behaviour)

    def finalise(self) -> None:
        """End a tick."""
        if self._changed:
            self._changed = False
            self._guarded(self._end_stopped)
        self._guarded(self._observe_blackboard)
        self._ticks += 1
        if self._ticks % _UNWRITTEN_TICKS == 0:
            for each in self._latest.values():
                if each.ticks - each.written > each.ticks * _UNWRITTEN_SHARE:
                    self._put_repeated(each)

    def _guarded(self, method: Callable[..., None], *arguments: Any) -> None:
        try:
            method(*arguments)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a tick
            self._recording.note_fault("py_trees", error)

    def _visit(self, behaviour: Behaviour) -> None:
        self._changed = True
        pending, self._pending = self._pending, []
        for each in pending:
            self._record(each.behaviour, each.status)
        self._record(behaviour, behaviour.status)

    def _record(self, behaviour: Behaviour, status: Status | None) -> None:
        activation = self._enter(behaviour)
        activation.status = status
        activation.ticks += 1
        if status is not _RUNNING:
            self._end(activation, _STATUSES.get(status, "ERROR"))

    def _enter(self, behaviour: Behaviour) -> _Activation:
        """Return the open activation of a behaviour; start it, and those above it, if there is none."""
        latest = self._latest.get(id(behaviour))
        if latest is not None:
            if latest.is_open:
                return latest
            self._put_repeated(latest)
        elif len(self._latest) >= _KNOWN_MAX:
            for each in [each for each in self._latest.values() if not each.is_open]:
                self._put_repeated(self._latest.pop(id(each.behaviour)))
        is_child = behaviour.parent is not None and behaviour is not self._tree.root
        parent = self._enter(behaviour.parent) if is_child else None
        kind: RecordedKind = "language" if isinstance(behaviour, Composite | Decorator) else "action"
        fields = {"name": "text", **self._fields.get(type(behaviour), {})}
        declared = self._recording.type(kind, type(behaviour).__name__, fields)
        parameters = {name: _read(behaviour, name) for name in fields}
        node = self._episode.start(id(behaviour), declared, parameters, parent=parent.node if parent else None)
        activation = self._latest[id(behaviour)] = self._open[id(behaviour)] = _Activation(behaviour, parent, node)
        return activation

    def _end(
        self, activation: _Activation, status: NodeStatus | None, failure: BaseException | str | None = None
    ) -> None:
        """End an activation, after those below it, which py_trees stopped without a visit."""
        for child in [each for each in reversed(self._open.values()) if each.parent is activation]:
            self._end(child, "INTERRUPTED")
        feedback, result = _feedback(activation.behaviour), dict[str, Any](ticks=activation.ticks)
        activation.feedback = feedback
        if feedback and status == "SUCCEEDED":
            result["feedback"] = feedback
        elif feedback and failure is None:
            failure = feedback
        self._episode.end(id(activation.behaviour), status, failure, result)
        del self._open[id(activation.behaviour)]
        activation.is_open, activation.ticks = False, 0
        if activation.status is _RUNNING:  # py_trees stopped it, so its next tick is a new activation
            activation.status = None

    def _end_stopped(self) -> None:
        stopped = [each for each in self._open.values() if each.behaviour.status is not _RUNNING]
        for each in reversed(stopped):
            if each.is_open:
                self._end(each, "INTERRUPTED")

    def _end_all(self, error: BaseException | None) -> None:
        """End the open nodes; with the error, the behaviour that raised it and those above that one."""
        raised_in = None
        for frame, _line in traceback.walk_tb(error.__traceback__ if error is not None else None):
            if isinstance(behaviour := frame.f_locals.get("self"), Behaviour):
                raised_in = behaviour
        raising = self._enter(raised_in) if raised_in is not None else None
        above = set()
        while raising is not None:
            above.add(raising)
            raising = raising.parent
        for each in reversed(list(self._open.values())):
            if each in above:
                self._end(each, None, error)
            elif each.is_open:
                self._end(each, "INTERRUPTED")
        self._observe_blackboard()
        for each in self._latest.values():
            self._put_repeated(each)

    def _put_repeated(self, activation: _Activation) -> None:
        if activation.ticks > activation.written and not activation.is_open:
            activation.written = activation.ticks
            self._episode.observe("repeated", {"ticks": activation.ticks}, node=activation.node)

    def _observe_blackboard(self) -> None:
        if _are_equal(Blackboard.storage, self._values):
            return
        before, self._values = self._values, dict(Blackboard.storage)
        for key in {**before, **self._values}:
            value = self._values.get(key)  # None after it was removed
            if not _are_equal(value, before.get(key)) and self._is_observed(key):
                self._episode.observe(f"blackboard{key}", value, node=self._writer(key))

    def _writer(self, key: str) -> Hashable:
        """Return the node of the only behaviour that may write a key; None if there are others."""
        key_access = Blackboard.metadata.get(key)
        clients = key_access.write | key_access.exclusive if key_access is not None else ()
        writers = [
            each.node
            for each in self._latest.values()
            if any(client.id() in clients for client in each.behaviour.blackboards)
        ]
        return writers[0] if len(writers) == 1 else None


def _read(behaviour: Behaviour, name: str) -> Any:
    try:
        return getattr(behaviour, name, None)
    except Exception as error:  # noqa: BLE001  a property may raise anything
        return RefusedValue(reading_fault(error))


def _feedback(behaviour: Behaviour) -> str:
    try:
        return str(behaviour.feedback_message or "")
    except Exception as error:  # noqa: BLE001  a property may raise anything
        return reading_fault(error)


def _are_equal(value: object, other: object) -> bool:
    try:
        return value is other or bool(value == other)
    except Exception:  # noqa: BLE001  arrays have no truth value; a user's __eq__ may raise anything
        return False
