"""A made-up executive with run ids and no types is recorded by `Runs`: inputs, results, parents."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.memory import SyncMemory
from pycrorm_async.plan.failures import NavigationGoalNotReached
from pycrorm_async.record.executives import Runs
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import json_text, plain_value
from pycrorm_async.testing.contracts import check_executive
from pycrorm_async.world.pose import Pose
from tests.databases import ask
from tests.recording.recorded_memory import assert_verified, nodes, url_of


@dataclass
class Reading:
    volts: float
    taken_at: tuple[float, ...] = (1.0, 2.0)


class Place(NamedTuple):
    x: float
    readings: list[Reading]


class Model:
    """A model as one of pydantic, which may refuse to be dumped."""

    def __init__(self, **fields: Any) -> None:
        self.fields = fields

    def model_dump(self) -> dict[str, Any]:
        if not self.fields:
            raise OSError("no fields")
        return self.fields


def opened(folder: Path) -> SyncMemory:
    return Memory.sync(url_of(folder), settings=Settings(fold="at_end"))


async def test_a_made_up_engine_passes_the_test_of_an_integration(tmp_path: Path) -> None:
    def drive(recording: Recording) -> None:
        with Runs(recording, "engine 1.0", description="Bring milk", tags=["milk"]) as runs:
            runs.start(1, "language", "Flow", {"name": "bring"})
            runs.start(2, "action", "pick_up", {"object_name": "milk", "force_n": 5, "is_fast": True}, parent=1)
            runs.observe("battery", Reading(24.0), 2)
            runs.end(2, result={"seen": [Reading(23.5)]})
            runs.end(1, "INTERRUPTED")

    flow, pick_up = await check_executive(drive, tmp_path)
    assert [(each.dtype, each.kind, each.status.name) for each in (flow, pick_up)] == [
        ("Flow", "language", "INTERRUPTED"),
        ("pick_up", "action", "SUCCEEDED"),
    ]
    assert pick_up.parent_id == flow.id
    file = tmp_path / "executive.db"
    assert ask(file, "SELECT object_name, force_n, is_fast FROM pick_up") == [("milk", 5.0, 1)]
    [(result,)] = ask(file, "SELECT result FROM pick_up JOIN task_tree_node USING (id)")
    assert json.loads(result) == {"seen": [{"volts": 23.5, "taken_at": [1.0, 2.0]}]}
    volts = "SELECT number FROM observation JOIN observation_value USING (id) WHERE key = 'volts' AND node_id ="
    assert ask(file, f"{volts} {pick_up.id}") == [(24.0,)]
    described = "SELECT description, metadata ->> 'executive' FROM process_metadata"
    assert ask(file, described) == [("Bring milk", "engine 1.0")]


def test_a_number_is_real_with_and_without_a_decimal_point_and_none_declares_no_field(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            for number, force in enumerate((5, 5.5, None)):
                runs.start(number, "action", "push", {"force_n": force, "note": None})
                runs.end(number)
        assert (memory.status.missing.total, memory.status.faults.total) == (0, 0)
    columns = {name for _, name, *_ in ask(tmp_path / "memory.db", "PRAGMA table_info(push)")}
    assert "note" not in columns
    assert ask(tmp_path / "memory.db", "SELECT force_n FROM push ORDER BY id") == [(5.0,), (5.5,), (None,)]


def test_an_input_that_is_no_scalar_is_a_text_of_json(tmp_path: Path) -> None:
    inputs = {"place": [1, 2.5], "reading": Reading(24.0), "at": datetime(2026, 1, 2, tzinfo=UTC), "model": Model(a=1)}
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            runs.start(1, "action", "drive", inputs)
            runs.end(1)
        assert memory.status.missing.total == 0
    assert ask(tmp_path / "memory.db", 'SELECT place, reading, "at", model FROM drive') == [
        ("[1, 2.5]", '{"volts": 24.0, "taken_at": [1.0, 2.0]}', '"2026-01-02 00:00:00+00:00"', '{"a": 1}')
    ]


def test_a_parent_a_run_and_an_observed_run_that_are_not_open_are_no_faults(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            runs.start(2, "action", "look", parent="elsewhere")
            runs.end(2)
            runs.start(3, "action", "reach", parent=2)
            runs.end("elsewhere")
            runs.observe("door", "open", "elsewhere")
            runs.end(3)
        assert memory.status.faults.total == 0
    assert nodes(tmp_path) == [("look", None, "SUCCEEDED", None), ("reach", None, "SUCCEEDED", None)]


def test_an_exception_ends_a_run_as_it_ends_a_node(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        with pytest.raises(OSError, match="no power"), Runs(memory.recording, "engine 1.0") as runs:
            for number, error in enumerate((NavigationGoalNotReached("blocked"), OSError("no power"))):
                runs.start(number, "action", "drive")
                runs.end(number, failure=error)
            raise OSError("no power")
        assert memory.status.faults.total == 0
    assert nodes(tmp_path) == [("drive", None, "FAILED", "blocked"), ("drive", None, "ERROR", "no power")]
    assert ask(tmp_path / "memory.db", "SELECT status FROM process_metadata") == [("ERROR",)]


def test_runs_report_from_any_thread(tmp_path: Path) -> None:
    def branch(runs: Runs, number: int) -> None:
        for each in range(20):
            runs.start((number, each), "action", "step", {"branch": number}, parent="all")
            runs.end((number, each))

    with opened(tmp_path) as memory, Runs(memory.recording, "engine 1.0") as runs:
        runs.start("all", "language", "Parallel")
        threads = [threading.Thread(target=branch, args=(runs, number)) for number in range(4)]
        for each in threads:
            each.start()
        for each in threads:
            each.join()
        runs.end("all")
    counts = "SELECT branch, count(*) FROM step GROUP BY branch ORDER BY branch"
    assert ask(tmp_path / "memory.db", counts) == [(float(number), 20) for number in range(4)]
    assert {parent for _dtype, parent, *_ in nodes(tmp_path)[1:]} == {"Parallel"}
    assert_verified(tmp_path)


def test_an_engine_may_simplify_its_own_values_at_any_depth(tmp_path: Path) -> None:
    class Engine(Runs):
        def simplified(self, value: Any) -> Any:
            return f"{value.volts} V" if isinstance(value, Reading) else value

    with opened(tmp_path) as memory, Engine(memory.recording, "engine 1.0") as runs:
        runs.start(1, "action", "measure", {"before": [Reading(24.0)]})
        runs.end(1, result={"after": (Reading(23.0),)})
    [(before, result)] = ask(
        tmp_path / "memory.db", "SELECT before, result FROM measure JOIN task_tree_node USING (id)"
    )
    assert (json.loads(before), json.loads(result)) == (["24.0 V"], {"after": ["23.0 V"]})


def test_a_value_that_cannot_be_copied_is_returned_and_recorded_as_missing(tmp_path: Path) -> None:
    endless: list[Any] = []
    endless.append(endless)
    model = Model()
    assert plain_value(endless) is json_text(endless) is endless
    assert plain_value(model) is json_text(model) is model
    with opened(tmp_path) as memory:
        with Runs(memory.recording, "engine 1.0") as runs:
            runs.start(1, "action", "measure", {"volts": endless})
            runs.end(1, result=model)
        assert (memory.status.missing.total, memory.status.faults.total) == (2, 0)
    assert nodes(tmp_path) == [("measure", None, "SUCCEEDED", None)]


def test_values_that_events_have_a_form_for_stay_as_they_are() -> None:
    pose = Pose([1, 2, 3])
    assert plain_value({"pose": pose, 1: (pose, "a")}) == {"pose": pose, "1": [pose, "a"]}
    assert plain_value(Reading) is Reading


def test_containers_of_other_classes_are_copied_as_dicts_and_lists() -> None:
    place = Place(1.0, [Reading(24.0, ())])
    assert plain_value(MappingProxyType({"at": place})) == {"at": [1.0, [{"volts": 24.0, "taken_at": []}]]}
