"""`PyCRAMEpisodes` holds the nodes that run in each thread, the episode of the real world, and that of a simulation."""

from __future__ import annotations

import sys
import threading
from collections.abc import Hashable
from typing import Any

from pycrorm_async.events.values import PoseValue
from pycrorm_async.integrations.pycram_values import AS_THEY_ARE, PyCRAMValues
from pycrorm_async.recording.declarations.recorded_type import RecordedKind
from pycrorm_async.recording.recorded_episode import RecordedEpisode
from pycrorm_async.recording.recording import Recording


class RunningNode:
    """A node that runs: PyCRAM's node, or the action that another one performs; `key` names it in its episode.

    A description of an action has no key: the action to which it resolves is recorded, or the description if it failed.
    """

    def __init__(self, of: Any, episode: RecordedEpisode, kind: RecordedKind, *, is_description: bool = False) -> None:
        self.of, self.episode, self.kind, self.is_description = of, episode, kind, is_description
        self.key: Hashable | None = None


class Change:
    """The last pose of an object and the last positions of its joints that a motion has set."""

    def __init__(self, of: Any) -> None:
        self.of = of
        self.pose: PoseValue | None = None
        self.joints: dict[str, float] = {}


class _Thread(threading.local):
    """The nodes that run in this thread, innermost last, and the changes of its motion, by `id` of the object.

    `is_collecting` while one call sets several joints: what it changes is recorded when it returns.
    """

    def __init__(self) -> None:
        self.nodes: list[RunningNode] = []
        self.changes: dict[int, Change] = {}
        self.is_collecting = False


class PyCRAMEpisodes:
    """The episodes of one `remember`.

    Attributes:
        thread: the running nodes of the calling thread.
        real: the episode of the real world.
    """

    real: RecordedEpisode

    def __init__(self, recording: Recording, values: PyCRAMValues) -> None:
        self.thread = _Thread()
        self._recording = recording
        self._values = values
        self._simulation: RecordedEpisode | None = None
        self._lock = threading.Lock()
        self._handled = sys.exception()  # the block may be in an `except`, whose exception has not ended it

    def open(self, world: Any, **labels: Any) -> RecordedEpisode:
        """Open an episode in this world."""
        name = type(world).__name__ if world is not None else None

        def convert(value: Any) -> Any:
            return value if type(value) in AS_THEY_ARE else self._values.value(value, episode)

        episode = self._recording.episode(
            world=name,
            convert=convert,
            failures=(self._values.pycram.PlanFailure,),
            **labels,
        )
        return episode

    def add_world(self, episode: RecordedEpisode, world: Any) -> None:
        """Record the objects that are in the world, and which of them are attached to which."""
        objects = list(world.objects) if world is not None else []
        for each in objects:
            episode.object_added(self._values.key(each), **self._values.description(each))
        for each in objects:
            for child, attachment in each.attachments.items():
                if not attachment.is_inverse:
                    link = attachment.parent_link.name
                    episode.object_attached(self._values.key(each), self._values.key(child), link)

    def present(self) -> RecordedEpisode:
        """Return the episode of the present world; open one for the first node in the prospection world."""
        world = self._values.pycram.World.current_world
        if world is None or not world.is_prospection_world:
            return self.real
        with self._lock:
            if self._simulation is None:
                thinker = self.real.node_reference(self.cause(self.real))
                description = "a simulation in the prospection world"
                self._simulation = self.open(world, description=description, simulated=True, thought_by=thinker)
                self.add_world(self._simulation, world)
            return self._simulation

    def of(self, world: Any) -> RecordedEpisode | None:
        """Return the episode of a world; None for a prospection world in which no node has run."""
        return self._simulation if world.is_prospection_world else self.real

    def cause(self, episode: RecordedEpisode) -> Hashable | None:
        """Return the key of the innermost node of this thread in an episode; None without one."""
        for each in reversed(self.thread.nodes):  # a generator would take twice as long
            if each.key is not None and each.episode is episode:
                return each.key
        return None

    def is_interruption(self, failure: BaseException | None) -> bool:
        """Return whether Ctrl-C ended what this left, also if another exception took the place of its own.

        PyCRAM's signal handler removes the robot and exits; what PyCRAM still does to record an action then fails.
        """
        plan_failure = self._values.pycram.PlanFailure
        while failure is not None and failure is not self._handled and not isinstance(failure, plan_failure):
            if isinstance(failure, KeyboardInterrupt | SystemExit):
                return True
            failure = failure.__context__
        return False

    def end_simulation(self, failure: BaseException | None) -> None:
        """End the simulation, if there is one."""
        with self._lock:
            simulation, self._simulation = self._simulation, None
        if simulation is not None:
            simulation.close(failure, "INTERRUPTED" if self.is_interruption(failure) else None)
