"""The hooks of our own plan layer: the `Recorder` receives the reports of plans and worlds, and writes their episodes.

Theory of operation. The plan layer and the world call the recorder synchronously, in the thread and context of the
plan. `current_episode` holds the episode of a context. It is used only if it is open in this memory and if it is a
simulation exactly when the context is in one, so that no simulated event gets into a real episode. A node that starts
without an episode opens an implicit one, which ends with the node; that node's context then sees the implicit episode
until the node ends.

A plan that runs without a memory also runs with one, because the recorder catches and counts every exception of its
own. Only the caller's settings let an exception reach a plan, and only before `perform` runs: `SpoolFull` with
`on_full="fail"`; `Unrecordable` and `DeclarationRefused` with `on_unrecordable="refuse"`. Without these settings, a
value that cannot be recorded is recorded as missing.

`node_ended` may also run in a thread and context of the garbage collector, when it closes a plan that was dropped
unfinished, and between any two bytecodes of that thread. So it resets `current_episode` only if the context still holds
the node's episode, and it takes no lock.
"""

from __future__ import annotations

import inspect
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import asynccontextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial, wraps
from typing import Any, Final, Literal, NamedTuple, ParamSpec, TypeVar

from pycrorm_async import errors
from pycrorm_async.connected_var import set_inside
from pycrorm_async.events import types as event_types
from pycrorm_async.plan.execution import CalledPerforms, Search, Seen, Simulation, called_performs, current_simulation
from pycrorm_async.plan.execution import recorder as plan_observer
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.plan.task import TaskTreeNode, current_node
from pycrorm_async.record import episode_writer, values
from pycrorm_async.record.camera import put_image
from pycrorm_async.record.objects import ObjectRows
from pycrorm_async.record.opening import EpisodeOpening, current_task
from pycrorm_async.record.plan_types import Declarations
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import brief_pose, clean, encode_or_missing, read_parameters
from pycrorm_async.world.bullet import BulletWorld, Object, current_world
from pycrorm_async.world.pose import ObjectType, Pose
from pycrorm_async.world.world_copy import acting_robot, counterpart, related

current_episode: ContextVar[Episode | None] = ContextVar("current_episode", default=None)
"""The innermost episode opened in this context; it may be closed already."""


class NodeRecord(NamedTuple):
    """The hooks' record of a running node, kept as `TaskTreeNode.record`.

    Attributes:
        episode: the episode that recorded the node.
        sequence: sequence of the node's NodeStarted; its id.
        implicit: whether the episode was opened for this node alone and ends with it.
        outer_episode: the current episode of the context before the node started.
        poses: the poses in parameters of this node and of those around it, each with a reference to it.
    """

    episode: Episode
    sequence: int
    implicit: bool
    outer_episode: Episode | None
    poses: values.KnownPoses = ()


