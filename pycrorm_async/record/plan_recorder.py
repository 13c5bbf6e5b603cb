"""The `Recorder` receives the reports of the plan and the world, and passes each to its episode.

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
unfinished. So it resets `current_episode` only if the context still holds the node's episode.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from typing import Any, Literal

from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.errors import (
    DeclarationRefused,
    EpisodeFull,
    EpisodeRefused,
    FilesError,
    SpoolFull,
    SpoolStuck,
    Unrecordable,
)
from pycrorm_async.events.types import Blob, NodeReference, StateSampled
from pycrorm_async.plan.execution import CalledPerforms, Candidate, Cells, Refusal, Seen, Simulation, current_simulation
from pycrorm_async.plan.task import TaskTreeNode, current_node
from pycrorm_async.record.declarations import Declarations, KnownTypes
from pycrorm_async.record.episode import Episode, NodeRecord
from pycrorm_async.record.episode_writer import (
    NO_LABELS,
    Emitter,
    EpisodeOpening,
    EpisodeWriter,
    Labels,
    OpenEpisodes,
    Provenance,
    check_arguments,
    current_task,
    name_of,
    put_observation,
)
from pycrorm_async.record.parameters import EPISODE_TEXT_MAX
from pycrorm_async.world.bullet import BulletWorld, Object, current_world
from pycrorm_async.world.pose import ObjectType
from pycrorm_async.world.world_copy import acting_robot

_log = logging.getLogger("pycrorm_async")
current_episode: ContextVar[Episode | None] = ContextVar("current_episode", default=None)
"""The innermost episode opened in this context; it may be closed already."""


class Recorder:
    """Implements the plan layer's `PlanObserver` and the world's `WorldWatcher` for one memory."""

    def __init__(
        self,
        emitter: Emitter,
        *,
        episodes: OpenEpisodes,
        software: str,
        provenance: Provenance | None = None,
    ) -> None:
        self._emitter = emitter
        self.episodes = episodes
        self._software = software
        self._provenance = provenance
        self._strict = emitter.settings.on_unrecordable == "refuse"
        self._declarations = Declarations(strict=self._strict)
        self._sampler = _sampler_of(emitter)
        self.calls = CalledPerforms(lambda designator: emitter.note_unawaited(getattr(designator, "__dtype__", "it")))
        """Performs called outside any episode."""

    @property
    def known_types(self) -> KnownTypes:
        """The types declared in this memory, by any executive."""
        return self._declarations.known

    @property
    def is_closed(self) -> bool:
        """True if the memory is closed, or belongs to the process that forked this one."""
        return self._emitter.is_closed

    # --- episodes ---------------------------------------------------------------------------------------------

    def open_episode(
        self, *, description: str, plan: str | None = None, seed: int | None = None, labels: Labels = NO_LABELS
    ) -> Episode:
        """Open an episode in this context; `close_episode` ends it.

        Raises `EpisodeRefused` if this task has an open episode, `CallerError` for an argument that does not fit.
        """
        open_episode = self.episode_here()
        if open_episode is not None and open_episode.task is current_task():
            raise EpisodeRefused(
                f"episode {open_episode} is open in this task already: end it first, or open the other in its own task"
            )
        check_arguments(description=description, plan=plan, seed=seed, strict=self._strict)
        return self._start(description, plan=plan, seed=seed, labels=labels)

    def _start(
        self, description: str, *, plan: str | None = None, seed: int | None = None, labels: Labels = NO_LABELS
    ) -> Episode:
        """Start an episode; a simulation if this context is in one."""
        simulation, world = current_simulation.get(), current_world.get()
        opening = EpisodeOpening(
            description,
            self._software,
            plan,
            seed,
            world.description if world else None,
            simulated=simulation is not None,
            thought_by=_simulating_node(simulation),
            provenance=self._provenance,
            labels=labels,
        )
        episode = Episode(self._emitter, self.episodes.new_id(), opening)
        self.episodes.add(episode)  # first, so that the memory ends an episode whose start Ctrl-C interrupted
        try:
            episode.open()
        except FilesError as error:  # of a disk that failed meanwhile: the plan goes on and is not recorded
            self._emitter.note_fault("EpisodeStarted", error)
        except Exception:
            self.episodes.by_id.pop(episode.id, None)
            raise
        if world is not None:
            episode.enter_world(world)
        return episode

    def close_episode(self, episode: EpisodeWriter[Any], failure: BaseException | None) -> None:
        """Write the end of an episode that `failure` left, or None. Exceptions are counted, not raised."""
        if self._sampler is not None and not self._emitter.is_closed:
            self._sample(self._sampler.stop_episode, episode)
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

    def episode_of(self, node: TaskTreeNode) -> Episode | None:
        """Return the open episode of this memory in which the node is recorded; None without one."""
        record: NodeRecord | None = node.record
        return record.episode if record is not None and record.episode.id in self.episodes.by_id else None

    # --- the port of the plan layer ----------------------------------------------------------------------------------

    def admit(self) -> Awaitable[None] | None:
        sink = self._emitter.sink
        if not sink.full or self._emitter.is_closed or not self._emitter.must_wait():
            return None
        return sink.room()

    def node_started(self, node: TaskTreeNode) -> None:
        assert node.designator is not None
        if self._emitter.is_closed:
            self._emitter.note_unrecorded(node.designator.__dtype__)
            return
        outer_episode = current_episode.get()
        implicit: Episode | None = None
        try:
            declared = self._declarations.of(type(node.designator), self._emitter.put_declaration)
            episode = self.episode_here()
            if episode is None:
                dtype = declared.dtype
                episode = implicit = self.open_episode(description=dtype, plan=dtype)
            sequence = episode.start_node(node, declared)
        except BaseException as error:
            if implicit is not None:
                self.close_episode(implicit, error)
            if isinstance(error, Unrecordable | DeclarationRefused) or not isinstance(error, Exception):
                raise
            self._emitter.note_fault("NodeStarted", error)  # a fault of the memory must not reach a plan
        else:
            node.record = NodeRecord(episode, sequence, implicit is not None, outer_episode)
            if implicit is not None:
                current_episode.set(implicit)
            if declared.fault is not None:
                self._emitter.missing.note(declared.dtype, "type", declared.fault)
            if self._sampler is not None and node.kind == "motion" and episode.acts_in_recorded_world:
                self._sample(self._sampler.begin, episode, sequence)

    def node_ended(self, node: TaskTreeNode) -> None:
        record: NodeRecord | None = node.record
        if record is None or self._emitter.is_closed:
            return
        if self._sampler is not None and node.kind == "motion":
            self._sample(self._sampler.end, record.episode, record.sequence)
        try:
            record.episode.end_node(node)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("NodeEnded", error)
        if record.implicit:
            self.close_episode(record.episode, node.failure)
            if current_episode.get() is record.episode:  # the garbage collector may close the plan in another context
                current_episode.set(record.outer_episode)

    def location_resolved(
        self, *, location: str, offered: tuple[Candidate, ...], taken: int | None, considered: int,
        refused: tuple[Refusal, ...], offered_beyond: int, cells: Cells | None, node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        episode = self.episode_here()
        if episode is None or self._emitter.is_closed:
            return
        try:
            episode.record_location(
                location=location, offered=offered, taken=taken, considered=considered, refused=refused,
                offered_beyond=offered_beyond, cells=cells, node=node,
            )  # fmt: skip
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("LocationResolved", error)

    def object_detected(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        episode = self.episode_here()
        if episode is None or self._emitter.is_closed:
            return
        try:
            episode.record_detection(source=source, object_type=object_type, seen=seen, node=node)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("ObjectDetected", error)

    def simulation_started(self, simulation: Simulation) -> None:
        if self._emitter.is_closed:
            return
        outer = current_episode.get()
        simulation.record = record = _SimulationRecord(
            outer.node_reference(simulation.by) if outer is not None else None, outer
        )
        try:
            record.episode = self._start(_description_of(simulation))
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("EpisodeStarted", error)
        # None if the episode could not start, so that no simulated event gets into the outer episode.
        current_episode.set(record.episode)

    def simulation_ended(self, simulation: Simulation, failure: BaseException | None) -> None:
        record: _SimulationRecord | None = simulation.record
        if record is None:
            return
        if record.episode is not None:
            self.close_episode(record.episode, failure)
        if current_episode.get() is record.episode:  # the garbage collector may close the plan in another context
            current_episode.set(record.outer_episode)

    def _sample(self, step: Callable[..., None], *arguments: object) -> None:
        try:
            step(*arguments)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("StateSampled", error)

    # --- the port of the world ---------------------------------------------------------------------------------------

    def world_entered(self, world: BulletWorld) -> None:
        episode = self.episode_here()
        if episode is None or self._emitter.is_closed:
            return
        try:
            episode.enter_world(world)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not prevent entering a world
            self._emitter.note_fault("entering a world", error)

    def world_left(self, world: BulletWorld) -> None:
        episode = self.episode_here()
        if episode is not None:
            episode.leave_world(world, emptied=True)


def _sampler_of(emitter: Emitter) -> Sampler | None:
    settings = emitter.settings
    if settings.sample_interval_ms is None:
        return None
    return Sampler(emitter, interval_ms=settings.sample_interval_ms, change_min=settings.sample_change_min)


class _SimulationRecord:
    """The hooks' record of a running simulation.

    Attributes:
        node: the node that runs the simulation; None outside any recorded episode.
        outer_episode: the current episode of the context before the simulation began.
        episode: the simulation's own episode; None if it could not start.
    """

    def __init__(self, node: NodeReference | None, outer_episode: Episode | None) -> None:
        self.node = node
        self.outer_episode = outer_episode
        self.episode: Episode | None = None


def _simulating_node(simulation: Simulation | None) -> NodeReference | None:
    record = simulation.record if simulation is not None else None
    return record.node if isinstance(record, _SimulationRecord) else None


def _description_of(simulation: Simulation) -> str:
    if simulation.description is not None:
        return simulation.description[:EPISODE_TEXT_MAX]
    if simulation.by is not None and simulation.by.designator is not None:
        return f"simulation in {simulation.by.designator.__dtype__}"
    return "simulation"


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
# end of its motion. Its lock is reentrant, because the garbage collector may close a dropped plan, and so call `end`,
# in a thread that holds the lock. Therefore `_sample` checks `is_over` again after it has read the channels.


class _Motion:
    """A running motion: its node, the robot that acts, and the values last written of its channels."""

    def __init__(self, episode: Episode, node: int, robot: Object) -> None:
        self.episode = episode
        self.node = node
        self.robot = robot
        self.written: dict[str, float] | None = None
        self.is_over = False


class Sampler:
    """Samples the robot's state for one memory.

    Attributes:
        omitted: number of samples not written because the spool or the episode had no room.
    """

    def __init__(self, emitter: Emitter, *, interval_ms: int, change_min: float) -> None:
        self._emitter = emitter
        self._interval_s = interval_ms / 1000
        self._change_min = change_min
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
                motion.is_over = True

    def stop_episode(self, episode: EpisodeWriter[Any]) -> None:
        """Stop sampling all motions of an episode, before the episode ends."""
        with self._lock:
            self._stop_motions(episode)

    def _stop_motions(self, episode: EpisodeWriter[Any]) -> None:  # without a loop in `with`: see `OrderedCalls`
        for key in [key for key in self._running if key[0] is episode]:
            self._running.pop(key).is_over = True

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
        world = recorded_world.world
        robot = motion.robot if world.has(motion.robot) else world.robot  # another may have taken its place
        reference = recorded_world.reference(robot) if robot is not None else None
        if robot is None or reference is None:
            return
        if robot is not motion.robot:
            motion.robot, motion.written = robot, None
        if motion.written is None:
            motion.written = dict(recorded_world.sampled.get(robot, {}))
        written = motion.written
        changed = {
            channel: value
            for channel, value in _read_channels(robot).items()
            if channel not in written or abs(value - written[channel]) > margin
        }
        # The garbage collector may have ended the motion in this thread since the channels were read.
        if not changed or motion.is_over or self._emitter.is_closed:
            return
        try:
            self._emitter.offer(motion.episode.id, StateSampled(reference, changed, motion.node))
        except (EpisodeFull, SpoolFull, SpoolStuck):
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


# === observations =============================================================================================
#
# Record the observations that a program makes itself, from any thread.
#
# A thread without the plan's context, such as the callback of a sensor, observes for the episode that this memory
# opened last.


class Observations:
    """Records observations of one memory."""

    def __init__(self, emitter: Emitter, recorder: Recorder) -> None:
        self._emitter = emitter
        self._recorder = recorder
        self._kept: set[tuple[str, str]] = set()

    @property
    def is_closed(self) -> bool:
        """True if the memory is closed, or belongs to the process that forked this one."""
        return self._emitter.is_closed

    def observe(self, name: str, values: object, *, node: TaskTreeNode | None) -> None:
        """Record values under this name. Raises `Unrecordable` with `on_unrecordable="refuse"` only."""
        if self.is_closed:
            self._emitter.note_unrecorded(f"the observation {name_of(name)}")
            return
        try:
            self._observe(name, values, node)
        except Unrecordable:
            raise
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("Observed", error)

    def keep(self, name: str, key: str, content: Callable[[], Blob]) -> None:
        """Record a content that nodes name by this key, once for all episodes of the memory.

        Outside an episode nothing is recorded; the next call tries again, also where the spool had no room.
        """
        if self.is_closed or (name, key) in self._kept or self._recorder.episode_here() is None:
            return
        try:
            if self._observe(name, {key: content()}, None):
                self._kept.add((name, key))
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("Observed", error)

    def _observe(self, name: str, values: object, node: TaskTreeNode | None) -> int:
        """Return the sequence of the event; 0 if it was counted as missing."""
        own = self._recorder.episode_here()
        episode: EpisodeWriter[Any] | None
        if node is not None:
            episode = self._recorder.episode_of(node)
        elif own is not None:
            episode, node = own, current_node.get()
        else:
            episode = self._recorder.episodes.last_opened()
        if episode is None:
            self._emitter.missing.note("observation", name_of(name), "no episode is open")
            return 0
        return put_observation(self._emitter, episode, name, values, episode.node_or_root(node), may_refuse=True)


observations: ConnectedVar[Observations] = ConnectedVar("observations")
"""The observations of the memory that records this context; None without an open memory."""
