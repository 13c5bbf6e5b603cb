"""Measured defects of the plan language of the thesis' time, each with the property that this package keeps instead.

Numbers are those of the table in tests/README.md.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import Code, Designator, NavigateAction, ParkArmsAction, PlanFailure, Repeat
from pycrorm_async.plan.failures import ObjectLost
from pycrorm_async.world import Arms, Pose
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import FailingActionPerformable, lab, nodes_of, recorded, results_of, statuses

pytestmark = pytest.mark.slow


def succeeding(text: str = "well") -> NoteActionPerformable:
    return NoteActionPerformable(text)


def failing() -> FailingActionPerformable:
    return FailingActionPerformable(ObjectLost("the milk slipped", "milk"))


async def test_a_failure_deep_inside_an_expression_fails_all_of_it(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        for plan in ((succeeding() + failing()) | succeeding(), (failing() | succeeding()) + succeeding("never")):
            with pytest.raises(ObjectLost, match="the milk slipped"):
                await plan.perform()
    nodes = await nodes_of(tmp_path)
    # The branches ran in any order; their classes and outcomes are always the same.
    assert sorted(statuses(nodes)[1:]) == sorted(
        [
            *[("Parallel", "FAILED"), ("Sequential", "FAILED"), ("FailingAction", "FAILED")] * 2,
            *[("NoteAction", "SUCCEEDED")] * 3,
        ]
    )
    for node in nodes:
        if node.status.name == "FAILED":
            assert (node.reason, node.failure_message) == ("ObjectLost", "the milk slipped")
            assert node.failure_arguments == ["the milk slipped", "milk"]


async def test_a_sequence_runs_in_the_order_in_which_it_is_written_however_it_is_nested(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        await (succeeding("1") + (succeeding("2") + succeeding("3"))).perform()
        await ((succeeding("4") + succeeding("5")) + (succeeding("6") + (succeeding("7") + succeeding("8")))).perform()
        await memory.flush()
        notes = memory.mapped(NoteActionPerformable)
        assert list(await results_of(tmp_path, select(notes.text).order_by(notes.id))) == list("12345678")
    assert [dtype for dtype, _ in statuses(await nodes_of(tmp_path)) if dtype != "NoteAction"] == [
        None,
        "Sequential",
        "Sequential",
    ]


async def test_a_repetition_returns_its_rounds_and_failures(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        outcome = await (succeeding() * 3).perform()
        assert (outcome.rounds, outcome.results, outcome.succeeded) == (3, (None, None, None), (0, 1, 2))
        with pytest.raises(PlanFailure) as caught:
            await Repeat(failing(), 2).perform()
        assert [type(each) for each in caught.value.data] == [ObjectLost, ObjectLost]
    nodes = await nodes_of(tmp_path)
    assert statuses(nodes)[1:] == [
        ("Repeat", "SUCCEEDED"),
        *[("NoteAction", "SUCCEEDED")] * 3,
        ("Repeat", "FAILED"),
        *[("FailingAction", "FAILED")] * 2,
    ]
    assert nodes[1].result == {"rounds": 3}
    assert nodes[5].failure_message is not None
    assert "2 of 2 rounds failed (1, 2)" in nodes[5].failure_message


async def test_every_branch_performs_its_own_operand(tmp_path: Path) -> None:
    async def note_number(number: int) -> int:
        await asyncio.sleep(0)
        return number

    branches: list[Designator] = [Code(note_number, number=number) for number in range(40)]
    plan = branches[0] | branches[1]
    for each in branches[2:]:
        plan = plan | each
    async with recorded(tmp_path):
        outcome = await plan.perform()
    assert outcome.results == tuple(range(40))
    calls = select(TaskTreeNode).where(TaskTreeNode.dtype == "Code").order_by(TaskTreeNode.id)
    assert sorted(node.result for node in await results_of(tmp_path, calls)) == list(range(40))


async def test_expressions_are_nodes_of_the_recorded_tree(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab():
            plan = NavigateAction([Pose([1, 0, 0])]) + (failing() - ParkArmsAction([Arms.LEFT]))
            await plan.perform()
    nodes = await nodes_of(tmp_path)
    nodes_by_id = {node.id: node for node in nodes}

    def depth(node: TaskTreeNode) -> int:
        return 0 if node.parent_id is None else 1 + depth(nodes_by_id[node.parent_id])

    assert [(depth(node), node.kind, node.dtype, node.status.name) for node in nodes] == [
        (0, "root", None, "SUCCEEDED"),
        (1, "language", "Sequential", "SUCCEEDED"),
        (2, "action", "NavigateAction", "SUCCEEDED"),
        (3, "motion", "MoveMotion", "SUCCEEDED"),
        (2, "language", "TryInOrder", "SUCCEEDED"),
        (3, "action", "FailingAction", "FAILED"),
        (3, "action", "ParkArmsAction", "SUCCEEDED"),
        (4, "motion", "MoveArmJointsMotion", "SUCCEEDED"),
    ]
    assert nodes[4].result == {"succeeded": [1], "failures": ["ObjectLost: the milk slipped"]}
    for node in nodes:
        assert node.end_time is not None
        assert node.end_time >= node.start_time