class Episode(episode_writer.EpisodeWriter):
    """An open or closed episode of our own plan layer.

    Attributes:
        task: the asyncio task that opened the episode; None outside any task.
        world: the recorder of its world; None if there is no world.
        faults: faults of the plan, each type once: performs that were never awaited.
        calls: performs called in the episode's context.
    """

    def __init__(self, recording: Recording, opening: EpisodeOpening) -> None:
        super().__init__(recording.emitter, recording.episodes.new_id(), opening)
        self.task = current_task()
        self.world: WorldRecorder | None = None
        self.frozen_poses: Final = values.FrozenPoses(Pose)
        self.faults: tuple[str, ...] = ()
        self.calls: Final = CalledPerforms(self._note_unawaited)
        self._entered_world: str | None = None

    def enter_world(self, world: BulletWorld) -> None:
        """Record this world from now on. A second world at the same time is not recorded, but counted as missing."""
        if self.world is None:
            self.world = WorldRecorder(self, world)
        elif self.world.world is not world:
            self.emitter.missing.note("Episode", "second world", f"{self} records only the world entered first")

    @property
    def acts_in_recorded_world(self) -> bool:
        """True if the current world of this context is the recorded world, not a second one."""
        return self.world is not None and current_world.get() in (None, self.world.world)

    def leave_world(self, world: BulletWorld, *, emptied: bool) -> None:
        """Stop recording this world; with `emptied`, record first that all its objects were removed."""
        if self.world is not None and self.world.world is world:
            if self._opening.world is None:
                self._entered_world = episode_writer.episode_text_of(world.description)
            if emptied:
                self.world.empty()
            self.world.stop()
            self.world = None

    def reference(self, world_object: Object, /) -> event_types.ObjectReference | None:
        """Return the object's current row in this episode; None if there is no row."""
        return self.world.reference(world_object) if self.world is not None else None

    def node_reference(self, node: TaskTreeNode | None) -> event_types.NodeReference:
        """Return a reference to this node, or to its nearest recorded ancestor; without a node, to the root."""
        return event_types.NodeReference(str(self), self.node_or_root(node))

    def end_episode(self, failure: BaseException | None, world: str | None = None) -> None:
        """Write the end of the episode, after reporting performs that were never awaited."""
        if not self.closed:
            self.calls.close()
        if self.world is not None:
            self.leave_world(self.world.world, emptied=False)
        super().end_episode(failure, world or self._entered_world)

    def _note_unawaited(self, designator: type[Designator]) -> None:
        self.emitter.note_unawaited(designator.__dtype__)
        fault = f"{designator.__dtype__}.perform() was called and never awaited"
        if fault not in self.faults:
            self.faults = (*self.faults[1 - episode_writer.UNAWAITED_MAX :], fault)

    def node_or_root(self, node: TaskTreeNode | None, /) -> int:
        """Return the sequence of this node or of its nearest recorded ancestor; without a node, that of the root."""
        while node is not None:
            record: NodeRecord | None = node.record
            if record is not None and record.episode is self:
                return record.sequence
            node = node.parent
        return self.nodes.root

    def sequence_of(self, node: TaskTreeNode | None) -> int | None:
        """Return the sequence of this node or of its nearest recorded ancestor; None if there is none."""
        sequence = self.node_or_root(node)
        return sequence if sequence != self.nodes.root else None

    def robot_state(self) -> episode_writer.ActingRobot | None:
        """Return the state of the robot that acts in this context; None if no robot acts, or in a second world."""
        if self.world is None:
            return None
        if not self.acts_in_recorded_world:
            self.emitter.missing.note("Episode", "robot of a second world", "the episode records only the first world")
            return None
        try:
            return self.world.robot()
        except Exception as error:  # noqa: BLE001  the node is recorded without the robot's state
            self.emitter.note_fault("robot state", error)
            return None


