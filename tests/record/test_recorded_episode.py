"""Episodes that another executive writes: from any thread, with their outcomes, also while the spool is full."""

from __future__ import annotations

import asyncio
import gc
import threading
from contextlib import closing, suppress
from enum import Enum
from pathlib import Path
from typing import Any, Literal, cast

import pytest

from pycrorm_async import Settings
from pycrorm_async.events.types import (
    FailureValue,
    NodeEnded,
    NodeStarted,
    PoseValue,
    SeenValue,
)
from pycrorm_async.plan.failures import NavigationGoalInCollision
from pycrorm_async.queue import recorder_queue
from pycrorm_async.record import keyed_episode
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.world.pose import Pose
from tests.databases import ask
from tests.record.recordings import Recorded, assert_verified, events, faults_of, nodes, opened

# === recorded episode =========================================================================================
#
# Episodes that another executive writes: from any thread, by keys of its own, without ever raising.

HERE = Pose([1, 2, 3])


class Side(Enum):
    LEFT = 1


def test_a_move_to_the_last_pose_writes_nothing_and_one_to_no_pose_is_counted(tmp_path: Path) -> None:
    def write(_: Recording, episode: RecordedEpisode) -> None:
        episode.object_added("m", "milk", "MILK", HERE)
        poses: list[Any] = [Pose([1, 2, 3]), Pose([1, 2, 4]), Pose([1, 2, 4]), (1, 2, 3), None]
        for each in poses:
            episode.object_moved("m", each)
        episode.object_moved("never added", HERE)
        episode.object_moved("m", poses[-1])

    total, last = faults_of(tmp_path, write)
    assert total == 4
    assert last is not None
    assert "expected a PoseValue, got None" in last
    assert [each["pose"]["position"] for each in events(tmp_path, "ObjectMoved")] == [[1.0, 2.0, 4.0]]


def test_a_joint_at_its_last_position_is_not_written_again(tmp_path: Path) -> None:
    def write(_: Recording, episode: RecordedEpisode) -> None:
        episode.object_added("r", "robot", "ROBOT", HERE, {"torso": 0.2})
        for joints in ({"torso": 0.2}, {"torso": 0.2, "elbow": 1.0}, {"elbow": 1.0}, {"torso": 0.3, "elbow": 1.0}):
            episode.joints_moved("r", joints)

    assert faults_of(tmp_path, write) == (0, None)
    assert [each["joints"] for each in events(tmp_path, "JointsMoved")] == [{"elbow": 1.0}, {"torso": 0.3}]


