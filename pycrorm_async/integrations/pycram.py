"""`remember` records unmodified plans of PyCRAM: `with remember("sqlite:///memory.db"): plan.perform()`.

It observes PyCRAM from outside. PyCRAM's callbacks of plans report actions, motions and code; replaced methods report
what has no callback: actions that another action performs, expressions of the language, branches in threads, plans in
the prospection world, and changes of a Bullet world. All of them act only inside the block.

Theory of operation. Each thread has a stack of the nodes that run in it, because PyCRAM has one current node for all
threads and so loses nodes of parallel branches or assigns wrong parents. The stack of a branch begins with the
parallel node. That of a thread that the plan starts itself begins empty, so its first node is a child of the root.
PyCRAM has two nodes for an action: a description, and the resolved action. Only the resolved action is recorded, or the
description if it fails before. The first node in the prospection world opens a simulated episode, which ends with
PyCRAM's `with` block; in it, the copy of an object has the key of the original. An exception of this package's hooks is
counted and does not reach the plan.
"""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial, wraps
from inspect import Signature, signature
from pathlib import Path
from typing import Any, Final, Protocol

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import NodeStatus, SeenValue
from pycrorm_async.integrations.foreign_package import ForeignPackage
from pycrorm_async.integrations.pycram_values import MotionChange, PyCRAMEpisodes, PyCRAMValues, RunningNode
from pycrorm_async.memory import Memory
from pycrorm_async.record.declarations import DeclaredType, RecordedKind
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.settings import Settings, Writer

# === seams ====================================================================================================
#
# `Seams` replace methods of another library's classes, and restore them whichever way the block ends.


class _Observer(Protocol):
    seams: Seams


class Seams:
    """Replaces methods by seams, which act only while `is_on`, and adds callbacks; `remove` removes both.

    A method that another library has replaced in turn is not restored; the seam inside it then only calls the original.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.is_on = False
        self._undo = ExitStack()

    def remove(self) -> None:
        """Remove all seams; calls of them that other threads have begun record nothing from now on."""
        self.is_on = False
        self._undo.close()

    def around(self, owner: type, name: str, perform: Callable[..., Any]) -> None:
        """Call `perform(call, subject, *args)` in place of a method, where `call()` performs the method itself.

        An argument that the caller passes by name is passed to `perform` by position, unless it is keyword-only.
        """
        original = vars(owner)[name]
        parameters = signature(original)

        def seam(subject: Any, *args: Any, **kwargs: Any) -> Any:
            call = partial(original, subject, *args, **kwargs)
            if kwargs:
                args, kwargs = _by_position(parameters, subject, args, kwargs)
            return perform(call, subject, *args, **kwargs) if self.is_on else call()

        self._replace(owner, name, seam)

    def after(self, owner: type, name: str, report: Callable[..., Any]) -> None:
        """Call `report(subject, *args)` after a method has returned; named arguments are passed as in `around`."""
        original = vars(owner)[name]
        parameters = signature(original)

        def seam(subject: Any, *args: Any, **kwargs: Any) -> Any:
            result = original(subject, *args, **kwargs)
            if kwargs:
                args, kwargs = _by_position(parameters, subject, args, kwargs)
            if self.is_on:
                report(subject, *args, **kwargs)
            return result

        self._replace(owner, name, seam)

    def _replace(self, owner: type, name: str, method: Callable[..., Any]) -> None:
        original = vars(owner)[name]
        seam = wraps(original)(method)

        def restore() -> None:
            if vars(owner).get(name) is seam:
                setattr(owner, name, original)

        setattr(owner, name, seam)
        self._undo.callback(restore)

    def callback(self, add: Callable[[Any], None], remove: Callable[[Any], None], callback: Callable[..., Any]) -> None:
        """Add a callback; remove it with the seams, unless another library has removed it."""
        add(callback)
        self._undo.callback(_without_fault, remove, callback)


def _by_position(
    parameters: Signature, subject: Any, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Move named arguments to their positions; return them unchanged if they do not fit the method."""
    try:
        bound = parameters.bind(subject, *args, **kwargs)
    except TypeError:
        return args, kwargs
    return bound.args[1:], bound.kwargs


def _without_fault(remove: Callable[[Any], None], callback: Callable[..., Any]) -> None:
    with suppress(ValueError, KeyError):
        remove(callback)


