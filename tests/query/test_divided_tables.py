"""Queries for one episode, on a memory on PostgreSQL that is partitioned by episode."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest
from sqlalchemy import Engine, Select, event, select
from sqlalchemy.orm import selectinload, undefer

from pycrorm_async import Reading, orm
from pycrorm_async.events import types as events
from pycrorm_async.learning.recorded_policy import policy_contents
from pycrorm_async.learning.rollouts import episodes_question, rollouts_question
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.placement import Placement
from tests.databases import Server, ask, ask_each, run_in_own_loop
from tests.projections.event_script import MOVE, NAVIGATE, PICK_UP, Script, declarations, declared, field, name_of, pose
from tests.projections.sql_queries import stored_and_folded

pytestmark = pytest.mark.slow

EPISODES, PARTITIONS, ASKED = 12, 4, 7
EPISODE = "process_metadata_id"
OF_DIVIDED = f"""SELECT relname FROM pg_class JOIN pg_attribute ON attrelid = pg_class.oid
WHERE relnamespace = 'memory_tables'::regnamespace AND relkind = 'p' AND attname = '{EPISODE}' ORDER BY relname"""
OF_THE_LOG = """SELECT DISTINCT of_log.relname, view.relname FROM pg_rewrite
JOIN pg_depend ON pg_depend.objid = pg_rewrite.oid JOIN pg_class of_log ON of_log.oid = pg_depend.refobjid
JOIN pg_class view ON view.oid = pg_rewrite.ev_class
WHERE of_log.relnamespace = 'pycrorm'::regnamespace AND view.relnamespace = 'memory'::regnamespace"""
READERS_OF_EVENTS = {
    "PickUpWithContextView",
    "action",
    "designator",
    "language",
    "motion",
    "root_failure",
    "task_tree_node",
}
BATCH = declared(
    "BatchRolloutAction",
    "batch_rollout_action",
    *(field(name, "text", slot) for slot, name in enumerate(("policy", "scene"), 2)),
    *(field(name, "integer", slot) for slot, name in enumerate(("seed", "first", "count"), 4)),
)
TRY = declared("MoveAndPickUpAction", "move_and_pick_up_action", field("policy", "text", 2, optional=True))
LEARN = declared("LearnPolicyAction", "learn_policy_action", field("policy", "text", 2))
SETS = declared("SetAction", "set_action", field("things", "list", 2, item="object"))


def episode(number: int) -> Script:
    """An episode in which a robot navigates, fails to pick the milk up, and handles a list of objects."""
    script = Script(number)
    put = script.put
    put(events.EpisodeStarted("Tutorial", "me", "host", "1.0", "3.11", plan="breakfast"))
    root = put(events.NodeStarted("root"))
    robot = put(events.ObjectAdded("pr2", "ROBOT", pose(0.5), {"torso": 0.25}))
    milk = put(events.ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    state = events.RobotValue(pose(0.5, turned=0.6), "ROBOT", 0.25, events.ObjectReference(robot, robot))
    drive = put(events.NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7, 8)}, state))
    offered, refused = (events.CandidateValue(pose(7, 8), ("LEFT",)),), (events.RefusalValue(pose(8, 8), "too far"),)
    put(events.LocationResolved("CostmapLocation", offered, 0, 9, drive, refused))
    move = put(events.NodeStarted("motion", drive, name_of(MOVE), {"target": pose(7, 8)}, state))
    put(events.NodeEnded(move, "SUCCEEDED"))
    put(events.NodeEnded(drive, "SUCCEEDED"))
    seen = events.ObjectReference(milk, milk)
    put(
        events.NodeStarted(
            "action", root, name_of(SETS), {"things": [seen, events.ObjectValue("BelieveObject", "cup")]}, state
        )
    )
    rollout = {"policy": "seen", "scene": "kitchen", "seed": 69, "first": 0, "count": 1}
    batch = put(events.NodeStarted("action", root, name_of(BATCH), rollout, state))
    tried = put(events.NodeStarted("action", batch, name_of(TRY), {}, state))
    pick = put(
        events.NodeStarted(
            "action", tried, name_of(PICK_UP), {"object_designator": seen, "arm": "LEFT", "grasp": "TOP"}, state
        )
    )
    put(events.ObjectMoved(milk, "milk", "MILK", pose(9, 9, 9), pick))
    too_far = events.FailureValue("plan.failures.IKError", "too far", ["LEFT"])
    put(events.NodeEnded(pick, "FAILED", too_far))
    put(events.NodeEnded(tried, "FAILED", too_far))
    learned = put(events.NodeStarted("action", root, name_of(LEARN), {"policy": "learned"}, state))
    put(events.Observed("policy", events.BlobReference("aa", "application/json", 2), learned))
    put(events.EpisodeEnded("FAILED"))
    return script


@pytest.fixture(scope="module")
def divided(server: Server) -> Iterator[str]:
    """The URL of a filled memory with partitions."""
    url = server.new_database()
    run_in_own_loop(fill(url))
    yield url
    server.drop(url)


async def fill(url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True, placement=Placement(PARTITIONS))
    records = [record for number in range(1, EPISODES + 1) for record in episode(number).records]
    await stored_and_folded(log, [*declarations(NAVIGATE, MOVE, PICK_UP, SETS, BATCH, TRY, LEARN), *records])
    await log.close()


class Statement(NamedTuple):
    text: str
    parameters: tuple[Any, ...]


@contextmanager
def executed() -> Iterator[list[Statement]]:
    """Collect the queries that any engine executes."""
    statements: list[Statement] = []

    def note(_connection: Any, _cursor: Any, text: str, parameters: Any, _context: Any, _many: bool) -> None:
        if re.match(r"\s*(SELECT|WITH)", text) and "set_config" not in text:
            statements.append(Statement(text, tuple(parameters)))

    event.listen(Engine, "before_cursor_execute", note)
    try:
        yield statements
    finally:
        event.remove(Engine, "before_cursor_execute", note)


async def parts_read(log: EventLog, statement: Statement) -> set[tuple[str, str]]:
    """Return table and number of each partition that the server reads for a statement."""
    async with log.engine.connect() as connection:
        explain = f"EXPLAIN (ANALYZE, FORMAT JSON) {statement.text}"
        plan: Any = (await connection.exec_driver_sql(explain, statement.parameters)).scalar_one()
    parts = set()
    for step in steps_of(plan):
        table, _, part = step.get("Relation Name", "").rpartition("_part")
        if table and step["Actual Loops"]:
            parts.add((table, part))
    return parts


def steps_of(plan: Any) -> Iterator[dict[str, Any]]:
    pending = [(json.loads(plan) if isinstance(plan, str) else plan)[0]["Plan"]]
    while pending:
        step = pending.pop()
        pending += step.get("Plans", [])
        yield step


async def rows_of(reading: Reading, statement: Select[Any]) -> None:
    async with reading.session() as session:
        assert (await session.scalars(statement)).all()


def of_episode(class_: Any, *options: Any) -> Callable[[Reading], Coroutine[Any, Any, None]]:
    return lambda reading: rows_of(reading, select(class_).where(class_.process_metadata_id == ASKED).options(*options))


async def spatial_relations(reading: Reading) -> None:
    async with reading.session() as session:
        await session.scalars(select(orm.SpatialRelation).where(orm.SpatialRelation.process_metadata_id == ASKED))


async def the_tree(reading: Reading) -> None:
    assert len(await reading.tree(ASKED)) == 8


async def a_snapshot(reading: Reading) -> None:
    assert (await reading.as_of(ASKED, sequence=8)).world.objects


WITHOUT_ROWS = ("successful_pick_ups", "streams")
"""Questions that find nothing in this memory."""


def asked(name: str, *arguments: Any) -> Callable[[Reading], Coroutine[Any, Any, None]]:
    async def ask_it(reading: Reading) -> None:
        assert await getattr(reading.ask, name)(*arguments, episode=ASKED).rows() or name in WITHOUT_ROWS

    return ask_it


def selected(statement: Any, episode: Any) -> Callable[[Reading], Coroutine[Any, Any, None]]:
    async def read(reading: Reading) -> None:
        async with reading.session() as session:
            assert (await session.execute(statement.where(episode == ASKED))).all()

    return read


PICK_UPS = orm.PickUpWithContextView
PICK_UP_EPISODE = PICK_UPS.process_metadata_id
JOINED = select(orm.PickUpAction).join(orm.PickUpAction.object).join(orm.Object.pose).join(orm.PickUpAction.node)
ROBOTS = select(orm.ProcessMetaData).options(selectinload(orm.ProcessMetaData.robots))
ROLLOUTS = rollouts_question(scene="kitchen", seed=69)
ROUNDS = episodes_question(scene="kitchen", seeds=[69], policies=["seen"])
ARGUMENTS = {"object_history": ("milk",), "moves_of": ("milk",), "experience_at": (0.5, 0.0)}


@pytest.mark.parametrize(
    "question",
    [
        *(pytest.param(asked(each, *ARGUMENTS.get(each, ())), id=each) for each in QUESTIONS),
        pytest.param(selected(ROLLOUTS, PICK_UP_EPISODE), id="rollouts"),
        pytest.param(selected(ROUNDS, orm.ProcessMetaData.id), id="episodes of rollouts"),
        pytest.param(
            selected(policy_contents("learned"), orm.Observation.process_metadata_id), id="the content of a policy"
        ),
        pytest.param(of_episode(orm.Action), id="actions"),
        pytest.param(of_episode(orm.Action, undefer(orm.Action.parameters)), id="actions with parameters"),
        pytest.param(of_episode(orm.NavigateAction), id="actions of a type"),
        pytest.param(of_episode(orm.TaskTreeNode, selectinload(orm.TaskTreeNode.children)), id="nodes with children"),
        pytest.param(of_episode(orm.Object, selectinload(orm.Object.node)), id="objects with nodes"),
        pytest.param(of_episode(orm.LocationResolution, selectinload(orm.LocationResolution.refusals)), id="places"),
        pytest.param(of_episode(orm.EpisodeRobot), id="robots"),
        pytest.param(selected(ROBOTS, orm.ProcessMetaData.id), id="an episode with its robots"),
        pytest.param(of_episode(orm.PickUpWithContextView), id="pick-ups"),
        pytest.param(selected(select(PICK_UPS.id, PICK_UPS.object_z), PICK_UP_EPISODE), id="places of pick-ups"),
        pytest.param(of_episode(orm.RootFailure), id="where failures began"),
        pytest.param(selected(select(PICK_UPS.scene, PICK_UPS.description), PICK_UP_EPISODE), id="scenes of pick-ups"),
        pytest.param(selected(select(PICK_UPS.policy), PICK_UP_EPISODE), id="policies of pick-ups"),
        pytest.param(
            selected(JOINED.where(orm.Object.name == "milk"), orm.PickUpAction.process_metadata_id), id="a join"
        ),
        pytest.param(spatial_relations, id="spatial relations"),
        pytest.param(the_tree, id="the task tree"),
        pytest.param(a_snapshot, id="a snapshot"),
    ],
)
async def test_a_question_for_one_episode_reads_one_partition(
    divided: str, question: Callable[[Reading], Coroutine[Any, Any, None]]
) -> None:
    async with Reading.open(divided) as reading:
        with executed() as statements:
            await question(reading)
    log = await EventLog.open(DatabaseAddress.parse(divided), create=False)
    read = {part: statement for statement in statements for part in await parts_read(log, statement)}
    await log.close()
    assert read
    numbers = {number for _, number in read}
    assert len(numbers) == 1, {part: statement.text for part, statement in read.items()}


def test_the_episode_is_part_of_every_primary_key(divided: str) -> None:
    tables = [name for (name,) in ask(divided, OF_DIVIDED)]
    assert len(tables) > 40
    without_key = set()
    for table in tables:
        keys = ask(
            divided,
            f"SELECT attname FROM pg_index JOIN pg_attribute ON attrelid = indrelid AND attnum = ANY (indkey)"
            f""" WHERE indisprimary AND indrelid = 'memory_tables."{table}"'::regclass""",
        )
        assert not keys or (EPISODE,) in keys, table
        without_key |= set() if keys else {table}
    assert without_key == {"zz_joint_change__1001", "zz_state_sample__1001"}  # their rows differ in a name


def test_views_look_events_up_by_their_episode_and_sequence(divided: str) -> None:
    """Views show the parameters of nodes from the log, which would take a seventh of the memory again in a table.

    Each lookup names the episode, so that it reads one partition, and none is made for a column that is not selected.
    Declarations are not rows of an episode: each database of a divided memory has all of them.
    """
    readers: dict[str, set[str]] = {}
    for table, view in ask(divided, OF_THE_LOG):
        readers.setdefault(table, set()).add(view)
    assert readers.keys() == {"event", "pycrorm_declaration"}
    assert readers["event"] == READERS_OF_EVENTS
    for view in READERS_OF_EVENTS:
        # The partitions are so small that a server would read them as a whole. Here it does if it has no other way.
        without_scans = "SET enable_seqscan = off", "SET enable_bitmapscan = off"
        explained = [f'EXPLAIN (FORMAT JSON) SELECT {columns} FROM memory."{view}"' for columns in ("*", "id")]
        *_, every_column, identity = ask_each(divided, [*without_scans, *explained])
        steps = steps_on_events(every_column)
        assert steps, view
        for step in steps:
            assert step["Node Type"] == "Index Scan", step
            assert re.fullmatch(r"event_part\d_pkey", step["Index Name"]), step
            assert re.search(r"\(episode = .*\(sequence = ", step["Index Cond"]), step
        assert steps_on_events(identity) == [], view


def steps_on_events(plan: list[Any]) -> list[dict[str, Any]]:
    [(text,)] = plan
    return [step for step in steps_of(text) if step.get("Relation Name", "").startswith("event")]
