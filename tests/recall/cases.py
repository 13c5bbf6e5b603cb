"""Cases for the tests: scripts of episodes whose actions become cases, and random cases whose values are few."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from random import Random
from typing import Any

import numpy as np
from hypothesis import strategies as st

from pycrorm_async.events import types as events
from pycrorm_async.events.ids import row_id
from pycrorm_async.projections.columns import Layout
from pycrorm_async.projections.custom_tables import learner_of
from pycrorm_async.projections.fold import decode_events
from pycrorm_async.recall.blocks import CaseBlock
from pycrorm_async.recall.cases import CaseBatch, CaseProjection
from pycrorm_async.recall.columns import Case
from tests.projections.event_script import Script, declarations, declared, field, name_of, pose

# === case script ==============================================================================================
#
# Scripts of episodes whose actions become cases: one with known values, and random ones.

FETCH = declared(
    "FetchAction",
    "fetch_action",
    field("item", "object", 2),
    field("arm", "enum", 3),
    field("status", "text", 4),
    field("grams", "integer", 5),
    field("gently", "boolean", 6),
    field("at", "datetime", 7),
    field("goal", "pose", 8),
    field("surface", "object", 9),
)
WAIT = declared("WaitAction", "wait_action", field("seconds", "real", 2))
TYPES = declarations(FETCH, WAIT)
LEFT_TURN = 0.5**0.5
"""The quaternion's z of a quarter turn to the left."""


class CaseScript(Script):
    """An episode with a robot, an environment and objects."""

    def __init__(self, episode: int = 1, *, simulated: bool = False) -> None:
        super().__init__(episode)
        self.put(events.EpisodeStarted("", "me", "host", "", "3.11", simulated=simulated))
        self.robot = self.add("pr2", "ROBOT", pose(1.0, 1.0))
        self.kitchen = self.add("kitchen", "ENVIRONMENT", pose())

    def add(self, name: str, type_: str, at: events.PoseValue) -> int:
        return self.put(events.ObjectAdded(name, type_, at))

    def acting(self, at: events.PoseValue, torso: float | None = 0.25) -> events.RobotValue:
        return events.RobotValue(at, "ROBOT", torso, events.ObjectReference(self.robot, self.robot), "pr2")

    def fetch(self, item: int | Mapping[str, Any], parent: int | None = None, **parameters: Any) -> int:
        value = {"object": item, "row": item} if isinstance(item, int) else item
        values = {"item": value, "arm": "LEFT", **parameters}
        robot = self.acting(pose(2.0, 0.0, 0.0, turned=LEFT_TURN))
        return self.put(events.NodeStarted("action", parent, name_of(FETCH), values, robot))

    def wait(self, parent: int | None = None, seconds: object = 1.5) -> int:
        return self.put(events.NodeStarted("action", parent, name_of(WAIT), {"seconds": seconds}))

    def end(self, node: int, status: events.NodeStatus = "SUCCEEDED", reason: str | None = None) -> int:
        failure = events.FailureValue(f"pycrorm_async.plan.failures.{reason}", "no") if reason is not None else None
        return self.put(events.NodeEnded(node, status, failure))


def cases_of(*scripts: Script, first_number: int = 1) -> list[Case]:
    """Fold whole episodes in memory; return their cases as a memory keeps them, by node."""
    _, batch = learner_of(CaseProjection())(Layout(), [each.payload for each in TYPES])
    rows = batch()
    assert isinstance(rows, CaseBatch)
    for number, script in enumerate(scripts, first_number):
        stored = script.stored(number)
        assert rows.fold(stored, decode_events(stored)[0]) is None
    return in_order(CaseBlock.of(rows.cases).cases()) if rows.cases else []


def in_order(cases: Iterable[Case]) -> list[Case]:
    return sorted(cases, key=lambda each: each.node)


STATUSES: Sequence[tuple[events.NodeStatus, str | None]] = [
    ("SUCCEEDED", None),
    ("FAILED", "IKError"),
    ("CANCELLED", None),
    ("LOST", None),
]


