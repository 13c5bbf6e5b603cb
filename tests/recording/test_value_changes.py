"""Changes of a store of values are observed: each once, in each episode from the first value on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.memory import SyncMemory
from pycrorm_async.record.executives import ValueChanges
from tests.databases import ask
from tests.recording.recorded_memory import url_of


def opened(folder: Path) -> SyncMemory:
    return Memory.sync(url_of(folder), settings=Settings(fold="at_end"))


def observed(folder: Path) -> list[tuple[Any, ...]]:
    """Return (episode, name, value) of each observation, in order."""
    return ask(
        folder / "memory.db",
        "SELECT observation.process_metadata_id, name, coalesce(number, text) FROM observation"
        " LEFT JOIN observation_value USING (id) ORDER BY observation.id",
    )


def test_each_change_is_observed_once_and_a_removed_key_as_none(tmp_path: Path) -> None:
    board: dict[str, Any] = {"volts": 24.0, "goal": "kitchen"}
    changes = ValueChanges(lambda: board, "board/")
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        for _ in range(3):
            changes.observe(episode)
        board["volts"] = 23.5
        changes.observe(episode)
        del board["goal"]
        changes.observe(episode)
    assert observed(tmp_path) == [
        (1, "board/volts", 24.0),
        (1, "board/goal", "kitchen"),
        (1, "board/volts", 23.5),
        (1, "board/goal", None),
    ]


def test_each_episode_begins_with_all_values(tmp_path: Path) -> None:
    changes = ValueChanges(lambda: {"volts": 24.0})
    with opened(tmp_path) as memory:
        for _ in range(2):
            with memory.recording.episode(description="d") as episode:
                changes.observe(episode)
    assert observed(tmp_path) == [(1, "volts", 24.0), (2, "volts", 24.0)]


def test_only_the_keys_that_are_meant_are_observed_by_the_node_that_wrote_them(tmp_path: Path) -> None:
    board = {"volts": 24.0, "secret": "1234"}
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        episode.start("measure", memory.recording.type("action", "Measure"))
        changes = ValueChanges(lambda: board, is_observed=lambda key: key != "secret", node={"volts": "measure"}.get)
        changes.observe(episode)
        episode.end("measure")
        assert memory.status.faults.total == 0
    assert observed(tmp_path) == [(1, "volts", 24.0)]
    below = "SELECT dtype FROM observation JOIN task_tree_node ON task_tree_node.id = observation.node_id"
    assert ask(tmp_path / "memory.db", below) == [("Measure",)]


def test_a_value_that_cannot_be_compared_is_a_change_each_time(tmp_path: Path) -> None:
    class Odd(float):
        def __eq__(self, other: object) -> bool:
            raise OSError("no")

        __hash__ = None  # type: ignore[assignment]

    board: dict[str, Any] = {}
    changes = ValueChanges(lambda: board)
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        for number in range(3):
            board["odd"] = Odd(1.5)
            board["number"] = number
            changes.observe(episode)
    assert [(name, value) for _, name, value in observed(tmp_path) if name == "number"] == [
        ("number", 0.0),
        ("number", 1.0),
        ("number", 2.0),
    ]
    assert sum(name == "odd" for _, name, _value in observed(tmp_path)) == 3


def test_what_the_function_for_a_key_raises_reaches_the_caller_once(tmp_path: Path) -> None:
    def refuse(key: str) -> bool:
        raise OSError(key)

    changes = ValueChanges(lambda: {"volts": 24.0}, is_observed=refuse)
    with opened(tmp_path) as memory, memory.recording.episode(description="d") as episode:
        with pytest.raises(OSError, match="volts"):
            changes.observe(episode)
        changes.observe(episode)
    assert observed(tmp_path) == []
