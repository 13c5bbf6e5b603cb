"""Generate task trees of pick-up rollouts as plain values; the thesis has 50,000 of them below one root (section 5.2).

A rollout navigates, faces the milk and picks it up. It has 9 nodes if the arm cannot reach the place in front of the
milk, 11 if it cannot reach the milk, and 13 otherwise. The shares are those of the thesis, so 50,000 rollouts have its
488,043 nodes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

__all__ = ["Place", "Robot", "WorldObject", "Node", "Tree", "tree", "tree_of", "THESIS_NODES", "SHARES", "MILK"]

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
