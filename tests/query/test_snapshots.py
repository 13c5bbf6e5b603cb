"""The task tree, the world, the percepts and the searches of an episode at every moment, on both databases."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import fields
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged, UnknownEpisode
from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    Happening,
    JointsMoved,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    RefusalValue,
    RobotValue,
    SeenValue,
    StateSampled,
)
from pycrorm_async.projections.projector import Projector
from pycrorm_async.query.named_queries import NodeSummary, Percept, PlaceSearch, percepts_of, searches_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.replay import EpisodeReplay
from pycrorm_async.query.snapshot import AttachmentThen, Moment, NodeThen, RobotThen, moment_of, moments
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from pycrorm_async.world.pose import Pose
from tests.commands import answer, pycrorm
from tests.databases import run_in_own_loop
from tests.projections.event_script import (
    MOVE,
    NAVIGATE,
    PICK_UP,
    T0_NS,
    Script,
    append_and_fold,
    declarations,
    name_of,
    pose,
    row,
)
from tests.projections.sql_queries import stored_and_folded

# === story ====================================================================================================
#
# Write an episode event by event, each with the state after it, written beside it by hand.

TYPES = (NAVIGATE, PICK_UP, MOVE)
PR2, MILK, OUTER, INNER, AGAIN = 3, 4, 5, 9, 18


class Line(NamedTuple):
    """An event, and the state after it: every node's status in tree order, every object, the episode's status."""

    event: Happening
    tree: str
    world: str
    status: str = "RUNNING"


def moved_object(sequence: int) -> ObjectReference:
    return ObjectReference(sequence, sequence)


ROBOT = RobotValue(pose(), "ROBOT", 0.0, moved_object(PR2))
STARTED = "root RUNNING, NavigateAction RUNNING"
PICKS = f"{STARTED}, PickUpAction RUNNING"
FAILED = f"{STARTED}, PickUpAction FAILED IKError: too far"
MOVES = f"{FAILED}, MoveMotion RUNNING"
DRIVEN = MOVES.replace("NavigateAction RUNNING", "NavigateAction SUCCEEDED")
AT_START, DROVE, LIFTED = "pr2 0 0 0 | 0 1.5", "pr2 0.5 4 0 | 0 1.5", "pr2 0.5 4 0 | 0.25 1.5"
HELD = f"{LIFTED}; milk 5 6 7 < pr2 hand"
HOLDS = f"{LIFTED} < milk; milk 1 1 1"
MILK_SEEN = SeenValue("milk", "MILK", pose(8), moved_object(AGAIN), 1.0)
PICK = {"object_designator": moved_object(MILK), "arm": "LEFT"}
STORY = [
    Line(EpisodeStarted("a story", "me", "host", "1.0", "3.11"), "", ""),
    Line(NodeStarted("root"), "root RUNNING", ""),
    Line(ObjectAdded("pr2", "ROBOT", pose(), {"torso_lift_joint": 0.0, "arm": 1.5}), "root RUNNING", AT_START),
    Line(ObjectAdded("milk", "MILK", pose(1, 2, 3)), "root RUNNING", f"{AT_START}; milk 1 2 3"),
    Line(
        NodeStarted("action", 2, name_of(NAVIGATE), {"target_location": pose(7)}, ROBOT),
        STARTED,
        f"{AT_START}; milk 1 2 3",
    ),
    Line(ObjectMoved(PR2, "pr2", "ROBOT", pose(0.5, 4), OUTER), STARTED, f"{DROVE}; milk 1 2 3"),
    Line(JointsMoved(ObjectReference(PR2, 6), {"torso_lift_joint": 0.25}, OUTER), STARTED, f"{LIFTED}; milk 1 2 3"),
    # Samples may arrive late: the setters are exact.
    Line(StateSampled(ObjectReference(PR2, 6), {"base.x": 9.0, "arm": 9.0}, OUTER), STARTED, f"{LIFTED}; milk 1 2 3"),
    Line(NodeStarted("action", OUTER, name_of(PICK_UP), PICK, ROBOT), PICKS, f"{LIFTED}; milk 1 2 3"),
    Line(
        ObjectAttached(ObjectReference(PR2, 6), moved_object(MILK), "hand", INNER),
        PICKS,
        f"{LIFTED}; milk 1 2 3 < pr2 hand",
    ),
    Line(ObjectMoved(MILK, "milk", "MILK", pose(5, 6, 7), INNER), PICKS, HELD),
    Line(NodeEnded(INNER, "FAILED", FailureValue("a.b.IKError", "too far")), FAILED, HELD),
    Line(NodeStarted("motion", 2, name_of(MOVE), {"target": pose(8)}, ROBOT), MOVES, HELD),
    Line(NodeEnded(OUTER, "SUCCEEDED"), DRIVEN, HELD),
    Line(ObjectDetached(ObjectReference(PR2, 6), ObjectReference(MILK, 11), "hand"), DRIVEN, f"{LIFTED}; milk 5 6 7"),
    Line(ObjectRemoved(ObjectReference(MILK, 11)), DRIVEN, LIFTED),
    Line(ObjectMoved(MILK, "milk", "MILK", pose(9, 9, 9)), DRIVEN, LIFTED),  # recorded late, by another thread
    Line(ObjectAdded("milk", "MILK", pose(1, 1, 1)), DRIVEN, f"{LIFTED}; milk 1 1 1"),
    Line(ObjectAttached(moved_object(AGAIN), ObjectReference(PR2, 6), None), DRIVEN, HOLDS),
    Line(LocationResolved("CostmapLocation", (CandidateValue(pose(1), ("LEFT",)),), 0, 4, OUTER), DRIVEN, HOLDS),
    Line(ObjectDetected("camera", "MILK", (MILK_SEEN,), OUTER), DRIVEN, HOLDS),
    Line(
        EpisodeEnded("LOST"),
        DRIVEN.replace("root RUNNING", "root LOST").replace("Motion RUNNING", "Motion LOST"),
        HOLDS,
        "LOST",
    ),
]


def story(number: int = 1) -> Script:
    script = Script(number)
    for line in STORY:
        script.put(line.event)
    return script


# === as of ====================================================================================================
#
# The task tree and the world of an episode at every moment, on each kind of database.
#
# The expected state after each event is written beside the event by hand.

ID = "00000000-0000-7000-8000-000000000001"


@pytest.fixture(scope="module")
def filled_url(module_database_url: str) -> str:
    """The URL of a memory in which episode 1 is the story."""
    run_in_own_loop(append_and_fold(module_database_url, [*declarations(*TYPES), *story().records]))
    return module_database_url


def state_of(then: Moment) -> tuple[str, str, str]:
    """Return the snapshot in the notation of the story."""
    return ", ".join(map(_node_words, then.tree)), "; ".join(map(_object_words, then.world.objects)), then.status


def _node_words(node: NodeThen) -> str:
    reason = f" {node.reason}: {node.failure_message}" if node.reason else ""
    return f"{node.dtype or 'root'} {node.status}{reason}"


def _object_words(each: Any) -> str:
    words = " ".join([each.name, *(f"{value:g}" for value in each.pose.position)])
    if each.joints:
        words += " | " + " ".join(f"{each.joints[joint]:g}" for joint in ("torso_lift_joint", "arm"))
    if each.attached_to:
        words += " < " + " ".join(filter(None, each.attached_to))
    return words


def at(sequence: int) -> datetime:
    return datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC) + timedelta(seconds=sequence)


@pytest.mark.slow
async def test_snapshots_equal_the_expected_tree_and_world_after_every_event(reading: Reading) -> None:
    for sequence, line in enumerate(STORY, 1):
        then = await reading.as_of(1, sequence=sequence)
        assert (then.sequence, then.time_s, then.at) == (sequence, sequence - 1.0, at(sequence))
        assert state_of(then) == line[1:], sequence


@pytest.mark.slow
async def test_a_time_selects_the_last_event_before_it(reading: Reading) -> None:
    """Event n of a story happens n - 1 seconds after its first, and n seconds after 22:13:20."""
    for sequence in range(1, len(STORY) + 1):
        for time in (sequence - 1, float(sequence - 1), sequence - 1 + 0.999_999_999, at(sequence)):
            assert (await reading.as_of(1, time=time)).sequence == sequence
        for time in (sequence - 1 - 1e-9, at(sequence) - timedelta(microseconds=1)):
            if sequence > 1:
                assert (await reading.as_of(1, time=time)).sequence == sequence - 1
    for when in ({"sequence": 10**9}, {"time": 1e9}, {"time": datetime(2099, 1, 1, tzinfo=UTC)}):
        assert (await reading.as_of(1, **when)).sequence == len(STORY)
    assert (await reading.as_of(1, time=np.float64(2.5))).sequence == 3
    assert (await reading.as_of(1, sequence=np.int64(3))).sequence == 3  # type: ignore[arg-type]  # as a frame has it


@pytest.mark.slow
async def test_the_moments_of_one_pass_are_the_snapshots_after_each_of_these_events(
    reading: Reading, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, sequences = await reading.log(), {1, 6, 10, 14, 15}
    expected = [await reading.as_of(1, sequence=each) for each in sorted(sequences)]
    read: list[int] = []
    real = EpisodeReplay.read

    def noted(replay: EpisodeReplay, event: StoredEvent) -> Any:
        read.append(event.sequence)
        return real(replay, event)

    monkeypatch.setattr(EpisodeReplay, "read", noted)
    assert [each async for each in moments(log, 1, sequences)] == expected
    assert read == [*range(1, 16)]


@pytest.mark.slow
async def test_the_snapshot_at_the_end_has_the_tree_of_the_tables(reading: Reading) -> None:
    def summary(node: NodeSummary) -> dict[str, Any]:
        return {each.name: getattr(node, each.name) for each in fields(NodeSummary) if each.compare}

    then = await reading.as_of(1, time=1e9)
    assert [summary(each) for each in then.tree] == [summary(each) for each in await reading.tree(1)]
    for name in ("1", ID, "last", await reading.episode("1")):
        assert await reading.as_of(name, time=1e9) == then
    with pytest.raises(UnknownEpisode, match="there is no episode '9'"):
        await reading.as_of(9, time=1e9)


@pytest.mark.slow
async def test_a_node_has_its_status_at_that_moment(reading: Reading) -> None:
    parameters = {"object_designator": {"object": MILK, "row": MILK, "name": "milk"}, "arm": "LEFT"}
    running = NodeThen(
        id=row(INNER), parent_id=row(OUTER), depth=2, dtype="PickUpAction", kind="action", parameters=parameters,
        status="RUNNING", started_at=at(INNER), duration_ns=None, reason=None, failure_message=None, simulated=False,
        sequence=INNER, end_sequence=None, start_s=8.0, end_s=None,
    )  # fmt: skip
    assert (await reading.as_of(1, sequence=11)).tree[2] == running
    failed = (await reading.as_of(1, sequence=12)).tree[2]
    assert (failed.status, failed.duration_ns, failed.end_s, failed.end_sequence) == ("FAILED", 3_000_000_000, 11.0, 12)
    lost = (await reading.as_of(1, sequence=22)).tree[3]
    assert (lost.status, lost.duration_ns, lost.end_s, lost.end_sequence) == ("LOST", None, None, None)
    assert [each.dtype for each in (await reading.as_of(1, sequence=9)).running] == [
        None,
        "NavigateAction",
        "PickUpAction",
    ]
    assert [each.dtype for each in (await reading.as_of(1, sequence=14)).running] == [None, "MoveMotion"]


@pytest.mark.slow
async def test_a_world_has_its_objects_and_its_robots_pose_at_that_moment(reading: Reading) -> None:
    then = (await reading.as_of(1, sequence=11)).world
    assert then.attachments == (AttachmentThen("pr2", "milk", "hand"),)
    assert then.robot == RobotThen("pr2", Pose([0.5, 4, 0]), 0.25)
    milk = then.object("milk")
    assert (milk.id, milk.identity_id, milk.object_type, milk.attached_to) == (
        row(11),
        row(MILK),
        "MILK",
        ("pr2", "hand"),
    )
    assert milk.pose.time_ns == T0_NS - 1_000_007
    again = (await reading.as_of(1, sequence=18)).world.object("milk")
    assert (again.id, again.identity_id) == (row(AGAIN), row(AGAIN))
    gone = (await reading.as_of(1, sequence=16)).world
    with pytest.raises(CallerError, match="the world had no object 'milk' at this moment; its objects: pr2"):
        gone.object("milk")
    empty = (await reading.as_of(1, sequence=2)).world
    assert (empty.objects, empty.robot, empty.attachments) == ((), None, ())
    with pytest.raises(CallerError, match="the world had no object 'milk' at this moment; its objects: none"):
        empty.object("milk")


@pytest.mark.slow
async def test_a_node_without_an_end_has_no_end_time_and_a_removed_object_holds_nothing(log: EventLog) -> None:
    """Leaving a world removes object by object; a node that outlives its episode is LOST."""
    script = Script()
    for event in (
        EpisodeStarted("left", "me", "h", "1", "3.11"),
        NodeStarted("root"),
        ObjectAdded("pr2", "ROBOT", pose()),
        ObjectAdded("milk", "MILK", pose(1, 2, 3)),
        ObjectAttached(moved_object(3), moved_object(4), "hand"),
        ObjectRemoved(moved_object(3)),
        NodeEnded(2, "LOST"),
    ):
        script.put(event)
    await stored_and_folded(log, script.records)
    async with Reading.open_address(log.address) as reading:
        then = await reading.as_of(1, sequence=7)
        assert [_object_words(each) for each in then.world.objects] == ["milk 1 2 3"]
        assert (then.world.attachments, then.world.robot) == ((), None)
        (root,) = then.tree
        assert (root.status, root.duration_ns, root.end_s) == ("LOST", None, None)
        assert (await reading.tree(1))[0].duration_ns is None


# --- naming an episode ------------------------------------------------------------------------------------------------


@pytest.mark.slow
async def test_unfolded_events_are_read_from_the_log(log: EventLog) -> None:
    await Projector(log).open()
    records = story().records
    await log.append([*declarations(*TYPES), *records[:6]])
    async with Reading.open_address(log.address) as reading:
        assert await reading.episodes() == []
        assert state_of(await reading.as_of("last", time=1e9)) == STORY[5][1:]
        await log.append(records[6:15])
        assert state_of(await reading.as_of("last", time=1e9)) == STORY[14][1:]


@pytest.mark.slow
async def test_an_episode_of_many_events_is_read_up_to_the_moment(log: EventLog) -> None:
    script = Script()
    script.put(EpisodeStarted("long", "me", "h", "1", "3.11"))
    milk = script.put(ObjectAdded("milk", "MILK", pose(2)))
    for sequence in range(3, 1201):
        script.put(ObjectMoved(milk, "milk", "MILK", pose(sequence)))
    await stored_and_folded(log, script.records)
    async with Reading.open_address(log.address) as reading:
        for sequence in (2, 249, 250, 251, 252, 499, 500, 501, 999, 1000, 1001, 1200):
            then = await reading.as_of(1, sequence=sequence)
            assert then.world.object("milk").pose.position.x == sequence


# --- invalid moments and unreadable events ----------------------------------------------------------------------------


INVALID: list[tuple[dict[str, Any], str]] = [
    ({}, "a moment needs either a time or the sequence of an event: pass exactly one of them"),
    ({"time": -0.5}, "-0.5 s is before episode 1 began"),
    ({"sequence": 0}, "event 0 is before episode 1 began"),
    ({"time": at(0)}, r"2023-11-14 22:13:20\+00:00 is before episode 1 began"),
    ({"time": float("nan")}, "time must be seconds since the episode's start or a datetime, got nan"),
    ({"time": "1"}, "time must be seconds since the episode's start or a datetime, got '1'"),
    ({"time": datetime(2023, 1, 1)}, r"datetime.datetime\(2023, 1, 1, 0, 0\) has no time zone: add one"),  # noqa: DTZ001
    ({"sequence": True}, "sequence must be an integer, got True"),
]


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_an_invalid_moment_is_refused(reading: Reading) -> None:
    for when, message in INVALID:
        with pytest.raises(CallerError, match=message):
            await reading.as_of(1, **when)


UNREADABLE: list[tuple[str, bytes | None, int, type[Exception], str]] = [
    ("NodeEnded", b'{"node":', 1, LogDamaged, f"episode {ID}, event 16: NodeEnded cannot be decoded: "),
    ("NodeEnded", b'{"node":99,"status":"FAILED"}', 1, LogDamaged, "event 16: node 99 ends and never started"),
    ("NodeStarted", b'{"kind":"action","parent":99}', 1, LogDamaged, "event 16: its parent 99 never started"),
    ("EpisodeStarted", None, 1, LogDamaged, "event 16: the episode starts a second time"),
    ("ObjectRemoved", b'{"object":{"object":5,"row":5}}', 1, LogDamaged, "event 16: object 5 was never added"),
    ("NodeStarted", b'{"kind":"action","parent":2,"designator":"0f"}', 1, LogDamaged, "type 0f was never declared"),
    ("NodeEnded", b"{}", 4, DatabaseForeign, "event 16: NodeEnded has version 4, this version reads 3: use a newer"),
    ("ObjectPainted", b"{}", 1, DatabaseForeign, "ObjectPainted is not an event type of this version: use a newer"),
]


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_a_snapshot_before_an_unreadable_event_is_given(log: EventLog) -> None:
    scripts = [Script(number) for number in range(1, len(UNREADABLE) + 1)]
    for script, (type_, payload, version, *_) in zip(scripts, UNREADABLE, strict=True):
        for line in STORY[:15]:
            script.put(line.event)
        script.put_payload(type_, payload or script.records[0].payload, version)
        script.put(NodeEnded(2, "SUCCEEDED"))
    await stored_and_folded(log, [*declarations(*TYPES), *(record for each in scripts for record in each.records)])
    async with Reading.open_address(log.address) as reading:
        for number, (*_, kind, message) in enumerate(UNREADABLE, 1):
            assert state_of(await reading.as_of(number, sequence=15)) == STORY[14][1:]
            assert state_of(await reading.as_of(number, time=14.5)) == STORY[14][1:]
            for when in ({"sequence": 16}, {"time": 1e9}):
                with pytest.raises(kind, match=message):
                    await reading.as_of(number, **when)


@pytest.mark.slow
async def test_an_episode_that_does_not_begin_with_its_start_is_damaged(log: EventLog) -> None:
    script = Script()
    script.put(NodeStarted("root"))
    await stored_and_folded(log, script.records)
    async with Reading.open_address(log.address) as reading:
        with pytest.raises(LogDamaged, match="event 1: the episode begins with NodeStarted instead of EpisodeStarted"):
            await reading.as_of(1, sequence=1)


# === percepts and places ======================================================================================
#
# `pycrorm show` and snapshots have the percepts of an episode and the places that were considered.

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
COUNTS = "considered 700, offered 600; detected 2"


def search_script() -> Script:
    """Return an episode in which a node looked for milk and for a place to stand."""
    script = Script()
    put = script.put
    put(EpisodeStarted("Look around", "me", "host", "1.0", "3.11"))
    root = put(NodeStarted("root"))
    milk = put(ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    drive = put(NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7, 8)}))
    offered = tuple(CandidateValue(pose(x, 8), ("LEFT",)) for x in (7, 6))
    refused = tuple(RefusalValue(pose(9, 9), reason) for reason in ("hidden", "occupied", "occupied"))
    put(LocationResolved("CostmapLocation", offered, 1, 700, drive, refused, 598))
    known = SeenValue("milk", "MILK", pose(1, 2, 3), ObjectReference(milk, milk), 0.5)
    put(ObjectDetected("camera", "MILK", (known, SeenValue("jug?", "JUG", pose(4), None, None, 0.25, "stereo")), drive))
    put(NodeEnded(drive, "SUCCEEDED"))
    return script


PERCEPTS = (
    Percept(6, row(4), "milk", "MILK", "camera", "MILK", row(3), (1.0, 2.0, 3.0), UPRIGHT, None, 0.5),
    Percept(6, row(4), "jug?", "JUG", "stereo", "MILK", None, (4.0, 0.0, 0.0), UPRIGHT, 0.25, None),
)
SEARCH = PlaceSearch(5, row(4), "CostmapLocation", 700, 600, (6.0, 8.0, 0.0), {"occupied": 2, "hidden": 1})


@pytest.fixture
async def reading_searches(database_url: str) -> AsyncIterator[Reading]:
    await append_and_fold(database_url, [*declarations(NAVIGATE), *search_script().records])
    async with Reading.open(database_url) as opened:
        yield opened


async def test_the_tables_and_a_snapshot_list_the_same_percepts_and_searches(reading_searches: Reading) -> None:
    async with reading_searches.session(simulated=True) as session:
        assert tuple(await percepts_of(session, 1)) == PERCEPTS
        (search,) = await searches_of(session, 1)
    then = await reading_searches.as_of(1, sequence=6)
    assert (then.percepts, then.places, search) == (PERCEPTS, (SEARCH,), SEARCH)
    assert list(search.refused) == list(then.places[0].refused) == ["occupied", "hidden"]
    before = await reading_searches.as_of(1, sequence=5)
    assert (before.percepts, before.places) == ((), (SEARCH,))


async def test_a_node_has_the_number_of_its_percepts_and_of_the_places_for_it(reading_searches: Reading) -> None:
    for nodes in (await reading_searches.tree(1), (await reading_searches.as_of(1, sequence=7)).tree):
        assert [(each.considered, each.offered, each.detected) for each in nodes] == [(0, 0, 0), (700, 600, 2)]


def test_a_snapshot_keeps_the_latest_and_counts_all() -> None:
    stored = search_script().stored()
    replay = EpisodeReplay(EpisodeRow(1, "x", 204, 0, 0), DatabaseAddress.parse("sqlite:///x.db"))
    replay.dtypes = {name_of(NAVIGATE): "NavigateAction"}
    for event in stored[:4]:
        replay.read(event)
    for sequence in range(5, 205):
        replay.read(stored[5]._replace(sequence=sequence))
    then = moment_of(replay)
    assert [each.sequence for each in then.percepts] == [each for each in range(155, 205) for _ in range(2)]
    assert then.tree[1].detected == 400


@pytest.mark.soak_on("postgresql")
async def test_show_counts_them_in_the_tree_and_lists_them_in_full_and_as_json(
    reading_searches: Reading, database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    url = ("--url", database_url)
    plain, full = (pycrorm("show", "1", *more, *url, cwd=tmp_path).stdout for more in ((), ("--full",)))
    assert COUNTS in plain
    assert "occupied" not in plain
    assert "2 occupied, 1 hidden" in full
    assert "stereo" in full
    for document in (answer("show", "1", *more, *url, cwd=tmp_path) for more in ((), ("--at", "e7"))):
        assert [(each["name"], each["object_id"]) for each in document["percepts"]] == [
            ("milk", row(3)),
            ("jug?", None),
        ]
        assert document["places"][0]["refused"] == {"occupied": 2, "hidden": 1}
    assert COUNTS in (await reading_searches.tree(1))._repr_html_()
