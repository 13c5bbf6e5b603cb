"""Live folding on a real SQLite file: visible rows, stopped episodes, and several projectors of one memory."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    JointsMoved,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    PoseValue,
    RefusalValue,
    RobotValue,
)
from pycrorm_async.projections.generations import PROJECTION_VERSION, SHOWN, read_generation
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import (
    NAVIGATE,
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
    time_us,
)
from tests.projections.sql_queries import all_rows, ask, lose_event, names, stored_and_folded

pytestmark = pytest.mark.slow

VIA = declared("ViaAction", "via_action", field("via", "list", 2, item="pose"))

REFUSED = RefusalValue(pose(2, 2), "LEFT: too far")


def rich_episode(number: int) -> Script:
    """Return an episode with every kind of event, so that every table has rows."""
    script = Script(number)
    put = script.put
    put(EpisodeStarted(f"episode {number}", "me", "host", "1.0", "3.11"))
    root = put(NodeStarted("root"))
    robot = put(ObjectAdded("pr2", "ROBOT", pose(), {"torso": 0.1}))
    milk = put(ObjectAdded("milk", "MILK", pose(number, 2, 3)))
    state = RobotValue(pose(0.1, 0.2, 0), "ROBOT", 0.1, ObjectReference(robot, robot))
    drive = put(NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(1, 1)}, state))
    put(LocationResolved("CostmapLocation", (CandidateValue(pose(1, 1), ("LEFT",)),), 0, 10, drive, (REFUSED,)))
    moved = put(ObjectMoved(robot, "pr2", "ROBOT", pose(1, 1), drive))
    put(NodeEnded(drive, "SUCCEEDED"))
    parameters = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
    pick = put(NodeStarted("action", root, name_of(PICK_UP), parameters, state))
    put(JointsMoved(ObjectReference(robot, moved), {"torso": 0.2}, pick))
    put(ObjectAttached(ObjectReference(robot, moved), ObjectReference(milk, milk), "tool", pick))
    put(NodeEnded(pick, "FAILED", FailureValue("a.IKError", "far", [1])))
    via = put(NodeStarted("action", root, name_of(VIA), {"via": [pose(1), pose(2)]}, state))
    put(NodeEnded(via, "SUCCEEDED", result={"length": 2}))
    put(ObjectRemoved(ObjectReference(milk, milk), root))
    put(NodeEnded(root, "SUCCEEDED"))
    put(EpisodeEnded("SUCCEEDED"))
    return script


@pytest.mark.parametrize("batch_events", [1, 7, 10_000])
async def test_batches_of_any_size_make_the_same_rows(log: EventLog, batch_events: int) -> None:
    episodes = [rich_episode(1), rich_episode(2)]
    lost = Script(3)
    lost.put(NodeStarted("action", lost.put(NodeStarted("root")), name_of(SAYING), {"text": "oh"}))
    lost.put(EpisodeEnded("LOST"))
    records = [*declarations(NAVIGATE, PICK_UP, VIA, SAYING), *mixed(*episodes, lost)]
    await log.append(records)
    projector = Projector(log, batch_events=batch_events)
    await projector.open()
    assert await projector.catch_up() == len(records) - 4
    nodes = await ask(log, "SELECT id, status, end_time FROM task_tree_node ORDER BY id")
    expected = []
    for number in (1, 2):
        expected += [
            (row(2, number=number), "SUCCEEDED", time_us(16)),
            (row(5, number=number), "SUCCEEDED", time_us(8)),
            (row(9, number=number), "FAILED", time_us(12)),
            (row(13, number=number), "SUCCEEDED", time_us(14)),
        ]
    assert nodes == [*expected, (row(1, number=3), "LOST", None), (row(2, number=3), "LOST", None)]
    counts = {
        name.removeprefix("zz_").removesuffix("__1001"): len(rows)
        for name, rows in (await all_rows(log)).items()
        if rows
    }
    assert counts == {
        "process_metadata": 2, "task_tree_node": 10, "pose": 16, "object": 6, "object_removal": 2,
        "parameter_item": 4, "attachment": 2, "joint_change": 2, "location_resolution": 2, "location_candidate": 2,
        "location_refusal": 2,
        "navigate_action": 2, "pick_up_action": 2, "via_action": 2, "saying_action": 1,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("undeclared", "event 3: the designator type 00000000000000000000000000000000 was never declared"),
        ("newer", "event 3: NodeEnded has version 4, this version reads 3"),
        (
            "taken",
            "event 3: SayingAction: its table would be 'pose', which the memory itself uses (set another dtype)",
        ),
        (
            "refused by the database",
            "event 3: the database refuses it: ",
        ),
    ],
)
async def test_an_episode_that_cannot_be_folded_is_parked_there_and_the_others_continue(
    log: EventLog, bad: str, reason: str
) -> None:
    taken = declared("SayingAction", "pose", field("text", "text", 2))
    first, second = Script(1), Script(2)
    for script in (first, second):
        script.put(EpisodeStarted("why", "me", "host", "1.0", "3.11"))
        script.put(NodeStarted("root"))
    match bad:
        case "undeclared":
            first.put(NodeStarted("action", 2, "0" * 32))
        case "newer":
            first.put(NodeEnded(2, "SUCCEEDED"), version=4)
        case "taken":
            first.put(NodeStarted("action", 2, name_of(taken), {"text": "hi"}))
        case _:
            first.put(LocationResolved("CostmapLocation", considered=2**64 - 1))
    first.put(NodeEnded(2, "SUCCEEDED"))
    second.put(NodeStarted("action", 2, name_of(SAYING), {"text": "hi"}))
    projector = await stored_and_folded(log, [*declarations(SAYING, taken), *mixed(first, second)])
    (stopped,) = await log.stopped()
    assert stopped.number == 1
    assert stopped.parked is not None
    assert stopped.parked == reason or (bad.startswith("refused") and stopped.parked.startswith(reason))
    assert await ask(log, "SELECT number, folded, head FROM episode ORDER BY number") == [(1, 2, 4), (2, 3, 3)]
    assert await ask(log, "SELECT id, status FROM task_tree_node ORDER BY id") == [
        (row(2), "RUNNING"),
        (row(2, number=2), "RUNNING"),
        (row(3, number=2), "RUNNING"),
    ]
    assert await ask(log, "SELECT * FROM saying_action") == [(row(3, number=2), "hi", 2, 3)]
    assert await projector.catch_up() == 0


@pytest.mark.parametrize("batch_events", [1, 10_000])
async def test_an_event_whose_row_exists_already_parks_its_episode_and_changes_nothing(
    log: EventLog, batch_events: int
) -> None:
    script = Script()
    script.put(EpisodeStarted("the first", "me", "host", "1.0", "3.11"))
    script.put(NodeStarted("root"))
    script.put(EpisodeStarted("the second", "me", "host", "1.0", "3.11"))
    script.put(NodeEnded(2, "SUCCEEDED"))
    await log.append(script.records)
    projector = Projector(log, batch_events=batch_events)
    await projector.open()
    await projector.catch_up()
    assert await ask(log, "SELECT description FROM process_metadata") == [("the first",)]
    assert await ask(log, "SELECT status FROM task_tree_node") == [("RUNNING",)]
    assert await ask(log, "SELECT folded FROM episode") == [(2,)]
    ((reason,),) = await ask(log, "SELECT parked FROM episode")
    assert reason.startswith("event 3: ")


async def test_a_type_with_a_new_field_gets_a_column_and_keeps_older_rows(log: EventLog) -> None:
    louder = declared("SayingAction", "saying_action", field("text", "text", 2), field("volume", "real", 3))
    script = Script()
    script.put(NodeStarted("action", None, name_of(SAYING), {"text": "hi"}))
    projector = await stored_and_folded(log, [*declarations(SAYING), *script.records])
    script.put(NodeStarted("action", None, name_of(louder), {"text": "HI", "volume": 0.5}))
    script.put(NodeStarted("action", None, name_of(SAYING), {"text": "ho"}))
    await log.append([*declarations(louder), *script.records])
    await projector.catch_up()
    assert await ask(log, "SELECT id, text, volume FROM saying_action ORDER BY id") == [
        (row(1), "hi", None),
        (row(2), "HI", 0.5),
        (row(3), "ho", None),
    ]


async def test_a_descendant_is_listed_with_its_base_even_if_the_base_was_declared_later(log: EventLog) -> None:
    fields = (field("object_designator", "object", 2), field("arm", "enum", 3))
    base = declared("GrabAction", "grab_action", *fields)
    careful = declared(
        "CarefulGrabAction", "careful_grab_action", *fields, field("speed", "real", 4), bases=("GrabAction",)
    )
    script = Script()
    script.put(NodeStarted("action", None, name_of(careful), {"arm": "LEFT", "speed": 0.5}))
    projector = await stored_and_folded(log, [*declarations(careful), *script.records])
    script.put(NodeStarted("action", None, name_of(base), {"arm": "RIGHT"}))
    await log.append([*declarations(base), *script.records])
    await projector.catch_up()
    assert await ask(log, "SELECT * FROM grab_action ORDER BY id") == [
        (row(1), None, "LEFT", 1, 1),
        (row(2), None, "RIGHT", 1, 2),
    ]
    assert await ask(log, "SELECT * FROM careful_grab_action") == [(row(1), None, "LEFT", 0.5, 1, 1)]


async def test_doubles_and_texts_of_any_kind_are_stored_unchanged(log: EventLog) -> None:
    chance = random.Random(11)
    special = [0.1 + 0.2, 0.0, 5e-324, 1.7976931348623157e308, 2.0**53 + 1, 1 / 3]
    numbers = [*special, *(chance.uniform(-1, 1) * 10.0 ** chance.randint(-300, 300) for _ in range(294))]
    texts = ["", "Käse 🧀", "'; DROP TABLE zz_pose__1001; --", '"%s" ?1 :x', "a\nb\t\\", "\ud7ff\uffff"]
    script = Script()
    for x, y, z in zip(numbers[0::3], numbers[1::3], numbers[2::3], strict=True):
        script.put(ObjectAdded("milk", "MILK", PoseValue((x, y, z), (0.0, 0.0, 0.0, 1.0), "map", 0)))
    for text in texts:
        script.put(NodeStarted("action", None, name_of(SAYING), {"text": text}))
    await stored_and_folded(log, [*declarations(SAYING), *script.records])
    stored = [value for values in await ask(log, "SELECT x, y, z FROM pose ORDER BY id") for value in values]
    assert [value.hex() for value in stored] == [value.hex() for value in numbers]
    assert [text for (text,) in await ask(log, "SELECT text FROM saying_action ORDER BY id")] == texts


async def test_opening_again_changes_nothing(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(SAYING), *rich_episode(1).records[:2]])
    before = await ask(log, "SELECT * FROM pycrorm_generation")
    names_before = await names(log, "table", "view")
    await Projector(log).open()
    assert await ask(log, "SELECT * FROM pycrorm_generation") == before
    assert await names(log, "table", "view") == names_before


async def test_tables_of_another_version_are_refused(log: EventLog) -> None:
    await Projector(log).open()
    async with log.engine.begin() as connection:
        await connection.exec_driver_sql("UPDATE pycrorm_generation SET version = version + 1")
    refusal = f"made by version {PROJECTION_VERSION + 1} of the fold, this is version {PROJECTION_VERSION}: use a newer"
    with pytest.raises(DatabaseForeign, match=refusal):
        await Projector(log).open()


async def test_a_generation_is_read_again_only_where_number_revision_or_version_differ(log: EventLog) -> None:
    await Projector(log).open()
    async with log.engine.begin() as connection:
        known = await read_generation(connection, SHOWN, hold="share")
        assert known is not None
        assert known.layout.leaves
        assert await read_generation(connection, SHOWN, hold="share", known=known) is known
        for other in (
            replace(known, number=known.number + 1),
            replace(known, revision=known.revision - 1),
            replace(known, version=known.version - 1),
        ):
            again = await read_generation(connection, SHOWN, hold="share", known=other)
            assert again == known
        assert await read_generation(connection, "tables/making", known=known) is None


@pytest.mark.parametrize("missing", [1, 3])
async def test_a_missing_event_parks_its_episode_and_the_others_continue(log: EventLog, missing: int) -> None:
    projector = Projector(log)
    await projector.open()
    await log.append([*rich_episode(1).records[:3], *rich_episode(2).records[:3]])
    await lose_event(log, 1, missing)
    assert await projector.catch_up() == 3 + missing - 1
    rows = [(row.number, row.folded, row.parked) for row in await log.episodes()]
    assert rows == [(1, missing - 1, f"event {missing} is missing in the log"), (2, 3, None)]
