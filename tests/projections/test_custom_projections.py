"""Custom projections: folded live, rebuilt and verified like the memory's tables, and never at their cost."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import pytest
from sqlalchemy import column, func, select, table, text

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import (
    EpisodeStarted,
    EpisodeTagged,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    ObjectReference,
    PoseReference,
    RobotValue,
)
from pycrorm_async.memory import Memory
from pycrorm_async.projections import custom_tables
from pycrorm_async.projections.custom import Changes, CustomRows, Event, Projection
from pycrorm_async.projections.custom_tables import states
from pycrorm_async.projections.findings import TableDifference
from pycrorm_async.projections.fold import decode_events
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.pipeline import Share
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import (
    MOVE,
    PICK_UP,
    SAYING,
    Script,
    declarations,
    declared,
    field,
    mixed,
    name_of,
    pose,
    row,
)
from tests.projections.sql_queries import ask, lose_event, names, stored_and_folded
from tests.projections.verify_cases import rebuilt

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]


# === grasp rate ===============================================================================================
#
# Define custom projections of tries to grasp, and the episodes and rows with which they are tested.

_TRIES = table("grasp_try", column("arm"), column("status"))
_RATE = select(_TRIES.c.arm, func.count().label("tries")).group_by(_TRIES.c.arm)


class GraspRate(Projection):
    name, version = "grasp_rate", 1
    tables = {"grasp_try": {"arm": "text", "grasp": "text", "status": "text"}}  # noqa: RUF012 - a common form in user code
    views = [UserView("grasp_tries_per_arm", _RATE)]  # noqa: RUF012

    def fold(self, event: Event, rows: Changes) -> None:
        match event.happening:
            case NodeStarted(parameters=parameters) if event.dtype == "PickUpAction":
                rows.insert("grasp_try", event.id, arm=parameters["arm"], grasp=parameters["grasp"], status="RUNNING")
            case NodeEnded(node=node, status=status):
                rows.update("grasp_try", event.row(node), status=status)


TRIES = [
    ("LEFT", "TOP", "SUCCEEDED"),
    ("LEFT", "FRONT", "FAILED"),
    ("RIGHT", "TOP", "SUCCEEDED"),
    ("LEFT", "TOP", None),
]


def tries(episode: int = 1, *, simulated: bool = False, many: Sequence[Any] = TRIES) -> Script:
    """Return an episode of consecutive pick-ups: arm, grasp, status; None for a pick-up that has not ended."""
    script = Script(episode)
    script.put(EpisodeStarted("", "me", "host", "", "3.11", simulated=simulated))
    root = script.put(NodeStarted("root", simulated=simulated))
    for arm, grasp, status in many:
        parameters = {"object_designator": {"row": 1, "object": 1}, "arm": arm, "grasp": grasp}
        node = script.put(
            NodeStarted("action", root, designator=name_of(PICK_UP), parameters=parameters, simulated=simulated)
        )
        if status is not None:
            script.put(NodeEnded(node, status))
    return script


def rows_of(episode: int, many: Sequence[Any] = TRIES) -> list[tuple[Any, ...]]:
    """Compute the expected rows from the list, without a fold. A pick-up's node is the event after the previous end."""
    result, sequence = [], 3
    for arm, grasp, status in many:
        result.append((row(sequence, number=episode), episode, arm, grasp, status or "RUNNING"))
        sequence += 1 if status is None else 2
    return result


async def folded(log: EventLog, records: Sequence[Any], *projections: Projection, **options: Any) -> Projector:
    return await stored_and_folded(log, records, projections=projections, **options)


async def visible_rows(log: EventLog) -> list[tuple[Any, ...]]:
    return await ask(log, "SELECT * FROM grasp_try ORDER BY id")


class Stands(Projection):
    name, version = "stands", 1
    tables = {"stand": {"x": "real", "target": "json"}}  # noqa: RUF012 - a common form in user code
    reads = (NodeStarted,)

    def fold(self, event: Event, rows: Changes) -> None:
        assert isinstance(event.happening, NodeStarted)
        if event.happening.robot is not None:
            assert event.happening.robot.pose is not None
            x, target = event.happening.robot.pose.position[0], event.parameters.get("target")
            rows.insert("stand", event.id, x=x, target=target and target["position"])


class NoLeftHand(GraspRate):
    def fold(self, event: Event, rows: Changes) -> None:
        super().fold(event, rows)
        if event.parameters.get("arm") == "RIGHT":
            raise ZeroDivisionError("no right hand")


class NextGraspRate(GraspRate):
    version = 2
    tables = {"grasp_try": {"arm": "text", "hard": "boolean"}}  # noqa: RUF012 - a common form in user code
    views = []  # noqa: RUF012

    def fold(self, event: Event, rows: Changes) -> None:
        if event.dtype == "PickUpAction":
            rows.insert("grasp_try", event.id, arm=event.parameters["arm"], hard=event.parameters["grasp"] == "TOP")


# === custom projections =======================================================================================


