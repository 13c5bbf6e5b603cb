"""Faults around a recorder: refusals, full spools, failures; no event is lost or out of order."""

import asyncio
import math
from collections.abc import Awaitable
from dataclasses import dataclass
from typing import Any

import pytest

from pycrorm_async.errors import EpisodeRefused, SpoolFull, Unrecordable
from pycrorm_async.events.types import EpisodeEnded, NodeEnded, NodeStarted
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.task import current_node
from pycrorm_async.record.episode import Episode
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType
from tests.hooks.fakes import NoteActionPerformable, RecorderCase, findings, kinds, recorder_case

STRICT = Settings(on_unrecordable="refuse")


async def test_a_second_episode_in_the_same_task_is_refused_and_in_a_child_task_is_its_own() -> None:
    async def child() -> Episode:
        with case.episode() as own:
            await NoteActionPerformable("child").perform()
        return own

    with recorder_case() as case, case.episode() as outer:
        with pytest.raises(EpisodeRefused, match="is open in this task already"), case.episode():
            pass
        inner = await asyncio.create_task(child())
        await NoteActionPerformable("parent").perform()
    for episode, text in ((outer, "parent"), (inner, "child")):
        events = case.sink.of(episode)
        assert findings(events) == []
        notes = [e for _, e in events if isinstance(e, NodeStarted) and e.kind == "action"]
        assert [(note.parameters["text"], note.parent) for note in notes] == [(text, 2)]


async def test_a_parameter_that_cannot_be_recorded_is_refused_before_perform_runs() -> None:
    with recorder_case(STRICT) as case, case.episode() as episode:
        note = NoteActionPerformable("x", weight=math.nan)
        with pytest.raises(Unrecordable, match=r"^NoteAction\.weight cannot be recorded: nan is not a finite number$"):
            await note.perform()
        assert not note.ran
        assert current_node.get() is None
        await NoteActionPerformable("y").perform()
    assert kinds(case.sink.of(episode)).count("NodeStarted") == 2
    assert findings(case.sink.of(episode)) == []


async def test_a_parameter_that_cannot_be_recorded_is_recorded_as_missing() -> None:
    with recorder_case() as case, case.episode() as episode:
        note = NoteActionPerformable("x", weight=math.nan)
        await note.perform()
        assert note.ran
    start = next(e for _, e in case.sink.of(episode) if isinstance(e, NodeStarted) and e.kind == "action")
    assert start.parameters["weight"] == {"missing": "nan is not a finite number", "repr": "nan"}


async def test_a_start_that_is_too_large_is_refused_with_the_limit() -> None:
    small = Settings(record_bytes_max=2_000, on_unrecordable="refuse")
    with recorder_case(small) as case, case.episode(), pytest.raises(Unrecordable, match=r"2,000 are allowed"):
        await NoteActionPerformable("x" * 3_000).perform()


async def test_a_result_that_is_too_large_is_recorded_as_missing() -> None:
    @dataclass
    class LongActionPerformable(ActionAbstract):
        async def perform(self) -> str:
            return "x" * 3_000

    with recorder_case(Settings(record_bytes_max=2_000)) as case, case.episode() as episode:
        assert len(await LongActionPerformable().perform()) == 3_000
    end = next(e for _, e in case.sink.of(episode) if isinstance(e, NodeEnded))
    assert end.status == "SUCCEEDED"
    assert "2,000 are allowed" in end.result["missing"]


