"""Types of nodes that an executive declares by names, and the fields that cannot keep theirs."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.record.declarations import FieldSpec, KnownTypes, declare_type
from pycrorm_async.record.parameters import DeclaredType
from pycrorm_async.world.pose import Pose
from tests.commands import pycrorm
from tests.databases import ask
from tests.recording.recorded_memory import assert_verified, events, nodes, url_of

AT_END = Settings(fold="at_end")


@dataclass
class AnnounceActionPerformable(ActionAbstract):
    """Has a text, which an executive will declare as a number."""

    words: str

    async def perform(self) -> None:
        """Do nothing."""


def recorded(folder: Path, dtype: str, fields: Mapping[str, Any], values: Mapping[str, Any]) -> int:
    """Record one node of a type, and return how many values and names were counted as missing."""
    with Memory.sync(url_of(folder), settings=AT_END) as memory:
        kind = memory.recording.type("action", dtype, fields)
        assert memory.recording.type("action", dtype, fields) is kind
        with memory.recording.episode(description="d") as episode:
            episode.object_added("m", "milk", "MILK", Pose([1, 2, 3]))
            episode.start("a", kind, values)
            episode.end("a")
        assert memory.status.faults == (0, None)
        missing = memory.status.missing.total
    assert_verified(folder)
    return missing


def declared_dtypes(folder: Path) -> list[str]:
    payloads = ask(folder / "memory.db", "SELECT payload FROM pycrorm_declaration ORDER BY payload")
    return [json.loads(payload)["dtype"] for (payload,) in payloads]


def test_a_field_that_contradicts_a_built_in_type_is_kept_under_its_type(tmp_path: Path) -> None:
    fields = {"object_designator": "text", "arm": str, "grasp": "real"}
    assert recorded(tmp_path, "PickUpAction", fields, {"object_designator": "milk", "arm": "LEFT", "grasp": 1.5}) == 2
    columns = "SELECT object_designator_text, arm, grasp_real FROM pick_up_action"
    assert ask(tmp_path / "memory.db", columns) == [("milk", "LEFT", 1.5)]
    (declared,) = events(tmp_path, "NodeStarted")[1:]
    assert declared["parameters"] == {"object_designator_text": "milk", "arm": "LEFT", "grasp_real": 1.5}


def test_each_memory_searches_the_classes_for_a_built_in_type_once() -> None:
    searched: list[str] = []

    def find(dtype: str) -> None:
        searched.append(dtype)

    known_types = KnownTypes(find)
    for _ in range(2):
        declare_type("action", "Wipe", {}, known_types)
    assert searched == ["Wipe"]


def test_a_type_is_declared_when_it_is_asked_for_and_has_a_table_without_a_node(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory, memory.recording.episode(description="d"):
        memory.recording.type("action", "Wipe", {"surface": "text"})
    assert declared_dtypes(tmp_path) == ["Wipe"]
    assert ask(tmp_path / "memory.db", "SELECT surface FROM wipe") == []
    assert_verified(tmp_path)


def test_a_prepared_type_is_declared_when_it_is_asked_for_as_one_that_was_not_prepared(tmp_path: Path) -> None:
    fields: Mapping[str, FieldSpec] = {"arm": "integer", "grasp": "text", "surface": "pose", "_private": "real"}
    declared = []
    for folder, kinds in (("plain", ()), ("prepared", ("PickUpAction", "Wipe", "Unused"))):
        (tmp_path / folder).mkdir()
        with Memory.sync(url_of(tmp_path / folder), settings=AT_END) as memory:
            with memory.recording.episode(description="d"):
                for each in kinds:
                    memory.recording.prepare("action", each, fields, bases=("Move",))
                assert memory.status.missing.total == 0
                types = [
                    memory.recording.type("action", each, fields, bases=("Move",)) for each in ("PickUpAction", "Wipe")
                ]
            declared.append((types, memory.status.missing))
            assert memory.status.faults == (0, None)
        assert declared_dtypes(tmp_path / folder) == ["PickUpAction", "Wipe"]
        assert_verified(tmp_path / folder)
    assert declared[0] == declared[1]


def test_a_type_declared_after_another_was_prepared_keeps_its_table_and_columns(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory:
        recording = memory.recording
        with recording.episode(description="d"):
            recording.prepare("action", "Wipe", {"side": "text"})
            recording.prepare("action", "PourAction", {"cup": "text"})
            recording.type("action", "Wipe", {"side": "real"})
            recording.type("action", "pourAction", {"cup": "text"})
            wipe = recording.type("action", "Wipe", {"side": "text"})
            pour = recording.type("action", "PourAction", {"cup": "text"})
        assert [each.declared.name for each in wipe.fields] == ["side_text"]
        assert (pour.dtype, pour.declaration.table) == ("PourActionAction", "pour_action_action")
        assert memory.status.faults == (0, None)
    assert_verified(tmp_path)


def test_preparing_a_type_of_the_same_table_as_another_reserves_no_name(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory, memory.recording.episode(description="d"):
        memory.recording.prepare("action", "PickUpAction", {"arm": "text"})
        declared = memory.recording.type("action", "pickUpAction", {"arm": "integer"})
        assert (declared.dtype, declared.declaration.table) == ("pickUpAction", "pick_up_action")
        assert [each.declared.name for each in declared.fields] == ["arm"]
    assert declared_dtypes(tmp_path) == ["pickUpAction"]


def test_a_type_that_cannot_be_prepared_is_counted_and_does_not_reach_the_caller(tmp_path: Path) -> None:
    unhashable: Any = {"side": []}
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory:
        memory.recording.prepare("action", "Wipe", unhashable)
        assert memory.status.faults[0] == 1


def test_threads_that_ask_for_one_type_at_once_get_one_declaration(tmp_path: Path) -> None:
    declared: list[DeclaredType] = []
    together = threading.Barrier(8)
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory, memory.recording.episode(description="d"):

        def declare() -> None:
            together.wait()
            declared.append(memory.recording.type("action", "Wipe", {f"side_{n}": "real" for n in range(30)}))

        threads = [threading.Thread(target=declare) for _ in range(8)]
        interval_s = sys.getswitchinterval()
        sys.setswitchinterval(1e-6)
        try:
            for each in threads:
                each.start()
            for each in threads:
                each.join()
        finally:
            sys.setswitchinterval(interval_s)
        assert memory.status.faults == (0, None)
        spooled = memory.status.written
    assert {id(each) for each in declared} == {id(declared[0])}
    assert spooled == 3, "the start of the episode and of its root, and one declaration"


def test_a_built_in_type_keeps_its_concept_and_bases(tmp_path: Path) -> None:
    recorded(tmp_path, "PickUpAction", {"arm": str}, {"arm": "LEFT"})
    ((payload,),) = ask(
        tmp_path / "memory.db", "SELECT payload FROM pycrorm_declaration WHERE payload LIKE '%PickUpAction%'"
    )
    assert json.loads(payload)["concept"] == "PickingUp"


def test_a_field_that_contradicts_an_earlier_declaration_is_kept_under_its_type(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory:
        with memory.recording.episode(description="d") as episode:
            values: dict[FieldSpec, Any] = {"integer": 3, "text": "three", "boolean": True}
            for number, (kind, value) in enumerate(values.items()):
                declared = memory.recording.type("action", "Count", {"number": kind})
                episode.start(number, declared, {"number": value})
                episode.end(number)
        memory.flush()
        assert memory.status.missing.total == 2
    rows = ask(tmp_path / "memory.db", "SELECT number, number_text, number_boolean FROM count ORDER BY id")
    assert rows == [(3, None, None), (None, "three", None), (None, None, 1)]
    assert_verified(tmp_path)


async def test_a_field_that_contradicts_a_class_of_the_plan_layer_is_kept_under_its_type(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="ours"):
            await AnnounceActionPerformable("hello").perform()
        with memory.recording.episode(description="theirs") as episode:
            episode.start("a", memory.recording.type("action", "AnnounceAction", {"words": "real"}), {"words": 1.0})
            episode.end("a")
        await memory.flush()
        assert memory.status.faults == (0, None)
    rows = ask(tmp_path / "memory.db", "SELECT words, words_real FROM announce_action ORDER BY id")
    assert rows == [("hello", None), (None, 1.0)]


@pytest.mark.parametrize(
    ("field", "kept"),
    [
        ("id", "id_text"),
        ("target frame", "target_frame"),
        ("2nd", "field_2nd"),
        ("_x", "x"),
        ("é", "é"),
        ("Ω-1", "Ω_1"),
    ],
)
def test_a_field_whose_name_cannot_be_a_column_gets_a_similar_one(tmp_path: Path, field: str, kept: str) -> None:
    assert recorded(tmp_path, "Odd", {field: "text", "plain": "text"}, {field: "a", "plain": "b"}) == (kept != field)
    assert ask(tmp_path / "memory.db", f'SELECT "{kept}", plain FROM odd') == [("a", "b")]


@pytest.mark.parametrize(
    ("dtype", "kept"),
    [("Say it!", "Say_it"), ("__start__", "start"), ("Event", "EventAction"), ("", "Unnamed"), ("7", "action_7")],
)
def test_a_type_whose_name_cannot_be_a_table_gets_a_similar_one(tmp_path: Path, dtype: str, kept: str) -> None:
    assert recorded(tmp_path, dtype, {"text": "text"}, {"text": "hi"}) == 1
    assert nodes(tmp_path)[0][0] == kept


def test_values_of_fields_without_a_type_are_missing_with_the_reason(tmp_path: Path) -> None:
    fields: dict[str, Any] = {"thing": object, "kind": "colour", "number": int}
    values = {"thing": 1, "kind": "red", "number": "no number", "undeclared": 4}
    assert recorded(tmp_path, "Odd", fields, values) == 6  # two types, and four values
    (started,) = [each for each in events(tmp_path, "NodeStarted") if "designator" in each]
    assert all("missing" in each for each in started["parameters"].values())
    assert started["parameters"]["number"]["missing"] == "declared as int, got a str"


@pytest.mark.slow
def test_a_node_of_a_type_that_cannot_be_declared_is_shown_as_its_kind(tmp_path: Path) -> None:
    assert recorded(tmp_path, "MoveTCPMotion", {}, {}) == 1  # it is a motion, not an action
    assert nodes(tmp_path) == [(None, None, "SUCCEEDED", None)]
    assert "── action  SUCCEEDED" in pycrorm("show", "last", "--url", url_of(tmp_path), cwd=tmp_path).stdout
