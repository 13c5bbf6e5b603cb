"""The notifications of a perform, their order, and its outcomes."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Awaitable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import CoroutineType
from typing import Any

import pytest

from pycrorm_async.plan.execution import recorder
from pycrorm_async.plan.failures import ObjectUnreachable, PlanFailure
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.task import TaskTreeNode, collected_tree, current_node
from pycrorm_async.task_status import TaskStatus
from tests.plan.fakes import Recording

pytestmark = pytest.mark.slow


class Abort(BaseException):
    """A base exception that is no Exception."""


@dataclass
class Raising(ActionAbstract):
    what: Any

    async def perform(self) -> None:
        if self.what is not None:
            raise self.what


@dataclass
class Inside(ActionAbstract):
    """Perform one action after another."""

    parts: list[ActionAbstract]

    async def perform(self) -> int:
        for part in self.parts:
            await part.perform()
        return len(self.parts)


@dataclass
class Waiting(ActionAbstract):
    for_what: asyncio.Event

    async def perform(self) -> None:
        await self.for_what.wait()


@dataclass
class Empty(ActionAbstract):
    async def perform(self) -> None: ...


OUTCOMES = [
    (None, TaskStatus.SUCCEEDED),
    (PlanFailure("no", 1), TaskStatus.FAILED),
    (ObjectUnreachable("milk"), TaskStatus.FAILED),
    (ValueError("bug"), TaskStatus.ERROR),
    (asyncio.CancelledError(), TaskStatus.CANCELLED),
    (Abort(), TaskStatus.ERROR),
    (ExceptionGroup("failures", [PlanFailure("a"), ObjectUnreachable("b")]), TaskStatus.FAILED),
    (ExceptionGroup("nested", [ExceptionGroup("inner", [PlanFailure("a")]), PlanFailure("b")]), TaskStatus.FAILED),
    (ExceptionGroup("mixed", [PlanFailure("a"), ValueError("bug")]), TaskStatus.ERROR),
    (ExceptionGroup("nested", [ExceptionGroup("inner", [PlanFailure("a"), ValueError("bug")])]), TaskStatus.ERROR),
    (BaseExceptionGroup("cancelled", [PlanFailure("a"), asyncio.CancelledError()]), TaskStatus.ERROR),
]


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize(("raised", "status"), OUTCOMES, ids=lambda each: getattr(each, "name", type(each).__name__))
async def test_every_outcome_has_its_status_and_is_passed_on(
    raised: BaseException | None, status: TaskStatus, recorded: bool
) -> None:
    with maybe(Recording() if recorded else None), collected_tree() as tree:
        if raised is None:
            assert await Inside([Raising(None)]).perform() == 1
        else:
            with pytest.raises(type(raised)) as caught:
                await Inside([Raising(raised)]).perform()
            assert caught.value is raised
        assert current_node.get() is None
    assert [(node.status, node.failure) for node in tree] == [(status, raised), (status, raised)]
    assert [node.result for node in tree] == ([1, None] if raised is None else [None, None])
    assert all(node.ended_ns is not None and node.ended_ns >= node.started_ns for node in tree)


@pytest.mark.parametrize(("raised", "status"), [(KeyboardInterrupt, "CANCELLED"), (SystemExit, "ERROR")])
def test_an_exception_that_ends_the_process_ends_its_nodes(raised: type[BaseException], status: str) -> None:
    recording = Recording()

    async def plan() -> None:
        with recording.listening():
            await Inside([Raising(raised())]).perform()

    with pytest.raises(raised):
        asyncio.run(plan())
    assert recording.notes == ["start Inside", "start Raising", f"end Raising {status}", f"end Inside {status}"]


async def test_a_recorder_that_refuses_a_start_keeps_perform_from_running() -> None:
    class Refusing(Recording):
        def node_started(self, node: TaskTreeNode) -> None:
            if isinstance(node.designator, Raising):
                raise ZeroDivisionError
            super().node_started(node)

    with Refusing().listening() as recording, collected_tree() as tree:
        with pytest.raises(ZeroDivisionError):
            await Inside([Raising(AssertionError("perform ran"))]).perform()
        assert current_node.get() is None
    assert recording.notes == ["start Inside", "end Inside ERROR"]
    assert len(tree) == 1


async def test_a_node_starts_only_when_the_recorder_has_space() -> None:
    class Full(Recording):
        def __init__(self) -> None:
            super().__init__()
            self.room = asyncio.Event()

        def admit(self) -> Awaitable[None] | None:
            return None if self.room.is_set() else self._room()

        async def _room(self) -> None:
            self.notes.append("waits")
            await self.room.wait()

    with Full().listening() as recording:
        assert isinstance(recording, Full)
        plan = asyncio.create_task(Empty().perform())
        await recording.wait_for_notes(1)
        assert recording.notes == ["waits"]
        recording.room.set()
        await plan
        await Empty().perform()
    assert recording.notes[1:] == ["start Empty", "end Empty SUCCEEDED"] * 2


async def test_the_recorder_of_the_start_is_notified_of_the_end() -> None:
    first, second = Recording(), Recording()

    class Switching(ActionAbstract):
        async def perform(self) -> None:
            recorder.set(second)

    with first.listening():
        await Switching().perform()
    assert (first.notes, second.notes) == (["start Switching", "end Switching SUCCEEDED"], [])


async def test_a_plan_that_never_suspends_can_be_cancelled() -> None:
    class Endless(ActionAbstract):
        async def perform(self) -> None:
            while True:
                await Empty().perform()

    with collected_tree() as tree:
        plan = asyncio.create_task(Endless().perform())
        await asyncio.sleep(0)
        asyncio.get_running_loop().call_later(0.05, plan.cancel)
        with pytest.raises(asyncio.CancelledError):
            await plan
    endless, *done = tree
    assert endless.status is TaskStatus.CANCELLED
    assert len(done) > 100
    assert {node.status for node in done} == {TaskStatus.SUCCEEDED}


def test_a_plan_that_never_suspends_is_interrupted_by_ctrl_c() -> None:
    recording = Recording()

    class Endless(ActionAbstract):
        async def perform(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            while True:
                await Empty().perform()

    async def plan() -> None:
        with recording.listening():
            await Endless().perform()

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(plan())
    assert recording.notes[-1] == "end Endless CANCELLED"


async def test_an_abandoned_suspended_plan_does_not_change_the_current_node_of_others() -> None:
    with Recording().listening() as recording:

        async def suspended() -> CoroutineType[Any, Any, Any]:
            coroutine = Inside([Waiting(asyncio.Event())]).perform()
            while len(recording.notes) < 2:
                coroutine.send(None)
            assert isinstance(coroutine, CoroutineType)
            return coroutine

        dropped = await asyncio.create_task(suspended())
        here = TaskTreeNode(None, "root", None, 0)
        current_node.set(here)
        dropped.close()
        assert current_node.get() is here
    assert recording.notes[2:] == ["end Waiting ERROR", "end Inside ERROR"]


@contextmanager
def maybe(recording: Recording | None) -> Iterator[None]:
    if recording is None:
        yield
    else:
        with recording.listening():
            yield
