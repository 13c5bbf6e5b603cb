"""A case is made of each action that ends: the situation in which it started, and its outcome."""

from __future__ import annotations

from math import cos, pi, radians, sin

import pytest

from pycrorm_async.events.types import (
    EpisodeEnded,
    NodeStarted,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    PoseValue,
)
from pycrorm_async.recall.columns import RESERVED, Case
from tests.projections.event_script import T0_NS, declared, name_of, pose, row, time_us
from tests.recall.case_script import LEFT_TURN, CaseScript, cases_of


def test_a_case_has_the_situation_before_the_action_and_its_outcome() -> None:
    script = CaseScript()
    milk = script.add("milk", "MILK", pose(1.0, 0.5, 0.9, turned=LEFT_TURN))
    script.add("bowl", "BOWL", pose(1.0, 0.9, 0.9))
    script.add("cup", "JEROEN_CUP", pose(1.0, 0.5, 0.3))
    table = script.add("table", "GENERIC_OBJECT", pose(5.0))
    root = script.put(NodeStarted("root"))
    before = script.wait(root)
    script.end(before, "FAILED", "PerceptionTimeout")
    node = script.fetch(
        milk, root, status="urgent", grams=200, gently=True, at="2026-11-23T10:00:00.000000Z",
        goal=pose(2.0, 1.0, 0.5), surface={"object": table, "row": table},
    )  # fmt: skip
    script.put(ObjectMoved(milk, "milk", "MILK", pose(9.0)))
    script.end(node, "FAILED", "IKError")
    waited, fetched = cases_of(script)
    assert waited == Case(
        row(before), time_us(before), "WaitAction", {}, {"seconds": 1.5}, "FAILED", "PerceptionTimeout", 1.0
    )
    assert fetched._replace(numbers={}) == Case(
        row(node),
        time_us(node),
        "FetchAction",
        {
            "after": "WaitAction",
            "after_status": "FAILED",
            "robot": "pr2",
            "object_type": "MILK",
            "object_name": "milk",
            "near": ("BOWL",),
            "arm": "LEFT",
            "status_parameter": "urgent",
            "gently": "True",
            "surface_type": "GENERIC_OBJECT",
        },
        {},
        "FAILED",
        "IKError",
        2.0,
    )
    # The robot stands at (2, 0), turned to the left as the milk is: in the milk's frame it is 0.5 m behind its right.
    assert fetched.numbers == pytest.approx(
        {
            "stand_x": -0.5, "stand_y": -1.0, "stand_yaw": 0.0, "torso": 0.25, "object_z": 0.9, "height": 0.65,
            "grams": 200.0, "goal_x": 1.0, "goal_y": 0.0, "goal_z": 0.5, "goal_yaw": -pi / 2,
        },
        abs=1e-6,
    )  # fmt: skip


def test_beside_an_object_that_lies_or_leans_the_robot_has_no_place_in_its_frame() -> None:
    script = CaseScript()
    for degrees in (0, 7, 9, 90, 180):
        turn = radians(degrees) / 2
        milk = script.add("milk", "MILK", PoseValue((1.0, 0.0, 0.9), (sin(turn), 0.0, 0.0, cos(turn)), "map", T0_NS))
        script.end(script.fetch(milk))
    places = [{"stand_x", "stand_y", "stand_yaw"} & each.numbers.keys() for each in cases_of(script)]
    assert [len(each) for each in places] == [3, 3, 0, 0, 0]
    assert all(each.numbers["object_z"] == pytest.approx(0.9) for each in cases_of(script))


def test_the_outcome_is_no_feature_of_the_situation() -> None:
    script = CaseScript()
    milk = script.add("milk", "MILK", pose())
    first = script.fetch(milk)
    second = script.fetch(milk)
    script.end(first, "SUCCEEDED")
    script.end(second, "FAILED", "IKError")
    succeeded, failed = cases_of(script)
    assert (succeeded.symbols, succeeded.numbers) == (failed.symbols, failed.numbers)
    assert not RESERVED & (failed.symbols.keys() | failed.numbers.keys())


def test_an_action_has_the_action_around_it_and_the_one_before_it_inside_that() -> None:
    script = CaseScript()
    outer = script.wait()
    sequential = script.put(NodeStarted("language", outer))
    one = script.wait(sequential)
    inner = script.wait(one)
    script.end(inner)
    script.end(one, "CANCELLED")
    two = script.wait(script.put(NodeStarted("motion", outer)))
    script.end(two)
    script.end(outer)
    last = script.wait()
    script.end(last)
    around = {each.sequence: (each.symbols, each.parent) for each in cases_of(script)}
    assert around == {
        outer: ({}, None),
        one: ({"inside": "WaitAction"}, row(outer)),
        inner: ({"inside": "WaitAction"}, row(one)),
        two: ({"inside": "WaitAction", "after": "WaitAction", "after_status": "CANCELLED"}, row(outer)),
        last: ({"after": "WaitAction", "after_status": "SUCCEEDED"}, None),
    }


