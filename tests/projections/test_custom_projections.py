"""Custom projections: folded live, rebuilt and verified like the memory's tables, and never at their cost."""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from typing import Any

import pytest
from sqlalchemy import text

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import EpisodeStarted, NodeStarted
from pycrorm_async.memory import Memory
from pycrorm_async.projections import pipeline
from pycrorm_async.projections.custom import Changes, CustomFoldDefinition, CustomRows, Event, Projection, states
from pycrorm_async.projections.generations import PROJECTION, read_generation
from pycrorm_async.projections.pipeline import BatchFold, SideTarget
from pycrorm_async.projections.projector import Projector
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import PICK_UP, SAYING, Script, declarations, declared, field, mixed, name_of, row
from tests.projections.grasp_rate import TRIES, GraspRate, NoLeftHand, folded, rebuilt, rows_of, tries, visible_rows
from tests.projections.sql_queries import ask

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""


@pytest.mark.parametrize("batch_events", [1, 3, 10_000])
async def test_rows_do_not_depend_on_the_number_of_events_in_a_batch(log: EventLog, batch_events: int) -> None:
    records = [*declarations(PICK_UP), *mixed(tries(1), tries(2))]
    await folded(log, records, GraspRate(), batch_events=batch_events)
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]
    assert sorted(await ask(log, "SELECT arm, tries FROM grasp_tries_per_arm")) == [("LEFT", 6), ("RIGHT", 2)]


async def test_rows_follow_event_by_event_as_the_daemon_folds(log: EventLog) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *tries().records[:4]], GraspRate())
    assert [row[-1] for row in await visible_rows(log)] == ["SUCCEEDED"]
    await log.append(tries().records)
    while await projector.fold_next_batch():
        pass
    assert await visible_rows(log) == rows_of(1)


async def test_simulations_are_left_out_unless_the_projection_asks_for_them(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2, simulated=True))], GraspRate())
    assert await visible_rows(log) == rows_of(1)
    async with Reading(log).session(simulated=True) as session:
        seen = await session.execute(text("SELECT * FROM grasp_try ORDER BY id"))
        assert [tuple(each) for each in seen] == [*rows_of(1), *rows_of(2)]
        assert (await session.execute(text("SELECT sum(tries) FROM grasp_tries_per_arm"))).scalar_one() == 8


async def test_a_process_without_the_projection_leaves_it_and_one_with_it_catches_up(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *tries(1).records[:4]], GraspRate())
    await folded(log, [*declarations(SAYING), *mixed(tries(1), tries(2))])
    assert len(await visible_rows(log)) == 1
    assert await ask(log, "SELECT count(*) FROM task_tree_node") == [(10,)]
    await folded(log, [], GraspRate())
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]


async def test_a_projection_that_is_installed_later_begins_with_the_first_event_of_the_log(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))])
    await folded(log, [], GraspRate())
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]


@pytest.mark.parametrize(
    "payload",
    [b'{"version":2,"kind":"action"}', b"?", b'{"kind":"action","dtype":"XAction","table":7}', b"[" * 100_000],
    ids=["newer", "no JSON", "another shape", "too deep"],
)
async def test_an_unreadable_declaration_stops_nothing_else(log: EventLog, payload: bytes) -> None:
    strange = declarations(PICK_UP)[0]._replace(payload=payload)
    await log.append([*declarations(PICK_UP), strange, *tries().records])
    projector = Projector(log, projections=[GraspRate()])
    await projector.open()
    await projector.catch_up()
    assert await ask(log, "SELECT * FROM grasp_try ORDER BY id") == rows_of(1)


async def test_two_concurrent_processes_fold_every_event_once(log: EventLog) -> None:
    records = [*declarations(PICK_UP), *mixed(*(tries(episode) for episode in range(1, 21)))]
    await folded(log, records)
    other = await EventLog.open(log.address, create=True)
    try:
        both = [Projector(each, projections=[GraspRate()], batch_events=1_000) for each in (log, other)]
        for each in both:
            await each.open()
        await asyncio.gather(*(each.catch_up() for each in both))
    finally:
        await other.close()
    assert Counter(await visible_rows(log)) == Counter(each for episode in range(1, 21) for each in rows_of(episode))


