"""The status of a recorded node and of its episode: stated by the executive, or that of the failure."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, cast

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import EpisodeStatus, FailureValue, ObjectReference, PoseValue, RobotValue
from pycrorm_async.plan.failures import NavigationGoalInCollision
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from tests.databases import ask
from tests.recording.recorded_memory import events, faults_of, nodes, opened


def test_an_unknown_status_is_counted_and_the_node_ends_with_an_error(tmp_path: Path) -> None:
    def write(recording: Recording, episode: RecordedEpisode) -> None:
        episode.start(1, recording.type("action", "Step"))
        episode.end(1, cast("Any", "DONE"))

    total, last = faults_of(tmp_path, write)
    assert total == 1
    assert last is not None
    assert "'DONE' is not a status" in last
    assert [row[2] for row in nodes(tmp_path)] == ["ERROR"]


def test_a_failure_that_leaves_the_block_ends_the_episode_with_its_status(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        for failure in (NavigationGoalInCollision("n"), ValueError("v"), KeyboardInterrupt()):
            with pytest.raises(type(failure)), memory.recording.episode(description="d"):
                raise failure
        memory.recording.episode(description="left open")
    statuses = [each for (each,) in ask(tmp_path / "memory.db", "SELECT status FROM process_metadata ORDER BY id")]
    assert statuses == ["FAILED", "ERROR", "INTERRUPTED", "INTERRUPTED"]


def test_a_status_given_with_a_failure_of_another_language(tmp_path: Path) -> None:
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        episode.start("a", memory.recording.type("action", "Step"), robot=RobotValue(
            PoseValue((0, 0, 0), (0, 0, 0, 1), "map", 0), "ROBOT", None, ObjectReference(1, 1), "r"
        ))  # fmt: skip
        episode.end("a", "INTERRUPTED", FailureValue("bt.Preempted", "a higher priority"))
    assert nodes(tmp_path) == [("Step", None, "INTERRUPTED", "a higher priority")]


@pytest.mark.parametrize(
    ("status", "root"), [("FAILED", "FAILED"), ("INTERRUPTED", "CANCELLED"), ("ERROR", "ERROR"), (None, "ERROR")]
)
def test_an_executive_states_the_outcome_of_its_own_failure(
    tmp_path: Path, status: EpisodeStatus | None, root: str
) -> None:
    with opened(tmp_path) as memory:
        memory.recording.episode(description="d").close(ValueError("a failure of its own"), status)
    ended = ask(tmp_path / "memory.db", "SELECT status, failure_type, failure_message FROM process_metadata")
    assert [tuple(each) for each in ended] == [(status or "ERROR", "builtins.ValueError", "a failure of its own")]
    roots = ask(tmp_path / "memory.db", "SELECT status FROM task_tree_node WHERE kind = 'root'")
    assert [tuple(each) for each in roots] == [(root,)]


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
            episode = memory.recording.episode(failures=(Slip,))
            episode.start("a", memory.recording.type("action", "Step"))
            episode.end("a", failure=failure)
            episode.close(failure if isinstance(failure, BaseException) else None)
        assert memory.status.faults == (0, None)
    assert [row[2] for row in nodes(tmp_path)] == [status for _, status, _ in expected]
    assert [each["status"] for each in events(tmp_path, "EpisodeEnded")] == [status for *_, status in expected]


def test_failures_that_are_no_classes_are_refused(tmp_path: Path) -> None:
    with opened(tmp_path) as memory, pytest.raises(CallerError, match="failures must be a tuple of classes"):
        memory.recording.episode(failures=cast("Any", Slip))
