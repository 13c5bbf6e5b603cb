"""Episode-scoped projections: each event is folded once with the state of its own episode, whatever the batches are."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Sequence
from random import Random
from typing import Any, ClassVar

import pytest
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, EpisodeTagged, Happening, NodeEnded, NodeStarted
from pycrorm_async.projections import custom, fold
from pycrorm_async.projections.custom import (
    Changes,
    CustomRows,
    EpisodeFold,
    EpisodeFolds,
    EpisodeProjection,
    Event,
    Projection,
    own_projections,
)
from pycrorm_async.projections.custom_tables import states
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.dialect import RowRefused
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent
from tests.projections.event_script import PICK_UP, Script, declarations, mixed, name_of, row
from tests.projections.sql_queries import ask
from tests.projections.verify_cases import rebuilt

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""As in `test_custom_projections`."""


class Attempts(EpisodeProjection):
    """The number of each try with an arm within its episode, and the outcome of the try before it."""

    name, version = "attempts", 1
    tables = {"attempt": {"arm": "text", "number": "integer", "before": "text"}}  # noqa: RUF012 - a common form in user code
    read: ClassVar = Counter[str]()
    """Counts the reads of each event, by episode and sequence."""

    def episode(self) -> EpisodeFold:
        counts, arms, outcomes = Counter[str](), dict[int, str](), dict[str, str]()

        def fold(event: Event, rows: Changes) -> None:
            self.read[f"{event.number}/{event.sequence}"] += 1
            match event.happening:
                case NodeStarted(parameters=parameters) if event.dtype == "PickUpAction":
                    arm = arms[event.sequence] = parameters["arm"]
                    counts[arm] += 1
                    rows.insert("attempt", event.id, arm=arm, number=counts[arm], before=outcomes.get(arm))
                case NodeEnded(node=node, status=status) if node in arms:
                    outcomes[arms[node]] = status
                case EpisodeTagged(added=(tag, *_)):
                    rows.insert("attempt", event.id, arm=tag, number=sum(counts.values()))

        return fold


def episode(number: int, tries: Sequence[tuple[str, str]], *, ends: bool = True) -> Script:
    script = Script(number)
    script.put(EpisodeStarted("", "me", "host", "", "3.11"))
    root = script.put(NodeStarted("root"))
    for arm, status in tries:
        parameters = {"object_designator": {"row": 1, "object": 1}, "arm": arm, "grasp": "TOP"}
        node = script.put(NodeStarted("action", root, designator=name_of(PICK_UP), parameters=parameters))
        script.put(NodeEnded(node, status))  # type: ignore[arg-type]
    if ends:
        script.put(EpisodeEnded("SUCCEEDED"))
        script.put(EpisodeTagged(("late",)))
    return script


def expected(number: int, tries: Sequence[tuple[str, str]], *, ends: bool = True) -> list[tuple[Any, ...]]:
    """Compute the rows from the list, without a fold."""
    rows: list[tuple[Any, ...]] = []
    for index, (arm, _) in enumerate(tries):
        before = [status for other, status in tries[:index] if other == arm]
        rows.append((row(3 + 2 * index, number=number), number, arm, len(before) + 1, before[-1] if before else None))
    if ends:
        rows.append((row(4 + 2 * len(tries), number=number), number, "late", len(tries), None))
    return rows


def random_episodes(random: Random, count: int, *, tries_max: int = 6) -> list[list[tuple[str, str]]]:
    return [
        [
            (random.choice(["LEFT", "RIGHT"]), random.choice(["SUCCEEDED", "FAILED"]))
            for _ in range(random.randint(0, tries_max))
        ]
        for _ in range(count)
    ]


async def projector_of(log: EventLog, projection: EpisodeProjection | None = None, **options: Any) -> Projector:
    projector = Projector(log, projections=[projection or Attempts()], **options)
    await projector.open()
    return projector


async def rows_in(log: EventLog) -> list[tuple[Any, ...]]:
    return await ask(log, "SELECT * FROM attempt ORDER BY id")


