"""Simulations are left out of every answer unless the query asks for them; on each kind of database."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import func, select
from sqlalchemy.exc import DBAPIError

from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.events import types as events
from pycrorm_async.events.ids import episode_text
from pycrorm_async.orm import Action, Motion, PickUpAction, PickUpWithContextView, ProcessMetaData, TaskTreeNode
from pycrorm_async.orm import Pose as PoseRow
from pycrorm_async.projections.columns import COLUMNS
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.query.named_queries import SimulatingNode
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import (
    MOVE,
    NAVIGATE,
    PICK_UP,
    Script,
    declarations,
    declared,
    field,
    name_of,
    pose,
    row,
)
from tests.projections.sql_queries import ask, names

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""

CAREFUL = declared(
    "CarefulPickUpAction", "careful_pick_up_action", *PICK_UP.fields, field("speed", "real", 5),
    field("via", "list", 6, item="pose"), bases=("PickUpAction",),
)  # fmt: skip
EITHER = declared("Either", "either", field("count", "integer", 2), kind="language")
REFUSED = (events.RefusalValue(pose(2), "LEFT: too far"),)
TYPES = (NAVIGATE, PICK_UP, CAREFUL, MOVE, EITHER)
OF_NO_EPISODE = {"designator_type", "concept", "concept_ancestor", "object_concept"}
REACHED = UserView("reached", select(PickUpAction.arm, PoseRow.x).join(PickUpAction.object).join(PoseRow))


def everything(number: int, thinker: events.NodeReference | None = None) -> Script:
    """Return an episode with a row in every table; a simulation if a node caused it."""
    script = Script(number)
    put, simulated = script.put, thinker is not None
    put(
        events.EpisodeStarted("e", "me", "host", "1.0", "3.11", simulated=simulated, thought_by=thinker, tags=("t",))
    )  # 1
    root = put(events.NodeStarted("root", simulated=simulated))  # 2
    milk, table = (
        put(events.ObjectAdded("milk", "MILK", pose(1, 2, 3))),
        put(events.ObjectAdded("table", "ENVIRONMENT", pose())),
    )
    put(events.ObjectAttached(events.ObjectReference(table, table), events.ObjectReference(milk, milk), "top"))  # 5
    put(events.ObjectDetached(events.ObjectReference(table, table), events.ObjectReference(milk, milk), "top"))  # 6
    robot = events.RobotValue(pose(0.5), "ROBOT", 0.25)
    either = put(events.NodeStarted("language", root, name_of(EITHER), {"count": 2}, robot, simulated))  # 7
    drive = put(events.NodeStarted("action", either, name_of(NAVIGATE), {"target_location": pose(7)}, robot, simulated))
    move = put(events.NodeStarted("motion", drive, name_of(MOVE), {"target": pose(7)}, robot, simulated))
    put(events.StateSampled(events.ObjectReference(table, table), {"base.x": 0.5}, move))
    put(events.JointsMoved(events.ObjectReference(table, table), {"drawer": 0.25}, move))
    put(events.NodeEnded(move, "SUCCEEDED"))
    put(events.LocationResolved("CostmapLocation", (events.CandidateValue(pose(1), ("LEFT",)),), 0, 4, drive, REFUSED))
    seen = events.SeenValue("milk", "MILK", pose(1), events.ObjectReference(milk, milk), 1.0)
    put(events.ObjectDetected("camera", "MILK", (seen,), drive))
    put(events.NodeEnded(drive, "SUCCEEDED"))
    moved = put(events.ObjectMoved(milk, "milk", "MILK", pose(2, 2, 3)))
    grasp = {"object_designator": events.ObjectReference(milk, moved), "arm": "LEFT", "grasp": "TOP"}
    pick = put(events.NodeStarted("action", either, name_of(PICK_UP), grasp, robot, simulated))
    put(events.NodeEnded(pick, "FAILED", events.FailureValue("a.IKError", "too far")))
    slowly = grasp | {"speed": 0.5, "via": [pose(3), pose(4)]}
    careful = put(events.NodeStarted("action", either, name_of(CAREFUL), slowly, robot, simulated))
    put(events.NodeEnded(careful, "SUCCEEDED"))
    put(events.ObjectRemoved(events.ObjectReference(milk, moved)))
    put(events.ObjectAdded("pr2", "ROBOT", pose()))
    put(events.NodeEnded(either, "SUCCEEDED"))
    put(events.Observed("force", {"x": 1.5}, root))
    put(events.NodeEnded(root, "SUCCEEDED"))
    put(events.EpisodeEnded("SUCCEEDED"))
    put(events.EpisodeTagged(("late",)))
    return script


REAL, THINKING = Script(1).episode, 8
THOUGHT = events.NodeReference(episode_text(REAL), THINKING)


async def store_and_fold(log: EventLog, *scripts: Script) -> None:
    projector = Projector(log, views=[REACHED])
    await projector.open()
    await log.append([*declarations(*TYPES), *(record for script in scripts for record in script.records)])
    await projector.catch_up()


async def rows_by_view(log: EventLog) -> dict[str, list[Any]]:
    """Return every view with its rows, read by plain SQL."""
    return {
        name: sorted(await ask(log, f'SELECT * FROM "{name}"'), key=repr)
        for name in await names(log, "view")
        if not name.startswith("pg_")
    }


async def test_every_view_shows_simulations_only_to_a_session_that_asks_for_them(log: EventLog) -> None:
    """To such a session it shows as many rows again as the real episode has."""
    await store_and_fold(log, everything(1))
    before = await rows_by_view(log)
    leaves = {each.table for each in TYPES}
    own = set(COLUMNS) - {"simulated_episode"} | {"designator", "action", "motion", "language", "robot_state"}
    own |= {"position", "quaternion", "designator_type", "PickUpWithContextView", "reached", *leaves}
    assert [name for name in own if not before[name]] == []
    await store_and_fold(log, everything(2, THOUGHT))
    assert await rows_by_view(log) == before
    async with Reading.open_address(log.address) as reading, reading.session(simulated=True) as session:
        connection = await session.connection()
        for name, rows in before.items():
            count = (await connection.exec_driver_sql(f'SELECT count(*) FROM "{name}"')).scalar_one()
            assert (name, count) == (name, len(rows) if name in OF_NO_EPISODE else 2 * len(rows))
        with pytest.raises(DBAPIError):
            await connection.exec_driver_sql("UPDATE zz_pose__1001 SET x = 5")


async def test_the_same_queries_return_simulations_on_request(log: EventLog) -> None:
    await store_and_fold(log, everything(1), everything(2, THOUGHT))
    statement = (
        select(TaskTreeNode.process_metadata_id, TaskTreeNode.simulated).distinct().order_by("process_metadata_id")
    )
    async with Reading.open_address(log.address) as reading:
        async with reading.session() as session:
            assert [each.dtype for each in await session.scalars(select(Action).order_by(Action.id))] == [
                "NavigateAction", "PickUpAction", "CarefulPickUpAction",
            ]  # fmt: skip
            assert (await session.execute(statement)).all() == [(1, False)]
        async with reading.session(simulated=True) as session:
            actions = (await session.scalars(select(Action).order_by(Action.id))).all()
            assert [(each.id >> 31, each.dtype) for each in actions] == [
                (1, "NavigateAction"), (1, "PickUpAction"), (1, "CarefulPickUpAction"),
                (2, "NavigateAction"), (2, "PickUpAction"), (2, "CarefulPickUpAction"),
            ]  # fmt: skip
            assert actions[-1].robot_state is not None
            assert actions[-1].robot_state.pose.position.x == 0.5
            careful: Any = actions[-1]
            assert (careful.object.pose.x, careful.speed) == (2.0, 0.5)
            assert [each.x for each in actions[-1].entries("via")] == [3.0, 4.0]
            assert (await session.execute(statement)).all() == [(1, False), (2, True)]
            metadata = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
            assert [(each.simulated, each.thought_by, each.thought_by_node) for each in metadata] == [
                (False, None, None),
                (True, episode_text(REAL), THINKING),
            ]
            mapped = reading.mapped("CarefulPickUpAction")
            assert (await session.scalar(select(func.count()).select_from(mapped))) == 2
        frames = [await reading.dataframe(select(PickUpWithContextView), simulated=also) for also in (False, True)]
        assert [sorted(frame.process_metadata_id) for frame in frames] == [[1, 1], [1, 1, 2, 2]]
        reached = [await reading.dataframe(select(REACHED.table), simulated=also) for also in (False, True)]
        assert [list(frame.x) for frame in reached] == [[2.0, 2.0], [2.0] * 4]


async def test_other_sessions_do_not_see_the_simulations_that_one_session_asked_for(log: EventLog) -> None:
    await store_and_fold(log, everything(1), everything(2, THOUGHT))
    count = select(func.count()).select_from(TaskTreeNode)
    async with Reading.open_address(log.address) as reading:
        async with reading.session(simulated=True) as with_thoughts, reading.session() as without:
            assert await with_thoughts.scalar(count) == 12
            assert await without.scalar(count) == 6
            await with_thoughts.commit()
            assert await with_thoughts.scalar(count) == 12
        for _ in range(5):
            async with reading.session() as later:
                assert await later.scalar(count) == 6
        async with reading.session(simulated=True) as again:
            assert await again.scalar(count) == 12


async def test_later_simulations_are_visible_too(log: EventLog) -> None:
    """Including those of a type that was declared since, in the same session."""
    new = declared("WaveAction", "wave_action", field("times", "integer", 2))
    await store_and_fold(log, everything(1))
    async with Reading.open_address(log.address) as reading:
        async with reading.session(simulated=True) as session:
            assert await session.scalar(select(func.count()).select_from(Motion)) == 1
            await session.commit()
            await store_and_fold(log, everything(2, THOUGHT))
            assert await session.scalar(select(func.count()).select_from(Motion)) == 2
        script = Script(3)
        script.put(events.EpisodeStarted("e", "me", "host", "1.0", "3.11", simulated=True))
        script.put(events.NodeStarted("action", None, name_of(new), {"times": 3}, simulated=True))
        projector = Projector(log)
        await projector.open()
        await log.append([*declarations(*TYPES, new), *script.records])
        await projector.catch_up()
        async with reading.session(simulated=True) as session:
            wave: Any = reading.mapped("WaveAction")
            assert [each.times for each in await session.scalars(select(wave))] == [3]
        async with reading.session() as session:
            assert (await session.scalars(select(wave))).all() == []


async def test_the_overview_leaves_simulations_out_unless_asked_and_one_is_found_by_its_name(log: EventLog) -> None:
    deeper = events.NodeReference(episode_text(Script(2).episode), 2)
    elsewhere = events.NodeReference("018bcfe5-6800-7000-8000-000000000001", 12)
    await store_and_fold(log, everything(1), everything(2, THOUGHT), everything(3, deeper), everything(4, elsewhere))
    async with Reading.open_address(log.address) as reading:
        assert [(each.number, each.simulated, each.thought_by) for each in await reading.episodes()] == [
            (1, False, None)
        ]
        all_of_them = await reading.episodes(simulated=True)
        assert (await reading.episode("2")).simulated
        assert (await reading.episode(episode_text(Script(2).episode))).number == 2
        assert (await reading.episode("last")).number == 1
    assert [(each.number, each.simulated, each.thought_by) for each in all_of_them] == [
        (1, False, None),
        (2, True, SimulatingNode(episode_text(REAL), 1, row(THINKING), "NavigateAction")),
        (3, True, SimulatingNode(deeper.episode, 2, row(2, number=2), None)),
        (4, True, SimulatingNode(elsewhere.episode, None, None, None)),
    ]
    assert {(each.nodes, each.failed) for each in all_of_them} == {(6, 1)}


async def test_a_tree_names_the_simulations_of_its_nodes_and_a_simulations_own_tree_is_printed(log: EventLog) -> None:
    root = events.NodeReference(episode_text(REAL), 2)
    await store_and_fold(log, everything(1), everything(2, THOUGHT), everything(3, THOUGHT), everything(4, root))
    async with Reading.open_address(log.address) as reading:
        tree, simulation_tree = await reading.tree(1), await reading.tree(2)
    assert [(each.dtype, each.simulated, each.thoughts) for each in tree] == [
        (None, False, (4,)),
        ("Either", False, ()),
        ("NavigateAction", False, (2, 3)),
        ("MoveMotion", False, ()),
        ("PickUpAction", False, ()),
        ("CarefulPickUpAction", False, ()),
    ]
    assert [(each.dtype, each.simulated) for each in simulation_tree] == [(each.dtype, True) for each in tree]
    assert simulation_tree[4].parameters["object_designator"]["name"] == "milk"
    assert simulation_tree[4].failure_message == "too far"


async def test_a_memory_of_simulations_alone_has_no_last_episode(log: EventLog) -> None:
    await store_and_fold(log, everything(1, THOUGHT))
    async with Reading.open_address(log.address) as reading:
        assert await reading.episodes() == []
        with pytest.raises(UnknownEpisode, match="this memory has none yet: record one with"):
            await reading.episode("last")