def test_what_the_robot_holds_and_what_is_near_follows_the_world() -> None:
    script = CaseScript()
    milk, bowl = script.add("milk", "MILK", pose()), script.add("bowl", "BOWL", pose(3.0))
    robot, held = ObjectReference(script.robot, script.robot), ObjectReference(bowl, bowl)
    nodes = [script.fetch(milk)]
    script.put(ObjectAttached(robot, held, "gripper"))
    script.put(ObjectMoved(bowl, "bowl", "BOWL", pose(0.2)))
    nodes.append(script.fetch(milk))
    script.put(ObjectDetached(robot, held))
    nodes.append(script.fetch(milk))
    script.put(ObjectRemoved(held))
    nodes.append(script.fetch(milk))
    script.put(ObjectRemoved(ObjectReference(milk, milk)))
    nodes.append(script.fetch(milk))
    for node in nodes:
        script.end(node)
    seen = [{name: each.symbols.get(name) for name in ("near", "held", "object_type")} for each in cases_of(script)]
    assert seen == [
        {"near": None, "held": None, "object_type": "MILK"},
        {"near": ("BOWL",), "held": ("BOWL",), "object_type": "MILK"},
        {"near": ("BOWL",), "held": None, "object_type": "MILK"},
        {"near": None, "held": None, "object_type": "MILK"},
        {"near": None, "held": None, "object_type": None},
    ]


def test_near_ends_at_half_a_metre() -> None:
    script = CaseScript()
    milk, bowl = script.add("milk", "MILK", pose()), script.add("bowl", "BOWL", pose(0.5))
    script.end(script.fetch(milk))
    script.put(ObjectMoved(bowl, "bowl", "BOWL", pose(0.501)))
    script.end(script.fetch(milk))
    assert [each.symbols.get("near") for each in cases_of(script)] == [("BOWL",), None]


def test_an_object_outside_of_the_recorded_world_has_what_its_value_has() -> None:
    script = CaseScript()
    believed = {"dtype": "BelieveObject", "name": "cup", "object_type": "JEROEN_CUP"}
    for pose_ in ({}, {"pose": {"position": [2, 1, 1], "orientation": [0, 0, 0, 1], "frame": "map", "time_ns": 1}}):
        script.end(script.fetch({**believed, **pose_}))
    unplaced, placed = cases_of(script)
    assert unplaced.symbols["object_type"] == placed.symbols["object_type"] == "JEROEN_CUP"
    assert unplaced.numbers.keys() == {"torso"}
    assert (placed.numbers["object_z"], placed.numbers["height"], placed.numbers["stand_y"]) == (1.0, 0.75, -1.0)


def test_running_actions_become_lost_cases_when_their_episode_is_lost_and_none_otherwise() -> None:
    lost, ended = CaseScript(), CaseScript()
    for script, status in ((lost, "LOST"), (ended, "SUCCEEDED")):
        outer = script.wait()
        script.end(script.wait(outer), "LOST")
        script.wait(outer)
        script.put(EpisodeEnded(status))  # type: ignore[arg-type]
    assert [(each.status, each.duration_s) for each in cases_of(lost)] == [("LOST", None)] * 3
    assert [(each.status, each.duration_s) for each in cases_of(ended)] == [("LOST", None)]


def test_cases_of_a_simulation_are_marked() -> None:
    script = CaseScript(simulated=True)
    script.end(script.wait())
    assert [each.simulated for each in cases_of(script)] == [True]


def test_an_action_whose_type_was_never_declared_is_no_case_and_stops_nothing() -> None:
    script = CaseScript()
    strange = script.put(NodeStarted("action", designator=name_of(declared("Strange", "strange"))))
    inside = script.wait(strange)
    script.end(inside)
    script.end(strange)
    assert [each.sequence for each in cases_of(script)] == [inside]


@pytest.mark.parametrize("seconds", [None, 10**400, 1e308])
def test_a_number_that_is_missing_or_has_no_float_is_left_out(seconds: object) -> None:
    script = CaseScript()
    script.end(script.wait(seconds=seconds))
    assert [each.numbers for each in cases_of(script)] == [{}]
