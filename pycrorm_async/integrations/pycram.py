"""`remember` records unmodified plans of PyCRAM: `with remember("sqlite:///memory.db"): plan.perform()`.

It observes PyCRAM from outside. PyCRAM's callbacks of plans report actions, motions and code; replaced methods report
what has no callback: actions that another action performs, expressions of the language, branches in threads, plans in
the prospection world, and changes of a Bullet world. Leaving the block removes all of them.

Theory of operation. Each thread has a stack of the nodes that run in it, because PyCRAM has one current node for all
threads and so loses nodes of parallel branches or assigns wrong parents. The stack of a branch begins with the
parallel node; that of a thread that the plan starts itself is empty, so its first node is a child of the root. PyCRAM
has two nodes for an action, a description and what it resolves to; only the latter is recorded, unless the description
fails before it is resolved. The first node in the prospection world opens a simulated episode, which ends with PyCRAM's
`with` block; objects have their real keys in it. An exception of this package is counted and does not reach the plan.
"""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from pycrorm_async.errors import CallerError
from pycrorm_async.events.values import NodeStatus
from pycrorm_async.integrations.foreign_package import ForeignPackage
from pycrorm_async.integrations.pycram_episodes import PyCRAMEpisodes, RunningNode
from pycrorm_async.integrations.pycram_values import PyCRAMValues
from pycrorm_async.integrations.pycram_world import PyCRAMWorld
from pycrorm_async.integrations.seams import Seams, guarded
from pycrorm_async.memory import Memory
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.declarations.recorded_type import RecordedKind
from pycrorm_async.recording.recorded_episode import RecordedEpisode
from pycrorm_async.recording.recording import Recording
from pycrorm_async.settings import Settings, Writer

__all__ = ["KNOWN_VERSIONS", "remember"]

KNOWN_VERSIONS: Final = ("1.0.4",)
"""The versions of the distribution `pycram-robotics` whose methods this module replaces."""
_PYCRAM: Final = ForeignPackage("PyCRAM", extra="pycram", versions=KNOWN_VERSIONS)
_SETTINGS: Final = Settings(fold="at_end", sync_interval_ms=250)
_ACTIVE: Final[dict[int, object]] = {}
"""The active `remember` by process id: it replaces methods of the whole process; a forked child may have its own."""


@contextmanager
def remember(
    url: str,
    *,
    description: str = "a PyCRAM plan",
    plan: str | None = None,
    seed: int | None = None,
    tags: Sequence[str] = (),
    metadata: Mapping[str, Any] = {},
    spool: Path | str | None = None,
    writer: Writer | None = None,
    settings: Settings | None = None,
) -> Iterator[RecordedEpisode]:
    """Record the PyCRAM plans that any thread performs in this block, as one episode of the memory at this URL.

    The arguments are those of `Memory.open` and `Memory.episode`. By default the tables are made when the block ends,
    and events are synced every 250 ms instead of 50, which a power loss can take: both leave more time to the plan.

    Raises:
        MissingExtra: PyCRAM is not installed.
        CallerError: this version of PyCRAM is unknown, or another `remember` is active in this process.
        PycrormError: `Memory.open` raised it; no method of PyCRAM is replaced then.
    """
    _PYCRAM.check_version(_PYCRAM.installed_version("pycram-robotics"))
    process, this = os.getpid(), object()
    try:  # before `this` becomes the active one, because Ctrl-C may come directly after that
        if _ACTIVE.setdefault(process, this) is not this:
            raise CallerError("another `remember` is active in this process: leave its block, or perform inside it")
        labels = {"description": description, "plan": plan, "seed": seed, "tags": tags, "metadata": metadata}
        with (
            Memory.sync(url, spool=spool, writer=writer, settings=settings or _SETTINGS) as memory,
            _PyCRAMPlans(memory.recording).observing(**labels) as episode,
        ):
            yield episode
    finally:
        if process in _ACTIVE and _ACTIVE[process] is this:  # no call, so Ctrl-C cannot come before the next line
            del _ACTIVE[process]


