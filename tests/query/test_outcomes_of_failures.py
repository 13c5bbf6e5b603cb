"""What followed a failure is decided once: questions, pages, agents and recall give the same answer, with rates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.events.types import EpisodeStatus, NodeStatus
from pycrorm_async.live.follower import LogFollower
from pycrorm_async.memory import SyncMemory
from pycrorm_async.query.success import Samples, Values, interval_95, success_figure
from pycrorm_async.recall.recall import Recall
from pycrorm_async.report.overview import newest_episodes, overview_document
from pycrorm_async.report.write import outcomes_of
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.world.pose import Pose
from tests.integrations.test_mcp_server import agent_in_process

pytestmark = pytest.mark.slow

Perform = Callable[..., None]
FAILS, WORKS = False, True


class Plan:
    """Records an episode of nodes that are written as nested calls."""

    def __init__(self, memory: SyncMemory) -> None:
        recording = memory.recording
        self.types = {
            "pick": recording.type("action", "TakeAction", {"object": "object", "arm": "text"}),
            "named": recording.type("action", "FetchAction", {"object_name": "text", "attempt": "integer"}),
            "go": recording.type("action", "GoAction", {"target": Pose}),
            "bring": recording.type("action", "BringAction", {}),
            **{name: recording.type("language", name, {}) for name in ("Retry", "TryInOrder", "Selector", "Repeat")},
            **{name: recording.type("language", name, {}) for name in ("Sequential", "Monitor", "FallbackNode")},
        }
        self.recording = recording
        self.count = 0

    def record(self, tree: list[Any], status: EpisodeStatus | None = None) -> None:
        episode = self.recording.episode(description="plan")
        with episode:
            for name in ("milk", "bowl"):
                episode.object_added(name, name, "GENERIC_OBJECT", Pose([0, 0, 0]))
            for each in tree:
                self._node(episode, each, None)
            if status is not None:
                episode.close(status=status)

    def _node(self, episode: Any, node: tuple[Any, ...], parent: int | None) -> None:
        name, parameters, works, *children = node
        self.count += 1
        key = self.count
        episode.start(key, self.types[name], parameters, parent=parent)
        for each in children:
            self._node(episode, each, key)
        episode.end(key, failure=None if works else ("Slip", "it slipped"))


def pick(works: bool, name: str = "milk", arm: str = "LEFT") -> tuple[Any, ...]:
    return "pick", {"object": name, "arm": arm}, works


def go(works: bool, x: float) -> tuple[Any, ...]:
    return "go", {"target": Pose([x, 0, 0])}, works


def fetch(works: bool, attempt: int, name: str = "cup") -> tuple[Any, ...]:
    return "named", {"object_name": name, "attempt": attempt}, works


CASES: dict[str, tuple[list[Any], EpisodeStatus | None, list[str]]] = {
    "nothing is tried again": ([pick(FAILS)], None, ["ignored"]),
    "another object is taken": ([pick(FAILS), pick(WORKS, "bowl")], None, ["ignored"]),
    "another type succeeds": ([pick(FAILS), fetch(WORKS, 1, "milk")], None, ["ignored"]),
    "it had succeeded before": ([pick(WORKS), pick(FAILS)], None, ["ignored"]),
    "it fails again": ([pick(FAILS), pick(FAILS)], None, ["ignored", "ignored"]),
    "the other arm takes it": ([pick(FAILS), pick(WORKS, arm="RIGHT")], None, ["recovered"]),
    "the third try works": ([pick(FAILS), pick(FAILS), pick(WORKS)], None, ["recovered", "recovered"]),
    "it works inside another node": ([pick(FAILS), ("bring", {}, WORKS, pick(WORKS))], None, ["recovered"]),
    "it works outside the parent": ([("bring", {}, WORKS, pick(FAILS)), pick(WORKS)], None, ["ignored"]),
    "the parent is tried again": (
        [("bring", {}, FAILS, pick(FAILS)), ("bring", {}, WORKS, pick(WORKS))], None, ["recovered"],
    ),
    "the object is a text": ([fetch(FAILS, 1), fetch(WORKS, 2)], None, ["recovered"]),
    "another text is an object": ([fetch(FAILS, 1), fetch(WORKS, 2, "plate")], None, ["ignored"]),
    "it goes to the same place": ([go(FAILS, 1), go(WORKS, 1)], None, ["recovered"]),
    "it goes to another place": ([go(FAILS, 1), go(WORKS, 2)], None, ["ignored"]),
    "a retry": ([("Retry", {}, WORKS, pick(FAILS), pick(WORKS, arm="RIGHT"))], None, ["recovered"]),
    "an alternative": ([("TryInOrder", {}, WORKS, pick(FAILS), fetch(WORKS, 1))], None, ["recovered"]),
    "a selector": ([("Selector", {}, WORKS, pick(FAILS), go(WORKS, 1))], None, ["recovered"]),
    "a fallback of another library": ([("FallbackNode", {}, WORKS, pick(FAILS), go(WORKS, 1))], None, ["recovered"]),
    "an expression that goes on": ([("Monitor", {}, WORKS, pick(FAILS))], None, ["tolerated"]),
    "a repetition that fails with it": ([("Repeat", {}, FAILS, pick(FAILS), pick(WORKS))], "FAILED", ["failed"]),
    "the plan fails": ([pick(FAILS)], "FAILED", ["failed"]),
    "the plan fails later": ([pick(FAILS), pick(WORKS), go(FAILS, 1)], "FAILED", ["recovered", "failed"]),
}  # fmt: skip


def test_a_failure_is_open_while_nothing_around_it_has_ended(database_url: str, tmp_path: Path) -> None:
    with Memory.sync(database_url, spool=tmp_path / "spool") as memory:
        plan = Plan(memory)
        with memory.recording.episode(description="runs") as episode:
            for name in ("milk", "bowl"):
                episode.object_added(name, name, "GENERIC_OBJECT", Pose([0, 0, 0]))
            plan._node(episode, pick(FAILS), None)
            memory.flush()
            assert [each.outcome for each in memory.ask.root_failures().rows()] == ["open"]
            plan._node(episode, pick(WORKS), None)
            memory.flush()
            assert [each.outcome for each in memory.ask.root_failures().rows()] == ["recovered"]


@pytest.mark.soak_on("postgresql")
async def test_questions_pages_agents_and_recall_give_each_failure_its_outcome_and_the_same_rates(
    database_url: str, tmp_path: Path
) -> None:
    with Memory.sync(database_url, spool=tmp_path / "spool") as memory:
        plan = Plan(memory)
        for tree, status, _ in CASES.values():
            plan.record(tree, status)
        memory.flush()
    async with Reading.open(database_url) as reading:
        rows = await reading.ask.root_failures().rows()
        for number, (name, (_, _, outcomes)) in enumerate(CASES.items(), 1):
            found = [(each.outcome, each.recovered) for each in rows if each.episode == number]
            assert (name, found) == (name, [(each, each == "recovered") for each in outcomes])
        expected = Counter(outcome for _, _, outcomes in CASES.values() for outcome in outcomes)
        assert len(await reading.ask.root_failures(recovered=True).rows()) == expected["recovered"]
        causes = await reading.ask.failures_by_cause().rows()
        counted = {name: sum(getattr(each, name) for each in causes) for name in expected}
        assert counted == expected
        episodes, total = await newest_episodes(reading)
        document = await overview_document(reading, "Episodes", episodes, total, {}, {})
        shown = Counter[str]()
        for each in document["episodes"]:
            of_episode = Counter[str]()
            for *_, outcome, count, event in each["causes"]:
                of_episode[outcome] += count
                assert (await outcomes_of(reading, each["number"]))[str(event)] == outcome
            assert Counter((await outcomes_of(reading, each["number"])).values()) == of_episode
            shown += of_episode
        assert shown == expected
        rates = {each.dtype: each for each in await reading.ask.success_rates().rows()}
        for dtype, rate in rates.items():
            tries = [each["actions"].get(dtype, [0, 0])[:2] for each in document["episodes"]]
            good, tried = map(sum, zip(*tries, strict=True))
            assert (rate.succeeded, rate.succeeded + rate.failed) == (good, tried)
            assert (rate.low, rate.high) == pytest.approx(interval_95(good, tried))
            answer = await Recall.of(reading)(dtype, k=1000)
            assert answer.success is not None
            assert (answer.success.successes, answer.success.tries) == (good, tried)
            failed = [each for each in answer if each.status == "FAILED"]
            afterwards = Counter([await each.outcome() for each in failed])
            assert dict(await answer.outcomes()) == afterwards
            if dtype in ("TakeAction", "FetchAction", "GoAction"):
                began = await reading.ask.root_failures().rows()
                assert afterwards == Counter(each.outcome for each in began if each.dtype == dtype)
    async with agent_in_process(database_url) as agent:
        why = await agent.ask("why_failed", limit=100)
        assert Counter(each["outcome"] for each in why["failures"]) == expected
        assert {each["dtype"]: each["low"] for each in why["rates"]} == {name: each.low for name, each in rates.items()}
        assert "it slipped (recovered)" in await agent.ask("show", episode=[*CASES].index("a retry") + 1)


async def test_the_live_list_counts_what_the_tables_count(database_url: str, tmp_path: Path) -> None:
    with Memory.sync(database_url, spool=tmp_path / "spool") as memory:
        follower = LogFollower(DatabaseAddress.parse(database_url))
        plan = Plan(memory)
        for name in ("nothing is tried again", "the other arm takes it", "a retry"):
            plan.record(*CASES[name][:2])
        memory.flush()
    try:
        log = await follower.log()
        await follower.overview.catch_up(log, await log.episodes())
        live = (await follower.overview.document(log))["episodes"]
    finally:
        await follower.close()
    async with Reading.open(database_url) as reading:
        episodes, total = await newest_episodes(reading)
        kept = (await overview_document(reading, "Episodes", episodes, total, {}, {}))["episodes"]
    keys = "status", "failed", "failed_actions", "causes", "plan", "commit", "tags", "objects"
    assert [{key: each[key] for key in keys} for each in live] == [{key: each[key] for key in keys} for each in kept]
    counts = [{dtype: each[:3] for dtype, each in entry["actions"].items()} for entry in (*live, *kept)]
    assert counts[: len(live)] == counts[len(live) :]
    assert [cause[3:5] for each in live for cause in each["causes"]] == [
        ["ignored", 1],
        ["recovered", 1],
        ["recovered", 1],
    ]


def test_an_episode_says_how_many_of_its_actions_failed_beside_its_own_status(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory:
        plan = Plan(memory)
        plan.record([pick(FAILS), pick(FAILS), pick(WORKS), ("Monitor", {}, FAILS)])
        plan.record([pick(FAILS)], "FAILED")
        memory.flush()
        texts = [each.status_text for each in memory.episodes()]
    assert texts == ["SUCCEEDED, 2 actions failed", "FAILED"]


def test_a_reason_of_an_action_that_succeeded_and_an_action_without_an_end_are_no_failures(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory:
        take = memory.recording.type("action", "TakeAction", {"arm": "text"})
        with memory.recording.episode(description="odd") as episode:
            ends: dict[str, NodeStatus] = {"a": "SUCCEEDED", "b": "CANCELLED", "c": "FAILED"}
            for key, status in ends.items():
                episode.start(key, take, {"arm": "LEFT"})
                episode.end(key, status, ("Slip", "nearly"))
            episode.start("lost", take, {"arm": "LEFT"})
        memory.flush()
        assert [(each.reason, each.times) for each in memory.ask.failures_by_cause().rows()] == [("Slip", 1)]
        assert memory.recall("TakeAction").reasons == [("Slip", 1)]
        [rate] = memory.ask.success_rates().rows()
        assert (rate.times, rate.succeeded, rate.failed, rate.share) == (4, 1, 1, 0.5)
        assert [(each.succeeded, each.failed) for each in memory.ask.arms_used().rows()] == [(1, 1)]


# --- pictures and comments ----------------------------------------------------------------------------------------


def test_a_failure_and_a_success_at_one_place_are_both_drawn() -> None:
    place = np.zeros(40)
    succeeded = np.arange(40) % 2 == 0
    figure = success_figure(Samples("View", Values("x", place), Values("y", place), succeeded, 0, 0), kind="scatter")
    legend = figure.axes[0].get_legend()
    assert legend is not None
    legend.remove()
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba()).astype(int)  # type: ignore[attr-defined]  # of Agg
    red, blue = picture[..., 0] - picture[..., 2], picture[..., 2] - picture[..., 0]
    assert (red > 100).sum() > 20
    assert (blue > 100).sum() > 20
