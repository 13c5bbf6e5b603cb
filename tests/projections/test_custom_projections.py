"""A projection of one's own: kept live, rebuilt and verified like the memory's tables, and never at their cost."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Sequence
from typing import Any

import pytest
from sqlalchemy import column, func, select, table, text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import EpisodeStarted, NodeEnded, NodeStarted
from pycrorm_async.memory import Memory
from pycrorm_async.projections.custom.projection import Changes, Event, Projection
from pycrorm_async.projections.custom.projection_rows import CustomRows
from pycrorm_async.projections.custom.projection_tables import states
from pycrorm_async.projections.fold.fold import CannotFold
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import Rebuild, claimed
from pycrorm_async.projections.replaced_tables import clear
from pycrorm_async.projections.schema.user_views import UserView
from pycrorm_async.projections.verify.row_comparison import Difference
from pycrorm_async.projections.verify.verify import verify
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import PICK_UP, SAYING, Script, declarations, declared, field, mixed, name_of, row
from tests.projections.sql_queries import ask, names

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""On a server these take long; there they run in turns, and other modules show that it answers alike."""

_TRIES = table("grasp_try", column("arm"), column("status"))
_RATE = select(_TRIES.c.arm, func.count().label("tries")).group_by(_TRIES.c.arm)


class GraspRate(Projection):
    name, version = "grasp_rate", 1
    tables = {"grasp_try": {"arm": "text", "grasp": "text", "status": "text"}}  # noqa: RUF012 - as people write it
    views = [UserView("grasp_tries_per_arm", _RATE)]  # noqa: RUF012

    def fold(self, event: Event, rows: Changes) -> None:
        match event.happening:
            case NodeStarted(parameters=given) if event.dtype == "PickUpAction":
                rows.insert("grasp_try", event.id, arm=given["arm"], grasp=given["grasp"], status="RUNNING")
            case NodeEnded(node=node, status=status):
                rows.update("grasp_try", event.row(node), status=status)


TRIES = [
    ("LEFT", "TOP", "SUCCEEDED"),
    ("LEFT", "FRONT", "FAILED"),
    ("RIGHT", "TOP", "SUCCEEDED"),
    ("LEFT", "TOP", None),
]


def tries(episode: int = 1, *, simulated: bool = False, many: Sequence[Any] = TRIES) -> Script:
    """An episode of pick-ups, one after the other: arm, grasp, status; None for one that has not ended."""
    script = Script(episode)
    script.put(EpisodeStarted("", "me", "host", "", "3.11", simulated=simulated))
    root = script.put(NodeStarted("root", simulated=simulated))
    for arm, grasp, status in many:
        given = {"object_designator": {"row": 1, "object": 1}, "arm": arm, "grasp": grasp}
        node = script.put(
            NodeStarted("action", root, designator=name_of(PICK_UP), parameters=given, simulated=simulated)
        )
        if status is not None:
            script.put(NodeEnded(node, status))
    return script


def rows_of(episode: int, many: Sequence[Any] = TRIES) -> list[tuple[Any, ...]]:
    """What the table must have: counted from the list, with no fold. A try's node is the next event after the last."""
    found, sequence = [], 3
    for arm, grasp, status in many:
        found.append((row(sequence, number=episode), episode, arm, grasp, status or "RUNNING"))
        sequence += 1 if status is None else 2
    return found


async def folded(log: EventLog, records: Sequence[Any], *projections: Projection, **options: Any) -> Projector:
    projector = Projector(log, projections=projections, **options)
    await projector.open()
    await log.append(records)
    await projector.catch_up()
    return projector


async def shown(log: EventLog) -> list[tuple[Any, ...]]:
    return await ask(log, "SELECT * FROM grasp_try ORDER BY id")


async def rebuilt(log: EventLog, projection: Projection) -> None:
    async with claimed(log):
        rebuild = await Rebuild.begin(log, projection=projection)
        await rebuild.show()
        assert await clear(log) == []


@pytest.mark.parametrize("batch_events", [1, 3, 10_000])
async def test_its_rows_are_what_happened_however_many_events_are_folded_at_once(
    log: EventLog, batch_events: int
) -> None:
    records = [*declarations(PICK_UP), *mixed(tries(1), tries(2))]
    await folded(log, records, GraspRate(), batch_events=batch_events)
    assert await shown(log) == [*rows_of(1), *rows_of(2)]
    assert sorted(await ask(log, "SELECT arm, tries FROM grasp_tries_per_arm")) == [("LEFT", 6), ("RIGHT", 2)]