async def test_rows_do_not_depend_on_batches_restarts_and_other_processes(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(custom, "_EPISODES_MAX", 3)
    monkeypatch.setattr(custom, "_PAGE_EVENTS", 4)
    random = Random(1)
    episodes = random_episodes(random, 24)
    scripts = [episode(number, tries, ends=number % 3 != 0) for number, tries in enumerate(episodes, 1)]
    records = [each for first in range(0, len(scripts), 5) for each in mixed(*scripts[first : first + 5])]
    await log.append([*declarations(PICK_UP), *records[:1]])
    projectors = [await projector_of(log, batch_events=3)]
    del records[:1]
    while records:
        size = random.randint(1, 25)
        await log.append(records[:size])
        del records[:size]
        if random.random() < 0.2:  # a restart, or another process beside the first
            kept = projectors[: random.randint(0, 1)]
            projectors = [*kept, await projector_of(log, batch_events=random.randint(1, 12))]
        if random.random() < 0.7:
            await random.choice(projectors).catch_up()
    await asyncio.gather(*(each.catch_up() for each in projectors))
    rows = [each for number, tries in enumerate(episodes, 1) for each in expected(number, tries, ends=number % 3 != 0)]
    assert await rows_in(log) == rows
    result = await verify(log, projections=[Attempts()])
    assert (result.drift, result.damage) == (0, 0)
    await rebuilt(log, Attempts())
    assert await rows_in(log) == rows


async def test_a_process_reads_an_event_once_and_after_a_restart_those_of_open_episodes_again(log: EventLog) -> None:
    tries = [("LEFT", "FAILED"), ("RIGHT", "SUCCEEDED"), ("LEFT", "SUCCEEDED")]
    ended, still_open = episode(1, tries).records[:-1], episode(2, tries, ends=False).records
    await log.append(declarations(PICK_UP))
    Attempts.read.clear()
    projector = await projector_of(log)
    for each in (*ended, *still_open[:6]):
        await log.append([each])
        await projector.catch_up()
    once = [*(f"1/{each.sequence}" for each in ended), *(f"2/{each.sequence}" for each in still_open[:6])]
    assert Attempts.read == Counter(once)
    await log.append(still_open)
    Attempts.read.clear()
    await (await projector_of(log)).catch_up()
    assert Attempts.read == Counter(f"2/{each.sequence}" for each in still_open)
    assert await rows_in(log) == [each for number in (1, 2) for each in expected(number, tries, ends=False)]


async def test_the_folds_that_are_kept_are_bounded_and_end_with_their_episode(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[EpisodeFolds] = []
    make = EpisodeFolds.__init__

    def noted(self: EpisodeFolds, projection: EpisodeProjection) -> None:
        make(self, projection)
        kept.append(self)

    monkeypatch.setattr(EpisodeFolds, "__init__", noted)
    monkeypatch.setattr(custom, "_EPISODES_MAX", 4)
    tries = [("LEFT", "FAILED"), ("LEFT", "SUCCEEDED")]
    scripts = [episode(number, tries) for number in range(1, 8)]
    await log.append([*declarations(PICK_UP), *(each for script in scripts for each in script.records[:4])])
    projector = await projector_of(log)
    await projector.catch_up()
    assert [len(each._open) for each in kept] == [4]
    await log.append([each for script in scripts for each in script.records])
    await projector.catch_up()
    assert [len(each._open) for each in kept] == [0]
    assert await rows_in(log) == [each for number in range(1, 8) for each in expected(number, tries)]


async def test_tables_and_projections_fold_an_event_in_one_pass_and_one_transaction(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, decoded = Counter[int](), Counter[str]()
    spans, happening_of = EventLog.spans, fold.happening_of

    async def counted_spans(self: EventLog, some: Sequence[Span]) -> list[StoredEvent]:
        reads.update(sequence for each in some for sequence in range(each.after + 1, each.last + 1))
        return await spans(self, some)

    def counted_decoding(event: StoredEvent) -> Happening:
        decoded[f"{event.number}/{event.sequence}"] += 1
        return happening_of(event)

    tries = [("LEFT", "FAILED"), ("RIGHT", "SUCCEEDED"), ("LEFT", "SUCCEEDED")]
    records = [*declarations(PICK_UP), *episode(1, tries).records]
    projector = Projector(log, projections=[Attempts(), Tries()], installed=own_projections())
    await projector.open()
    monkeypatch.setattr(EventLog, "spans", counted_spans)
    monkeypatch.setattr(fold, "happening_of", counted_decoding)
    for some in (records[:6], records[6:]):  # the second batch continues the episode
        await log.append(some)
        writes = log.writes
        await projector.catch_up()
        assert log.writes == writes + 1
    assert set(reads.values()) == set(decoded.values()) == {1}
    assert len(reads) == len(decoded) == len(records) - 1
    assert await rows_in(log) == expected(1, tries)
    assert await ask(log, "SELECT id FROM trial ORDER BY id") == [(each[0],) for each in expected(1, tries)[:-1]]
    assert [(each.name, each.behind) for each in await states(log, [])] == [
        ("attempts", 0),
        ("recall", 0),
        ("tries", 0),
    ]
    assert (await verify(log, projections=[Attempts(), Tries(), *own_projections()])).drift == 0


class Tries(Projection):
    """A projection without a state."""

    name, tables = "tries", {"trial": {"arm": "text"}}

    def fold(self, event: Event, rows: Changes) -> None:
        if event.dtype == "PickUpAction":
            rows.insert("trial", event.id, arm=event.parameters["arm"])


class Moody(Attempts):
    """A fold that depends on more than the events: it refuses to read an episode a second time."""

    is_strict = False

    def episode(self) -> EpisodeFold:
        fold, strict = super().episode(), self.is_strict

        def strict_fold(event: Event, rows: Changes) -> None:
            if strict and event.sequence == 3:
                raise ZeroDivisionError("not again")
            fold(event, rows)

        return strict_fold


async def test_a_fold_that_fails_stops_its_episode_also_where_it_is_read_again(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = [("LEFT", "FAILED"), ("LEFT", "SUCCEEDED")]
    await log.append([*declarations(PICK_UP), *episode(1, tries).records[:5]])
    await (await projector_of(log, Moody())).catch_up()
    monkeypatch.setattr(Moody, "is_strict", True)
    await log.append([*episode(1, tries).records, *episode(2, tries).records])
    await (await projector_of(log, Moody())).catch_up()
    assert await rows_in(log) == expected(1, tries)[:2]  # of both nodes that started among the first five events
    (state,) = await states(log, [Moody()])
    assert state.parked == {
        1: "event 6: event 3, read again: ZeroDivisionError: not again",
        2: "event 3: attempts raised ZeroDivisionError: not again",
    }
    await rebuilt(log, Attempts())
    assert await rows_in(log) == [*expected(1, tries), *expected(2, tries)]


async def test_a_projection_that_cannot_be_written_leaves_the_batch_of_the_tables_whole(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = [("LEFT", "FAILED"), ("LEFT", "SUCCEEDED")]
    await log.append([*declarations(PICK_UP), *episode(1, tries).records[:5]])
    projector = await projector_of(log)
    await projector.catch_up()
    await log.append(episode(1, tries).records)
    write = CustomRows.write
    folded: list[list[tuple[Any, ...]]] = []

    async def refused(self: CustomRows, connection: AsyncConnection, generation: int) -> None:
        await write(self, connection, generation)
        if not folded:
            folded.append((await connection.exec_driver_sql("SELECT folded FROM episode")).all())  # type: ignore[arg-type]
            raise RowRefused("the disk of the projection is full")

    monkeypatch.setattr(CustomRows, "write", refused)
    assert await projector.runner.fold_next() == 3
    assert folded == [[(8,)]]
    assert await ask(log, "SELECT count(*) FROM episode WHERE folded = head") == [(1,)]
    assert len(await rows_in(log)) == 2
    await projector.catch_up()
    assert await rows_in(log) == expected(1, tries)
