"""Durations and orders are those of the monotonic clock; the wall clock, which may be set meanwhile, gives labels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from pycrorm_async import Memory, Reading
from pycrorm_async.clock import Clock
from pycrorm_async.export.export import export
from pycrorm_async.live.follower import Activity
from pycrorm_async.operations.copy import tag_episode
from pycrorm_async.plan import ActionAbstract, PlanFailure, Sequential, TryInOrder
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.recall.answer import Relation
from pycrorm_async.report.document import episode_document
from pycrorm_async.report.overview import overview_document
from tests.databases import ask, put_memory, run_in_own_loop
from tests.shared_folders import made_once

NOW_NS = 1_800_000_000_000_000_000
HOUR, YEARS_57 = 3_600, 57 * 365 * 86_400
STEPS = {
    "no step": [0, 0, 0, 0],
    "an hour back": [0, -HOUR, 0, 0],
    "from 1970 to the present": [YEARS_57, 0, 0, 0],
    "on and back again": [0, HOUR, 0, -HOUR],
    "back in each action": [-HOUR, -HOUR, -HOUR, -HOUR],
}
"""Seconds by which the wall clock is set inside each action."""


class SetClock:
    """A clock that advances with an action, in which its wall time can be set."""

    def __init__(self) -> None:
        self.since_ns = 0
        self.wall_ns = NOW_NS
        self.clock = Clock(wall_ns=lambda: self.wall_ns, monotonic_ns=lambda: self.since_ns)

    def advance(self, seconds: float, step_s: float = 0) -> None:
        self.since_ns += round(seconds * 1e9)
        self.wall_ns += round((seconds + step_s) * 1e9)


@dataclass
class Walk(ActionAbstract):
    """Takes some time, a third of it before the wall clock is set."""

    metres: float
    fails: bool = False

    async def perform(self) -> None:
        clock, steps = RUNS[-1]
        clock.advance(self.metres / 3)
        clock.advance(2 * self.metres / 3, steps.pop(0))
        if self.fails:
            raise PlanFailure("the way is blocked")


@dataclass
class Round(ActionAbstract):
    """Walks four times; the second time fails and is tried again."""

    metres: float

    async def perform(self) -> None:
        again = TryInOrder(Walk(self.metres * 2, fails=True), Walk(self.metres * 3))
        await Sequential(Walk(self.metres), again, Walk(self.metres * 4)).perform()


RUNS: list[tuple[SetClock, list[int]]] = []
"""The clock and the steps of the episode that is being recorded."""


async def record(url: str, spool: Path | None = None) -> None:
    """Record one episode for each of the steps, each by a program of its own."""
    for name, steps in STEPS.items():
        clock = SetClock()
        clock.wall_ns -= 10**9 * (YEARS_57 if "1970" in name else 0)
        RUNS.append((clock, [*steps]))
        async with (
            Memory.open(url, spool=spool, clock=clock.clock) as memory,
            memory.episode(description="a round", tags=["walk"]),
        ):
            clock.advance(0.25)
            await Round(1.5).perform()
            clock.advance(0.5)
        RUNS.pop()


@pytest.fixture
def stepped(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the URL of a memory with these episodes."""
    folder = made_once(
        tmp_path_factory, "stepped", lambda folder: run_in_own_loop(record(put_memory(folder / "memory.db")))
    )
    return f"sqlite:///{folder}/memory.db"


def assert_alike(read: dict[int, Any]) -> None:
    """Compare what was read of each episode with what was read of the one without a step."""
    first = read[1]
    assert first
    assert {name: read[number] for number, name in enumerate(STEPS, 1)} == dict.fromkeys(STEPS, first)


async def each_episode(read: Callable[[int], Any]) -> dict[int, Any]:
    return {number: await read(number) for number in range(1, len(STEPS) + 1)}


VIEWS = {"process_metadata": ("id", "created_at", "ended_at")} | dict.fromkeys(
    ("task_tree_node", "designator", "action", "root_failure"), ("process_metadata_id", "start_time", "end_time")
)
"""By view the columns of the episode, the start and the end."""


