"""Every reader shows the pose of a parameter and the failure of a node that the log has in the event of another one."""

from __future__ import annotations

import json

import pytest
import sqlalchemy as sa

from pycrorm_async.events import types as events
from pycrorm_async.live.follower import Activity
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.projections.custom import Changes, Event, Projection
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import parameters_text
from pycrorm_async.recall.cases import EpisodeCases
from pycrorm_async.recall.columns import Case
from pycrorm_async.report.document import episode_document
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow
from tests.projections.event_script import (
    MOVE,
    NAVIGATE,
    T0_NS,
    Script,
    declarations,
    declared,
    field,
    name_of,
    pose,
    row,
)
from tests.projections.sql_queries import ask, stored_and_folded

GO = declared("GoAction", "go_action", field("place", "pose", 2), field("arm", "enum", 3))
PLACE = {"position": [1.0, 2.0, 0.0], "orientation": [0.0, 0.0, 0.0, 1.0], "frame": "map", "time_ns": T0_NS - 1_000_007}
OTHER = events.PoseValue((0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "map", 5)


def _script() -> Script:
    """An action goes to a place by another action, whose motion and its own have other targets."""
    script, robot = Script(), events.RobotValue(pose())
    script.put(events.EpisodeStarted("", "me", "host", "", "3.11"))
    root = script.put(events.NodeStarted("root"))
    go = script.put(events.NodeStarted("action", root, name_of(GO), {"place": pose(1, 2), "arm": "LEFT"}, robot))
    named = events.PoseReference(go, "place", 2)
    navigate = script.put(events.NodeStarted("action", go, name_of(NAVIGATE), {"target_location": named}, robot))
    for target in (named, OTHER):
        motion = script.put(events.NodeStarted("motion", navigate, name_of(MOVE), {"target": target}))
        script.put(events.NodeEnded(motion, "SUCCEEDED"))
    for node in (navigate, go, root):
        script.put(events.NodeEnded(node, "SUCCEEDED"))
    script.put(events.EpisodeEnded("SUCCEEDED"))
    return script


async def test_views_and_moments_have_parameters_with_the_pose_and_the_tables_one_row_of_it(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(GO, NAVIGATE, MOVE), *_script().records])
    rows = await ask(log, "SELECT id, parameters FROM designator ORDER BY id")
    assert [(key, json.loads(text)) for key, text in rows] == [
        (row(3), {"place": PLACE, "arm": "LEFT"}),
        (row(4), {"target_location": PLACE}),
        (row(5), {"target": PLACE}),
        (row(7), {"target": {**PLACE, "position": [0.5, 0.0, 0.0], "time_ns": 5}}),
    ]
    text = dict(await ask(log, "SELECT dtype, parameters FROM action"))["GoAction"]
    assert (text[:10], text.endswith(',"arm":"LEFT"}')) == ('{"place":{', True)  # the order and the form as recorded
    assert await ask(log, "SELECT target_id FROM move_motion ORDER BY id") == [(row(3, 2),), (row(7, 2),)]
    assert await ask(log, "SELECT target_location_id FROM navigate_action") == [(row(3, 2),)]
    poses = await ask(log, "SELECT id, x, y FROM pose WHERE x > 0 ORDER BY id")
    assert poses == [(row(3, 2), 1.0, 2.0), (row(7, 2), 0.5, 0.0)]
    async with Reading.open_address(log.address) as reading:
        then = await reading.as_of(1, sequence=6)
    with_pose = [{"place": PLACE, "arm": "LEFT"}, {"target_location": PLACE}, {"target": PLACE}]
    assert [node.parameters for node in then.tree] == [{}, *with_pose]


@pytest.mark.soak_on("postgresql")
async def test_views_survive_what_only_looks_like_a_name_of_a_pose(log: EventLog) -> None:
    label = declared("LabelAction", "label_action", field("texts", "dict", 2, item="text"))
    script = Script()
    script.put(events.EpisodeStarted("", "me", "host", "", "3.11"))
    root = script.put(events.NodeStarted("root"))
    given = [{"texts": {"pose_of": text}} for text in ("milk", "1.5", "9" * 30)]
    given += [{"texts": {"pose_of": "2", "field": "x"}, 'a"b': {"missing": "why", "repr": "c"}}]
    for parameters in given:
        script.put(events.NodeStarted("action", root, name_of(label), parameters))
    await stored_and_folded(log, [*declarations(label), *script.records])
    for view in ("designator", "action"):
        rows = await ask(log, f"SELECT parameters FROM {view} ORDER BY id")
        assert [json.loads(text) for (text,) in rows] == given


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
async def test_a_damaged_event_hides_its_pose_and_not_the_nodes_that_name_it(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(GO, NAVIGATE, MOVE), *_script().records])
    async with log.engine.begin() as connection:
        await connection.execute(sa.text("DROP TRIGGER event_is_not_updated"))
        await connection.execute(sa.text("UPDATE event SET payload = replace(payload, ':', ';') WHERE sequence = 3"))
    rows = await ask(log, "SELECT id, parameters FROM designator ORDER BY id LIMIT 3")
    reference = {"pose_of": 3, "field": "place", "slot": 2}
    assert [json.loads(text) for _, text in rows] == [{}, {"target_location": reference}, {"target": reference}]