async def test_it_follows_event_by_event_as_the_daemon_folds(log: EventLog) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *tries().records[:4]], GraspRate())
    assert [row[-1] for row in await shown(log)] == ["SUCCEEDED"]
    await log.append(tries().records)
    while await projector.fold_next_batch():
        pass
    assert await shown(log) == rows_of(1)


async def test_what_was_only_thought_through_is_left_out_unless_it_is_asked_for(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2, simulated=True))], GraspRate())
    assert await shown(log) == rows_of(1)
    async with Reading(log).session(simulated=True) as session:
        seen = await session.execute(text("SELECT * FROM grasp_try ORDER BY id"))
        assert [tuple(each) for each in seen] == [*rows_of(1), *rows_of(2)]
        assert (await session.execute(text("SELECT sum(tries) FROM grasp_tries_per_arm"))).scalar_one() == 8


async def test_a_process_that_does_not_know_it_leaves_it_and_one_that_does_catches_up(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *tries(1).records[:4]], GraspRate())
    await folded(log, [*declarations(SAYING), *mixed(tries(1), tries(2))])
    assert len(await shown(log)) == 1
    assert await ask(log, "SELECT count(*) FROM task_tree_node") == [(10,)]
    await folded(log, [], GraspRate())
    assert await shown(log) == [*rows_of(1), *rows_of(2)]


async def test_a_projection_that_comes_later_begins_with_the_beginning_of_the_log(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))])
    await folded(log, [], GraspRate())
    assert await shown(log) == [*rows_of(1), *rows_of(2)]


@pytest.mark.parametrize(
    "payload",
    [b'{"version":2,"kind":"action"}', b"?", b'{"kind":"action","dtype":"XAction","table":7}', b"[" * 100_000],
    ids=["newer", "no JSON", "another shape", "too deep"],
)
async def test_a_declaration_that_cannot_be_read_stops_nothing_else(log: EventLog, payload: bytes) -> None:
    strange = declarations(PICK_UP)[0]._replace(payload=payload)
    await log.append([*declarations(PICK_UP), strange, *tries().records])
    projector = Projector(log, projections=[GraspRate()])
    await projector.open()
    await projector.catch_up()
    assert await ask(log, "SELECT * FROM grasp_try ORDER BY id") == rows_of(1)


async def test_two_that_fold_at_once_show_every_event_once(log: EventLog) -> None:
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
    assert Counter(await shown(log)) == Counter(each for episode in range(1, 21) for each in rows_of(episode))


class NoLeftHand(GraspRate):
    def fold(self, event: Event, rows: Changes) -> None:
        super().fold(event, rows)
        if event.parameters.get("arm") == "RIGHT":
            raise ZeroDivisionError("no right hand")


async def test_a_fold_that_raises_stops_its_episode_there_and_nowhere_else(
    log: EventLog, caplog: pytest.LogCaptureFixture
) -> None:
    left = [each for each in TRIES if each[0] == "LEFT"]
    records = [*declarations(PICK_UP), *mixed(tries(1), tries(2, many=left))]
    await folded(log, records, NoLeftHand())
    assert await shown(log) == [*rows_of(1)[:2], *rows_of(2, left)]  # the event that raised has left nothing
    assert await ask(log, "SELECT number, folded, parked FROM episode ORDER BY number") == [(1, 9, None), (2, 7, None)]
    (state,) = await states(log, [])
    assert state.parked == {1: "event 7: grasp_rate raised ZeroDivisionError: no right hand"}
    assert "episode 1 is parked in the projection grasp_rate: event 7" in caplog.text
    await rebuilt(log, GraspRate())
    assert await shown(log) == [*rows_of(1), *rows_of(2, left)]


class NextGraspRate(GraspRate):
    version = 2
    tables = {"grasp_try": {"arm": "text", "hard": "boolean"}}  # noqa: RUF012 - as people write it
    views = []  # noqa: RUF012

    def fold(self, event: Event, rows: Changes) -> None:
        if event.dtype == "PickUpAction":
            rows.insert("grasp_try", event.id, arm=event.parameters["arm"], hard=event.parameters["grasp"] == "TOP")