async def test_a_change_reaches_a_row_of_an_earlier_batch(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], GraspRate(), batch_events=3)
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]
    assert sorted(await ask(log, "SELECT arm, tries FROM grasp_tries_per_arm")) == [("LEFT", 6), ("RIGHT", 2)]


async def test_events_that_no_batch_of_the_tables_folded_are_looked_for_at_intervals(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_CHECK_S", "_CHECK_S_MAX"):
        monkeypatch.setattr(custom_tables, name, 1e9)
    projector = await folded(log, [*declarations(PICK_UP), *tries(1).records[:4]], GraspRate())
    await folded(log, tries(1).records)  # a process that folds the memory's own tables only
    for due_s, rows in ((1e9, rows_of(1)[:1]), (0.0, rows_of(1))):
        projector._custom._due_s = due_s
        while await projector.fold_next_batch():
            pass
        assert await visible_rows(log) == rows


async def test_the_share_of_a_process_without_the_code_is_folded_by_another(log: EventLog) -> None:
    projector = await folded(log, declarations(PICK_UP), GraspRate())
    await folded(log, mixed(tries(1), tries(2)))  # a process that folds the memory's own tables only
    for help_s, rows in ((1e12, rows_of(2)), (0.0, [*rows_of(1), *rows_of(2)])):
        projector._custom._help_s = help_s
        projector._custom._due_s = 0.0
        while await projector.fold_next_batch(Share(0, 2)):
            projector._custom._due_s = 0.0
        assert await visible_rows(log) == rows


async def test_simulations_are_left_out_unless_the_projection_asks_for_them(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2, simulated=True))], GraspRate())
    assert await visible_rows(log) == rows_of(1)
    async with Reading(log).session(simulated=True) as session:
        seen = await session.execute(text("SELECT * FROM grasp_try ORDER BY id"))
        assert [tuple(each) for each in seen] == [*rows_of(1), *rows_of(2)]
        assert (await session.execute(text("SELECT sum(tries) FROM grasp_tries_per_arm"))).scalar_one() == 8


async def test_an_unreadable_declaration_stops_nothing_else(log: EventLog) -> None:
    payloads = b'{"version":2,"kind":"action"}', b"?", b'{"kind":"action","dtype":"XAction","table":7}', b"[" * 100_000
    strange = [declarations(PICK_UP)[0]._replace(payload=each) for each in payloads]
    await folded(log, [*declarations(PICK_UP), *strange, *tries().records], GraspRate())
    assert await visible_rows(log) == rows_of(1)


async def test_the_reason_why_a_process_stops_folding_it_remains_until_the_projection_is_set_up_again(
    log: EventLog,
) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *tries(1).records], GraspRate())
    records = tries(2).records
    await log.append(records)
    await lose_event(log, 2, 4)
    await projector.catch_up()
    (state,) = await states(log, [GraspRate()])
    assert state.fault is not None
    assert state.fault.startswith("a process stopped folding the projection grasp_rate")
    assert "is missing in" in state.fault
    assert state.behind == len(records) - 3  # without those before the missing one
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
    events = tries().stored()[:1]
    refused = rows.fold(events, decode_events(events)[0])
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


# === rebuilt custom projections ===============================================================================
#
# The tables of a custom projection are rebuilt and verified, and continued after a kill.


async def test_a_new_version_is_not_folded_before_a_rebuild(log: EventLog, caplog: pytest.LogCaptureFixture) -> None:
    await folded(log, [*declarations(PICK_UP), *tries(1).records], GraspRate())
    before = await folded(log, [], GraspRate())
    projector = await folded(log, tries(2).records, NextGraspRate())
    assert "have version 1, its code has version 2: run `pycrorm rebuild grasp_rate`" in caplog.text
    assert await visible_rows(log) == rows_of(1)
    await rebuilt(log, NextGraspRate())
    new = [(each[0], each[1], each[2], each[3] == "TOP") for episode in (1, 2) for each in rows_of(episode)]
    assert await visible_rows(log) == new
    assert "grasp_tries_per_arm" not in await names(log, "view")
    caplog.clear()
    await log.append(tries(3).records)
    await before.catch_up()  # this process has version 1, and leaves the table
    assert await visible_rows(log) == new
    assert "this process stops folding the projection grasp_rate" in caplog.text
    assert await projector.catch_up() == 0


async def test_a_rebuild_makes_the_same_rows_as_live_folding_and_one_of_the_memory_leaves_them(log: EventLog) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], GraspRate())
    await rebuilt(log, GraspRate())
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]
    assert "zz_pycrorm_own_grasp_try__1002" in await names(log, "table")
    assert not [each for each in await names(log, "table") if "grasp_" in each and each.endswith("__1001")]
    await log.append(tries(3).records)  # a process that folded the old tables continues with the new ones
    await projector.catch_up()
    await rebuilt(log)
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2), *rows_of(3)]


