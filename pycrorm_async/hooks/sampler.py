"""Samples the robot's state while its motions run, in a thread of its own: a plan that never suspends starves a task.

Of each motion a sample is taken when it starts, every interval while it runs, and when it ends. The first and the last
hold all channels that differ from what was written before, those between only what changed by more than the margin;
a sample that would hold nothing is not written. So the last values before a moment are the state at that moment, up to
the margin, and the state a motion ended in is exact.

Sampling reads values that the world keeps in Python and never Bullet, which belongs to the plan's thread. It waits for
nothing: where the spool has no ordinary room a sample is left out and counted, and the next one holds what changed
since the last that was written.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from pycrorm_async.errors import SpoolFull, SpoolStuck
from pycrorm_async.events.types import StateSampled
from pycrorm_async.hooks.emitter import Emitter
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.world.objects import Object

__all__ = ["Sampler"]


class _Motion:
    """One that runs: its node, and what was written of its robot since it started, or before."""

    def __init__(self, episode: Episode, node: int) -> None:
        self.episode = episode
        self.node = node
        self.robot: Object | None = None
        self.written: dict[str, float] = {}
        self.is_full = False
        """Whether its episode is to be continued first: samples between its first and its last are left out."""
        self.over = False


class Sampler:
    """The sampler of one memory. Its thread starts with the first motion, sleeps while none runs, ends at `close`.

    `begin` and `end` are called in the thread of the plan. No sample of a motion is written after its `end`.

    Attributes:
        left_out: how many samples the spool, or the episode, had no room for.
    """

    def __init__(self, emitter: Emitter, *, interval_ms: int, change_min: float) -> None:
        self._emitter = emitter
        self._interval_s = interval_ms / 1000
        self._change_min = change_min
        # The collector may close a dropped plan while this thread holds the lock, so it must be one it can take again.
        self._changed = threading.Condition(threading.RLock())
        self._running: dict[tuple[Episode, int], _Motion] = {}
        self._thread: threading.Thread | None = None
        self._asleep = False
        self._closed = False
        self.left_out = 0

    def begin(self, episode: Episode, node: int) -> None:
        """The motion of that node has started; nothing is done for one without a robot."""
        if episode.world is None or episode.world.world.robot is None:
            return
        with self._changed:
            if self._closed:
                return
            motion = self._running[episode, node] = _Motion(episode, node)
            self._sample(motion, margin=0.0)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="pycrorm sampler", daemon=True)
                self._thread.start()
            elif self._asleep:
                self._asleep = False
                self._changed.notify()

    def end(self, episode: Episode, node: int) -> None:
        """It is over, and its end not yet written."""
        with self._changed:
            motion = self._running.pop((episode, node), None)
            if motion is not None:
                self._sample(motion, margin=0.0)
                motion.over = True

    def drop(self, episode: Episode) -> None:
        """The episode is over, and motions that outlive it are out of its sight."""
        with self._changed:
            for key in [key for key in self._running if key[0] is episode]:
                self._running.pop(key).over = True

    @contextmanager
    def renumbering(self, episode: Episode) -> Iterator[Callable[[Mapping[int, int]], None]]:
        """Take no sample while the episode is continued; give a function that takes the new sequences of its nodes.

        The first sample afterwards holds all channels, because samples are told by what their own episode holds.
        """
        with self._changed:
            yield lambda renumbered: self._renumber(episode, renumbered)

    def _renumber(self, episode: Episode, renumbered: Mapping[int, int]) -> None:
        for key in [key for key in self._running if key[0] is episode]:
            motion = self._running.pop(key)
            node = renumbered.get(motion.node)
            if node is None:
                motion.over = True
                continue
            motion.node, motion.robot, motion.is_full = node, None, False
            self._running[episode, node] = motion

    def close(self) -> None:
        """No sample is taken any more; waits for the thread."""
        with self._changed:
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
                        self.left_out += 1
                        continue
                    try:
                        self._sample(motion, margin=self._change_min)
                    except Exception as error:  # noqa: BLE001  the next sample may be taken all the same
                        self._emitter.note_fault("StateSampled", error)

    def _sample(self, motion: _Motion, *, margin: float) -> None:
        seen = motion.episode.world
        robot = seen.world.robot if seen is not None else None
        reference = seen.reference(robot) if seen is not None and robot is not None else None
        if seen is None or robot is None or reference is None:
            return
        if robot is not motion.robot:
            motion.robot, motion.written = robot, dict(seen.sampled.get(robot, {}))
        before = motion.written
        changed = {
            channel: value
            for channel, value in _channels(robot).items()
            if channel not in before or abs(value - before[channel]) > margin
        }
        # The collector may have ended the motion just now, in this very thread.
        if not changed or motion.over or self._emitter.over:
            return
        try:
            sequence = self._emitter.offer(motion.episode.id, StateSampled(reference, changed, motion.node))
        except (SpoolFull, SpoolStuck):
            self.left_out += 1
            return
        motion.is_full = sequence >= motion.episode.continue_at
        before.update(changed)
        seen.sampled.setdefault(robot, {}).update(changed)


def _channels(robot: Object) -> dict[str, float]:
    """Base pose and joints as they were set last. Each is read at once, also while another thread sets it."""
    pose = robot.pose
    x, y, z = pose.position
    qx, qy, qz, qw = pose.orientation
    base = {"base.x": x, "base.y": y, "base.z": z, "base.qx": qx, "base.qy": qy, "base.qz": qz, "base.qw": qw}
    return base | robot.joint_positions()