def random_script(episode: int, random: Random, *, actions: int) -> CaseScript:
    """Return an episode with actions inside each other in a changing world. It may end, be lost or stay open."""
    script = CaseScript(episode, simulated=random.random() < 0.1)
    objects = [script.add(f"thing {index}", random.choice(["MILK", "BOWL"]), pose(index / 3)) for index in range(3)]
    open_nodes = [script.put(events.NodeStarted("root"))]
    for _ in range(actions):
        match random.randrange(8):
            case 0 | 1:
                item, goal = random.choice(objects), pose(random.random(), 1.0)
                grams = random.choice([None, 5, 2**40 + 1])
                open_nodes.append(script.fetch(item, open_nodes[-1], grams=grams, goal=goal))
            case 2:
                open_nodes.append(script.wait(open_nodes[-1], random.random() * 4))
            case 3:
                moved = random.choice(objects)
                script.put(events.ObjectMoved(moved, "thing", "MILK", pose(random.random() * 2)))
            case 4:
                change = random.choice([events.ObjectAttached, events.ObjectDetached])
                ends = (
                    events.ObjectReference(script.robot, script.robot),
                    events.ObjectReference(objects[0], objects[0]),
                )
                script.put(change(*ends))
            case 5:
                script.put(
                    events.JointsMoved(events.ObjectReference(script.robot, script.robot), {"torso": random.random()})
                )
            case _ if len(open_nodes) > 1:
                script.end(open_nodes.pop(), *random.choice(STATUSES))
            case _:
                script.put(events.NodeStarted("motion", open_nodes[-1]))
    if random.random() < 0.6:
        while random.random() < 0.7 and len(open_nodes) > 1:
            script.end(open_nodes.pop())
        script.put(events.EpisodeEnded(random.choice(["LOST", "SUCCEEDED"])))
    return script


# === random cases =============================================================================================
#
# Random cases whose values are few, so that cues meet them, with every kind of column and every absence.

CASE_TYPES = ("PickUpAction", "PlaceAction", "NavigateAction")
WORDS = ("MILK", "BOWL", "CUP", "SPOON")
CASE_STATUSES = ("SUCCEEDED", "FAILED", "ERROR", "LOST")


def random_case(sequence: int, chance: random.Random, *, words: tuple[str, ...] = WORDS) -> Case:
    """One case; its start differs from those of others in some tries only, and it may lack any feature."""

    def some(value: object) -> bool:
        return value is not None and chance.random() < 0.8

    texts = {
        "object_type": chance.choice(words),
        "arm": chance.choice(("LEFT", "RIGHT")),
        "near": tuple(sorted(chance.sample(words, chance.randrange(len(words))))),
    }
    numbers = {
        "height": round(chance.uniform(0.5, 1.5), 2),
        "stand_yaw": chance.uniform(-3.14, 3.14),
        "ticket": chance.choice((3.0, 2.0**40 + 1)),
    }
    status = chance.choice(CASE_STATUSES)
    episode = chance.randrange(1, 4)
    return Case(
        row_id(episode, sequence, 0),
        chance.randrange(50),
        chance.choice(CASE_TYPES),
        {name: value for name, value in texts.items() if value and some(value)},
        {name: value for name, value in numbers.items() if some(value)},
        status,
        chance.choice(("IKError", "ObjectUnreachable")) if status == "FAILED" else None,
        None if status == "LOST" else chance.random(),
        row_id(episode, 7, 0) if chance.random() < 0.3 else None,
        chance.random() < 0.1,
    )


def random_cases(count: int, seed: int, *, words: tuple[str, ...] = WORDS) -> list[Case]:
    """Return cases with different nodes."""
    chance = random.Random(seed)
    return [random_case(sequence, chance, words=words) for sequence in range(1, count + 1)]


def kept_case(case: Case) -> Case:
    """Return a random case as a block keeps it: numbers are float32, but for columns with large ones."""
    numbers = {name: number if number > 2**24 else float(np.float32(number)) for name, number in case.numbers.items()}
    symbols = {name: value for name, value in case.symbols.items() if value}
    duration_s = None if case.duration_s is None else float(np.float32(case.duration_s))
    return case._replace(symbols=symbols, numbers=numbers, duration_s=duration_s)


CASES = st.builds(random_cases, st.integers(1, 40), st.integers(0, 2**32))
"""Lists of random cases."""