def guarded(method: Callable[..., Any]) -> Callable[..., Any]:
    """Count the exceptions of an observer's method, so that none reaches the plan; skip it unless the seams are on."""

    @wraps(method)
    def call(self: _Observer, *args: Any, **kwargs: Any) -> Any:
        try:
            return method(self, *args, **kwargs) if self.seams.is_on else None
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self.seams.recording.note_fault(f"{type(self).__name__}.{method.__name__}", error)
            return None

    return call


# === pycram ===================================================================================================

KNOWN_VERSIONS: Final = ("1.0.4",)
"""The versions of the distribution `pycram-robotics` whose methods this module replaces."""
_PYCRAM: Final = ForeignPackage("PyCRAM", extra="pycram", versions=KNOWN_VERSIONS)
_SETTINGS: Final = Settings(fold="at_end", sync_interval_ms=250)
_ACTIVE: Final[dict[int, object]] = {}
"""The processes with an active `remember`: only one in each, because it replaces methods, also in a forked child."""


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
    and events are synced every 250 ms instead of 50, so a power loss can take more. Both leave the plan more time.

    Raises:
        MissingExtra: PyCRAM is not installed.
        CallerError: this version of PyCRAM is unknown, or another `remember` is active in this process.
        PycrormError: `Memory.open` raised it; no method of PyCRAM is replaced then.
    """
    _PYCRAM.check_version(_PYCRAM.installed_version("pycram-robotics"))
    process = os.getpid()
    if _ACTIVE.setdefault(process, token := object()) is not token:  # one call, so that no other thread comes between
        raise CallerError("another `remember` is active in this process: leave its block, or perform inside it")
    try:
        labels = {"description": description, "plan": plan, "seed": seed, "tags": tags, "metadata": metadata}
        with (
            Memory.sync(url, spool=spool, writer=writer, settings=settings or _SETTINGS) as memory,
            _PyCRAMPlans(memory.recording).observing(**labels) as episode,
        ):
            yield episode
    finally:
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
        failure: BaseException | None = None  # not `sys.exception()`: a block inside an `except` has that one
        with self._episodes.open(world, **labels) as episode:
            self._episodes.real, self.seams.is_on = episode, True
            try:
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
        # Asking Bullet for pose and torso takes as long as recording the event. In the real world motions never ask,
        # and other nodes only after a movement that no seam saw.
        is_recorded = episode is self._episodes.real and (self._world.is_followed or node.kind == "motion")
        robot = self._values.robot_key() if is_recorded else self._values.robot(episode)
        node.key = episode.start(next(self._keys), declared, values, parent=self._episodes.cause(episode), robot=robot)

    def _kind(self, designator: type) -> RecordedKind:
        if issubclass(designator, self._pycram.ActionDescription):
            return "action"
        return "motion" if issubclass(designator, self._pycram.BaseMotion) else "language"

    def _bases(self, designator: type) -> list[str]:
        """Return the dtypes of the actions that an action descends from, nearest first; for other designators, none."""
        base = self._pycram.ActionDescription
        return [each.__name__ for each in designator.__mro__[1:] if issubclass(each, base) and each is not base]

    def _end(
        self, node: RunningNode, status: NodeStatus, failure: BaseException | None = None, result: Any = None
    ) -> None:
        """End a node, and those inside it whose end PyCRAM did not report; a failure's class replaces `status`."""
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
            return call()  # recorded: the node that has just started is this action's
        return self._performed(call, action, "action")

    def _performed(self, call: Callable[[], Any], designator: Any, kind: RecordedKind = "language") -> Any:
        node = self._begin(designator, kind)
        if node is None:
            return call()
        self._parallel[id(designator)] = node
        before = getattr(designator, "reason", None)  # PyCRAM keeps the reason of an earlier call
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


# === pycram world =============================================================================================
#
# `PyCRAMWorld` records the objects of PyCRAM's Bullet worlds: poses, joints, attachments, also of worlds made later.
#
# PyCRAM sets joints one by one and each time moves the objects that the robot holds, so the changes of a motion are
# collected in its thread and recorded once, when the motion ends.