async def test_verify_finds_every_change_and_nothing_else(log: EventLog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pycrorm_async.projections.verify._PART_EVENTS", 10)  # several parts
    records = [*declarations(PICK_UP), *mixed(*(tries(episode) for episode in range(1, 5)))]
    await folded(log, [*records, *tries(5).records[:6]], GraspRate())
    result = await verify(log, projections=[GraspRate()])
    assert (result.drift, result.damage, result.not_compared) == (0, 0, {})
    assert result.rows == (await verify(log)).rows + 4 * 4 + 2
    assert (await verify(log)).not_compared == {"grasp_rate": "its code is not installed here"}
    table = "zz_pycrorm_own_grasp_try__1001"
    first, second = rows_of(2)[:2]
    async with log.engine.begin() as connection:
        for change in (
            f"UPDATE {table} SET arm = 'BOTH' WHERE id = {first[0]}",
            f"DELETE FROM {table} WHERE id = {second[0]}",
            f"INSERT INTO {table} (id, process_metadata_id) VALUES ({row(5, number=9)}, 9)",
        ):
            await connection.exec_driver_sql(change)
    result = await verify(log, projections=[GraspRate()])
    assert result.differences == [
        TableDifference(2, 3, "grasp_try", "arm", "BOTH", "LEFT"),
        TableDifference(2, 5, "grasp_try", None, None, second),
        TableDifference(9, 5, "grasp_try", None, (row(5, number=9), 9, None, None, None), None),
    ]
    (only,) = [each for each in await log.episodes() if each.number == 1]
    assert (await verify(log, episode=only, projections=[GraspRate()])).drift == 0
    await rebuilt(log, GraspRate())
    assert (await verify(log, projections=[GraspRate()])).drift == 0


async def test_verify_reports_a_fold_that_was_changed_without_a_new_version(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *tries().records], GraspRate())
    result = await verify(log, projections=[NoLeftHand()])
    (difference,) = map(str, result.differences)
    assert difference == (
        "grasp_rate.fold is 'folded in the tables', and should be"
        " 'parked: grasp_rate raised ZeroDivisionError: no right hand'"
    )
    assert (await verify(log, projections=[NextGraspRate()])).not_compared.keys() == {"grasp_rate"}


@pytest.mark.parametrize("batch_events", [1, 100])
async def test_a_projection_gets_the_pose_of_the_robot_that_a_node_names_by_a_row(
    log: EventLog, batch_events: int
) -> None:
    script = Script()
    script.put(EpisodeStarted("", "me", "host", "", "3.11"))
    robot = script.put(ObjectAdded("pr2", "ROBOT", pose(0.5)))
    root, row_of_robot, nodes = script.put(NodeStarted("root")), robot, []
    for x in (0.5, 1.5, 1.5, 2.5):
        if x != 0.5:
            row_of_robot = script.put(ObjectMoved(robot, "pr2", "ROBOT", pose(x)))
        state = RobotValue(None, "ROBOT", 0.25, ObjectReference(robot, row_of_robot), "pr2")
        nodes.append(script.put(NodeStarted("action", root, name_of(SAYING), {"text": "hi"}, state)))
    nodes.append(script.put(NodeStarted("action", root, name_of(SAYING), {}, RobotValue(pose(9.5), "ROBOT"))))
    go = script.put(NodeStarted("action", root, name_of(MOVE), {"target": pose(7, 8)}, RobotValue(pose(3))))
    script.put(EpisodeTagged(("far",)))
    named = {"target": PoseReference(go, "target", 2)}
    nodes += [go, script.put(NodeStarted("action", go, name_of(MOVE), named, RobotValue(pose(4))))]
    await folded(log, [*declarations(SAYING, MOVE), *script.records], Stands(), batch_events=batch_events)
    rows = [(row(node), x) for node, x in zip(nodes, (0.5, 1.5, 1.5, 2.5, 9.5, 3, 4), strict=True)]
    assert await ask(log, "SELECT id, x FROM stand ORDER BY id") == rows
    targets = await ask(log, "SELECT target FROM stand WHERE x > 2.6 AND x < 5 ORDER BY id")
    assert targets == [("[7,8,0.0]",)] * 2
    result = await verify(log, projections=[Stands()])
    assert (result.drift, result.damage, result.not_compared) == (0, 0, {})


@pytest.mark.parametrize("sequence", [2**70, 0])
async def test_an_event_that_names_no_earlier_one_is_refused_alone(log: EventLog, sequence: int) -> None:
    script, other = Script(1), tries(2)
    script.put(EpisodeStarted("", "me", "host", "", "3.11"))
    root = script.put(NodeStarted("root"))
    named = PoseReference(sequence, "target", 2)
    script.put(NodeStarted("motion", root, name_of(MOVE), {"target": named}, RobotValue(None, "ROBOT")))
    await folded(log, [*declarations(MOVE, PICK_UP), *mixed(script, other)], Stands())
    states = await ask(log, "SELECT number, head - folded, parked IS NULL FROM episode ORDER BY number")
    assert states == [(1, 1, False), (2, 0, True)]