class Recorder:
    """Implements the plan layer's `PlanObserver` and the world's `WorldWatcher` for one memory."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._emitter = emitter = recording.emitter
        self.episodes = recording.episodes
        self._strict = emitter.settings.on_unrecordable == "refuse"
        self._declarations = Declarations(recording.known_types, strict=self._strict)
        self._sampler = Sampler(emitter) if emitter.settings.sample_interval_ms is not None else None
        self._kept: set[tuple[str, str]] = set()
        self._pose_fields: dict[type, tuple[tuple[str, int], ...]] = {}
        self.calls = CalledPerforms(lambda designator: emitter.note_unawaited(getattr(designator, "__dtype__", "it")))
        """Performs called outside any episode."""

    @property
    def is_closed(self) -> bool:
        """True if the memory is closed, or belongs to the process that forked this one."""
        return self._emitter.is_closed

    # --- episodes ---------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def episode(self, **opening: Any) -> AsyncIterator[Episode]:
        """Record an episode in this context; the arguments are those of `open_episode`."""
        if (room := self.admit()) is not None:
            await room
        episode = self.open_episode(**opening)
        failure: BaseException | None = None
        with set_inside(current_episode, episode), set_inside(called_performs, episode.calls):
            try:
                yield episode
            except BaseException as raised:
                failure = raised
                raise
            finally:
                self.close_episode(episode, failure)

    def open_episode(self, *, description: str, **arguments: Any) -> Episode:
        """Open an episode in this context; `close_episode` ends it. `Recording.opening` has the arguments.

        Raises `EpisodeRefused` if this task has an open episode, `CallerError` for an argument that does not fit.
        """
        open_episode = self.episode_here()
        if open_episode is not None and open_episode.task is current_task():
            raise errors.EpisodeRefused(
                f"episode {open_episode} is open in this task already: end it first, or open the other in its own task"
            )
        simulation, world = current_simulation.get(), current_world.get()
        record = simulation.record if simulation is not None else None
        opening = self._recording.opening(
            description,
            world=world.description if world else None,
            simulated=simulation is not None,
            thought_by=record.node if isinstance(record, _SimulationRecord) else None,
            **arguments,
        )
        episode = Episode(self._recording, opening)
        self.episodes.add(episode)  # first, so that the memory ends an episode whose start Ctrl-C interrupted
        try:
            episode.open()
        except errors.FilesError as error:  # of a disk that failed meanwhile: the plan goes on and is not recorded
            self._emitter.note_fault("EpisodeStarted", error)
        except Exception:
            self.episodes.by_id.pop(episode.id, None)
            raise
        if world is not None:
            episode.enter_world(world)
        return episode

    def close_episode(self, episode: episode_writer.EpisodeWriter, failure: BaseException | None) -> None:
        """Write the end of an episode that `failure` left, or None. Exceptions are counted, not raised."""
        if self._sampler is not None and not self._emitter.is_closed:
            self._guarded("StateSampled", self._sampler.stop_episode, episode)
        self.episodes.close(episode, failure)

    @property
    def samples_left_out(self) -> int:
        """The number of samples omitted because the spool or the episode had no room."""
        return self._sampler.omitted if self._sampler is not None else 0

    def close(self) -> None:
        """Stop the sampler and report performs that were never awaited."""
        self.calls.close()
        if self._sampler is not None:
            self._sampler.close()

    def episode_here(self) -> Episode | None:
        """Return the open episode of this memory in this context; None if only one of the two is a simulation."""
        episode = current_episode.get()
        if episode is None or episode.closed or episode.id not in self.episodes.by_id:
            return None
        return episode if episode.simulated is (current_simulation.get() is not None) else None

    # --- the port of the plan layer ----------------------------------------------------------------------------------

    def admit(self) -> Awaitable[None] | None:
        sink = self._emitter.sink
        if not sink.full or self._emitter.is_closed or not self._emitter.must_wait():
            return None
        return sink.room()

    def node_started(self, node: TaskTreeNode) -> None:
        designator, emitter = node.designator, self._emitter
        assert designator is not None
        if emitter.is_closed:
            emitter.note_unrecorded(designator.__dtype__)
            return
        outer_episode = current_episode.get()
        implicit: Episode | None = None
        try:
            kind = type(designator)
            declared = self._declarations.declared.get(kind) or self._declarations.of(kind, emitter.put_declaration)
            episode = self.episode_here()
            if episode is None:
                dtype = declared.dtype
                episode = implicit = self.open_episode(description=dtype, plan=dtype)
            missing: dict[str, str] = {}
            parameters = read_parameters(designator, declared.fields, episode, missing)
            robot = episode.robot_state() if episode.world is not None else None
            around: NodeRecord | None = node.parent.record if node.parent is not None else None
            poses = around.poses if around is not None and around.episode is episode else ()
            fields = self._pose_fields.get(kind)
            if fields is None:
                fields = self._pose_fields[kind] = values.pose_fields(declared.declaration.fields)
            whole = dict(parameters) if emitter.feed.observers else None
            if fields and poses:
                values.name_known(parameters, fields, poses)
            above = episode.node_or_root(node.parent)
            sequence = episode.nodes.start(
                declared, node.kind, above, parameters, robot, missing, whole=whole, may_refuse=True
            )
            if fields:
                poses = values.with_own(poses, parameters, fields, sequence)
        except BaseException as error:
            if implicit is not None:
                self.close_episode(implicit, error)
            if isinstance(error, errors.Unrecordable | errors.DeclarationRefused) or not isinstance(error, Exception):
                raise
            emitter.note_fault("NodeStarted", error)  # a fault of the memory must not reach a plan
            return
        node.record = NodeRecord(episode, sequence, implicit is not None, outer_episode, poses)
        if implicit is not None:
            current_episode.set(implicit)
        if declared.fault is not None:
            emitter.missing.note(declared.dtype, "type", declared.fault)
        if self._sampler is not None and node.kind == "motion" and episode.acts_in_recorded_world:
            self._guarded("StateSampled", self._sampler.begin, episode, sequence)

    def node_ended(self, node: TaskTreeNode) -> None:
        record: NodeRecord | None = node.record
        if record is None or self._emitter.is_closed:
            return
        episode, sequence = record.episode, record.sequence
        if self._sampler is not None and node.kind == "motion":
            self._guarded("StateSampled", self._sampler.end, episode, sequence)
        try:
            failure = episode.failures.copy(node.failure, episode) if node.failure is not None else None
            result = encode_or_missing(node.result, episode) if node.result is not None else None
            episode.nodes.end(sequence, node.status._value_, failure, result)  # `value` takes 0.1 µs longer
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("NodeEnded", error)
        if record.implicit:
            self.close_episode(episode, node.failure)
            if current_episode.get() is episode:  # the garbage collector may close the plan in another context
                current_episode.set(record.outer_episode)

    def location_resolved(self, search: Search) -> None:
        self._in_episode("LocationResolved", lambda episode: _put_location(episode, search))

    def object_detected(self, **percepts: Any) -> None:
        self._in_episode("ObjectDetected", lambda episode: _put_percepts(episode, **percepts))

    def simulation_started(self, simulation: Simulation) -> None:
        if self._emitter.is_closed:
            return
        outer = current_episode.get()
        simulation.record = record = _SimulationRecord(
            outer.node_reference(simulation.by) if outer is not None else None, outer
        )
        current_episode.set(None)  # so that no simulated event gets into the outer episode if this one cannot start
        by = simulation.by.designator if simulation.by is not None else None
        description = simulation.description
        if description is None:
            description = f"simulation in {by.__dtype__}" if by is not None else "simulation"

        def start() -> None:
            record.episode = self.open_episode(description=description)
            current_episode.set(record.episode)

        self._guarded("EpisodeStarted", start)

    def simulation_ended(self, simulation: Simulation, failure: BaseException | None) -> None:
        record: _SimulationRecord | None = simulation.record
        if record is None:
            return
        if record.episode is not None:
            self.close_episode(record.episode, failure)
        if current_episode.get() is record.episode:  # the garbage collector may close the plan in another context
            current_episode.set(record.outer_episode)

    # --- the port of the world ---------------------------------------------------------------------------------------

    def world_entered(self, world: BulletWorld) -> None:
        self._in_episode("entering a world", lambda episode: episode.enter_world(world))

    def world_left(self, world: BulletWorld) -> None:
        if (episode := self.episode_here()) is not None:
            episode.leave_world(world, emptied=True)

    # --- observations of a program -----------------------------------------------------------------------------------

    def observe(self, name: str, values: object, *, node: TaskTreeNode | None) -> None:
        """Record values under this name. Raises `Unrecordable` with `on_unrecordable="refuse"` only.

        A thread without the plan's context, such as the callback of a sensor, observes for the episode that this memory
        opened last.
        """
        if self.is_closed:
            self._emitter.note_unrecorded(f"the observation {episode_writer.name_of(name)}")
            return
        self._guarded("Observed", lambda: self._observe(name, values, node, may_refuse=True))

    def record_image(self, name: str, node: TaskTreeNode | None, image: object) -> bool:
        """Record an image as an observation in the episode that is open here, if one is; return whether it did."""
        episode, acting = self._observer(node)
        return episode is not None and put_image(episode, name, image, episode.node_or_root(acting))

    def keep(self, name: str, key: str, content: Callable[[], event_types.Blob]) -> None:
        """Record a content that nodes name by this key, once for all episodes of the memory.

        Outside an episode nothing is recorded; the next call tries again, also where the spool had no room.
        """
        if not self.is_closed and (name, key) not in self._kept and self.episode_here() is not None:
            self._guarded("Observed", self._keep, name, key, content)

    def _keep(self, name: str, key: str, content: Callable[[], event_types.Blob]) -> None:
        if self._observe(name, {key: content()}, None, may_refuse=False):
            self._kept.add((name, key))

    def _observe(self, name: str, values: object, node: TaskTreeNode | None, *, may_refuse: bool) -> int:
        """Return the sequence of the event; 0 if it was counted as missing."""
        episode, acting = self._observer(node)
        if episode is None:
            self._emitter.missing.note("observation", episode_writer.name_of(name), "no episode is open")
            return 0
        at = episode.node_or_root(acting)
        return episode_writer.put_observation(episode, name, values, at, may_refuse=may_refuse)

    def _observer(self, node: TaskTreeNode | None) -> tuple[episode_writer.EpisodeWriter | None, TaskTreeNode | None]:
        """Return the open episode that observes here, and its node; with `node`, those of this node."""
        if node is not None:
            record: NodeRecord | None = node.record
            return record.episode if record is not None and record.episode.id in self.episodes.by_id else None, node
        if (own := self.episode_here()) is not None:
            return own, current_node.get()
        return self.episodes.last_opened(), None

    # --- inside -----------------------------------------------------------------------------------------------

    def _in_episode(self, event_type: str, write: Callable[[Episode], object]) -> None:
        episode = self.episode_here()
        if episode is not None and not self._emitter.is_closed:
            self._guarded(event_type, write, episode)

    def _guarded(self, event_type: str, step: Callable[..., object], *arguments: object) -> None:
        """Call a step; a fault of the memory is counted and does not reach the plan."""
        try:
            step(*arguments)
        except errors.Unrecordable:
            raise
        except Exception as error:  # noqa: BLE001  counted
            self._emitter.note_fault(event_type, error)


def observing() -> Recorder | None:
    """Return the recorder of the memory that records this context; None if there is no open memory."""
    observer = plan_observer.get()
    return observer if isinstance(observer, Recorder) else None


@dataclass
class _SimulationRecord:
    """The hooks' record of a running simulation.

    Attributes:
        node: the node that runs the simulation; None outside any recorded episode.
        outer_episode: the current episode of the context before the simulation began.
        episode: the simulation's own episode; None if it could not start.
    """

    node: event_types.NodeReference | None
    outer_episode: Episode | None
    episode: Episode | None = None


_P = ParamSpec("_P")
_T = TypeVar("_T")


def with_tree(plan: Callable[_P, Coroutine[Any, Any, _T]]) -> Callable[_P, Coroutine[Any, Any, _T]]:
    """Record each call of a plan as one episode in the open memory, unless an episode is open already.

    >>> @with_tree
    ... async def plan():
    ...     with simulated_robot:
    ...         await ParkArmsActionPerformable(Arms.BOTH).perform()
    >>> await plan()

    The episode is named by the first line of the plan's docstring, or else by its name. Without an open memory the plan
    is only performed. Raises `CallerError` for a function that is not `async def`.
    """
    if not inspect.iscoroutinefunction(plan):
        raise errors.CallerError(f"with_tree needs an `async def`, got {plan!r:.100}")
    named_plan = plan.func if isinstance(plan, partial) else plan
    name = named_plan.__name__
    description = (inspect.getdoc(named_plan) or name).partition("\n")[0]

    @wraps(plan)
    async def performed(*arguments: _P.args, **named: _P.kwargs) -> _T:
        own = plan_observer.get()
        if not isinstance(own, Recorder) or own.is_closed or own.episode_here() is not None:
            return await plan(*arguments, **named)
        async with own.episode(description=description, plan=name):
            return await plan(*arguments, **named)

    return performed


# === episode events ===========================================================================================
#
# Write the events of resolved locations and of perception from values of the plan.


def _put_location(episode: Episode, search: Search) -> None:
    location, cells = clean(search.location), search.cells
    event = event_types.LocationResolved(
        location=location,
        offered=tuple(
            event_types.CandidateValue(
                brief_pose(each.pose),
                tuple(arm.name for arm in each.arms),
                each.grasp.name if each.grasp is not None else None,
                each.torso_height,
            )
            for each in search.offered
        ),
        taken=search.taken,
        considered=search.considered,
        node=episode.sequence_of(search.node),
        refused=tuple(event_types.RefusalValue(brief_pose(each.pose), clean(each.reason)) for each in search.refused),
        offered_beyond=search.offered_beyond,
        cells=event_types.CellsValue(cells.occupied, cells.hidden, cells.free) if cells is not None else None,
    )
    episode.events.put(event, location)


def _put_percepts(
    episode: Episode,
    *,
    source: Literal["camera", "world_state"],
    object_type: ObjectType | None,
    seen: Sequence[Seen],
    node: TaskTreeNode | None,
) -> None:
    percepts = tuple(_seen_value(each, episode) for each in seen)
    searched = object_type.name if object_type is not None else None
    episode.events.put(event_types.ObjectDetected(source, searched, percepts, episode.sequence_of(node)))


def _seen_value(seen: Seen, references: Episode) -> event_types.SeenValue:
    thing = seen.thing
    world_object = thing.world_object if isinstance(thing, ObjectDesignator) else thing
    return event_types.SeenValue(  # perception often computes numbers of numpy
        clean(thing.name),
        thing.object_type.name,
        brief_pose(seen.pose if seen.pose is not None else thing.pose),
        references.reference(world_object) if world_object is not None else None,
        float(seen.visible) if seen.visible is not None else None,
        float(seen.confidence) if seen.confidence is not None else None,
        clean(seen.source) if seen.source is not None else None,
    )


# === world recorder ===========================================================================================
#
# The `WorldRecorder` turns changes of one world into events of one episode and keeps each object's current row.
#
# Theory of operation. The world calls its observer synchronously from its setters, in the thread of the plan. Each call
# builds one event and puts it into the queue at once, so the values are those of that moment and the events have the
# order of the changes. The rows of the objects, and what happens if an event cannot be written, are those of
# `ObjectRows`.
#
# The recorder starts with `ObjectAdded` and `ObjectAttached` for the present state of the world.


class WorldRecorder(ObjectRows[Object]):
    """Observes one world for one episode; the constructor records the present state of the world.

    Attributes:
        world: the observed world.
        sampled: for each robot, the last sampled value of each channel in this episode.
    """

    def __init__(self, episode: Episode, world: BulletWorld) -> None:
        super().__init__(episode)
        self.world = world
        self.sampled: dict[Object, dict[str, float]] = {}
        self._poses: dict[Object, tuple[Pose, event_types.BriefPose]] = {}
        self._acting: dict[
            Object, tuple[Pose, float | None, event_types.ObjectReference | None, episode_writer.ActingRobot]
        ] = {}
        for each in world.objects:
            self.object_added(each)
        for each in world.objects:
            for child, link in each.attachments.items():
                self.object_attached(each, child, link)
        world.observe(self)

    def empty(self) -> None:
        """Record that all objects were removed, because the world was closed."""
        for each in tuple(self._references):
            self.object_removed(each)

    def stop(self) -> None:
        """Stop observing the world; `reference` still works."""
        self.world.unobserve(self)

    def reference(self, world_object: Object) -> event_types.ObjectReference | None:
        """Return the current row of this object, or of its counterpart if it is in a copy of this world; else None."""
        row = self._references.get(world_object)
        if row is None and world_object.world is not self.world and related(world_object.world, self.world):
            local_object = counterpart(world_object, self.world)
            row = self._references.get(local_object) if local_object is not None else None
        return row

    def robot(self) -> episode_writer.ActingRobot | None:
        """Return base pose and torso height of the robot that acts in this context; None if there is no robot."""
        robot = acting_robot(self.world)
        if robot is None:
            return None
        pose, row = robot.pose, self._references.get(robot)
        description = robot.robot_description
        torso = description.torso_joint if description is not None else None
        height = robot.joint_position(torso) if torso is not None else None
        made_of = self._acting.get(robot)
        if made_of is not None and made_of[0] is pose and made_of[1] == height and made_of[2] is row:
            return made_of[3]
        state = event_types.RobotValue(
            self._value_of(robot, pose), robot.object_type._name_, height, row, clean(robot.name)
        )
        acting = self.acting(state)
        self._acting[robot] = pose, height, row, acting
        return acting

    def _value_of(self, world_object: Object, pose: Pose) -> event_types.BriefPose:
        """Copy the pose of an object, once for the event of its motion and the nodes that start there."""
        recorded = self._poses.get(world_object)
        if recorded is None or recorded[0] is not pose:
            self._poses[world_object] = recorded = pose, brief_pose(pose)
        return recorded[1]

    # --- the world's observer ---------------------------------------------------------------------------------

    def object_added(self, added: Object) -> None:
        self._put(
            lambda: event_types.ObjectAdded(
                clean(added.name),
                added.object_type.name,
                self._value_of(added, added.pose),
                dict(added.joint_positions()),
                self._causing_node(),
                self._emitter.descriptions.declare(added),
                _color(added),
                *_model(added),
                added.mass_kg,
                clean(added.base_link) or None,
            ),
            row_of=added,
        )

    def object_removed(self, removed: Object) -> None:
        self._acting.pop(removed, None)
        self._poses.pop(removed, None)
        self._put_removed(removed, self._causing_node())

    def object_moved(self, moved: Object) -> None:
        reference = self._references.get(moved)
        if reference is None:
            return
        self._put(
            lambda: event_types.ObjectMoved(
                reference.object,
                clean(moved.name),
                moved.object_type.name,
                self._value_of(moved, moved.pose),
                self._causing_node(),
            ),
            row_of=moved,
            identity=reference.object,
        )

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        self._put_joints(moved, positions, self._causing_node())

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        self._put_attachment(event_types.ObjectAttached, parent, child, link, self._causing_node())

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        self._put_attachment(event_types.ObjectDetached, parent, child, link, self._causing_node())

    def _causing_node(self) -> int | None:
        """Return the node that caused a change: the context's innermost recorded node, if this episode recorded it."""
        node = current_node.get()
        while node is not None and node.record is None:
            node = node.parent
        if node is not None and node.record.episode is self._episode:
            sequence: int = node.record.sequence
            return sequence
        return None