def test_a_call_has_run_when_it_returns_whichever_threads_call_and_one_of_the_memory_does_not_wait(
    tmp_path: Path,
) -> None:
    with closing(Recorded(tmp_path, Settings())) as recorded:
        step = recorded.recording.type("action", "Step")
        episodes = [recorded.recording.episode(description=each) for each in "ab"]
        not_run: list[tuple[object, int]] = []

        def work(episode: RecordedEpisode, worker: object) -> None:
            for number in range(100):
                episode.start((worker, number), step)
                if not episode.is_open((worker, number)):
                    not_run.append((worker, number))
                episode.end((worker, number))

        workers = [*range(4), "pycrorm writer"]
        threads = [
            threading.Thread(target=work, args=(episodes[at % 2], each), name=str(each))
            for at, each in enumerate(workers)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [each for each in not_run if each[0] != "pycrorm writer"] == []
        for each in episodes:
            each.close()
        assert recorded.emitter.faults == (0, None)
        for log in recorded.logs():
            started = [sequence for sequence, event in log if isinstance(event, NodeStarted)]
            assert sorted(event.node for _, event in log if isinstance(event, NodeEnded)) == started


def test_what_happened_is_in_the_tables(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        recording = memory.recording
        pick_up = recording.type(
            "action", "PickUpAction", {"object_designator": "object", "arm": Side, "grasp": "enum"}
        )
        with recording.episode(
            description="breakfast",
            plan="breakfast",
            seed=3,
            tags=["demo"],
            metadata={"executive": "mine"},
            world="flat",
        ) as episode:
            episode.object_added(
                7, "pr2", "ROBOT", HERE, {"torso": 0.2}, torso_joint="torso", model="PR2",
                urdf="<robot name='r'><link name='base_link'/></robot>", base_link="base_link",
            )  # fmt: skip
            episode.object_added("m", "milk", "MILK", Pose([1, 0, 1]), color=(1, 1, 1, 1), mass_kg=1.0)
            episode.start("p", pick_up, {"object_designator": "m", "arm": Side.LEFT, "grasp": "FRONT"}, robot=7)
            episode.joints_moved(7, {"torso": 0.3, "elbow": 1.0}, node="p")
            episode.object_moved("m", Pose([1, 0, 1.2]), node="p")
            episode.object_attached(7, "m", "l_gripper", node="p")
            episode.observe("force", {"x": 1.5}, node="p")
            reference = episode.reference("m")
            episode.detected(
                [SeenValue("milk", "MILK", PoseValue((1, 0, 1), (0, 0, 0, 1), "map", 0), reference)], node="p"
            )
            episode.end("p", "FAILED", NavigationGoalInCollision("the table"), {"tried": [1, HERE]})
            episode.object_detached(7, "m")
            episode.object_removed("m")
        assert (memory.status.faults.total, memory.status.missing.total) == (0, 0)
        assert memory.recent_episodes == (str(episode),)
    file = tmp_path / "memory.db"
    assert nodes(tmp_path) == [("PickUpAction", None, "FAILED", "the table")]
    picked = "SELECT arm, grasp, object.name FROM pick_up_action JOIN object ON object.id = object_designator_id"
    assert ask(file, picked) == [("LEFT", "FRONT", "milk")]
    robot = "SELECT robot, torso_height FROM task_tree_node WHERE dtype = 'PickUpAction' AND robot_pose_id IS NOT NULL"
    assert ask(file, robot) == [("pr2", 0.2)]
    assert sorted(ask(file, "SELECT joint, position FROM joint_change WHERE node_id IS NOT NULL")) == [
        ("elbow", 1.0),
        ("torso", 0.3),
    ]
    assert ask(file, "SELECT DISTINCT name FROM object WHERE base_link = 'base_link'") == [("pr2",)]
    assert ask(file, "SELECT kind, link FROM attachment ORDER BY id") == [
        ("attached", "l_gripper"),
        ("detached", "l_gripper"),
    ]
    (result,) = [each["result"] for each in events(tmp_path, "NodeEnded") if "result" in each]
    assert result["tried"][1]["position"] == [1.0, 2.0, 3.0]
    assert_verified(tmp_path)


def test_values_go_through_the_conversion_and_what_it_refuses_is_missing_with_its_reason(tmp_path: Path) -> None:
    class Grip:
        def __init__(self, object_key: str) -> None:
            self.object_key = object_key

    def convert(value: Any) -> Any:
        if isinstance(value, Grip):
            return value.object_key
        if isinstance(value, bytes):
            raise ValueError("bytes are not kept")  # noqa: TRY004  as an executive would
        return 1 / 0 if value == "fault" else value

    with opened(tmp_path) as memory:
        kind = memory.recording.type(
            "action", "GripIt", {"what": "object", "all": ("list", "object"), "raw": "text", "text": str}
        )
        with memory.recording.episode(description="d", convert=convert) as episode:
            episode.object_added("m", "milk", "MILK", HERE)
            episode.start("g", kind, {"what": Grip("m"), "all": [Grip("m"), "m"], "raw": b"1", "text": "fault"})
            episode.observe("seen", {"grip": Grip("m"), "raw": b"1"}, node="g")
            episode.end("g", result={"grip": Grip("m")})
        assert memory.status.faults == (0, None)
        assert memory.status.missing.total == 3
    (started,) = [each for each in events(tmp_path, "NodeStarted") if "designator" in each]
    row = {"object": 3, "row": 3}
    assert started["parameters"]["what"] == row
    assert started["parameters"]["all"] == [row, row]
    assert started["parameters"]["raw"]["missing"] == "bytes are not kept"
    assert "ZeroDivisionError" in started["parameters"]["text"]["missing"]
    (observed,) = events(tmp_path, "Observed")
    assert (observed["values"]["grip"], observed["missing"]["raw"]) == ("m", "bytes are not kept")
    assert_verified(tmp_path)


def test_a_key_in_use_ends_its_first_node_lost_and_starts_the_second(tmp_path: Path) -> None:
    def write(recording: Recording, episode: RecordedEpisode) -> None:
        kind = recording.type("action", "Twice")
        episode.start(1, kind)
        episode.start(1, kind)
        episode.end(1)
        episode.start(1, kind)  # after its end a key is free again
        episode.end(1)

    assert faults_of(tmp_path, write)[0] == 1
    assert [row[2] for row in nodes(tmp_path)] == ["LOST", "SUCCEEDED", "SUCCEEDED"]
    ends = [(each["node"], each.get("status", "SUCCEEDED")) for each in events(tmp_path, "NodeEnded")]
    assert ends == [(3, "LOST"), (5, "SUCCEEDED"), (7, "SUCCEEDED"), (2, "SUCCEEDED")]  # each as it happened
    assert_verified(tmp_path)


def test_the_kind_of_an_action_and_the_status_of_success_are_omitted_whichever_objects_say_them(tmp_path: Path) -> None:
    def write(recording: Recording, episode: RecordedEpisode) -> None:
        for kind, status in (("action", "SUCCEEDED"), ("motion", "FAILED")):
            own, outcome = (cast("Any", "".join(list(each))) for each in (kind, status))  # not the package's constants
            episode.start(kind, recording.type(own, f"{kind}_of_a_tree"))
            episode.end(kind, outcome)

    assert faults_of(tmp_path, write) == (0, None)
    starts, ends = events(tmp_path, "NodeStarted")[1:], events(tmp_path, "NodeEnded")[:2]
    assert [(each.get("kind"), len(each["designator"])) for each in starts] == [(None, 16), ("motion", 16)]
    assert [each.get("status") for each in ends] == [None, "FAILED"]
    assert_verified(tmp_path)


def test_an_unknown_parent_is_counted_and_an_ended_one_is_kept(tmp_path: Path) -> None:
    def write(recording: Recording, episode: RecordedEpisode) -> None:
        kind = recording.type("action", "Step")
        episode.start("a", kind)
        episode.end("a")
        episode.start("b", kind, parent="a")
        episode.end("b")
        episode.start("c", kind, parent="never")
        episode.end("c")

    assert faults_of(tmp_path, write)[0] == 1
    assert [row[1] for row in nodes(tmp_path)] == [None, "Step", None]


def test_what_a_start_returned_names_its_node_long_after_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keyed_episode, "_ENDED_MAX", 3)
    with opened(tmp_path) as memory, memory.recording.episode() as episode:
        job = memory.recording.type("action", "Job", {"number": int})
        first = episode.start("key", job, {"number": 0})
        episode.end("key")
        for number in range(1, 20):
            episode.start("key", job, {"number": number})
            episode.end("key")
        episode.observe("ticks", 7, node=first)
        episode.start("child", job, {"number": -1}, parent=first)
        episode.end("child")
        assert memory.status.faults.total == 0
    of_observation = "SELECT number FROM job JOIN observation ON job.id = node_id"
    of_child = (
        "SELECT job.number FROM job JOIN task_tree_node AS node ON node.parent_id = job.id"
        " JOIN job AS child ON child.id = node.id"
    )
    assert ask(tmp_path / "memory.db", of_observation) == ask(tmp_path / "memory.db", of_child) == [(0,)]


def test_nodes_that_start_below_ended_ones_do_not_keep_all_of_these(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keyed_episode, "_ENDED_MAX", 3)
    kept: list[int] = []

    def write(recording: Recording, episode: RecordedEpisode) -> None:
        step = recording.type("action", "Step")
        for key in range(20):
            episode.start(key, step, parent=key - 1 if key else None)
            episode.end(key)
        everything = gc.get_objects()
        kept.append(sum(type(each) is keyed_episode.Node and each.declared is step for each in everything))

    assert faults_of(tmp_path, write) == (0, None)
    assert kept == [3]
    assert len(nodes(tmp_path)) == 20


def test_nodes_open_at_the_end_are_lost_and_counted_once_or_cancelled_by_an_interruption(tmp_path: Path) -> None:
    expected = {
        KeyboardInterrupt(): "CANCELLED",
        asyncio.CancelledError(): "CANCELLED",
        ValueError(): "LOST",
        None: "LOST",
    }
    with opened(tmp_path) as memory:
        for failure in expected:
            episode = memory.recording.episode(description="d")
            for key in range(3):
                episode.start(key, memory.recording.type("action", "Step"))
            episode.close(failure)
            assert memory.status.faults.total == (failure is None)
        assert str(memory.status.faults.last).endswith("which end LOST: 3")
    assert [row[2] for row in nodes(tmp_path)] == [status for status in expected.values() for _ in range(3)]
    assert_verified(tmp_path)


def test_a_simulation_names_the_node_that_imagined_it(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        kind = memory.recording.type("action", "Plan")
        with memory.recording.episode(description="real") as real:
            real.start("p", kind)
            thought = memory.recording.episode(description="t", simulated=True, thought_by=real.node_reference("p"))
            thought.start("q", kind)
            thought.end("q")
            thought.close()
            real.end("p")
        assert memory.recent_episodes == (str(real),)
    assert [each.get("thought_by") for each in events(tmp_path, "EpisodeStarted")] == [
        None,
        {"episode": str(real), "node": 3},
    ]
    assert ask(tmp_path / "memory.db", "SELECT count(*) FROM process_metadata") == [(1,)]  # a query leaves it out
    assert_verified(tmp_path)


def test_an_end_can_end_the_nodes_that_are_open_below(tmp_path: Path) -> None:
    def write(recording: Recording, episode: RecordedEpisode) -> None:
        step = recording.type("action", "Step")
        episode.start("job", step)
        episode.start("other", step)
        episode.start("ended", step, parent="job")
        episode.start("below it", step, parent="ended")
        episode.end("ended", "FAILED")
        episode.start("inside", step, parent="job")
        episode.start("innermost", step, parent="inside")
        episode.end("job", failure=ValueError("dropped"), below="INTERRUPTED")
        assert not episode.is_open("below it")
        episode.end("other", below="INTERRUPTED")
        episode.start("last", step)
        episode.end("last", below=cast("Any", "GONE"))

    total, last = faults_of(tmp_path, write)
    assert total == 1
    assert last is not None
    assert "'GONE' is not a status" in last
    # in this order: ended, innermost, inside, below it, job, other, last, the root
    ends = [(each["node"], each.get("status", "SUCCEEDED")) for each in events(tmp_path, "NodeEnded")]
    assert ends == [
        (5, "FAILED"), (9, "INTERRUPTED"), (8, "INTERRUPTED"), (6, "INTERRUPTED"), (3, "ERROR"), (4, "SUCCEEDED"),
        (15, "SUCCEEDED"), (2, "SUCCEEDED"),
    ]  # fmt: skip
    assert_verified(tmp_path)


# === full spool ===============================================================================================
#
# An executive whose spool is full: a start waits, or is left out and counted, as the settings declare.


def full_recording(folder: Path, on_full: Literal["wait", "fail"]) -> tuple[Recorded, Any, Any]:
    """Return a recording with a full spool, its open episode, and the type of its nodes; `outer` is open."""
    small = Settings(
        on_full=on_full,
        spool_bytes_max=2**17,
        spool_reserve_bytes=2**15,
        segment_bytes=2**15,
        record_bytes_max=2**13,
    )
    recorded = Recorded(folder, small)
    step = recorded.recording.type("action", "Step", {"text": str})
    episode = recorded.recording.episode(description="d")
    episode.start("outer", step)
    number = 0
    while not recorded.queue.full:
        number += 1
        episode.start(number, step, {"text": "x" * 4_000})
        episode.end(number)
    return recorded, episode, step


def test_a_start_that_must_not_wait_is_left_out_and_counted(tmp_path: Path) -> None:
    recorded, episode, step = full_recording(tmp_path, "fail")
    with closing(recorded):
        assert recorded.emitter.faults == (0, None)
        assert episode.start("left out", step) is None
        total, last = recorded.emitter.faults
        assert total == 1
        assert last is not None
        assert last.startswith("NodeStarted: SpoolFull: the spool is full (spool_bytes_max) and on_full is 'fail'")
        episode.start("its child", step, parent="left out")
        episode.end("its child")
        episode.end("left out")
        assert recorded.emitter.faults[0] == 4
        assert "no open node has the key 'left out'" in str(recorded.emitter.faults.last)
        episode.end("outer")  # an end uses the reserve
        episode.close()
        assert recorded.emitter.faults[0] == 4
        (log,) = recorded.logs()
        starts = [sequence for sequence, event in log if isinstance(event, NodeStarted)]
        assert sorted(event.node for _, event in log if isinstance(event, NodeEnded)) == starts


def test_a_start_waits_until_the_spool_has_room_and_logs_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(recorder_queue, "_WAIT_WARNING_S", 0.0)
    recorded, episode, step = full_recording(tmp_path, "wait")
    with closing(recorded):
        assert not episode.wait_for_room(0.0)
        threads = [
            threading.Thread(target=call, daemon=True)
            for call in (lambda: episode.start("later", step), episode.wait_for_room)
        ]
        written = recorded.queue.written
        for each in threads:
            each.start()
        for _ in range(2_000):
            if caplog.text.count("the plan waits because spool") == len(threads):
                break
            threads[0].join(0.01)
        assert all(each.is_alive() for each in threads)
        assert recorded.queue.written == written
        episode.observe("omitted", 1)  # needs no lock that the waiting start holds
        episode.end("outer")

        async def drain() -> None:
            await recorded.queue.synced_to()
            for each in await recorded.queue.get_batch(events_max=10_000, bytes_max=2**26, age_s_max=0):
                await recorded.queue.acknowledge(each.position)

        asyncio.run(drain())
        for each in threads:
            each.join(20)
        assert episode.is_open("later")
        episode.end("later")
        episode.close()
        assert recorded.emitter.faults == (0, None)


# === recorded outcomes ========================================================================================
#
# The status of a recorded node and of its episode: stated by the executive, or that of the failure.


def test_an_executive_states_the_outcome_of_its_own_failure(tmp_path: Path) -> None:
    roots = {"FAILED": "FAILED", "INTERRUPTED": "CANCELLED", "ERROR": "ERROR", None: "ERROR"}
    with opened(tmp_path) as memory:
        for status in roots:
            memory.recording.episode(description="d").close(ValueError("a failure of its own"), cast("Any", status))
    ended = ask(
        tmp_path / "memory.db", "SELECT status, failure_type, failure_message FROM process_metadata ORDER BY id"
    )
    assert ended == [(each or "ERROR", "builtins.ValueError", "a failure of its own") for each in roots]
    own = ask(tmp_path / "memory.db", "SELECT status FROM task_tree_node WHERE kind = 'root' ORDER BY id")
    assert [status for (status,) in own] == [*roots.values()]


class Slip(Exception):
    """A plan failure of an executive of its own."""


def test_without_a_status_a_node_and_its_episode_have_that_of_the_failure(tmp_path: Path) -> None:
    expected: list[tuple[Any, str, str]] = [
        (None, "SUCCEEDED", "SUCCEEDED"),
        (NavigationGoalInCollision("n"), "FAILED", "FAILED"),
        (Slip("s"), "FAILED", "FAILED"),
        ("the wheel slipped", "FAILED", "SUCCEEDED"),
        (FailureValue("Slip", "s"), "FAILED", "SUCCEEDED"),
        (ValueError("v"), "ERROR", "ERROR"),
        (KeyboardInterrupt(), "CANCELLED", "INTERRUPTED"),
        (SystemExit(0), "CANCELLED", "INTERRUPTED"),
        (asyncio.CancelledError(), "CANCELLED", "INTERRUPTED"),
    ]
    with opened(tmp_path) as memory:
        for failure, *_ in expected:
            with suppress(BaseException), memory.recording.episode(failures=(Slip,)) as episode:
                episode.start("a", memory.recording.type("action", "Step"))
                episode.end("a", failure=failure)
                if isinstance(failure, BaseException):
                    raise failure
        memory.recording.episode(description="left open")
        assert memory.status.faults == (0, None)
    assert [row[2] for row in nodes(tmp_path)] == [status for _, status, _ in expected]
    ends = [each["status"] for each in events(tmp_path, "EpisodeEnded")]
    assert ends == [*(status for *_, status in expected), "INTERRUPTED"]
