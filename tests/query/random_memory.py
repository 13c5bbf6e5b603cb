"""Memories made at random, and answers to the named questions reckoned in plain Python from their events alone."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec

from pycrorm_async.events import types as events
from tests.projections.event_script import MOVE, NAVIGATE, PICK_UP, SAYING, T0_NS, Script, declarations, name_of, pose

TYPES = declarations(NAVIGATE, PICK_UP, SAYING, MOVE)
DTYPES = {name_of(each): each.dtype for each in (NAVIGATE, PICK_UP, SAYING, MOVE)}
REASONS = ("a.IKError", "a.CollisionError", "b.ObjectLost", "ValueError")
MESSAGES = ("cannot reach (1, 2)", "50% of the way", "milk_2 is gone", "Too far")
NAMES = ("milk", "Cereal", "milk_2", "bowl")


class RandomEpisode(Script):
    """An episode made at random. It ends, or it still runs and has open nodes."""

    def __init__(self, number: int, seed: int) -> None:
        super().__init__(number)
        self.number = number
        self.happenings: list[events.Happening] = []
        self._dice = dice = random.Random(seed)
        self._rows: dict[str, events.ObjectReference] = {}
        tags = tuple(dice.sample(["night", "kitchen"], dice.randrange(3)))
        self.put(
            events.EpisodeStarted(
                f"run {number} of milk", "me", "host", "1", "3.11", plan=dice.choice(["tidy", "set"]), tags=tags
            )
        )
        root = self.put(events.NodeStarted("root"))
        for name in dice.sample(NAMES, 3):
            added = self.put(events.ObjectAdded(name, dice.choice(["MILK", "BOWL"]), self._place()))
            self._rows[name] = events.ObjectReference(added, added)
        runs = number % 5 == 0
        self._children(root, dice.randrange(2, 6), depth=0, open_=runs)
        for name in [*self._rows][: dice.randrange(3)]:
            self.put(events.ObjectRemoved(self._rows.pop(name), root))
        if not runs:
            self.put(events.NodeEnded(root, "SUCCEEDED"))
            self.put(events.EpisodeEnded(dice.choice(["SUCCEEDED", "FAILED"])))

    def put(self, event: events.Happening, *, version: int | None = None) -> int:
        self.happenings.append(event)
        return super().put(event, version=version)

    def _place(self) -> events.PoseValue:
        place = pose(self._dice.choice([0.0, 0.5, 2.0]), self._dice.choice([0.0, 1.0]), 0.9)
        return msgspec.structs.replace(place, time_ns=T0_NS + self.number)

    def _children(self, parent: int, count: int, *, depth: int, open_: bool) -> bool:
        """Put this many nodes; return whether one of them failed."""
        failed = False
        for number in range(count):
            ends = not (open_ and number == count - 1)
            failed |= self._node(parent, depth, ends=ends)
            if self._dice.random() < 0.5:
                self._change(parent if self._dice.random() < 0.8 else None)
        return failed

    def _node(self, parent: int, depth: int, *, ends: bool) -> bool:
        dice = self._dice
        type_ = MOVE if depth > 1 else dice.choice([NAVIGATE, PICK_UP, SAYING])
        robot = events.RobotValue(self._place(), "ROBOT", dice.choice([None, 0.25]), name=dice.choice([None, "pr2"]))
        started = events.NodeStarted(
            "motion" if type_ is MOVE else "action",
            parent,
            name_of(type_),
            self._parameters(type_.dtype),
            robot if type_ is PICK_UP or dice.random() < 0.8 else None,
        )
        node = self.put(started)
        child_failed = depth < 3 and self._children(node, dice.randrange(3), depth=depth + 1, open_=not ends)
        for _ in range(dice.randrange(2)):
            self._change(node)
        if not ends:
            return False
        if dice.random() < (0.7 if child_failed else 0.3):
            self.put(events.NodeEnded(node, dice.choice(["FAILED", "FAILED", "ERROR"]), self._failure()))
            return True
        self.put(events.NodeEnded(node, "INTERRUPTED" if dice.random() < 0.2 else "SUCCEEDED"))
        return False

    def _failure(self) -> events.FailureValue:
        return events.FailureValue(self._dice.choice(REASONS), self._dice.choice(MESSAGES))

    def _parameters(self, dtype: str) -> dict[str, Any]:
        dice = self._dice
        match dtype:
            case "PickUpAction":
                arm, grasp = dice.choice(["LEFT", "RIGHT"]), dice.choice(["TOP", "FRONT"])
                return {"object_designator": self._rows[dice.choice([*self._rows])], "arm": arm, "grasp": grasp}
            case "SayingAction":
                return {"text": "hello"}
            case "NavigateAction":
                return {"target_location": self._place()}
        return {"target": self._place()}

    def _change(self, node: int | None) -> None:
        dice = self._dice
        first, second = dice.sample([*self._rows], 2) if len(self._rows) > 1 else ([*self._rows] * 2)
        one, two = self._rows[first], self._rows[second]
        match dice.randrange(7):
            case 0 | 1 | 2:
                moved = self.put(events.ObjectMoved(one.object, first, "MILK", self._place(), node))
                self._rows[first] = events.ObjectReference(one.object, moved)
            case 3:
                self.put(events.ObjectAttached(one, two, "gripper", node))
            case 4:
                self.put(events.ObjectDetached(one, two, "gripper", node))
            case 5:
                self.put(events.JointsMoved(one, {"lid": dice.random(), "door": dice.random()}, node))
            case 6:
                seen = events.SeenValue(first, "MILK", self._place(), one, confidence=0.5)
                self.put(events.ObjectDetected("camera", None, (seen,), node))


@dataclass
class Node:
    """A node according to its events."""

    episode: int
    sequence: int
    started: events.NodeStarted
    end: int | None = None
    ended: events.NodeEnded | None = None
    parent: Node | None = None
    children: list[Node] = field(default_factory=list)
    object_names: dict[int, str] = field(default_factory=dict)

    @property
    def dtype(self) -> str | None:
        return None if self.started.designator is None else DTYPES[self.started.designator]

    @property
    def status(self) -> str:
        return self.ended.status if self.ended is not None else "RUNNING"

    @property
    def is_failed(self) -> bool:
        return self.status in ("FAILED", "ERROR")

    @property
    def duration(self) -> float | None:
        return None if self.end is None else float(self.end - self.sequence)

    @property
    def reason(self) -> str | None:
        failure = self.ended.failure if self.ended is not None else None
        return failure.type.split(".")[-1] if failure is not None else None

    @property
    def message(self) -> str | None:
        failure = self.ended.failure if self.ended is not None else None
        return failure.message if failure is not None else None

    def up(self) -> Iterator[Node]:
        yield self
        if self.parent is not None:
            yield from self.parent.up()

    @property
    def arm(self) -> str | None:
        return next((each.started.parameters["arm"] for each in self.up() if "arm" in each.started.parameters), None)

    @property
    def object(self) -> str | None:
        for each in self.up():
            reference = each.started.parameters.get("object_designator")
            if reference is not None:
                return self.object_names[reference.object]
        return None

    @property
    def subject(self) -> tuple[Any, ...]:
        """The object, or else the parameters by which a second try is the same."""
        parameters = self.started.parameters
        if "object_designator" in parameters:
            return ("object", parameters["object_designator"].object)
        places = (
            msgspec.structs.replace(each, time_ns=0)
            for each in parameters.values()
            if isinstance(each, events.PoseValue)
        )
        return (*places, parameters.get("text"))

    def down(self) -> Iterator[Node]:
        yield self
        for each in self.children:
            yield from each.down()

    @property
    def outcome(self) -> str:
        for node in self.up():
            if node.status == "SUCCEEDED":
                return "ignored"
            if node.status == "RUNNING":
                return "open"
            others = node.parent.down() if node.is_failed and node.parent is not None else ()
            if any(each.repeats(node) for each in others):
                return "recovered"
        return "failed"

    def repeats(self, failed: Node) -> bool:
        is_later = failed.end is not None and self.sequence > failed.end
        return is_later and self.status == "SUCCEEDED" and (self.dtype, self.subject) == (failed.dtype, failed.subject)

    @property
    def recovered(self) -> bool:
        return self.outcome == "recovered"


def nodes_of(episodes: Iterable[RandomEpisode]) -> list[Node]:
    """Return all nodes, in the order in which they started."""
    nodes: list[Node] = []
    for each in episodes:
        own: dict[int, Node] = {}
        names: dict[int, str] = {}
        for sequence, happening in enumerate(each.happenings, 1):
            match happening:
                case events.NodeStarted(parent=parent):
                    own[sequence] = Node(
                        each.number, sequence, happening, parent=own.get(parent or 0), object_names=names
                    )
                    if parent is not None:
                        own[parent].children.append(own[sequence])
                case events.NodeEnded(node=node):
                    own[node].end, own[node].ended = sequence, happening
                case events.ObjectAdded(name=name):
                    names[sequence] = name
        nodes += own.values()
    return nodes


def root_failures_of(episodes: Iterable[RandomEpisode]) -> list[Node]:
    return [
        each for each in nodes_of(episodes) if each.is_failed and not any(child.is_failed for child in each.children)
    ]


def course_of(episode: RandomEpisode, name: str) -> list[tuple[int, str, str | None, str | None]]:
    """Return what happened to an object: sequence, what, the other object, a detail; in the order of the answer."""
    names = {
        sequence: each.name
        for sequence, each in enumerate(episode.happenings, 1)
        if isinstance(each, events.ObjectAdded)
    }
    course: list[tuple[int, str, str | None, str | None]] = []
    for sequence, happening in enumerate(episode.happenings, 1):
        match happening:
            case events.ObjectAdded(name=own) if own == name:
                course.append((sequence, "added", None, None))
            case events.ObjectMoved(name=own) if own == name:
                course.append((sequence, "moved", None, None))
            case events.ObjectRemoved(object=own) if names[own.object] == name:
                course.append((sequence, "removed", None, None))
            case (
                events.ObjectAttached(parent=parent, child=child, link=link)
                | events.ObjectDetached(parent=parent, child=child, link=link)
            ):
                attaches = isinstance(happening, events.ObjectAttached)
                if names[child.object] == name:
                    course.append((sequence, "attached" if attaches else "detached", names[parent.object], link))
                if names[parent.object] == name:
                    course.append((sequence, "holds" if attaches else "releases", names[child.object], link))
            case events.JointsMoved(object=own, joints=joints) if names[own.object] == name:
                course += [(sequence, "joint moved", None, joint) for joint in joints]
            case events.ObjectDetected(seen=seen):
                course += [(sequence, "detected", None, "camera") for each in seen if each.name == name]
    failed = [each for each in root_failures_of([episode]) if each.object == name]
    course += [(each.sequence, "an action failed", None, each.reason) for each in failed]
    return sorted(course, key=lambda each: (each[0], each[1], each[3] or ""))


# === random episodes ==========================================================================================
#
# Make the random episodes about which all named questions are asked.

EPISODES = [RandomEpisode(number, seed=number) for number in range(1, 26)]
