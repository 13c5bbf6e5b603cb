"""The words of the plan layer and of the log are the same, though neither imports the other."""

from __future__ import annotations

from typing import get_args

from pycrorm_async.events import types
from pycrorm_async.plan import task
from pycrorm_async.task_status import TaskStatus


def test_the_kinds_of_a_node_are_the_same_in_a_plan_and_in_the_log() -> None:
    assert get_args(task.NodeKind) == get_args(types.NodeKind) == ("root", "action", "motion", "language")


def test_the_status_of_a_node_is_the_same_in_a_plan_and_in_the_log() -> None:
    in_the_plan = {status.name: status.value for status in TaskStatus}
    assert in_the_plan == {word: word for word in get_args(types.NodeStatus)}
    assert len(in_the_plan) == 7