async def test_a_batch_that_another_process_has_folded_meanwhile_is_not_written(log: EventLog) -> None:
    script = tries()
    await folded(log, [*declarations(PICK_UP), *script.records[:4]], GraspRate())
    await folded(log, script.records[4:])  # a process that folds the memory's own tables only
    other = await EventLog.open(log.address, create=True)
    try:
        folds = []
        for each in (log, other):
            async with each.reading() as connection:
                generation = await read_generation(connection, f"{PROJECTION}grasp_rate")
            assert generation is not None
            target = SideTarget(each, f"{PROJECTION}grasp_rate", "grasp_rate", GraspRate.version)
            folds.append(BatchFold(each, target, generation, CustomFoldDefinition(GraspRate())))
            await folds[-1].prepare(await target.unfolded(100, after=0, reached={}))
        assert [await each.write() for each in folds] == [len(script.records) - 4, 0]
    finally:
        await other.close()
    assert await visible_rows(log) == rows_of(1)
    [state] = await states(log, [GraspRate()])
    assert (state.behind, state.parked) == (0, {})


@pytest.mark.parametrize("page_events", [4, 10_000])
async def test_a_fold_that_raises_stops_its_episode_and_no_other(
    log: EventLog, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, page_events: int
) -> None:
    monkeypatch.setattr(pipeline, "_PAGE_EVENTS", page_events)
    left = [each for each in TRIES if each[0] == "LEFT"]
    records = [*declarations(PICK_UP), *mixed(tries(1), tries(2, many=left))]
    await folded(log, records, NoLeftHand())
    assert await visible_rows(log) == [*rows_of(1)[:2], *rows_of(2, left)]  # the event that raised has left no row
    assert await ask(log, "SELECT number, folded, parked FROM episode ORDER BY number") == [(1, 9, None), (2, 7, None)]
    (state,) = await states(log, [])
    assert state.parked == {1: "event 7: grasp_rate raised ZeroDivisionError: no right hand"}
    assert "episode 1 is parked in the projection grasp_rate: event 7" in caplog.text
    await rebuilt(log, GraspRate())
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2, left)]


async def test_the_reason_why_a_process_stops_folding_it_remains_until_the_projection_is_set_up_again(
    log: EventLog,
) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *tries(1).records], GraspRate())
    records = tries(2).records
    await log.append(records)
    async with log.engine.begin() as connection:
        is_server = connection.dialect.name == "postgresql"
        trigger = "event_is_not_changed ON event" if is_server else "event_is_not_deleted"
        await connection.exec_driver_sql(f"DROP TRIGGER {trigger}")
        await connection.exec_driver_sql("DELETE FROM event WHERE episode = 2 AND sequence = 4")
    await projector.catch_up()
    (state,) = await states(log, [GraspRate()])
    assert state.fault is not None
    assert state.fault.startswith("a process stopped folding the projection grasp_rate")
    assert "is missing in" in state.fault
    assert state.behind == len(records)
    await Projector(log, projections=[GraspRate()]).open()
    (state,) = await states(log, [GraspRate()])
    assert state.fault is None


class TakesAView(GraspRate):
    name = "other"
    tables = {"other": {"n": "integer"}}  # noqa: RUF012 - a common form in user code


class TakesALeaf(TakesAView):
    tables = {"pick_up_action": {"n": "integer"}}  # noqa: RUF012 - a common form in user code
    views = []  # noqa: RUF012


@pytest.mark.parametrize(
    ("projection", "reason"),
    [
        (
            TakesAView(),
            "the projection other needs the name 'grasp_tries_per_arm', which the projection grasp_rate has",
        ),
        (TakesALeaf(), "the projection other needs the name 'pick_up_action', which the memory has"),
    ],
)
async def test_a_name_that_is_already_used_is_refused_with_both_owners(
    log: EventLog, projection: Projection, reason: str
) -> None:
    await folded(log, [], GraspRate())
    with pytest.raises(CallerError, match=reason):
        await Projector(log, projections=[projection]).open()
    await Projector(log, installed=[projection]).open()  # a conflict with an installed package is only reported


async def test_a_type_that_is_declared_later_still_gets_its_table(
    log: EventLog, caplog: pytest.LogCaptureFixture
) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *tries(1).records], GraspRate())
    trying = declared("GraspTry", "grasp_try", field("text", "text", 2))
    script = Script(2)
    script.put(EpisodeStarted("", "me", "host", "", "3.11"))
    node = script.put(NodeStarted("action", designator=name_of(trying), parameters={"text": "again"}))
    await log.append([*declarations(trying), *script.records])
    await projector.catch_up()
    assert await ask(log, "SELECT id, text FROM grasp_try") == [(row(node, number=2), "again")]
    assert "the projection grasp_rate has no views: the names grasp_try belong to the memory" in caplog.text
    assert await ask(log, "SELECT count(*) FROM episode WHERE parked IS NOT NULL") == [(0,)]