@pytest.mark.soak_on("postgresql")
async def test_every_view_has_the_durations_of_the_monotonic_clock(database_url: str, tmp_path: Path) -> None:
    await record(database_url, tmp_path / "spool")
    for view, (episode, start, end) in VIEWS.items():
        query = f"SELECT {episode}, id, duration_s, {end} - {start} FROM {view} ORDER BY id"
        rows: dict[int, list[Any]] = {}
        for number, _, *times in ask(database_url, query):
            rows.setdefault(number, []).append(times)
        assert all(round(seconds * 1e6) == microseconds > 0 for seconds, microseconds in rows[1])
        assert_alike(rows)


async def test_every_answer_about_an_episode_has_the_times_of_the_monotonic_clock(stepped: str, tmp_path: Path) -> None:
    async with Reading.open(stepped) as reading:
        log = await reading.log()

        async def summary(number: int) -> Any:
            each: EpisodeSummary = await reading.episode(str(number))
            assert each.ended_at is not None
            return each.duration_ns, each.ended_at - each.started_at

        async def tree(number: int) -> Any:
            nodes = await reading.tree(number)
            return [(each.sequence, each.duration_ns) for each in nodes], nodes.gantt("time").svg

        async def asked(number: int) -> Any:
            questions = "durations", "longest_actions", "steps_before_failures", "root_failures"
            answers = [await getattr(reading.ask, name)(episode=number).rows() for name in questions]
            labels = "episode", "time", "node_id"
            rows = [row._asdict().items() for answer in answers for row in answer]
            return [{name: value for name, value in row if name not in labels} for row in rows]

        async def moments(number: int) -> Any:
            then = [await reading.as_of(number, time=seconds) for seconds in (0.25, 2, 5, 12, 99)]
            return [
                (each.sequence, each.time_s, [(node.start_s, node.duration_ns) for node in each.tree]) for each in then
            ]

        async def page(number: int) -> Any:
            document = await episode_document(reading, number)
            return document["times"], document["nodes"]

        async def lists(number: int) -> Any:
            episodes = [await reading.episode(str(number))]
            document = await overview_document(reading, "", episodes, 1, {}, {})
            activity = Activity((await log.episodes(number, number))[0])
            for event in await log.events(number):
                activity.read(event, {})
            return [each["seconds"] for each in (*document["episodes"], activity.entry())]

        async def messages(number: int) -> Any:
            path = tmp_path / f"{number}.mcap"
            await export(reading, number, path)
            with path.open("rb") as file:
                times = [(message.sequence, message.log_time) for *_, message in make_reader(file).iter_messages()]
            return [(sequence, time - times[0][1]) for sequence, time in times]

        for read in (summary, tree, asked, moments, page, lists, messages):
            assert_alike(await each_episode(read))
        assert [each.number for each in await reading.episodes()] == [*range(1, len(STEPS) + 1)]
        assert (await reading.episode("last")).number == len(STEPS)
        listed = await reading.ask.episodes().rows()
        assert [(row.episode, row.duration_s) for row in listed] == [
            (number, 15.75) for number in range(len(STEPS), 0, -1)
        ]


async def test_remembered_actions_have_the_order_of_the_monotonic_clock(stepped: str) -> None:
    async with Memory.open(stepped) as memory:

        async def relations(number: int) -> Any:
            walks = [each.id for each in await memory.reading.tree(number) if each.dtype == "WalkAction"]
            related = {}
            for place, wanted in product(range(len(walks)), Relation):
                cases = await memory.recall.related(walks[place], wanted)
                related[place, wanted] = [(each.type, each.sequence, each.duration_s) for each in cases]
            return related

        assert_alike(await each_episode(relations))


async def test_no_time_passes_on_the_clock_of_an_episode_until_it_is_tagged(stepped: str) -> None:
    later = SetClock()
    later.advance(0, YEARS_57)
    async with Reading.open(stepped) as reading:
        log = await reading.log()
        await tag_episode(log.address, "1", ("late",), (), clock=later.clock)
        *_, end, tagging = await log.events(1)
        assert (tagging.type, tagging.monotonic_ns) == ("EpisodeTagged", end.monotonic_ns)
        assert (await reading.episode("1")).duration_ns == 15_750_000_000
