"""The collected task tree: its order, its drawing, and its use beside a recorder."""

from __future__ import annotations

import asyncio
import re
from dataclasses import dataclass, field

import pytest

from pycrorm_async.plan.failures import ObjectLost
from pycrorm_async.plan.language import ActionAbstract, BaseMotion
from pycrorm_async.plan.task import TaskTreeNode, collected_tree, current_node
from tests.plan.fake_observer import Recording


@dataclass
class Step(BaseMotion):
    fails: bool = False

    async def perform(self) -> None:
        if self.fails:
            raise ObjectLost("gone")


@dataclass
class Plan(ActionAbstract):
    parts: list[Step | Plan] = field(default_factory=list)

    async def perform(self) -> None:
        for part in self.parts:
            await part.perform()


def drawn(tree: object) -> list[str]:
    return re.sub(r" \d+\.\d ms", "", str(tree)).splitlines()


async def test_a_tree_is_drawn_with_its_branches_in_order() -> None:
    with collected_tree() as tree:
        await Plan([Step(), Plan([Step(), Plan()]), Step()]).perform()
        with pytest.raises(ObjectLost):
            await Plan([Step(fails=True)]).perform()
    assert drawn(tree) == [
        "Plan SUCCEEDED",
        "├── Step SUCCEEDED",
        "├── Plan SUCCEEDED",
        "│   ├── Step SUCCEEDED",
        "│   └── Plan SUCCEEDED",
        "└── Step SUCCEEDED",
        "Plan FAILED (ObjectLost)",
        "└── Step FAILED (ObjectLost)",
    ]
    assert len(str(tree).splitlines()) == len(tree) == 8
    assert re.fullmatch(r"Plan SUCCEEDED \d+\.\d ms", str(tree).splitlines()[0])
    assert [tree.depth(node) for node in tree] == [0, 1, 1, 2, 2, 1, 0, 1]
    assert tree.children(tree.roots[0]) == tuple(node for node in tree if node.parent is tree.roots[0])


async def test_an_empty_tree_is_drawn_as_nothing() -> None:
    with collected_tree() as tree:
        pass
    assert (str(tree), len(tree), list(tree)) == ("", 0, [])


async def test_a_running_node_is_drawn_without_a_duration() -> None:
    class Looking(ActionAbstract):
        async def perform(self) -> None:
            seen.append(str(tree))

    seen: list[str] = []
    with collected_tree() as tree:
        await Looking().perform()
    assert seen == ["Looking RUNNING"]


async def test_a_child_of_a_node_that_is_not_collected_is_a_root() -> None:
    token = current_node.set(TaskTreeNode(None, "root", None, 0))
    try:
        with collected_tree() as tree:
            await Plan([Step()]).perform()
    finally:
        current_node.reset(token)
    assert drawn(tree) == ["Plan SUCCEEDED", "└── Step SUCCEEDED"]


async def test_trees_and_recorders_do_not_disturb_each_other() -> None:
    with Recording().listening() as recording, collected_tree() as outer:
        await Step().perform()
        with collected_tree() as inner:
            await Plan([Step()]).perform()
        await Step().perform()
    assert drawn(outer) == [
        "Step SUCCEEDED",
        "Plan SUCCEEDED",
        "└── Step SUCCEEDED",
        "Step SUCCEEDED",
    ]
    assert drawn(inner) == ["Plan SUCCEEDED", "└── Step SUCCEEDED"]
    assert [each.split()[0] for each in recording.notes] == [
        "start",
        "end",
        "start",
        "start",
        "end",
        "end",
        "start",
        "end",
    ]


async def test_a_tree_collects_the_tasks_of_its_context_and_no_others() -> None:
    outside = asyncio.Event()

    async def other() -> None:
        await outside.wait()
        await Plan().perform()

    elsewhere = asyncio.create_task(other())
    with collected_tree() as tree:
        inside = asyncio.create_task(Plan([Step()]).perform())
        outside.set()
        await asyncio.gather(elsewhere, inside)
    assert drawn(tree) == ["Plan SUCCEEDED", "└── Step SUCCEEDED"]


async def test_a_deep_tree_is_drawn_without_recursion() -> None:
    deep = current = Plan()
    for _ in range(200):
        current.parts.append(Plan())
        current = current.parts[0]  # type: ignore[assignment]  # only plans here
    with collected_tree() as tree:
        await deep.perform()
    assert len(str(tree).splitlines()) == 201
    assert str(tree).splitlines()[200].startswith("    " * 199 + "└── Plan")