class Wrong(Projection):
    name = "wrong"
    tables = {"wrong_row": {"n": "integer", "x": "real", "said": "text", "is_it": "boolean", "order": "json"}}  # noqa: RUF012 - a common form in user code

    def __init__(self, *changes: tuple[str, int, dict[str, Any]]) -> None:
        self.changes = changes

    def fold(self, event: Event, rows: Changes) -> None:
        for into, id_, columns in self.changes:
            rows.insert(into, id_, **columns)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ([("wrong_rows", row(1), {})], "wrong has no table 'wrong_rows'"),
        ([("wrong_row", row(1), {"m": 1})], "wrong_row has no column 'm' to fill"),
        ([("wrong_row", row(1), {"process_metadata_id": 7})], "wrong_row has no column 'process_metadata_id' to fill"),
        ([("wrong_row", row(1), {"n": "one"})], "wrong_row.n: 'one' is not of the declared type integer"),
        ([("wrong_row", row(1), {"n": True})], "wrong_row.n: True is not of the declared type integer"),
        ([("wrong_row", row(1), {"n": 2**63})], "wrong_row.n: 9223372036854775808 is not of the declared type integer"),
        ([("wrong_row", row(1), {"x": float("nan")})], "wrong_row.x: nan is not a finite number"),
        ([("wrong_row", row(1), {"said": 1})], "wrong_row.said: 1 is not of the declared type text"),
        ([("wrong_row", row(1), {"said": "a\x00"})], "wrong_row.said: the text holds U\\+0000"),
        ([("wrong_row", row(1), {"is_it": 1})], "wrong_row.is_it: 1 is not of the declared type boolean"),
        ([("wrong_row", row(1), {"order": object()})], "wrong_row.order: .*unsupported"),
        ([("wrong_row", row(1, number=2), {})], "wrong_row: 4294967328 is not a row of this episode"),
        ([("wrong_row", row(1), {}), ("wrong_row", row(1), {})], "wrong_row has a row 2147483680 already"),
    ],
)
def test_a_row_that_cannot_be_stored_is_refused_alike_on_every_database(changes: Any, reason: str) -> None:
    rows = CustomRows(Wrong(("wrong_row", row(1, slot=1), {"n": 1}), *changes), {})
    refused = rows.fold(tries().stored()[:1])
    assert refused is not None
    assert refused[0] == 1
    assert re.search(reason, refused[1])
    assert rows.to_insert() == {}


async def test_values_are_kept_exactly_in_columns_with_names_that_the_database_reserves(log: EventLog) -> None:
    parameters = {"n": -(2**62), "x": 1, "said": "ä", "is_it": False, "order": {"b": [1, None]}}

    class Changing(Wrong):
        def fold(self, event: Event, rows: Changes) -> None:
            if event.sequence == 1:
                rows.insert("wrong_row", event.id, **parameters)
                rows.insert("wrong_row", event.row(1, 31))
            if event.sequence == 2:
                rows.update("wrong_row", event.row(1, 31), **parameters)
                rows.update("wrong_row", event.row(9), n=1)  # no such column

    await folded(log, tries(many=[]).records, Changing(), batch_events=1)
    whole = (-(2**62), 1.0, "ä", False, '{"b":[1,null]}')
    result = await ask(log, 'SELECT id, n, x, said, is_it, "order" FROM wrong_row ORDER BY id')
    assert result == [(row(1), *whole), (row(1, 31), *whole)]


@pytest.mark.parametrize(
    ("attributes", "reason"),
    [
        ({"name": "Grasp Rate"}, "its name is 'Grasp Rate', and must be"),
        ({"version": 0}, "its version is 0"),
        ({"tables": {}}, "it has no tables"),
        ({"tables": {"pose": {"x": "real"}}}, "the table name 'pose' is used by the memory itself"),
        ({"tables": {"one": {"id": "integer"}}}, "the column name one.id is reserved"),
        ({"tables": {"one": {"n": "int"}}}, "the column one.n is 'int', and must be one of row, integer"),
        ({"tables": {"grasp_tries_per_arm": {}}}, "two of its tables and views have the name 'grasp_tries_per_arm'"),
    ],
)
def test_an_impossible_projection_is_refused_at_once(attributes: dict[str, Any], reason: str) -> None:
    kind: type[Projection] = type("Mine", (GraspRate,), attributes)
    with pytest.raises(CallerError, match=f"the projection Mine: {reason}"):
        Memory.open("sqlite://", projections=[kind()])