@pytest.mark.parametrize(
    ("raised", "node_status", "episode_status"),
    [
        (PlanFailure("spilled", 3), "FAILED", "FAILED"),
        (ValueError("spilled", 3), "ERROR", "ERROR"),
        (ExceptionGroup("spilled", [PlanFailure("a"), PlanFailure("b")]), "FAILED", "FAILED"),
        (ExceptionGroup("spilled", [PlanFailure("a"), ValueError("b")]), "ERROR", "ERROR"),
        (asyncio.CancelledError("spilled", 3), "CANCELLED", "INTERRUPTED"),
        (KeyboardInterrupt("spilled", 3), "CANCELLED", "INTERRUPTED"),
        (SystemExit("spilled", 3), "ERROR", "ERROR"),
    ],
)
def test_a_failure_keeps_class_message_and_arguments(
    raised: BaseException, node_status: str, episode_status: str
) -> None:
    @dataclass
    class FailActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            raise raised

    async def plan(case: RecorderCase) -> None:
        with case.episode():
            await FailActionPerformable().perform()

    with recorder_case() as case:
        loop = asyncio.new_event_loop()
        try:
            with pytest.raises(type(raised)):
                loop.run_until_complete(plan(case))
        finally:
            loop.close()
    events = case.sink.only()
    assert findings(events) == []
    end = events[-3][1]
    assert isinstance(end, NodeEnded)
    assert end.failure is not None
    kind = type(raised)
    assert (end.status, end.failure.type) == (node_status, f"{kind.__module__}.{kind.__qualname__}")
    assert end.failure.message == str(raised)
    assert "spilled" in end.failure.message
    assert end.failure.arguments[0] == "spilled"
    assert len(end.failure.arguments) == 2
    assert isinstance(events[-1][1], EpisodeEnded)
    assert events[-1][1].status == episode_status


async def test_a_fault_of_the_memory_never_reaches_the_plan_and_is_counted() -> None:
    with recorder_case() as case, case.episode(), BulletWorld():
        case.sink.broken = True
        Object("milk", ObjectType.MILK)
        note = NoteActionPerformable("x")
        assert await note.perform() == "x"
        assert note.ran
        assert case.emitter.faults.total == 2
        assert case.emitter.faults.last == "NodeStarted: RuntimeError: the disk is on fire"
        case.sink.broken = False


async def test_a_full_spool_refuses_the_start_on_request_and_keeps_the_ends() -> None:
    @dataclass
    class FillActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            case.sink.full = True
            with pytest.raises(SpoolFull, match="on_full is 'fail'"):
                await NoteActionPerformable("x").perform()

    with recorder_case(Settings(on_full="fail")) as case, case.episode() as episode:
        await FillActionPerformable().perform()
    assert findings(case.sink.of(episode)) == []
    assert case.sink.of(episode)[-1][1] == EpisodeEnded("SUCCEEDED")


async def test_a_full_spool_makes_the_start_wait_by_default() -> None:
    with recorder_case() as case, case.episode() as episode:
        case.sink.full = True
        note = NoteActionPerformable("x")
        task: Awaitable[Any] = asyncio.create_task(note.perform())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not note.ran
        case.sink.full = False
        case.sink.space.set()
        await task
        assert note.ran
    assert findings(case.sink.of(episode)) == []


async def test_a_parameter_that_raises_when_it_is_read_is_refused_before_perform_runs() -> None:
    class Heavy:
        def __float__(self) -> float:
            raise RuntimeError("too heavy")

    with recorder_case(STRICT) as case, case.episode() as episode:
        note = NoteActionPerformable("x", weight=Heavy())  # type: ignore[arg-type]
        with pytest.raises(Unrecordable, match=r"NoteAction\.weight .* reading it raised RuntimeError: too heavy"):
            await note.perform()
        assert not note.ran
    assert kinds(case.sink.of(episode)).count("NodeStarted") == 1


async def test_a_start_that_fails_by_a_fault_of_the_recorder_leaves_no_episode_open() -> None:
    with recorder_case() as case:
        await NoteActionPerformable("first").perform()
        case.sink.broken_starts = 1
        await NoteActionPerformable("second").perform()
        await NoteActionPerformable("third").perform()
        assert case.emitter.faults.total == 1
        assert case.recorder.episodes.all == ()
    for name in case.sink.sequences:
        assert findings(case.sink.of(name)) == []
