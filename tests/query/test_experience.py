"""Experience from past pick-ups: the ones that count, their success rates, and their order."""

from __future__ import annotations

import math
from typing import Any

import pytest
from sqlalchemy import Connection, event

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import EpisodeStarted, NodeEnded, NodeStarted, ObjectAdded
from pycrorm_async.events.values import FailureValue, NodeStatus, ObjectReference, PoseValue, RobotValue
from pycrorm_async.plan.experience import PastSuccess
from pycrorm_async.query.experience import ATTEMPTS_MAX, Attempt, PickUpExperience, best_first
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world.enums import Arms, Grasp, ObjectType
from pycrorm_async.world.pose import Pose, yaw_quaternion
from tests.databases import Server
from tests.projections.event_script import PICK_UP, T0_NS, Script, declarations, name_of
from tests.projections.sql_queries import stored_and_folded

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""


def tried(
    x: float, y: float, *, succeeded: bool, arm: Arms = Arms.LEFT, z: float = -0.9, torso: float | None = 0.3
) -> Attempt:
    return Attempt(arm, Grasp.FRONT, torso, Pose([x, y, z]), succeeded)


def ways(result: list[PastSuccess]) -> list[tuple[Arms, float, float, float, int]]:
    return [(each.arm, *each.stand.position[:2], round(each.score, 9), each.times) for each in result]


def test_the_rate_of_a_pose_is_the_share_of_successes_near_it() -> None:
    attempts = [
        tried(-0.7, 0, succeeded=True),
        tried(-0.65, 0, succeeded=True),  # 0.05 m from the first
        tried(-0.7, 0.08, succeeded=False),  # 0.08 m from the first, 0.094 m from the second
        tried(-0.7, 0, succeeded=False, arm=Arms.RIGHT),  # another arm
        tried(-0.7, 0, succeeded=False, z=-0.7),  # another height
        tried(-0.7, 0, succeeded=False, torso=0.1),  # another torso height
        tried(-0.9, 0.2, succeeded=True),  # no neighbour
        tried(-0.9, 0.5, succeeded=True),
        tried(-0.9, 0.5, succeeded=True),
        tried(-0.9, 0.5, succeeded=True),
        tried(0.9, 0.5, succeeded=False),
    ]
    assert ways(best_first(attempts)) == [
        (Arms.LEFT, -0.9, 0.5, 0.8, 3),  # (3 + 1) / (3 + 2)
        (Arms.LEFT, -0.9, 0.2, round(2 / 3, 9), 1),  # (1 + 1) / (1 + 2)
        (Arms.LEFT, -0.7, 0.0, 0.6, 1),  # (2 + 1) / (3 + 2)
        (Arms.LEFT, -0.65, 0.0, 0.6, 1),
    ]


def test_equal_rates_are_ordered_by_successes_and_then_by_position_in_the_list() -> None:
    attempts = [tried(x, 0, succeeded=True) for x in (-0.8, -0.75, -0.75, -0.7)]
    assert [(each.stand.position.x, each.times) for each in best_first(attempts)] == [(-0.75, 2), (-0.8, 1), (-0.7, 1)]


def test_without_a_torso_height_the_pose_alone_counts_and_without_attempts_there_is_no_experience() -> None:
    attempts = [tried(-0.7, 0, succeeded=True, torso=None), tried(-0.7, 0.05, succeeded=False, torso=None)]
    (result,) = best_first(attempts)
    assert (result.torso_height, result.score) == (None, 0.5)
    assert best_first([]) == []
    assert best_first([tried(-0.7, 0, succeeded=False)]) == []


# --- from the tables ------------------------------------------------------------------------------------------------


def picked(
    script: Script, object_number: int, *, arm: str = "LEFT", status: NodeStatus = "SUCCEEDED", at: tuple[float, float],
    heading: float = 0.0,
) -> None:  # fmt: skip
    stand = PoseValue((*at, 0.0), yaw_quaternion(heading), "map", T0_NS)
    parameters = {"object_designator": ObjectReference(object_number, object_number), "arm": arm, "grasp": "FRONT"}
    node = script.put(NodeStarted("action", None, name_of(PICK_UP), parameters, RobotValue(stand, "ROBOT", 0.3)))
    script.put(NodeEnded(node, status, None if status == "SUCCEEDED" else FailureValue("a.IKError", "far")))


def added(script: Script, name: str, kind: str, at: tuple[float, float, float], heading: float = 0.0) -> int:
    return script.put(ObjectAdded(name, kind, PoseValue(at, yaw_quaternion(heading), "map", T0_NS)))


async def experience_of(log: EventLog, *scripts: Script, arm: Arms | None = None) -> list[PastSuccess]:
    await stored_and_folded(log, [*declarations(PICK_UP), *(each for script in scripts for each in script.records)])
    return list(await PickUpExperience(Reading(log)).successes(ObjectType.MILK, arm=arm))


