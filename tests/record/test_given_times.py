"""Record what happened at another time: times and ids that the executive gives, ends of which nothing is known."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import episode_text, named_episode_id
from pycrorm_async.events.types import SeenValue
from pycrorm_async.record.arguments import pose_of
from pycrorm_async.record.event_times import At
from pycrorm_async.record.recording import Recording
from pycrorm_async.world.pose import Pose
from tests.databases import ask
from tests.record.recordings import assert_verified, opened

SECOND = 1_000_000_000
START = 1_556_700_000 * SECOND  # 2019-05-01T08:40:00Z


def rows(folder: Path, statement: str) -> list[tuple[Any, ...]]:
    return [tuple(each) for each in ask(folder / "memory.db", statement)]


def test_each_event_has_the_time_at_which_it_happened(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        drive = memory.recording.type("action", "Drive", {"speed": "real"})
        with memory.recording.episode(description="2019", at=START, created_by="ada") as episode:
            episode.object_added("cup", "cup", "CUP", Pose([1, 2, 3]), at=START + SECOND)
            episode.start("a", drive, {"speed": 0.5}, at=(START + 2 * SECOND, 12_345))
            episode.object_moved("cup", Pose([2, 2, 3]), at=START + 3 * SECOND)
            episode.observe("force", 1.5, node="a", at=START + 3 * SECOND)
            episode.end("a", at=START + 4 * SECOND)
            episode.close(at=START + 5 * SECOND)
        assert memory.status.faults.total == 1  # the monotonic time that lies before the episode
        memory.flush()
    assert_verified(tmp_path)
    times = rows(tmp_path, "SELECT wall_ns - 1556700000000000000, monotonic_ns FROM event ORDER BY sequence")
    seconds = [0, 0, 1, 2, 3, 3, 4, 5, 5]
    assert [wall_ns / SECOND for wall_ns, _ in times] == seconds
    late = [START + each * SECOND for each in (0, 0, 1, 1, 3, 3, 4, 5, 5)]
    assert [monotonic_ns for _, monotonic_ns in times] == late
    [(created_at, created_by, clock)] = rows(
        tmp_path, "SELECT created_at, created_by, clock_synchronized FROM process_metadata"
    )
    assert (created_at, created_by, clock) == (START // 1000, "ada", None)


def test_times_that_go_back_get_one_line_and_keep_their_order(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with opened(tmp_path) as memory:
        with memory.recording.episode(description="a clock an hour off", at=START) as episode:
            for each in (3600, 0, 1, -7200, 3599.5):
                episode.observe("x", 1, at=START + round(each * SECOND))
            episode.close(at=START + 3700 * SECOND)
        assert memory.status.faults.total == 1
    [line] = [each.getMessage() for each in caplog.records if "lies" in each.getMessage()]
    assert "the time 2019-05-01T08:40:00.000000Z lies 3600.000 s before the event before it" in line
    assert_verified(tmp_path)
    seconds = [each[0] for each in rows(tmp_path, "SELECT (ns - 1556700000000000000) / 1000000000 FROM observation")]
    assert seconds == [3600] * 5


def test_an_episode_of_now_takes_the_stamps_of_its_sensors(tmp_path: Path) -> None:
    with opened(tmp_path) as memory, memory.recording.episode(description="now") as episode:
        now = time.time_ns()
        episode.observe("stamped", 1, at=now - 20_000_000)
        episode.observe("unstamped", 1)
        episode.observe("from the future", 1, at=now + 3600 * SECOND)
        episode.observe("after it", 1)
    assert_verified(tmp_path)
    stamps = dict(rows(tmp_path, "SELECT name, ns FROM observation"))
    assert list(stamps) == ["stamped", "unstamped", "from the future", "after it"]
    assert sorted(stamps.values()) == list(stamps.values())
    [(wall_ns,)] = rows(tmp_path, "SELECT wall_ns FROM event WHERE payload LIKE '%\"stamped\"%'")
    assert wall_ns == now - 20_000_000


def test_a_wrong_time_is_refused_for_an_episode_and_counted_for_an_event(tmp_path: Path) -> None:
    wrong: tuple[Any, ...] = (1.5, "2019-05-01", True, 2**63, (1, 2, 3), (1, "2"))
    with opened(tmp_path) as memory:
        for each in wrong:
            with pytest.raises(CallerError, match="at must"):
                memory.recording.episode(at=each)
        with memory.recording.episode(at=START) as episode:
            for number, each in enumerate(wrong, 1):
                episode.observe("x", 1, at=each)
                assert memory.status.faults.total == number
                assert "at must" in str(memory.status.faults.last)
        memory.flush()
    assert rows(tmp_path, "SELECT ns FROM observation") == [(START,)] * len(wrong)


def test_what_never_reported_its_end_is_neither_a_success_nor_a_failure(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        drive = memory.recording.type("action", "Drive", {})
        with memory.recording.episode(description="a", at=START) as episode:
            for each in "abcd":
                episode.start(each, drive, at=START + SECOND)
            episode.end("a", "SUCCEEDED", at=START + 2 * SECOND)
            episode.end("b", "UNKNOWN", at=START + 3 * SECOND)
            episode.end("c", "FAILED", untimed=True, at=START + 3 * SECOND)
            episode.close(status="UNKNOWN", at=START + 4 * SECOND)
        assert memory.status.faults.total == 0
        memory.flush()
        rates = memory.ask.success_rates().rows()
        [summary] = memory.episodes()
    assert_verified(tmp_path)
    assert rows(tmp_path, "SELECT status, (end_ns - start_ns) / 1000000000 FROM task_tree_node ORDER BY id") == [
        ("UNKNOWN", 4),
        ("SUCCEEDED", 1),
        ("UNKNOWN", 2),
        ("FAILED", None),
        ("UNKNOWN", None),
    ]
    assert summary.status == "UNKNOWN"
    assert (summary.failed, summary.failed_actions) == (1, 1)
    [rate] = [each._asdict() for each in rates]
    assert (rate["times"], rate["succeeded"], rate["failed"]) == (4, 1, 1)
    assert rate["share"] == 0.5


# === ids ======================================================================================================


def record_drives(recording: Recording, name: str | UUID, count: int, *, at: At | None = START) -> Any:
    """Record an episode of many actions, as an import does."""
    drive = recording.type("action", "Drive", {"goal": "text"})
    with recording.episode(id=name, description="an import", at=at) as episode:
        for each in range(count):
            now = None if at is None else START + each * SECOND
            episode.start(each, drive, {"goal": f"place {each}"}, at=now)
            if each % 10 == 0:
                episode.object_added(f"cup {each}", f"cup {each}", "CUP", Pose([each, 0, 0]), at=now, node=each)
            episode.end(each, "SUCCEEDED", at=now)
    return episode


def contents(folder: Path) -> list[tuple[Any, ...]]:
    """Return what the log has, without the times of poses, which are those of their creation."""
    return [
        (sequence, kind, wall_ns, payload.split('"time_ns"')[0])
        for sequence, kind, wall_ns, payload in rows(
            folder, "SELECT sequence, type, wall_ns, payload FROM event ORDER BY episode, sequence"
        )
    ]


def test_an_episode_of_one_name_is_recorded_once(tmp_path: Path) -> None:
    for turn in range(2):
        with opened(tmp_path) as memory:
            episode = record_drives(memory.recording, "drives.log", 30)
            assert episode.is_recorded == (turn == 1)
            assert str(episode) == episode_text(named_episode_id("drives.log"))
            again = record_drives(memory.recording, "drives.log", 30)
            assert again.is_recorded
            assert memory.status.faults.total == 0
    assert_verified(tmp_path)
    assert rows(tmp_path, "SELECT count(*), count(DISTINCT id) FROM task_tree_node") == [(31, 31)]


def test_a_uuid_is_the_id_itself_and_a_wrong_name_is_refused(tmp_path: Path) -> None:
    own = UUID("12345678-1234-4678-9234-567812345678")
    wrong: tuple[Any, ...] = ("", "a\0b", 7, b"x")
    with opened(tmp_path) as memory:
        for each in wrong:
            with pytest.raises(CallerError, match="the id of an episode must be"):
                memory.recording.episode(id=each)
        assert str(record_drives(memory.recording, own, 3)) == str(own)
        assert record_drives(memory.recording, str(own), 3).is_recorded


@pytest.mark.slow
def test_a_killed_recording_of_a_name_is_continued_and_nothing_is_doubled(tmp_path: Path) -> None:
    program = (
        "import sys; from pycrorm_async import Memory; from tests.record.test_given_times import record_drives, opened;"
        "from pathlib import Path\n"
        "with opened(Path(sys.argv[1])) as memory:\n"
        "    record_drives(memory.recording, 'drives.log', 6_000)\n"
    )
    whole = tmp_path / "whole"
    whole.mkdir()
    with opened(whole) as memory:
        record_drives(memory.recording, "drives.log", 3_000)
    killed = tmp_path / "killed"
    killed.mkdir()
    with opened(killed):
        pass
    heads = [0]
    for _ in range(2):
        process = subprocess.Popen([sys.executable, "-c", program, str(killed)], cwd=Path(__file__).parents[2])
        while len(rows(killed, "SELECT 1 FROM event")) <= heads[-1] + 200:
            assert process.poll() is None
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        heads.append(len(rows(killed, "SELECT 1 FROM event")))
    with opened(killed) as memory:
        episode = record_drives(memory.recording, "drives.log", 6_000)
        assert episode.refusal is None
        assert memory.status.faults.total == 0
    assert_verified(killed)
    assert contents(killed)[:2_000] == contents(whole)[:2_000]
    nodes = "SELECT count(*), count(DISTINCT payload) FROM event WHERE type = 'NodeStarted'"
    assert rows(killed, nodes) == [(6_001, 6_001)]
    assert rows(killed, "SELECT count(*) FROM task_tree_node") == [(6_001,)]
    assert rows(killed, "SELECT status FROM process_metadata") == [("SUCCEEDED",)]


def test_a_source_that_has_changed_is_refused_in_one_line(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        drive = memory.recording.type("action", "Drive", {"goal": "text"})
        episode = memory.recording.episode(id="log", at=START)
        episode.start(1, drive, {"goal": "a"}, at=START)
        episode.close(KeyboardInterrupt())
    assert rows(tmp_path, "SELECT status FROM process_metadata") == [("RUNNING",)]
    with opened(tmp_path) as memory:
        episode = memory.recording.episode(id="log", at=START)
        episode.start(1, drive, {"goal": "b"}, at=START)
        episode.end(1, at=START)
        episode.close(at=START)
        assert "event 3 of the episode" in str(episode.refusal)
        assert memory.status.faults.total == 1
    assert_verified(tmp_path)
    assert rows(tmp_path, "SELECT count(*) FROM event") == [(3,)]


@pytest.mark.soak_on("postgresql")
async def test_a_name_and_its_samples_are_found_on_each_database_inside_a_loop(
    database_url: str, tmp_path: Path
) -> None:
    for turn in range(2):
        async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
            assert record_drives(memory.recording, "drives.log", 3).is_recorded == (turn == 1)
            with memory.recording.episode(id="joints.log", at=START) as episode:
                episode.sampled("joints", ["a", "b"], [[1.5, 2.5]] * 3, [START, START + 1, START + SECOND])
                episode.close(status="UNKNOWN", at=START + SECOND)
            await memory.flush()
            frame = await memory.samples("joints")
            streams = await memory.ask.streams().rows()
            assert frame["ns"].tolist() == [START, START + 1, START + SECOND]
            assert [tuple(each)[1:4] for each in streams] == [("joints", 2, 3)]
            assert [each.status for each in await memory.episodes()] == ["SUCCEEDED", "UNKNOWN"]


def test_two_processes_that_record_one_name_are_refused_in_one_line(tmp_path: Path) -> None:
    hasty = Settings(fold="at_end", flush_timeout_s=0.5)
    with opened(tmp_path) as first:
        episode = first.recording.episode(id="drives.log", at=START)
        with opened(tmp_path, hasty) as second:
            again = record_drives(second.recording, "drives.log", 3)
            assert "another process records this episode" in str(again.refusal)
            assert second.status.faults.total == 1
        assert "is open already" in str(first.recording.episode(id="drives.log", at=START).refusal)
        episode.close(at=START)
    assert_verified(tmp_path)
    assert rows(tmp_path, "SELECT count(*) FROM process_metadata") == [(1,)]


# === frames ===================================================================================================


def test_a_pose_in_a_frame_whose_place_is_known_is_recorded_in_the_map(tmp_path: Path) -> None:
    quarter = [0, 0, math.sqrt(0.5), math.sqrt(0.5)]
    with opened(tmp_path) as memory, memory.recording.episode(description="frames") as episode:
        episode.object_added("robot", "pr2", "ROBOT", Pose([1, 2, 0], quarter))
        episode.frame_moved("camera", Pose([0.5, 0, 1], frame="pr2"))
        episode.object_added("cup", "cup", "CUP", Pose([2, 0, 0], frame="camera"))
        episode.object_added("lost", "lost", "CUP", Pose([2, 0, 0], frame="gripper"))
        episode.detected([SeenValue("cup", "CUP", pose_of(Pose([0, 1, 0], frame="pr2")))])
        episode.object_moved("cup", Pose([1, 0, 0], frame="camera"))
        episode.frame_moved("a", Pose([0, 0, 0], frame="b"))
        episode.frame_moved("b", Pose([0, 0, 0], frame="a"))
        episode.object_moved("cup", Pose([9, 9, 9], frame="a"))
    assert_verified(tmp_path)
    places = [
        (name, round(x, 9), round(y, 9), round(z, 9), frame)
        for name, x, y, z, frame in rows(
            tmp_path, "SELECT name, x, y, z, frame FROM object JOIN pose ON pose.id = pose_id ORDER BY object.id"
        )
    ]
    assert places == [
        ("pr2", 1, 2, 0, "map"),
        ("cup", 1, 4.5, 1, "map"),
        ("lost", 2, 0, 0, "gripper"),
        ("cup", 1, 3.5, 1, "map"),
        ("cup", 9, 9, 9, "a"),
    ]
    [(x, y, frame)] = rows(tmp_path, "SELECT round(x, 9), round(y, 9), frame FROM detection")
    assert (x, y, frame) == (0, 2, "map")
