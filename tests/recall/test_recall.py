"""`memory.recall` finds what has ended in the memory, also what its own process has not flushed yet."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from pycrorm_async import Memory, Reading, Settings
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import CallerError, DatabaseUnavailable, UnknownEpisode
from pycrorm_async.recall import running_cases
from pycrorm_async.recall.answer import Answer, Relation
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.recall import Recall
from pycrorm_async.recall.running_cases import ProcessCases
from pycrorm_async.world import Arms
from tests.recall.sliding_grips import (
    FETCH,
    GRIP,
    FetchSlidingActionPerformable,
    GripSlidingActionPerformable,
    grip,
    record,
)

pytestmark = pytest.mark.soak_on("postgresql")
"""Blocks are read and searched alike there: `test_both_databases_and_a_rebuild_return_the_same_answers`."""


@pytest.fixture(scope="module")
def url(module_database_url: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    spool = tmp_path_factory.mktemp("recall") / "spool"

    async def fill() -> None:
        async with Memory.open(module_database_url, spool=spool) as memory:
            await record(memory)

    asyncio.run(fill())
    return module_database_url


@pytest_asyncio.fixture
async def recall(url: str) -> AsyncIterator[Recall]:
    async with Reading.open(url) as reading:
        yield Recall.of(reading)


def shapes(answer: Answer) -> list[tuple[float, int, int]]:
    return [(each.score, each.case.episode, each.case.sequence) for each in answer]


async def test_a_cue_of_enums_and_numbers_finds_the_actions_most_like_it(recall: Recall) -> None:
    answer = await recall(GripSlidingActionPerformable, has={"arm": Arms.LEFT}, near={"level": (1.1, 0.3)}, k=3)
    levels = [round(each.numbers["level"], 1) for each in answer]
    assert levels[0] == 1.1
    assert set(levels[1:]) == {0.9, 1.3}
    assert answer[0].case.status == "FAILED"
    assert answer[0].case.reason == "SlipperyFailure"
    assert answer[0].score == pytest.approx(1.0)
    assert answer.considered == 12


async def test_conditions_hold_for_every_action_of_the_answer(recall: Recall) -> None:
    everything = await recall(GRIP, k=100)
    assert len(everything) == 12
    first = everything[-1]
    assert {each.case.episode for each in await recall(GRIP, episode=1)} == {1}
    assert {each.case.episode for each in await recall(GRIP, episode=[1, "last"])} == {1, 2}
    assert {each.case.episode for each in await recall(GRIP, tag="kitchen")} == {1}
    assert {each.symbols["arm"] for each in await recall(GRIP, lacks={"arm": Arms.LEFT})} == {"RIGHT"}
    assert {each.status for each in await recall(GRIP, only={"status": "FAILED"})} == {"FAILED"}
    assert first.node not in {each.node for each in await recall(GRIP, prohibit=[first], k=100)}
    assert [each.node for each in await recall(GRIP, before=everything[-2].node)] == [first.node]
    assert len(await recall(GRIP, after=first, k=100)) == 11
    assert len(await recall(GRIP, after=datetime(2020, 1, 1, tzinfo=UTC), before="2200-01-01")) == 12
    assert len(await recall(GRIP, as_of="2020-01-01")) == 0
    fetch = (await recall(FETCH))[0]
    inside = await recall(GRIP, during=fetch)
    assert [round(each.numbers["level"], 1) for each in inside] == [0.9, 0.7]
    assert len(await recall(GRIP, during=("2020-01-01", "2200-01-01"))) == 12
    answer = await recall(GRIP, only={"arm": "MIDDLE"})
    assert (list(answer), answer.never_seen) == ([], (("arm", "MIDDLE"),))
    assert list(await recall("FlyAction", has={"wing": "LEFT"})) == []


BAD: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "naive": ({"before": datetime(2026, 1, 1)}, CallerError, "has no time zone"),  # noqa: DTZ001
    "no moment": ({"after": "yesterday"}, CallerError, "'yesterday' is not a moment"),
    "episode": ({"episode": 77}, UnknownEpisode, "there is no episode '77'"),
    "node": ({"before": 2**40}, CallerError, "there is no case of event 0 of episode 512"),
    "negative node": ({"before": -1}, CallerError, "there is no case of -1"),
    "tag": ({"tag": "kitchn"}, CallerError, "no episode has the tag 'kitchn'; did you mean kitchen?"),
    "robot": ({"robot": "pr2"}, CallerError, "has a feature 'robot'"),
    "a text as k": ({"k": "3"}, CallerError, "k must be 1 to 10,000, got '3'"),
    "a text as score": ({"minimum": "a"}, CallerError, "minimum must be a score from 0 to 1, got 'a'"),
    "None": ({"has": {"arm": None}}, CallerError, "arm is given as None: leave it out"),
    "a list of features": ({"has": ["arm"]}, CallerError, "features are given as ['arm']: give a dictionary"),
    "a long feature": ({"has": {"x" * 1_000_000: "y"}}, CallerError, "... (1,000,002 characters)"),
    "a name as case": ({"prohibit": ["1/20"]}, CallerError, "'1/20' is not a case: give one of an answer"),
    "one prohibited": ({"prohibit": 5}, CallerError, "`prohibit` takes a list of cases"),
}


async def test_a_condition_that_cannot_be_is_refused_in_one_line(recall: Recall) -> None:
    for name, (arguments, error, line) in BAD.items():
        with pytest.raises(error) as refused:
            await recall(GRIP, **arguments)
        assert line in str(refused.value), name
        assert "\n" not in str(refused.value), name


async def test_other_wrong_arguments_are_refused_in_one_line(recall: Recall) -> None:
    with pytest.raises(CallerError, match="3 is not a type: give a designator class"):
        await recall(3)  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="give the type of the actions"):
        await recall.follows(None)  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="there is no status 'FALED'; did you mean FAILED"):
        await recall.follows(GRIP, status="FALED")
    with pytest.raises(CallerError, match="'1/20' is not a case"):
        await recall.like("1/20")  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="activation must be a number, got 'often'"):
        await recall.forget("often")  # type: ignore[arg-type]


async def test_from_a_case_one_gets_to_what_was_around_it(recall: Recall) -> None:
    second, first = await recall(GRIP, during=(await recall(FETCH))[0])
    assert await first.next() == second.case
    assert await second.previous() == first.case
    assert await second.next() is None
    parent = await first.parent()
    assert isinstance(parent, Case)
    assert parent.type == FETCH
    assert await recall.related(parent, "during") == await recall.related(parent.node, Relation.DURING)
    moment = await second.moment()
    assert [node.dtype for node in moment.running if node.dtype is not None] == [FETCH, GRIP]
    with pytest.raises(CallerError, match="'inside' is not a relation: give one of before, meets"):
        await recall.related(parent, "inside")


async def test_what_is_like_a_case_does_not_contain_it(recall: Recall) -> None:
    asked = (await recall(GRIP, only={"status": "FAILED"}))[0]
    alike = await recall.like(asked, k=100)
    assert asked.node not in {each.node for each in alike}
    assert len(alike) == 11
    assert {"arm", "item"} <= {name for name, _ in alike.cue.has}
    assert "status" not in dict(alike.cue.has)
    assert [each.score for each in alike] == sorted([each.score for each in alike], reverse=True)


async def test_an_answer_is_a_frame(recall: Recall) -> None:
    frame = await recall.frame(GRIP, has={"arm": "LEFT"}, k=3)
    assert list(frame["score"]) == [1.0, 1.0, 1.0]
    assert set(frame["arm"]) == {"LEFT"}
    assert {"node", "started", "status", "reason", "duration", "level", "item"} <= set(frame.columns)
    assert len(await recall.frame("FlyAction")) == 0


async def test_what_is_forgotten_is_hidden_from_this_object_only(url: str, recall: Recall) -> None:
    dry = await recall.forget(5.0, dry_run=True)
    assert dry.cases == 14
    assert len(await recall(GRIP)) == 12
    await recall.forget(5.0)
    assert list(await recall(GRIP)) == []
    async with Reading.open(url) as reading:
        assert len(await Recall.of(reading)(GRIP)) == 12
    await recall.forget(-math.inf)
    assert len(await recall(GRIP)) == 12
    with pytest.raises(CallerError, match="activation must be a number, got nan"):
        await recall.forget(math.nan)


async def test_a_failure_is_recalled_before_it_is_flushed(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'memory.db'}") as memory:
        assert list(await memory.recall(GRIP)) == []
        async with memory.episode():
            await grip(Arms.LEFT, 0.8)
            await grip(Arms.LEFT, 1.5)
            answer = await memory.recall(GripSlidingActionPerformable, near={"level": (1.4, 1.0)})
            assert [each.case.status for each in answer] == ["FAILED", "SUCCEEDED"]
            assert answer.reasons == [("SlipperyFailure", 1)]
            assert await answer[1].next() == answer[0].case
            await grip(Arms.RIGHT, 0.9)
            assert len(await memory.recall(GRIP)) == 3
            await memory.flush()
            stored = await memory.recall(GRIP)
            assert len(stored) == 3, "each case is there once"
            await grip(Arms.RIGHT, 1.2)
            assert len(await memory.recall(GRIP)) == 4
        await FetchSlidingActionPerformable(0.5, 0.6).perform()
        assert len(await memory.recall(GRIP)) == 6
        await memory.flush()
        live = {(each.node, each.status): each for each in await memory.recall(GRIP)}
        async with Reading.open(f"sqlite:///{tmp_path / 'memory.db'}") as reading:
            read = {(each.node, each.status): each for each in await Recall.of(reading)(GRIP)}
        assert live.keys() == read.keys()
        assert [each.case for each in live.values()] == [each.case for each in read.values()]
        recall = memory.recall
    with pytest.raises(CallerError, match="the memory is closed"):
        await recall(GRIP)
    with pytest.raises(CallerError, match="not open"):
        await memory.recall(GRIP)


async def test_what_happened_before_the_first_recall_is_recalled_too(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'memory.db'}") as memory, memory.episode():
        await grip(Arms.LEFT, 1.5)
        assert [each.case.status for each in await memory.recall(GRIP)] == ["FAILED"]
        await grip(Arms.LEFT, 0.7)
        first, second = (await memory.recall(GRIP))[::-1]
        assert second.symbols["after"] == GRIP, "the fold of the episode goes through both"
        assert second.symbols["after_status"] == "FAILED"
        assert await first.next() == second.case


async def test_an_event_that_is_read_from_the_log_and_observed_is_folded_once(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'memory.db'}") as memory, memory.episode() as episode:
        parts = memory._open_parts
        await grip(Arms.LEFT, 0.7)

        async def flush() -> None:
            await grip(Arms.RIGHT, 0.8)  # recorded while the first recall begins, as by another thread
            await memory.flush()
            await grip(Arms.RIGHT, 0.9)

        running = ProcessCases(
            parts.emitter, open_episodes=lambda: [episode.id], flush=flush, log=parts.reading.log, clock=SYSTEM_CLOCK
        )
        numbered, unnumbered = await running.new()
        assert [round(case.numbers["level"], 1) for case in numbered] == [0.7, 0.8, 0.9]
        assert list(unnumbered) == []
        assert "after" not in numbered[0].symbols
        assert await running.new() == ([], [])


async def test_episodes_that_are_not_stored_yet_have_numbers_of_their_own(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'empty.db'}"):
        pass
    async with (
        Memory.open(f"sqlite:///{tmp_path / 'memory.db'}") as memory,
        Reading.open(f"sqlite:///{tmp_path / 'empty.db'}") as empty,  # in whose log no episode gets a number
    ):
        running = ProcessCases(
            memory._open_parts.emitter,
            open_episodes=list,
            flush=memory.flush,
            log=empty.log,
            clock=SYSTEM_CLOCK,
        )
        assert await running.new() == ([], [])
        for level in (0.7, 0.8):
            async with memory.episode():
                await grip(Arms.LEFT, level)
        numbered, unnumbered = await running.new()
        assert [*numbered] == []
        assert [round(case.numbers["level"], 1) for case in unnumbered] == [0.7, 0.8]
        assert len({case.node for case in unnumbered}) == 2


async def test_events_that_found_the_buffer_full_are_read_from_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running_cases, "_EVENTS_MAX", 4)
    async with Memory.open(f"sqlite:///{tmp_path / 'memory.db'}") as memory, memory.episode():
        for round_ in range(1, 4):
            for _ in range(3):
                await grip(Arms.LEFT, 1.5)
            answer = await memory.recall(GRIP, k=100)
            assert len(answer) == 3 * round_
            assert {each.status for each in answer} == {"FAILED"}


async def test_without_cases_the_error_names_how_to_make_them(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    async with Memory.open(url, settings=Settings(recall=False)) as memory:
        await grip(Arms.LEFT, 1.5)
        with pytest.raises(DatabaseUnavailable, match=r"recall=False.* run `pycrorm writer --once`"):
            await memory.recall(GRIP)
    async with Memory.open(url) as memory:  # as the command does
        await memory.flush()
        assert [each.status for each in await memory.recall(GRIP)] == ["FAILED"]