async def test_another_version_is_not_folded_before_it_is_rebuilt(
    log: EventLog, caplog: pytest.LogCaptureFixture
) -> None:
    await folded(log, [*declarations(PICK_UP), *tries(1).records], GraspRate())
    before = await folded(log, [], GraspRate())
    projector = await folded(log, tries(2).records, NextGraspRate())
    assert "have version 1, its code has version 2: run `pycrorm rebuild grasp_rate`" in caplog.text
    assert await shown(log) == rows_of(1)
    await rebuilt(log, NextGraspRate())
    new = [(each[0], each[1], each[2], each[3] == "TOP") for episode in (1, 2) for each in rows_of(episode)]
    assert await shown(log) == new
    assert "grasp_tries_per_arm" not in await names(log, "view")
    caplog.clear()
    await log.append(tries(3).records)
    await before.catch_up()  # it knows version 1 only, and leaves it
    assert await shown(log) == new
    assert "this process stops folding the projection grasp_rate" in caplog.text
    assert await projector.catch_up() == 0


async def test_the_reason_why_a_process_stops_folding_it_stays_until_it_is_set_up_again(log: EventLog) -> None:
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


async def test_rebuilt_it_is_what_it_was_live(log: EventLog) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], GraspRate())
    await rebuilt(log, GraspRate())
    assert await shown(log) == [*rows_of(1), *rows_of(2)]
    assert "pycrorm_own_grasp_try__2" in await names(log, "table")
    assert not [each for each in await names(log, "table") if "grasp_" in each and each.endswith("__1")]
    await log.append(tries(3).records)  # who folded the old tables goes on with the new ones
    await projector.catch_up()
    assert await shown(log) == [*rows_of(1), *rows_of(2), *rows_of(3)]


async def test_a_rebuild_of_our_tables_leaves_it_as_it_is(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2, simulated=True))], GraspRate())
    async with claimed(log):
        rebuild = await Rebuild.begin(log)
        await rebuild.show()
        assert await clear(log) == []
    assert await shown(log) == rows_of(1)


async def test_a_rebuild_that_broke_off_is_taken_up(log: EventLog, monkeypatch: pytest.MonkeyPatch) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], GraspRate())
    monkeypatch.setattr("pycrorm_async.projections.rebuild._BATCH_EVENTS", 5)
    async with claimed(log):
        broken = await Rebuild.begin(log, projection=GraspRate())
        assert await broken.fold_next_batch() == 5
    assert await shown(log) == [*rows_of(1), *rows_of(2)]
    async with claimed(log):
        again = await Rebuild.begin(log, projection=GraspRate())
        assert again.number == broken.number
        assert await again.left() == 18 - 5
    await rebuilt(log, GraspRate())
    assert await shown(log) == [*rows_of(1), *rows_of(2)]


class TakesAView(GraspRate):
    name = "other"
    tables = {"other": {"n": "integer"}}  # noqa: RUF012 - as people write it


class TakesALeaf(TakesAView):
    tables = {"pick_up_action": {"n": "integer"}}  # noqa: RUF012 - as people write it
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
async def test_a_name_that_is_taken_is_refused_with_both(log: EventLog, projection: Projection, reason: str) -> None:
    await folded(log, [], GraspRate())
    with pytest.raises(CallerError, match=reason):
        await Projector(log, projections=[projection]).open()
    await Projector(log, installed=[projection]).open()  # of a package that is installed it is only told


async def test_a_type_that_is_declared_later_has_its_table_all_the_same(
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
    tables = {"wrong_row": {"n": "integer", "x": "real", "said": "text", "is_it": "boolean", "order": "json"}}  # noqa: RUF012 - as people write it

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
        ([("wrong_row", row(1, number=2), {})], "wrong_row: 4294967328 is no row of this episode"),
        ([("wrong_row", row(1), {}), ("wrong_row", row(1), {})], "wrong_row has a row 2147483680 already"),
    ],
)
def test_a_row_that_cannot_be_kept_is_refused_on_every_database_alike(changes: Any, reason: str) -> None:
    rows = CustomRows(Wrong(("wrong_row", row(1, slot=1), {"n": 1}), *changes), {})
    with pytest.raises(CannotFold, match=reason):
        rows.fold(tries().stored()[0])
    assert rows.to_insert() == {}


async def test_values_are_kept_as_they_are_also_in_columns_with_names_of_the_database(log: EventLog) -> None:
    given = {"n": -(2**62), "x": 1, "said": "ä", "is_it": False, "order": {"b": [1, None]}}

    class Changing(Wrong):
        def fold(self, event: Event, rows: Changes) -> None:
            if event.sequence == 1:
                rows.insert("wrong_row", event.id, **given)
                rows.insert("wrong_row", event.row(1, 31))
            if event.sequence == 2:
                rows.update("wrong_row", event.row(1, 31), **given)
                rows.update("wrong_row", event.row(9), n=1)  # there is none

    await folded(log, tries(many=[]).records, Changing(), batch_events=1)
    whole = (-(2**62), 1.0, "ä", False, '{"b":[1,null]}')
    found = await ask(log, 'SELECT id, n, x, said, is_it, "order" FROM wrong_row ORDER BY id')
    assert found == [(row(1), *whole), (row(1, 31), *whole)]


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
def test_a_projection_that_cannot_be_is_refused_at_once(attributes: dict[str, Any], reason: str) -> None:
    kind: type[Projection] = type("Mine", (GraspRate,), attributes)
    with pytest.raises(CallerError, match=f"the projection Mine: {reason}"):
        Memory.open("sqlite://", projections=[kind()])


