"""The `Sampler` records the robot's state while motions run.

Theory of operation. The sampler takes a sample of each motion when it starts, every `interval_ms` while it runs, and
when it ends. The first and the last sample hold all channels that differ from the values written before; a sample in
between holds the channels that changed by more than `change_min`; an empty sample is not written. So the last values
before a moment are the state at that moment, up to `change_min`, and the state at the end of a motion is exact.

Periodic samples are taken by a thread, because a plan that never suspends would starve a task. The thread starts with
the first motion, sleeps while no motion runs, and ends at `close`. The first and the last sample are taken in the
plan's thread, by `begin` and `end`. The thread reads only values that the world keeps in Python, never Bullet, which
belongs to the plan's thread. It never waits for room: if the spool has only its reserve left, the sample is counted in
`omitted`, and the next one holds all changes since the last written sample.

One condition variable guards the running motions. All samples are taken while it is held, so no sample follows the end
of its motion, and `renumbering` keeps samples out while an episode moves to a follow-up. Its lock is reentrant, because
the garbage collector may close a dropped plan, and so call `end`, in a thread that holds the lock. Therefore `_sample`
checks `is_over` again after it has read the channels.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from pycrorm_async.errors import SpoolFull, SpoolStuck
from pycrorm_async.events.types import StateSampled
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter
from pycrorm_async.world.objects import Object
from pycrorm_async.world.robots.acting_robot import acting_robot


class _Motion:
    """A running motion: its node, the robot that acts, and the values last written of its channels.

    `is_full` is set once a sample reached the episode's `continue_at`; then only the last sample of the motion is
    still taken, to save sequences until the episode continues in a follow-up.
    """

    def __init__(self, episode: Episode, node: int, robot: Object) -> None:
        self.episode = episode
        self.node = node
        self.robot = robot
        self.written: dict[str, float] | None = None
        self.is_full = False
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

    @contextmanager
    def renumbering(self, episode: Episode) -> Iterator[Callable[[Mapping[int, int]], None]]:
        """Take no sample while the episode moves to a follow-up; yield a function for the new sequences of its nodes.

        The next sample of each motion holds all channels, because the follow-up must not depend on the former episode.
        """
        with self._lock:
            yield lambda renumbered: self._renumber(episode, renumbered)

    def _renumber(self, episode: Episode, renumbered: Mapping[int, int]) -> None:
        for key in [key for key in self._running if key[0] is episode]:
            motion = self._running.pop(key)
            node = renumbered.get(motion.node)
            if node is None:
                motion.is_over = True
                continue
            motion.node, motion.written, motion.is_full = node, None, False
            self._running[episode, node] = motion

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
                    if motion.is_full:
                        self.omitted += 1
                        continue
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
            sequence = self._emitter.offer(motion.episode.id, StateSampled(reference, changed, motion.node))
        except (SpoolFull, SpoolStuck):
            self.omitted += 1
            return
        motion.is_full = sequence >= motion.episode.continue_at
        written.update(changed)
        recorded_world.sampled.setdefault(robot, {}).update(changed)


def _read_channels(robot: Object) -> dict[str, float]:
    """Read base pose and joints as last set. Each read is atomic, even while another thread sets the value."""
    pose = robot.pose
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    base = {"base.x": x, "base.y": y, "base.z": z, "base.qx": qx, "base.qy": qy, "base.qz": qz, "base.qw": qw}
    return base | robot.joint_positions()