class PyCRAMWorld:
    """Observes the worlds of this process.

    Attributes:
        is_followed: whether seams saw each movement; False once physics or a restored state may have moved an object.
    """

    def __init__(self, seams: Seams, values: PyCRAMValues, episodes: PyCRAMEpisodes) -> None:
        self.seams = seams
        self._values = values
        self._episodes = episodes
        self.is_followed = True

    def connect(self) -> None:
        """Replace the methods that change a world."""
        used = self._values.pycram
        self.seams.after(used.World, "add_object", self._object_added)
        self.seams.around(used.World, "remove_object", self._remove_object)
        self.seams.after(used.BulletWorld, "reset_object_base_pose", self._object_moved)
        self.seams.after(used.BulletWorld, "_reset_joint_position", self._joint_moved)
        self.seams.around(used.Object, "set_multiple_joint_positions", self._joints_moved)
        for unseen in ("step", "set_realtime", "restore_physics_simulator_state"):
            self.seams.after(used.BulletWorld, unseen, self._moved_unseen)
        self.seams.after(used.Object, "attach", self._attached)
        self.seams.after(used.Object, "detach", self._detached)

    @guarded
    def _object_added(self, world: Any, added: Any) -> None:
        if (episode := self._episodes.of(world)) is not None:
            cause = self._episodes.cause(episode)
            episode.object_added(self._values.key(added), **self._values.description(added), node=cause)

    def _remove_object(self, call: Callable[[], Any], world: Any, *removed: Any, **_: Any) -> Any:
        key = self._key(*removed)  # first: the prospection world then forgets whose copy it is
        result = call()
        self._object_removed(world, key)
        return result

    @guarded
    def _key(self, removed: Any) -> Hashable:
        return self._values.key(removed)

    @guarded
    def _object_removed(self, world: Any, key: Any) -> None:
        self.flush()
        if (episode := self._episodes.of(world)) is not None and episode.reference(key) is not None:
            episode.object_removed(key, node=self._episodes.cause(episode))

    @guarded
    def _object_moved(self, world: Any, moved: Any, pose: Any) -> None:
        if self._episodes.of(world) is not None:
            self._change(moved).pose = self._values.pose(pose)
            self._flush_unless_moving()

    @guarded
    def _joint_moved(self, world: Any, joint: Any, position: float) -> None:
        thread, owner = self._episodes.thread, joint.object
        change = thread.changes.get(id(owner))
        if change is None:  # only for the first joint that this motion sets
            if self._episodes.of(world) is None:
                return
            change = self._change(owner)
        change.joints[joint.name] = float(position)
        if not thread.is_collecting:
            self._flush_unless_moving()

    def _joints_moved(self, call: Callable[[], Any], *_: Any, **__: Any) -> Any:
        """Record the joints that one call sets as one change, also outside a motion."""
        thread = self._episodes.thread
        is_outermost, thread.is_collecting = not thread.is_collecting, True
        try:
            return call()
        finally:
            if is_outermost:
                thread.is_collecting = False
                self._flush_unless_moving()

    def _change(self, changed: Any) -> MotionChange:
        changes = self._episodes.thread.changes
        change = changes.get(id(changed))
        if change is None:
            changes[id(changed)] = change = MotionChange(changed)
        return change

    @guarded
    def _moved_unseen(self, *_: Any, **__: Any) -> None:
        self.is_followed = False

    @guarded
    def _attached(self, parent: Any, child: Any, *_: Any, **__: Any) -> None:
        self.flush()
        if (episode := self._episodes.of(parent.world)) is not None:
            keys, link = (self._values.key(parent), self._values.key(child)), parent.attachments[child].parent_link.name
            episode.object_attached(*keys, link, node=self._episodes.cause(episode))

    @guarded
    def _detached(self, parent: Any, child: Any, *_: Any, **__: Any) -> None:
        self.flush()
        if (episode := self._episodes.of(parent.world)) is not None:
            keys = self._values.key(parent), self._values.key(child)
            episode.object_detached(*keys, node=self._episodes.cause(episode))

    def detected(self, node: RunningNode, result: Any) -> None:
        """Record the result of a detecting motion."""
        values, episode = self._values, node.episode
        seen = []
        for each in result:
            if isinstance(each, values.pycram.Object):
                row = episode.reference(values.key(each))
                seen.append(SeenValue(each.name, values.object_type(each), values.pose(each.pose), row))
        episode.detected(seen, node=node.key)

    @guarded
    def _flush_unless_moving(self) -> None:
        thread = self._episodes.thread
        if not thread.is_collecting and not (thread.nodes and thread.nodes[-1].kind == "motion"):
            self.flush()

    def flush(self) -> None:
        """Record the changes that this thread has made to the world since the last flush."""
        thread = self._episodes.thread
        if not thread.changes:
            return
        changes, thread.changes = thread.changes, {}
        for change in changes.values():
            episode, key = self._episodes.of(change.of.world), self._values.key(change.of)
            if episode is None or episode.reference(key) is None:
                continue
            cause = self._episodes.cause(episode)
            if change.pose is not None:
                episode.object_moved(key, change.pose, node=cause)
            if change.joints:
                episode.joints_moved(key, change.joints, node=cause)
