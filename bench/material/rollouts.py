"""Generate task trees of pick-up rollouts, and record them in a spool; the thesis has 50,000 (section 5.2)."""

from __future__ import annotations

import asyncio
import math
import os
import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from pycrorm_async import __version__
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.events.codec import Heading, short_name
from pycrorm_async.events.ids import EpisodeId, episode_id
from pycrorm_async.events.types import (
    BriefPose,
    DesignatorTypeDeclared,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    Happening,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectReference,
    PoseReference,
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
from pycrorm_async.record.declarations import DeclaredType
from pycrorm_async.record.episode_writer import Emitter, EpisodeWriter
from pycrorm_async.record.opening import EpisodeOpening
from pycrorm_async.record.plan_types import declared_type
from pycrorm_async.settings import Settings
from tests.databases import ask

# === rollouts =================================================================================================
#
# Generate task trees of pick-up rollouts as plain values; the thesis has 50,000 of them below one root (section 5.2).
#
# A rollout navigates, faces the milk and picks it up. It has 9 nodes if the arm cannot reach the place in front of the
# milk, 11 if it cannot reach the milk, and 13 otherwise. The shares are those of the thesis, so 50,000 rollouts have
# its 488,043 nodes.

THESIS_NODES: Final = 488_043
_THESIS_ROLLOUTS, _SUCCEEDED, _STUCK_LATER = 50_000, 7_886, 3_249
SHARES: Final = (_SUCCEEDED, _STUCK_LATER, _THESIS_ROLLOUTS - _SUCCEEDED - _STUCK_LATER)
"""Numbers of rollouts with 5, 3 and 1 motions in their pick-up."""
_STEP_NS = 5_000_000
_BEGAN_NS = 1_700_000_000_000_000_000


class Place(NamedTuple):
    """A pose in the map: position in m, unit quaternion xyzw, and time in ns (UTC)."""

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    time_ns: int


class Robot(NamedTuple):
    """The pose of the robot's base, and the height of its torso in m."""

    place: Place
    torso_m: float


class WorldObject(NamedTuple):
    """A world object and its pose."""

    name: str
    type: str
    place: Place


@dataclass(slots=True)
class Node:
    """One action or motion, with values by field name, enum members by their name, and times in ns (UTC)."""

    dtype: str
    values: dict[str, object]
    start_ns: int
    robot: Robot | None = None
    end_ns: int = 0
    failure: str | None = None
    children: list[Node] = field(default_factory=list)

    def walked(self) -> Iterator[Node]:
        """Yield this node and its descendants, parents first."""
        yield self
        for child in self.children:
            yield from child.walked()


@dataclass(slots=True)
class Tree:
    """The rollouts below the root, and the number of nodes with the root."""

    rollouts: list[Node]
    nodes: int
    began_ns: int = _BEGAN_NS


MILK: Final = WorldObject("milk", "MILK", Place((1.3, 1.0, 0.9), (0.0, 0.0, 0.0, 1.0), _BEGAN_NS))


def tree(nodes: int, seed: int) -> Tree:
    """Generate complete rollouts with about `nodes` nodes; `THESIS_NODES` gives exactly this number."""
    count = max(1, round(_THESIS_ROLLOUTS * (nodes - 1) / (THESIS_NODES - 1)))
    succeeded = round(count * _SUCCEEDED / _THESIS_ROLLOUTS)
    stuck_later = min(count - succeeded, round(count * _STUCK_LATER / _THESIS_ROLLOUTS))
    motions = [5] * succeeded + [3] * stuck_later + [1] * (count - succeeded - stuck_later)
    random.Random(seed).shuffle(motions)
    return tree_of(motions, seed)


def tree_of(motions: Sequence[int], seed: int = 0) -> Tree:
    """Generate rollouts by the motions of their pick-ups: 5 for a success, 1 or 3 if the last motion failed."""
    rng, clock = random.Random(seed), _Clock(_BEGAN_NS)
    nodes = [node for each in motions for node in _rollout(each, rng, clock)]
    return Tree(nodes, 1 + sum(1 for each in nodes for _ in each.walked()))


class _Clock:
    """A clock that advances by one step with each reading."""

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns

    def read(self) -> int:
        self._now_ns += _STEP_NS
        return self._now_ns


def _rollout(motions: int, rng: random.Random, clock: _Clock) -> list[Node]:
    """Generate navigating, facing and picking up; with fewer than five motions the last motion of the pick-up fails."""
    arm, grasp = rng.choice(("LEFT", "RIGHT")), rng.choice(("FRONT", "LEFT", "RIGHT", "TOP"))
    x, y = rng.uniform(0.3, 2.3), rng.uniform(0.0, 2.0)
    turned = math.atan2(y - MILK.place.position[1], x - MILK.place.position[0]) + math.pi
    start = _place(0.0, 0.0, 0.0, clock)
    place = _place(x, y, 0.0, clock)
    facing = _place(x, y, turned, clock)
    torso = rng.uniform(0.0, 0.33)
    navigated = _action("NavigateAction", {"target_location": place}, Robot(start, torso), clock)
    navigated.children = [_motion("MoveMotion", {"target": place}, clock)]
    _end(navigated, clock)
    faced = _action("FaceAtAction", {"pose": MILK.place}, Robot(place, torso), clock)
    turning = _action("NavigateAction", {"target_location": facing}, Robot(place, torso), clock)
    turning.children = [_motion("MoveMotion", {"target": facing}, clock)]
    looking = _action("LookAtAction", {"target": MILK.place}, Robot(facing, torso), clock)
    looking.children = [_motion("LookingMotion", {"target": MILK.place}, clock)]
    faced.children = [_end(turning, clock), _end(looking, clock)]
    _end(faced, clock)
    picked = _action(
        "PickUpAction", {"object_designator": MILK, "arm": arm, "grasp": grasp}, Robot(facing, torso), clock
    )
    picked.children = [_pick_up_motion(number, arm, facing, clock) for number in range(motions)]
    if motions < 5:
        picked.children[-1].failure = picked.failure = "IKError"
    return [navigated, faced, _end(picked, clock)]


def _pick_up_motion(number: int, arm: str, facing: Place, clock: _Clock) -> Node:
    """Generate one motion of a pick-up: move in front of the object, open, move to it, close, lift."""
    if number in (1, 3):
        state = "OPEN" if number == 1 else "CLOSE"
        return _motion("MoveGripperMotion", {"motion": state, "gripper": arm, "allow_gripper_collision": None}, clock)
    x, y, z = MILK.place.position
    target = Place((x - 0.1 + 0.05 * number, y, z + 0.01 * number), facing.orientation, clock.read())
    return _motion("MoveTCPMotion", {"target": target, "arm": arm, "allow_gripper_collision": True}, clock)


def _place(x: float, y: float, turned: float, clock: _Clock) -> Place:
    return Place((x, y, 0.0), (0.0, 0.0, math.sin(turned / 2), math.cos(turned / 2)), clock.read())


def _action(dtype: str, values: dict[str, object], robot: Robot, clock: _Clock) -> Node:
    return Node(dtype, values, clock.read(), robot)


def _motion(dtype: str, values: dict[str, object], clock: _Clock) -> Node:
    return _end(Node(dtype, values, clock.read()), clock)


def _end(node: Node, clock: _Clock) -> Node:
    node.end_ns = clock.read()
    return node


# === fold progress ============================================================================================
#
# Read from the database how many events are in the log and in the tables, over an independent connection.

_POLL_S = 0.05
_STALLED_S = 60.0
_NO_LOG = ("no such table", "does not exist", "unable to open", "locked")


class Progress(NamedTuple):
    """Numbers of events in the log and in the tables."""

    appended: int
    folded: int


def progress(url: str) -> Progress:
    """Return the sums over all episodes; 0 if the log does not exist yet."""
    try:
        [(head, folded)] = ask(url, "SELECT coalesce(sum(head), 0), coalesce(sum(folded), 0) FROM episode")
    except Exception as error:
        if any(each in str(error) for each in _NO_LOG):
            return Progress(0, 0)
        raise
    return Progress(int(head), int(folded))


def until_folded(url: str, events: int) -> tuple[float, float]:
    """Wait until `events` events are in the tables; return the seconds until they were in the log and in the tables.

    Raises:
        TimeoutError: the numbers did not change for a minute.
    """
    begin_s = changed_s = time.perf_counter()
    appended_s = 0.0
    previous = Progress(0, 0)
    while True:
        current = progress(url)
        now_s = time.perf_counter() - begin_s
        if current != previous:
            previous, changed_s = current, time.perf_counter()
        elif time.perf_counter() - changed_s > _STALLED_S:
            raise TimeoutError(f"{url}: {current} of {events} events, without progress for {_STALLED_S:g} s")
        if not appended_s and current.appended >= events:
            appended_s = now_s
        if current.folded >= events:
            return appended_s, now_s
        time.sleep(_POLL_S)


# === spool recording ==========================================================================================
#
# Record task trees as events in a spool, by the real queue, as the hooks would record them.

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
        self._episode = self._episode_writer(EpisodeId(b""))
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
        self._episode = self._episode_writer(episode_id(SYSTEM_CLOCK.wall_ns(), os.urandom(10)))
        self._put(EpisodeStarted("rollouts", "bench", "here", __version__, "3"))
        self.root = self._put(NodeStarted("root"))
        milk = self._put(ObjectAdded(MILK.name, MILK.type, _pose(MILK.place)))
        self._milk = ObjectReference(milk, milk)

    def end(self) -> None:
        self._put(NodeEnded(self.root, "SUCCEEDED"))
        self._put(EpisodeEnded("SUCCEEDED"))

    def put_tree(
        self,
        node: Node,
        parent: int,
        *,
        after: Callable[[], None] | None = None,
        places: Mapping[Place, PoseReference] = MappingProxyType({}),
    ) -> None:
        """Put this node and its descendants; `after` is called after the end of each node.

        `places` are those in parameters of the nodes around, which are named.
        """
        declared = DECLARED[node.dtype]
        self._now_ns = node.start_ns
        sequence = self._put(
            NodeStarted(
                declared.declaration.kind,
                parent,
                short_name(declared.fingerprint),
                {name: self._written(value, places) for name, value in node.values.items()},
                _robot(node.robot),
            )
        )
        slots = {each.name: each.slot for each in declared.declaration.fields}
        own = {
            value: PoseReference(sequence, name, slots[name])
            for name, value in node.values.items()
            if isinstance(value, Place) and value not in places
        }
        for child in node.children:
            self.put_tree(child, sequence, after=after, places={**places, **own})
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
        return self._episode.events.put(event)

    def _episode_writer(self, name: EpisodeId) -> EpisodeWriter:
        return EpisodeWriter(self._emitter, name, EpisodeOpening("rollouts", "bench"))

    def _written(self, value: object, places: Mapping[Place, PoseReference]) -> Any:
        match value:
            case Place():
                return places.get(value) or _pose(value)
            case WorldObject():
                return self._milk
            case _:
                return value


def _pose(place: Place) -> PoseValue:
    return PoseValue(place.position, place.orientation, "map", place.time_ns)


def _robot(robot: Robot | None) -> RobotValue | None:
    return RobotValue(BriefPose.of(_pose(robot.place)), "ROBOT", robot.torso_m) if robot is not None else None