async def test_verify_finds_nothing_where_all_is_well_and_every_change_where_not(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pycrorm_async.projections.verify.parts._PART_EVENTS", 10)  # several parts
    records = [*declarations(PICK_UP), *mixed(*(tries(episode) for episode in range(1, 5)))]
    await folded(log, [*records, *tries(5).records[:6]], GraspRate())
    found = await verify(log, projections=[GraspRate()])
    assert (found.drift, found.damage, found.not_compared) == (0, 0, {})
    assert found.rows == (await verify(log)).rows + 4 * 4 + 2
    assert (await verify(log)).not_compared == {"grasp_rate": "its code is not installed here"}
    table = "pycrorm_own_grasp_try__1"
    first, second = rows_of(2)[:2]
    async with log.engine.begin() as connection:
        for change in (
            f"UPDATE {table} SET arm = 'BOTH' WHERE id = {first[0]}",
            f"DELETE FROM {table} WHERE id = {second[0]}",
            f"INSERT INTO {table} (id, process_metadata_id) VALUES ({row(5, number=9)}, 9)",
        ):
            await connection.exec_driver_sql(change)
    found = await verify(log, projections=[GraspRate()])
    assert found.differences == [
        Difference(2, 3, "grasp_try", "arm", "BOTH", "LEFT"),
        Difference(2, 5, "grasp_try", None, None, second),
        Difference(9, 5, "grasp_try", None, (row(5, number=9), 9, None, None, None), None),
    ]
    (only,) = [each for each in await log.episodes() if each.number == 1]
    assert (await verify(log, episode=only, projections=[GraspRate()])).drift == 0
    await rebuilt(log, GraspRate())
    assert (await verify(log, projections=[GraspRate()])).drift == 0


async def test_verify_tells_of_a_fold_that_means_something_else_under_the_same_version(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *tries().records], GraspRate())
    found = await verify(log, projections=[NoLeftHand()])
    (told,) = map(str, found.differences)
    assert told == (
        "grasp_rate.fold is 'folded in the tables', and should be"
        " 'parked: grasp_rate raised ZeroDivisionError: no right hand'"
    )
    assert (await verify(log, projections=[NextGraspRate()])).not_compared.keys() == {"grasp_rate"}


def _die_in_batch(url: str, last: int, *, rebuilding: bool) -> None:
    """Folds four events at a time; dies when the rows of that many batches are written, the last not committed."""
    write, count = CustomRows.write, 0

    async def written(self: CustomRows, connection: AsyncConnection, generation: int) -> None:
        nonlocal count
        await write(self, connection, generation)
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)

    async def fold() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        if rebuilding:
            async with claimed(log):
                await (await Rebuild.begin(log, projection=GraspRate())).show()
        await folded(log, [], GraspRate(), batch_events=4)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CustomRows, "write", written)
        patch.setattr("pycrorm_async.projections.rebuild._BATCH_EVENTS", 4)
        asyncio.run(fold())


@pytest.mark.parametrize("rebuilding", [False, True])
async def test_killed_in_the_middle_it_goes_on_where_it_was(
    log: EventLog, database_url: str, *, rebuilding: bool
) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], *([GraspRate()] if rebuilding else []))
    for last in (1, 2):
        process = multiprocessing.get_context("spawn").Process(
            target=_die_in_batch, args=(database_url, last), kwargs={"rebuilding": rebuilding}
        )
        process.start()
        await asyncio.to_thread(process.join)
        assert process.exitcode == -signal.SIGKILL
    if rebuilding:
        assert await shown(log) == [*rows_of(1), *rows_of(2)]
        async with claimed(log):
            assert await (await Rebuild.begin(log, projection=GraspRate())).left() == 18 - 4
        await rebuilt(log, GraspRate())
    else:
        assert await shown(log) == rows_of(1)[:1]
        await folded(log, [], GraspRate())
    assert await shown(log) == [*rows_of(1), *rows_of(2)]
    assert (await verify(log, projections=[GraspRate()])).drift == 0