def _color(added: Object) -> tuple[float, float, float, float] | None:
    if added.color is None:
        return None
    red, green, blue, opacity = map(float, added.color)
    return red, green, blue, opacity


def _model(added: Object) -> tuple[str | None, str | None]:
    """Return model and serial of a robot; None for other objects, and for each that its description lacks."""
    described = added.robot_description
    if described is None:
        return None, None
    return clean(described.name), clean(described.serial) if described.serial is not None else None


# === sampler ==================================================================================================
#
# The `Sampler` records the robot's state while motions run.
#
# Theory of operation. The sampler takes a sample of each motion when it starts, every `interval_ms` while it runs, and
# when it ends. The first and the last sample hold all channels that differ from the values written before; a sample in
# between holds the channels that changed by more than `change_min`; an empty sample is not written. So the last values
# before a moment are the state at that moment, up to `change_min`, and the state at the end of a motion is exact.
#
# Periodic samples are taken by a thread, because a plan that never suspends would starve a task. The thread starts with
# the first motion, sleeps while no motion runs, and ends at `close`. The first and the last sample are taken in the
# plan's thread, by `begin` and `end`. The thread reads only values that the world keeps in Python, never Bullet, which
# belongs to the plan's thread. It never waits for room: if the spool has only its reserve left, the sample is counted
# in `omitted`, and the next one holds all changes since the last written sample.
#
# One condition variable guards the running motions. All samples are taken while it is held, so no sample follows the
# end of its motion, with one exception: the garbage collector may close a dropped plan, and so call `end`, in the
# thread that takes a sample of it. So the lock is reentrant.


