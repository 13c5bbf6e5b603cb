"""Record task trees as events in a spool, by the real queue, as the hooks would record them."""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.material.rollouts import MILK, SHARES, Node, Place, Robot, Tree, WorldObject, tree_of
from pycrorm_async import __version__
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.events.codec import Heading
from pycrorm_async.events.ids import EpisodeId, episode_id
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    Happening,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectReference,
    PoseValue,
    RobotValue,
)
from pycrorm_async.plan.actions import (
    FaceAtPerformable,
    LookAtActionPerformable,
    NavigateActionPerformable,
    PickUpActionPerformable,
)
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.motions import LookingMotion, MoveGripperMotion, MoveMotion, MoveTCPMotion
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.record.declarations import declared_type
from pycrorm_async.record.episode_writer import Emitter
from pycrorm_async.record.parameters import DeclaredType
from pycrorm_async.settings import Settings

__all__ = ["spool_tree", "spool_rollouts", "Recording", "DECLARED"]

_CLASSES: tuple[type[Designator], ...] = (
    NavigateActionPerformable,
    FaceAtPerformable,
    LookAtActionPerformable,
    PickUpActionPerformable,
    MoveMotion,
    LookingMotion,
    MoveTCPMotion,
    MoveGripperMotion,
)
DECLARED: dict[str, DeclaredType] = {each.dtype: declared_type(each) for each in _CLASSES}


def spool_tree(tree: Tree, spool: Path) -> int:
    """Write the tree as one closed episode into the folder of a dead recorder; return the number of events."""
    recording = Recording(spool)
    recording.declare()
    recording.begin(tree.began_ns)
    for rollout in tree.rollouts:
        recording.put_tree(rollout, recording.root)
    recording.end()
    recording.leave()
    return recording.events


def spool_rollouts(count: int, spool: Path, *, seed: int, an_episode: int = 100) -> int:
    """Write `count` rollouts in episodes of `an_episode` into the folder of a dead recorder; return the event count.

    The outcome of each rollout is drawn with the shares of the thesis. Only one episode is in memory at a time.
    """
    recording, rng = Recording(spool), random.Random(seed)
    recording.declare()
    for first in range(0, count, an_episode):
        tree = tree_of(rng.choices((5, 3, 1), SHARES, k=min(an_episode, count - first)), seed + first)
        recording.begin(tree.began_ns)
        for rollout in tree.rollouts:
            recording.put_tree(rollout, recording.root)
        recording.end()
    recording.leave()
    return recording.events


class Recording:
    """A recorder that writes episodes one after the other, with the times of the values instead of the clock."""

    def __init__(self, spool: Path, *, settings: Settings | None = None, live: bool = False) -> None:
        self._now_ns = 1
        clock = SYSTEM_CLOCK if live else Clock(lambda: self._now_ns, lambda: self._now_ns)
        settings = settings or Settings(spool_bytes_max=64 * 2**30)
        name = episode_id(SYSTEM_CLOCK.wall_ns(), os.urandom(10))
        self.queue = RecorderQueue.create(spool, settings=settings, clock=clock, recorder=name, offered=True)
        self._emitter = Emitter(self.queue, settings)
        self._episode = EpisodeId(b"")
        self._milk = ObjectReference(0, 0)
        self.root = 0
        self.events = 0
        """Counts the events of episodes, without declarations, which every segment repeats."""

    def declare(self) -> None:
        """Declare the types; call it once, before the first episode."""
        for each in DECLARED.values():
            heading = Heading(None, DesignatorTypeDeclared.__name__, DesignatorTypeDeclared.version)
            self._emitter.put_payload(heading, each.payload)

    def begin(self, began_ns: int) -> None:
        """Begin an episode with its root and the milk."""
        self._now_ns = began_ns
        self._episode = episode_id(SYSTEM_CLOCK.wall_ns(), os.urandom(10))
        self._put(EpisodeStarted("rollouts", "bench", "here", __version__, "3"))
        self.root = self._put(NodeStarted("root"))
        milk = self._put(ObjectAdded(MILK.name, MILK.type, _pose(MILK.place)))
        self._milk = ObjectReference(milk, milk)

    def end(self) -> None:
        self._put(NodeEnded(self.root, "SUCCEEDED"))
        self._put(EpisodeEnded("SUCCEEDED"))

    def put_tree(self, node: Node, parent: int, *, after: Callable[[], None] | None = None) -> None:
        """Put this node and its descendants; `after` is called after the end of each node."""
        declared = DECLARED[node.dtype]
        self._now_ns = node.start_ns
        sequence = self._put(
            NodeStarted(
                declared.declaration.kind,
                parent,
                declared.fingerprint,
                {name: self._written(value) for name, value in node.values.items()},
                _robot(node.robot),
            )
        )
        for child in node.children:
            self.put_tree(child, sequence, after=after)
        self._now_ns = node.end_ns
        failure = FailureValue(node.failure, "") if node.failure else None
        self._put(NodeEnded(sequence, "FAILED" if failure else "SUCCEEDED", failure))
        if after is not None:
            after()

    def leave(self) -> None:
        """Sync everything and close the recorder, so that its folder is dead."""
        asyncio.run(self.queue.synced_to(self.queue.written))
        self.queue.close()
        self.queue.release()

    def _put(self, event: Happening) -> int:
        self.events += 1
        return self._emitter.put(self._episode, event)

    def _written(self, value: object) -> Any:
        match value:
            case Place():
                return _pose(value)
            case WorldObject():
                return self._milk
            case _:
                return value


def _pose(place: Place) -> PoseValue:
    return PoseValue(place.position, place.orientation, "map", place.time_ns)


def _robot(robot: Robot | None) -> RobotValue | None:
    return RobotValue(_pose(robot.place), "ROBOT", robot.torso_m) if robot is not None else None