class _PyCRAMPlans:
    """Observes the plans of this process."""

    def __init__(self, recording: Recording) -> None:
        self.seams = Seams(recording)
        self._values = PyCRAMValues()
        self._pycram = self._values.pycram
        self._episodes = PyCRAMEpisodes(recording, self._values)
        self._world = PyCRAMWorld(self.seams, self._values, self._episodes)
        self._thread = self._episodes.thread
        self._keys = itertools.count(1)
        self._types: dict[type, DeclaredType] = {}
        self._parallel: dict[int, RunningNode] = {}

    @contextmanager
    def observing(self, **labels: Any) -> Iterator[RecordedEpisode]:
        """Record an episode until the block ends."""
        world = self._pycram.World.current_world
        failure: BaseException | None = None  # not `sys.exception()`, which has one also if the block is in an `except`
        with self._episodes.open(world, **labels) as episode:
            self._episodes.real, self.seams.is_on = episode, True
            try:
                self._prepare_types()
                self._connect()
                self._add_world(world)
                yield episode
            except BaseException as error:
                failure = error
                raise
            finally:
                self._end_simulation(failure)
                self.seams.remove()
                if self._episodes.is_interruption(failure):
                    episode.close(failure, "INTERRUPTED")

    def _connect(self) -> None:
        plan, used, seams = self._pycram.Plan, self._pycram, self.seams
        seams.callback(plan.add_on_start_callback, plan.remove_on_start_callback, self._node_started)
        seams.callback(plan.add_on_end_callback, plan.remove_on_end_callback, self._node_ended)
        seams.around(plan, "perform", self._whole_plan)
        seams.around(used.ActionDescription, "perform", self._nested_action)
        sequences = (used.SequentialNode, used.TryInOrderNode, used.RepeatNode, used.MonitorNode)
        for expression in (*sequences, used.ParallelNode, used.TryAllNode):
            seams.around(expression, "perform", self._performed)
        seams.around(used.ParallelNode, "_lang_call", self._branch)
        seams.around(used.UseProspectionWorld, "__exit__", self._leave_prospection)
        self._world.connect()

    @guarded
    def _prepare_types(self) -> None:
        """Prepare the types of all imported designators, which is too slow to be done during the plan."""
        for designator in self._values.designators:
            fields, bases = self._values.expected_fields(designator), self._bases(designator)
            self.seams.recording.prepare(self._kind(designator), _dtype(designator), fields, bases=bases)

    @guarded
    def _add_world(self, world: Any) -> None:
        self._episodes.add_world(self._episodes.real, world)

    # --- nodes ------------------------------------------------------------------------------------------------

    @guarded
    def _node_started(self, node: Any) -> None:
        used, nodes = self._pycram, self._thread.nodes
        if isinstance(node, used.ActionNode):
            nodes.append(RunningNode(node, self._episodes.present(), "action", is_description=True))
        elif isinstance(node, used.ResolvedActionNode):
            if nodes:
                nodes[-1].is_description = False
            self._start(node, "action", node.designator_ref)
        elif isinstance(node, used.MotionNode):
            self._start(node, "motion", node.designator_ref)
        elif isinstance(node, used.CodeNode):
            self._start(node, "language", node)

    @guarded
    def _node_ended(self, node: Any) -> None:
        for started in reversed(self._thread.nodes):
            if started.of is node:
                break
        else:
            return
        statuses = self._pycram.TaskStatus
        if node.status is statuses.SUCCEEDED:
            self._end(started, "SUCCEEDED", None, node.result)
        else:  # PyCRAM handles plan failures only: after any other exception the node is still RUNNING
            failure = node.reason if node.status is statuses.FAILED else sys.exception()
            self._end(started, "FAILED", failure)

    def _start(self, of: Any, kind: RecordedKind, designator: Any) -> RunningNode:
        self._world.flush()
        values, type_ = self._values.parameters(designator), type(designator)
        node = RunningNode(of, self._episodes.present(), kind)
        self._write_start(node, type_, values)
        self._thread.nodes.append(node)
        return node

    def _write_start(self, node: RunningNode, type_: type, values: dict[str, Any]) -> None:
        declared = self._types.get(type_)
        if declared is None:
            fields, bases = self._values.field_types(type_, values), self._bases(type_)
            declared = self._types[type_] = self.seams.recording.type(node.kind, _dtype(type_), fields, bases=bases)
        episode = node.episode
        # Asking Bullet for pose and torso takes as long as recording the event, so it is done where they may differ.
        is_recorded = episode is self._episodes.real and (self._world.is_followed or node.kind == "motion")
        robot = self._values.robot_key() if is_recorded else self._values.robot(episode)
        node.key = episode.start(next(self._keys), declared, values, parent=self._episodes.cause(episode), robot=robot)

    def _kind(self, designator: type) -> RecordedKind:
        if issubclass(designator, self._pycram.ActionDescription):
            return "action"
        return "motion" if issubclass(designator, self._pycram.BaseMotion) else "language"

    def _bases(self, designator: type) -> list[str]:
        """Return the dtypes of the actions that an action descends from, nearest first; none for another type."""
        base = self._pycram.ActionDescription
        return [each.__name__ for each in designator.__mro__[1:] if issubclass(each, base) and each is not base]

    def _end(
        self, node: RunningNode, status: NodeStatus, failure: BaseException | None = None, result: Any = None
    ) -> None:
        """End a node, and those inside it whose end PyCRAM did not report; a failure's class decides the status."""
        self._world.flush()
        nodes = self._thread.nodes
        by_failure: NodeStatus | None = "CANCELLED" if self._episodes.is_interruption(failure) else None
        while nodes and (inner := nodes.pop()) is not node:
            if inner.key is not None:
                inner.episode.end(inner.key, by_failure or "ERROR", failure)
        if node.is_description and status != "SUCCEEDED":
            self._write_start(node, node.of.action, self._values.options(node.of))
        if node.key is not None:
            if type(getattr(node.of, "designator_ref", None)).__name__ == "DetectingMotion" and result:
                self._world.detected(node, result)
            node.episode.end(node.key, status if failure is None else by_failure, failure, result)

    def _whole_plan(self, call: Callable[[], Any], _plan: Any) -> Any:
        """Perform a plan, and end the nodes that a callback of another library kept PyCRAM from ending."""
        running, failure = len(self._thread.nodes), None
        try:
            return call()
        except BaseException as error:
            failure = error
            raise
        finally:
            if len(self._thread.nodes) > running:
                self._end_unreported(self._thread.nodes[running], failure)

    @guarded
    def _end_unreported(self, node: RunningNode, failure: BaseException | None) -> None:
        self._end(node, "ERROR", failure)

    def _nested_action(self, call: Callable[[], Any], action: Any) -> Any:
        nodes = self._thread.nodes
        if nodes and getattr(nodes[-1].of, "designator_ref", None) is action:
            return call()  # of the node that has just started
        return self._performed(call, action, "action")

    def _performed(self, call: Callable[[], Any], designator: Any, kind: RecordedKind = "language") -> Any:
        node = self._begin(designator, kind)
        if node is None:
            return call()
        self._parallel[id(designator)] = node
        before = getattr(designator, "reason", None)  # PyCRAM keeps the outcome of an earlier call
        try:
            result = call()
        except BaseException as failure:
            self._finish(node, failure)
            raise
        finally:
            self._parallel.pop(id(designator), None)
        self._finish(node, None, result, before)
        return result

    @guarded
    def _begin(self, designator: Any, kind: RecordedKind) -> RunningNode:
        return self._start(designator, kind, designator)

    @guarded
    def _finish(self, node: RunningNode, failure: BaseException | None, result: Any = None, before: Any = None) -> None:
        status, reason = getattr(node.of, "status", None), getattr(node.of, "reason", None)
        has_failed = status is self._pycram.TaskStatus.FAILED and (before is None or reason is not before)
        if failure is not None or has_failed:
            self._end(node, "FAILED", failure if failure is not None else reason)
        elif status is self._pycram.TaskStatus.INTERRUPTED:
            self._end(node, "INTERRUPTED")
        else:
            self._end(node, "SUCCEEDED", None, result)

    def _branch(self, call: Callable[[], Any], parallel: Any, _child: Any) -> Any:
        """Perform a branch below the parallel node, in the thread of the branch."""
        nodes, node = self._thread.nodes, self._parallel.get(id(parallel))
        running = len(nodes)
        nodes += [node] if node is not None else []
        try:
            return call()
        finally:
            del nodes[running:]

    def _leave_prospection(self, call: Callable[[], Any], context: Any, *exception: Any) -> Any:
        is_outermost = context.prev_world is not None
        result = call()
        if is_outermost:
            self._end_simulation(exception[1])
        return result

    @guarded
    def _end_simulation(self, failure: BaseException | None) -> None:
        self._world.flush()
        self._episodes.end_simulation(failure)


def _dtype(designator: type) -> str:
    return designator.__name__.removesuffix("Node")