async def test_poses_are_relative_to_the_object_whatever_its_orientation(log: EventLog) -> None:
    script = Script()
    milk = added(script, "milk", "MILK", (1.0, 2.0, 0.9), heading=math.pi / 2)
    picked(script, milk, at=(1.0, 1.3), heading=math.pi / 2)
    (result,) = await experience_of(log, script)
    # 0.7 m behind it, where "behind" is against its own x, which points along map's y
    assert result.stand.position == pytest.approx((-0.7, 0.0, -0.9))
    assert result.stand.orientation == pytest.approx((0, 0, 0, 1))
    assert (result.arm, result.grasp, result.torso_height, result.times) == (Arms.LEFT, Grasp.FRONT, 0.3, 1)
    assert result.score == pytest.approx(2 / 3)


async def test_other_types_other_arms_and_pick_ups_without_an_outcome_do_not_count(log: EventLog) -> None:
    script = Script()
    milk = added(script, "milk", "MILK", (1.0, 0.0, 0.9))
    bowl = added(script, "bowl", "BOWL", (1.0, 0.0, 0.9))
    picked(script, milk, at=(0.3, 0.0))
    picked(script, milk, at=(0.3, 0.0), arm="RIGHT")
    picked(script, bowl, at=(0.3, 0.0), status="FAILED")
    for status in ("CANCELLED", "INTERRUPTED", "ERROR", "LOST"):
        picked(script, milk, at=(0.3, 0.0), status=status)
    result = await experience_of(log, script)
    assert [(each.arm, round(each.score, 6)) for each in result] == [(Arms.RIGHT, 0.666667), (Arms.LEFT, 0.666667)]
    asked = PickUpExperience(Reading(log))
    assert [each.arm for each in await asked.successes(ObjectType.MILK, arm=Arms.LEFT)] == [Arms.LEFT]
    assert await asked.successes(ObjectType.SPOON, arm=None) == []


async def test_simulated_pick_ups_do_not_count(log: EventLog) -> None:
    simulation = Script(1)
    simulation.put(EpisodeStarted("thinking", "me", "host", "1.0", "3.11", simulated=True))
    milk = added(simulation, "milk", "MILK", (1.0, 0.0, 0.9))
    parameters = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "FRONT"}
    stand = PoseValue((0.3, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "map", T0_NS)
    node = simulation.put(
        NodeStarted("action", None, name_of(PICK_UP), parameters, RobotValue(stand, "ROBOT", 0.3), simulated=True)
    )
    simulation.put(NodeEnded(node, "SUCCEEDED"))
    done = Script(2)
    done.put(EpisodeStarted("doing", "me", "host", "1.0", "3.11"))
    picked(done, added(done, "milk", "MILK", (1.0, 0.0, 0.9)), at=(0.2, 0.0))
    assert [each.stand.position.x for each in await experience_of(log, simulation, done)] == pytest.approx([-0.8])


async def test_only_the_latest_pick_ups_are_read(log: EventLog) -> None:
    script = Script()
    milk = added(script, "milk", "MILK", (1.0, 0.0, 0.9))
    picked(script, milk, at=(0.4, 0.0))
    picked(script, milk, at=(0.2, 0.0))
    for _ in range(ATTEMPTS_MAX - 1):
        picked(script, milk, at=(0.0, 0.0), status="FAILED")
    assert [each.stand.position.x for each in await experience_of(log, script)] == pytest.approx([-0.8])


async def test_a_server_reads_the_latest_pick_ups_from_the_end_of_an_index(server: Server) -> None:
    log = await EventLog.open(DatabaseAddress.parse(server.new_database()), create=True)
    plans: list[str] = []

    def explained(connection: Connection, _cursor: object, statement: str, parameters: Any, *_: object) -> None:
        if statement.startswith("SELECT") and "PickUpWithContextView" in statement:
            plans.append(str(connection.exec_driver_sql(f"EXPLAIN {statement}", parameters).all()))

    script = Script()
    picked(script, added(script, "milk", "MILK", (1.0, 0.0, 0.9)), at=(0.4, 0.0))
    event.listen(log.engine.sync_engine, "before_cursor_execute", explained)
    try:
        assert len(await experience_of(log, script)) == 1
    finally:
        await log.close()
    (plan,) = plans
    assert "Limit" in plan
    assert "Sort" not in plan


async def test_a_closed_memory_is_not_queried(log: EventLog) -> None:
    asked = PickUpExperience(Reading(log))
    asked.is_closed = True
    with pytest.raises(CallerError, match="the memory is closed, so its experience cannot be read"):
        await asked.successes(ObjectType.MILK, arm=None)