def test_cases_and_the_live_page_have_the_pose() -> None:
    types = {name_of(each): each for each in (GO, NAVIGATE, MOVE)}
    cases: list[Case] = []
    stored = _script().stored()
    refused = EpisodeCases().read(((event, happening_of(event)) for event in stored), types.get, cases)
    assert refused is None
    navigated, went = cases
    features = [navigated.numbers[f"target_location_{each}"] for each in ("x", "y", "z", "yaw")]
    assert features == [went.numbers[f"place_{each}"] for each in ("x", "y", "z", "yaw")]
    assert features == [1.0, 2.0, 0.0, 0.0]

    activity = Activity(EpisodeRow(1, "e", 12, 12, T0_NS, None))
    for event in stored[:5]:
        activity.read(event, {name: each.dtype for name, each in types.items()})
    place = parameters_text({"target": PLACE}).removeprefix("target=")
    assert activity.now == ["GoAction", f"NavigateAction target_location={place}", f"MoveMotion target={place}"]


# --- failures -----------------------------------------------------------------------------------------------------

FAR, LATE = (
    events.FailureValue("plan.IKError", "too far", ["LEFT", {"m": 2.5}]),
    events.FailureValue("plan.TooLate", "5 s", []),
)


def _failing() -> Script:
    """A motion fails, and the two actions around it pass its failure on; then the root fails with another one."""
    script = Script()
    script.put(events.EpisodeStarted("", "me", "host", "", "3.11"))
    root = script.put(events.NodeStarted("root"))
    go = script.put(events.NodeStarted("action", root, name_of(GO), {"place": pose(1, 2), "arm": "LEFT"}))
    navigate = script.put(events.NodeStarted("action", go, name_of(NAVIGATE), {"target_location": pose(3)}))
    motion = script.put(events.NodeStarted("motion", navigate, name_of(MOVE), {"target": pose(3)}))
    end = script.put(events.NodeEnded(motion, "FAILED", FAR))
    for node in (navigate, go):
        script.put(
            events.NodeEnded(node, "FAILED", events.FailureValue(FAR.type, "", of=events.EndReference(motion, end)))
        )
    script.put(events.NodeEnded(root, "FAILED", LATE))
    script.put(events.EpisodeEnded("FAILED", LATE))
    return script


async def test_views_and_moments_and_pages_have_the_failure_at_each_node(log: EventLog) -> None:
    projector = Projector(log, projections=[Ends()], batch_events=1)  # `verify` folds all in one batch
    await projector.open()
    await log.append([*declarations(GO, NAVIGATE, MOVE), *_failing().records])
    await projector.catch_up()
    columns = "id, reason, failure_message, failure_arguments"
    far = "IKError", "too far", '["LEFT",{"m":2.5}]'
    rows = [(row(2), "TooLate", "5 s", None), *((row(each), *far) for each in (3, 4, 5))]
    assert await ask(log, f"SELECT {columns} FROM task_tree_node ORDER BY id") == rows
    named = "SELECT id, failure_message FROM {} WHERE failure_message = 'too far' ORDER BY id"
    assert await ask(log, named.format("action")) == [(row(3), "too far"), (row(4), "too far")]
    assert await ask(log, named.format("designator")) == [(row(each), "too far") for each in (3, 4, 5)]
    assert await ask(log, "SELECT id, reason, message FROM root_failure") == [(row(5), *far[:2])]
    ends = await ask(log, "SELECT message, arguments FROM ending ORDER BY id")
    assert ends == [far[1:]] * 3 + [("5 s", "[]")]
    async with Reading.open_address(log.address) as reading:
        then = await reading.as_of(1, sequence=9)
        page = await episode_document(reading, 1, first=7)  # behind the event that has the failure
        async with reading.session() as session:
            nodes = (await session.scalars(sa.select(TaskTreeNode))).all()
    assert [(node.reason, node.failure_message) for node in then.tree] == [each[1:3] for each in rows]
    assert sorted((each.failure_message, each.failure_arguments) for each in nodes) == [
        ("5 s", None), *[("too far", ["LEFT", {"m": 2.5}])] * 3
    ]  # fmt: skip
    assert "too far" in page["texts"]
    assert (await verify(log, projections=[Ends()])).drift == 0


class Ends(Projection):
    name, version = "ends", 1
    tables = {"ending": {"message": "text", "arguments": "json"}}  # noqa: RUF012 - a common form in user code
    reads = (events.NodeEnded,)

    def fold(self, event: Event, rows: Changes) -> None:
        failure = event.happening.failure if isinstance(event.happening, events.NodeEnded) else None
        if failure is not None:
            rows.insert("ending", event.id, message=failure.message, arguments=failure.arguments)