class _Motion:
    """A running motion: its node, the robot that acts, and the values last written of its channels."""

    def __init__(self, episode: Episode, node: int, robot: Object) -> None:
        self.episode = episode
        self.node = node
        self.robot = robot
        self.written: dict[str, float] | None = None


class Sampler:
    """Samples the robot's state for one memory.

    Attributes:
        omitted: number of samples not written because the spool or the episode had no room.
    """

    def __init__(self, emitter: episode_writer.Emitter) -> None:
        settings = emitter.settings
        assert settings.sample_interval_ms is not None, "None samples nothing"
        self._emitter = emitter
        self._interval_s = settings.sample_interval_ms / 1000
        self._change_min = settings.sample_change_min
        # The garbage collector may call `end` in a thread that holds the lock; a plain lock would deadlock there. Plans
        # use the lock itself, because Ctrl-C inside the condition's `__enter__`, a Python function, leaves it taken.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._running: dict[tuple[Episode, int], _Motion] = {}
        self._thread: threading.Thread | None = None
        self._asleep = False
        self._closed = False
        self.omitted = 0

    def begin(self, episode: Episode, node: int) -> None:
        """Start sampling the robot that acts in this context until the motion of this node ends, if there is one."""
        robot = acting_robot(episode.world.world) if episode.world is not None else None
        if robot is None:
            return
        with self._lock:
            if self._closed:
                return
            motion = self._running[episode, node] = _Motion(episode, node, robot)
            self._sample(motion, margin=0.0)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="pycrorm sampler", daemon=True)
                self._thread.start()
            elif self._asleep:
                self._asleep = False
                self._changed.notify()

    def end(self, episode: Episode, node: int) -> None:
        """Take the last sample of the motion. The caller writes the node's end afterwards."""
        with self._lock:
            motion = self._running.pop((episode, node), None)
            if motion is not None:
                self._sample(motion, margin=0.0)

    def stop_episode(self, episode: episode_writer.EpisodeWriter) -> None:
        """Stop sampling all motions of an episode, before the episode ends."""
        with self._lock:
            self._stop_motions(episode)

    def _stop_motions(
        self, episode: episode_writer.EpisodeWriter
    ) -> None:  # without a loop in `with`: see `OrderedCalls`
        for key in [key for key in self._running if key[0] is episode]:
            del self._running[key]

    def close(self) -> None:
        """Stop sampling, and wait until the thread has ended."""
        with self._lock:
            self._closed = True
            self._running.clear()
            self._changed.notify_all()
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    # --- inside -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        with self._changed:
            while not self._closed:
                if not self._running:
                    self._asleep = True
                    self._changed.wait()
                    continue
                self._changed.wait(self._interval_s)
                for motion in tuple(self._running.values()):
                    try:
                        self._sample(motion, margin=self._change_min)
                    except Exception as error:  # noqa: BLE001  one failed sample must not end the thread
                        self._emitter.note_fault("StateSampled", error)

    def _sample(self, motion: _Motion, *, margin: float) -> None:
        recorded_world = motion.episode.world
        if recorded_world is None:
            return
        robot = motion.robot
        reference = recorded_world.reference(robot)
        if reference is None:
            return
        if motion.written is None:
            motion.written = dict(recorded_world.sampled.get(robot, {}))
        written = motion.written
        changed = {
            channel: value
            for channel, value in _read_channels(robot).items()
            if channel not in written or abs(value - written[channel]) > margin
        }
        if not changed or self._emitter.is_closed:
            return
        try:
            motion.episode.events.put(event_types.StateSampled(reference, changed, motion.node), reserved=False)
        except (errors.EpisodeFull, errors.SpoolFull, errors.SpoolStuck):
            self.omitted += 1
            return
        written.update(changed)
        recorded_world.sampled.setdefault(robot, {}).update(changed)


def _read_channels(robot: Object) -> dict[str, float]:
    """Read base pose and joints as last set. Each read is atomic, even while another thread sets the value."""
    pose = robot.pose
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    base = {"base.x": x, "base.y": y, "base.z": z, "base.qx": qx, "base.qy": qy, "base.qz": qz, "base.qw": qw}
    return base | robot.joint_positions()
