"""Fold one log by two workers, each a projector with a log of its own: one prepares a batch while the other writes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence

import pytest

from pycrorm_async.events.codec import Record, encode
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    FieldDeclared,
    LocationResolved,
    NodeEnded,
    NodeStarted,
)
from pycrorm_async.projections import pipeline
from pycrorm_async.projections.pipeline import BatchPreview, FoldRunner, LiveTarget
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span
from tests.projections.event_script import SAYING, Script, declarations, declared, field, mixed, name_of, row
from tests.projections.sql_queries import ask, lose_event

pytestmark = pytest.mark.slow


class WorkerInLoop:
    """A worker in this loop; `wrote` lists the number of events of its batches."""

    def __init__(self, projector: Projector) -> None:
        self.projector = projector
        self.wrote: list[int] = []

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        return await self.projector.runner.prepare(spans)

    async def write(self) -> int:
        self.wrote.append(await self.projector.runner.write())
        return self.wrote[-1]


class LosesAnswers(WorkerInLoop):
    """Write, but let every answer be lost."""

    async def write(self) -> int:
        await super().write()
        return 0


class DiesOften(WorkerInLoop):
    """Die at every third request, so that another worker replaces it."""

    requests = 0

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        self._live()
        return await super().prepare(spans)

    async def write(self) -> int:
        self._live()
        return await super().write()

    def _live(self) -> None:
        self.requests += 1
        if self.requests % 3 == 0:
            raise Died


class Died(Exception):
    pass


class WritesTwice(WorkerInLoop):
    """Write before the request and again at it."""

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        preview = await super().prepare(spans)
        batch = self.projector.runner._prepared
        await super().write()
        self.projector.runner._prepared = batch
        return preview


@pytest.fixture(autouse=True)
def _any_batch_is_prepared_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "LOOKAHEAD_EVENTS_MIN", 1)


@pytest.fixture
async def other_log(log: EventLog) -> AsyncIterator[EventLog]:
    opened = await EventLog.open(log.address, create=True)
    yield opened
    await opened.close()


def talk(episode: int, *, words: int) -> Script:
    """Return nested nodes, so that rows are made in one batch and ended in another."""
    script = Script(episode)
    script.put(EpisodeStarted("a talk", "me", "host", "1.0", "3.11"))
    root = script.put(NodeStarted("root"))
    for word in range(0, words, 2):
        outer = script.put(NodeStarted("action", root, name_of(SAYING), {"text": f"{episode}.{word}"}))
        inner = script.put(NodeStarted("action", outer, name_of(SAYING), {"text": f"{episode}.{word + 1}"}))
        script.put(NodeEnded(inner, "SUCCEEDED"))
        script.put(NodeEnded(outer, "FAILED" if word % 3 else "SUCCEEDED"))
    script.put(NodeEnded(root, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return script


async def workers_of(logs: Sequence[EventLog], kind: type[WorkerInLoop], batch_events: int) -> list[WorkerInLoop]:
    hands = []
    for log in logs:
        projector = Projector(log, batch_events=batch_events)
        await projector.open()
        hands.append(kind(projector))
    return hands


async def fold_all(log: EventLog, hands: Sequence[WorkerInLoop], batch_events: int) -> int:
    """Fold until nothing is left, and return the number of events that the pipeline counted."""
    runner, count = FoldRunner(LiveTarget(log), batch_events=batch_events), 0
    while True:
        try:
            folded = await runner.fold_next(hands)
        except Died:
            hands = [*hands[1:], hands[0]]
            continue
        if folded is None:
            return count
        count += folded


async def folded_by_two(
    log: EventLog, other_log: EventLog, records: Sequence[Record], kind: type[WorkerInLoop], batch_events: int
) -> list[WorkerInLoop]:
    hands = await workers_of([log, other_log], kind, batch_events)
    await log.append(records)
    await fold_all(log, hands, batch_events)
    return hands


async def stored_words(log: EventLog) -> list[tuple[object, ...]]:
    """Return every word: its row, the parent node, its status, and the text."""
    return await ask(
        log,
        "SELECT node.id, node.parent_id, node.status, text FROM saying_action JOIN task_tree_node AS node"
        " ON node.id = saying_action.id ORDER BY node.id",
    )


def words_of(number: int, words: int, *, episode: int | None = None) -> list[tuple[object, ...]]:
    """Return the expected rows of the episode with this number."""
    expected: list[tuple[object, ...]] = []
    for word in range(0, words, 2):
        outer, status = row(3 + 2 * word, number=number), "FAILED" if word % 3 else "SUCCEEDED"
        expected += [
            (outer, row(2, number=number), status, f"{episode or number}.{word}"),
            (row(4 + 2 * word, number=number), outer, "SUCCEEDED", f"{episode or number}.{word + 1}"),
        ]
    return expected


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(
    ("hand", "batch_events"),
    [
        (WorkerInLoop, 2),
        (LosesAnswers, 2),
        (DiesOften, 2),
        (WritesTwice, 3),
    ],
)
async def test_every_event_is_folded_once_and_in_its_place(
    log: EventLog, other_log: EventLog, hand: type[WorkerInLoop], batch_events: int
) -> None:
    records = [*declarations(SAYING), *mixed(talk(1, words=12), talk(2, words=2)), *talk(3, words=6).records]
    hands = await folded_by_two(log, other_log, records, hand, batch_events)
    assert await stored_words(log) == [*words_of(1, 12), *words_of(2, 2), *words_of(3, 6)]
    assert await ask(log, "SELECT status, count(*) FROM process_metadata GROUP BY status") == [("SUCCEEDED", 3)]
    assert await ask(log, "SELECT count(*) FROM task_tree_node WHERE parent_id IS NULL AND end_time IS NOT NULL") == [
        (3,)
    ]
    assert await ask(log, "SELECT number, head - folded, parked FROM episode ORDER BY number") == [
        (1, 0, None),
        (2, 0, None),
        (3, 0, None),
    ]
    if hand is WorkerInLoop:
        assert all(sum(each.wrote) >= len(records) // 3 for each in hands)
        assert not any(
            0 in each.wrote[1:] for each in hands
        )  # no batch is prepared in vain; first the tables are altered


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(("bad", "place"), [("unknown", 6), ("refused by the database", 7), ("missing", 6)])
async def test_an_episode_stops_where_it_cannot_be_folded_whichever_worker_meets_that(
    log: EventLog, other_log: EventLog, bad: str, place: int
) -> None:
    first = talk(1, words=20)
    match bad:
        case "unknown":
            first.records[place - 1] = first.records[place - 1]._replace(type="RobotDanced")
        case "refused by the database":
            payload = encode(LocationResolved("CostmapLocation", considered=2**64 - 1))
            first.records[place - 1] = first.records[place - 1]._replace(type="LocationResolved", payload=payload)
    hands = await workers_of([log, other_log], WorkerInLoop, 2)
    await log.append([*declarations(SAYING), *first.records, *talk(2, words=4).records])
    if bad == "missing":
        await lose_event(log, 1, place)
    await fold_all(log, hands, 2)
    rows = await ask(log, "SELECT number, folded, parked IS NULL FROM episode ORDER BY number")
    assert [tuple(map(int, each)) for each in rows] == [(1, place - 1, 0), (2, 12, 1)]
    ((reason,),) = await ask(log, "SELECT parked FROM episode WHERE number = 1")
    assert reason.startswith(f"event {place}")
    begun = [each for each in (3, 4, 7, 8) if each < place]
    rows = await stored_words(log)
    assert [each[0] for each in rows if each not in words_of(2, 4)] == [row(each) for each in begun]
    assert [each for each in rows if each in words_of(2, 4)] == words_of(2, 4)


async def test_types_that_are_declared_meanwhile_are_learned_by_both_workers(
    log: EventLog, other_log: EventLog
) -> None:
    class Interrupted(WorkerInLoop):
        """Record and use a type that is new to both workers before its first batches are prepared."""

        count = 0

        async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
            Interrupted.count += 1
            if Interrupted.count <= 3:
                number = Interrupted.count
                louder = declared("SayingAction", "saying_action", field("text", "text", 2), volume(number))
                script = Script(100 + number)
                script.put(NodeStarted("action", None, name_of(louder), {"text": "LOUD", f"volume{number}": 0.5}))
                await other_log.append([*declarations(louder), *script.records])
            return await super().prepare(spans)

    records = [*declarations(SAYING), *talk(1, words=30).records]
    await folded_by_two(log, other_log, records, Interrupted, batch_events=4)
    loud = [(row(1, number=number), None, "RUNNING", "LOUD") for number in (2, 3, 4)]
    assert await stored_words(log) == [*words_of(1, 30), *loud]
    assert await ask(log, "SELECT volume1, volume2, volume3 FROM saying_action WHERE text = 'LOUD' ORDER BY id") == [
        (0.5, None, None),
        (None, 0.5, None),
        (None, None, 0.5),
    ]


def volume(number: int) -> FieldDeclared:
    return field(f"volume{number}", "real", 2 + number)


@pytest.mark.soak_on("sqlite")
async def test_several_pipelines_fold_every_event_once(log: EventLog, other_log: EventLog) -> None:
    pairs = [await workers_of([log, other_log], WorkerInLoop, 3) for _ in range(2)]
    talks = [talk(number, words=10) for number in range(1, 6)]
    await log.append([*declarations(SAYING), *mixed(*talks)])
    counts = await asyncio.gather(*(fold_all(log, each, 3) for each in pairs))
    assert await stored_words(log) == [word for number in range(1, 6) for word in words_of(number, 10)]
    assert sum(counts) == sum(len(each.records) for each in talks)
