"""Task trees of pick-up rollouts as plain values, as the thesis had 50,000 of them below one root (its section 5.2).

A rollout navigates, faces the milk and picks it up: 9 nodes when the arm cannot get in front of it, 11 when it cannot
get to it, 13 otherwise. The share of each is that of the thesis, so 50,000 rollouts have its 488,043 nodes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

__all__ = ["Place", "Robot", "Thing", "Node", "Tree", "tree", "tree_of", "THESIS_NODES", "SHARES", "MILK"]

THESIS_NODES: Final = 488_043
_THESIS_ROLLOUTS, _SUCCEEDED, _STUCK_LATER = 50_000, 7_886, 3_249
SHARES: Final = (_SUCCEEDED, _STUCK_LATER, _THESIS_ROLLOUTS - _SUCCEEDED - _STUCK_LATER)
"""Of rollouts with 5, 3 and 1 motions in their pick-up."""
_STEP_NS = 5_000_000
_BEGAN_NS = 1_700_000_000_000_000_000


class Place(NamedTuple):
    """A pose in the map: m, unit quaternion xyzw, when it was made (UTC, ns)."""

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    time_ns: int


class Robot(NamedTuple):
    """The robot's base, and its torso's height in m."""

    place: Place
    torso_m: float


class Thing(NamedTuple):
    """A world object and where it is."""

    name: str
    type: str
    place: Place


@dataclass(slots=True)
class Node:
    """One action or motion. `values` by our names of its fields; an enum member by its name. Times in ns, UTC."""

    dtype: str
    values: dict[str, object]
    start_ns: int
    robot: Robot | None = None
    end_ns: int = 0
    failure: str | None = None
    children: list[Node] = field(default_factory=list)

    def walked(self) -> Iterator[Node]:
        """This one and all below, each before what is below it."""
        yield self
        for child in self.children:
            yield from child.walked()


@dataclass(slots=True)
class Tree:
    """What is below the root, and how many nodes there are with the root."""

    rollouts: list[Node]
    nodes: int
    began_ns: int = _BEGAN_NS


MILK: Final = Thing("milk", "MILK", Place((1.3, 1.0, 0.9), (0.0, 0.0, 0.0, 1.0), _BEGAN_NS))


def tree(nodes: int, seed: int) -> Tree:
    """About so many nodes in whole rollouts; the thesis' number gives exactly that."""
    count = max(1, round(_THESIS_ROLLOUTS * (nodes - 1) / (THESIS_NODES - 1)))
    succeeded = round(count * _SUCCEEDED / _THESIS_ROLLOUTS)
    stuck_later = min(count - succeeded, round(count * _STUCK_LATER / _THESIS_ROLLOUTS))
    motions = [5] * succeeded + [3] * stuck_later + [1] * (count - succeeded - stuck_later)
    random.Random(seed).shuffle(motions)
    return tree_of(motions, seed)


def tree_of(motions: Sequence[int], seed: int = 0) -> Tree:
    """Rollouts whose pick-ups have so many motions each: 5 if it went well, 1 or 3 if the last of them failed."""
    chance, clock = random.Random(seed), _Clock(_BEGAN_NS)
    made = [node for each in motions for node in _rollout(each, chance, clock)]
    return Tree(made, 1 + sum(1 for each in made for _ in each.walked()))


class _Clock:
    """Each reading is a step later."""

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns

    def read(self) -> int:
        self._now_ns += _STEP_NS
        return self._now_ns


def _rollout(motions: int, chance: random.Random, clock: _Clock) -> list[Node]:
    """Navigating, facing and picking up. The pick-up has so many motions, and its last one fails below five."""
    arm, grasp = chance.choice(("LEFT", "RIGHT")), chance.choice(("FRONT", "LEFT", "RIGHT", "TOP"))
    x, y = chance.uniform(0.3, 2.3), chance.uniform(0.0, 2.0)
    turned = math.atan2(y - MILK.place.position[1], x - MILK.place.position[0]) + math.pi
    home = _place(0.0, 0.0, 0.0, clock)
    stand = _place(x, y, 0.0, clock)
    facing = _place(x, y, turned, clock)
    torso = chance.uniform(0.0, 0.33)
    navigated = _acted("NavigateAction", {"target_location": stand}, Robot(home, torso), clock)
    navigated.children = [_moved("MoveMotion", {"target": stand}, clock)]
    _end(navigated, clock)
    faced = _acted("FaceAtAction", {"pose": MILK.place}, Robot(stand, torso), clock)
    turning = _acted("NavigateAction", {"target_location": facing}, Robot(stand, torso), clock)
    turning.children = [_moved("MoveMotion", {"target": facing}, clock)]
    looking = _acted("LookAtAction", {"target": MILK.place}, Robot(facing, torso), clock)
    looking.children = [_moved("LookingMotion", {"target": MILK.place}, clock)]
    faced.children = [_end(turning, clock), _end(looking, clock)]
    _end(faced, clock)
    picked = _acted(
        "PickUpAction", {"object_designator": MILK, "arm": arm, "grasp": grasp}, Robot(facing, torso), clock
    )
    picked.children = [_pick_up_motion(number, arm, facing, clock) for number in range(motions)]
    if motions < 5:
        picked.children[-1].failure = picked.failure = "IKError"
    return [navigated, faced, _end(picked, clock)]


def _pick_up_motion(number: int, arm: str, facing: Place, clock: _Clock) -> Node:
    """In front of it, open, to it, close, up."""
    if number in (1, 3):
        state = "OPEN" if number == 1 else "CLOSE"
        return _moved("MoveGripperMotion", {"motion": state, "gripper": arm, "allow_gripper_collision": None}, clock)
    x, y, z = MILK.place.position
    target = Place((x - 0.1 + 0.05 * number, y, z + 0.01 * number), facing.orientation, clock.read())
    return _moved("MoveTCPMotion", {"target": target, "arm": arm, "allow_gripper_collision": True}, clock)


def _place(x: float, y: float, turned: float, clock: _Clock) -> Place:
    return Place((x, y, 0.0), (0.0, 0.0, math.sin(turned / 2), math.cos(turned / 2)), clock.read())


def _acted(dtype: str, values: dict[str, object], robot: Robot, clock: _Clock) -> Node:
    return Node(dtype, values, clock.read(), robot)


def _moved(dtype: str, values: dict[str, object], clock: _Clock) -> Node:
    return _end(Node(dtype, values, clock.read()), clock)


def _end(node: Node, clock: _Clock) -> Node:
    node.end_ns = clock.read()
    return node
