"""Types of nodes become declarations, from classes and from names; what cannot have columns is refused by name."""

from __future__ import annotations

import enum
import json
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, NewType, get_args

import numpy as np
import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import DeclarationRefused
from pycrorm_async.events import types
from pycrorm_async.events.types import FieldDeclared
from pycrorm_async.plan import task
from pycrorm_async.plan.actions import PickUpActionPerformable
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.record.declarations import Declared, FieldSpec, KnownTypes
from pycrorm_async.record.plan_types import Declarations, built_in_declaration, declared_type
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Pose
from tests.databases import ask
from tests.record.recordings import assert_verified, events, nodes, record, url_of

# === declaration ==============================================================================================
#
# The fields of a designator class become a declaration; a class that cannot have columns is refused by name.


class Colour(enum.Enum):
    RED = 1


@dataclass
class Inner:
    depth: float
    side: Colour | None = None


Weight = NewType("Weight", float)


@dataclass
class EverythingActionPerformable(ActionAbstract):
    """One field of every kind."""

    count: int
    weight: Weight
    text: str
    flag: bool
    when: datetime
    colour: Colour
    where: Pose
    what: ObjectDesignator
    names: list[str]
    scores: dict[str, float]
    inner: Inner
    mode: Literal["fast", "slow"]
    number: int | float
    maybe: Arms | None = None
    poses: Sequence[Pose] = ()
    triple: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _private: int = 0
    made: int = field(init=False, default=3)

    async def perform(self) -> None:
        """Succeed without doing anything."""


def test_every_kind_of_field_has_its_column() -> None:
    declaration = declared_type(EverythingActionPerformable).declaration
    module = __name__
    assert declaration.fields == (
        FieldDeclared("count", "count", "integer", 2),
        FieldDeclared("weight", "weight", "real", 3),
        FieldDeclared("text", "text", "text", 4),
        FieldDeclared("flag", "flag", "boolean", 5),
        FieldDeclared("when", "when", "datetime", 6),
        FieldDeclared("colour", "colour", "enum", 7, enum=f"{module}.Colour"),
        FieldDeclared("where", "where_id", "pose", 8),
        FieldDeclared("what", "what_id", "object", 9),
        FieldDeclared("names", "names", "list", 10, item="text"),
        FieldDeclared("scores", "scores", "dict", 11, item="real"),
        FieldDeclared("inner_depth", "inner_depth", "real", 12),
        FieldDeclared("inner_side", "inner_side", "enum", 13, optional=True, enum=f"{module}.Colour"),
        FieldDeclared("mode", "mode", "text", 14),
        FieldDeclared("number", "number", "real", 15),
        FieldDeclared("maybe", "maybe", "enum", 16, optional=True, enum="pycrorm_async.world.enums.Arms"),
        FieldDeclared("poses", "poses", "list", 17, item="pose"),
        FieldDeclared("triple", "triple", "list", 18, item="real"),
    )
    assert (declaration.kind, declaration.dtype, declaration.table) == (
        "action",
        "EverythingAction",
        "everything_action",
    )


def test_a_subclass_of_an_action_names_its_ancestors() -> None:
    @dataclass
    class GentlePickUpActionPerformable(PickUpActionPerformable):
        force: float = 1.0

    declaration = declared_type(GentlePickUpActionPerformable).declaration
    assert declaration.bases == ("PickUpAction",)
    assert [each.name for each in declaration.fields] == ["object_designator", "arm", "grasp", "force"]


@pytest.mark.parametrize(
    "kind", [set[str], list, dict, dict[int, str], Any, bytes, list[list[int]], int | str, np.ndarray]
)
def test_a_field_without_a_column_is_refused_by_name_and_type(kind: Any) -> None:
    namespace = {"__annotations__": {"odd": kind}, "perform": EverythingActionPerformable.perform.__wrapped__}  # type: ignore[attr-defined]
    made: type[ActionAbstract] = dataclass(type("OddActionPerformable", (ActionAbstract,), namespace))
    with pytest.raises(DeclarationRefused, match="field 'odd' has the type"):
        declared_type(made)


def test_a_class_with_fields_that_is_no_dataclass_is_refused() -> None:
    class BareActionPerformable(ActionAbstract):
        text: str

        async def perform(self) -> None:
            """Succeed without doing anything."""

    with pytest.raises(DeclarationRefused, match="add @dataclass"):
        declared_type(BareActionPerformable)


def saying(place: int) -> type[ActionAbstract]:
    if place == 0:

        @dataclass
        class SayingActionPerformable(ActionAbstract):
            text: str

            async def perform(self) -> None:
                """Succeed without doing anything."""

        return SayingActionPerformable

    @dataclass
    class SayingAction(ActionAbstract):
        text: str

        async def perform(self) -> None:
            """Succeed without doing anything."""

    return SayingAction


def test_two_live_classes_with_one_dtype_are_refused_with_both_paths() -> None:
    first, second = saying(0), saying(1)
    declarations = Declarations(KnownTypes(built_in_declaration))
    seen: list[Declared] = []
    declarations.of(first, seen.append)
    with pytest.raises(DeclarationRefused) as refused:
        declarations.of(second, seen.append)
    assert "saying.<locals>.SayingActionPerformable" in str(refused.value)
    assert "saying.<locals>.SayingAction " in str(refused.value)
    assert len(seen) == 1


def test_a_class_defined_again_at_the_same_place_replaces_the_first() -> None:
    first, again = saying(0), saying(0)
    declarations = Declarations(KnownTypes(built_in_declaration))
    seen: list[Declared] = []
    one = declarations.of(first, seen.append)
    assert declarations.of(first, seen.append) is one
    declarations.of(again, seen.append)
    assert [each.type.fingerprint for each in seen] == [one.fingerprint, one.fingerprint]


def test_a_class_defined_again_with_another_type_is_refused_with_both_types() -> None:
    def counting(kind: type) -> type[ActionAbstract]:
        async def perform(self: Any) -> None:
            """Succeed without doing anything."""

        namespace = {"__annotations__": {"many": kind}, "perform": perform, "__qualname__": "CountingAction"}
        return dataclass(type("CountingAction", (ActionAbstract,), namespace))

    declarations = Declarations(KnownTypes(built_in_declaration))
    seen: list[Declared] = []
    declarations.of(counting(int), seen.append)
    with pytest.raises(DeclarationRefused, match="field 'many' was integer before and is real now"):
        declarations.of(counting(float), seen.append)
    assert len(seen) == 1


def test_a_class_with_the_name_of_a_built_in_one_is_refused() -> None:
    @dataclass
    class NavigateAction(ActionAbstract):
        where: str

        async def perform(self) -> None:
            """Succeed without doing anything."""

    with pytest.raises(DeclarationRefused, match=r"plan\.actions\.NavigateActionPerformable already has the dtype"):
        Declarations(KnownTypes(built_in_declaration)).of(NavigateAction, lambda _: None)


@pytest.mark.parametrize("dtype", ["we ird'", "pose__1", "", "1st", "a-b"])
def test_a_dtype_that_is_no_name_is_refused(dtype: str) -> None:
    namespace = {"dtype": dtype, "perform": EverythingActionPerformable.perform.__wrapped__}  # type: ignore[attr-defined]
    made: type[ActionAbstract] = type("OddActionPerformable", (ActionAbstract,), namespace)
    with pytest.raises(DeclarationRefused, match="is not a name"):
        declared_type(made)


def renamed(aliases: Any, name: str = "WelcomeAction", base: type[Any] = ActionAbstract) -> type[ActionAbstract]:
    async def perform(self: Any) -> None:
        """Succeed without doing anything."""

    return dataclass(type(name, (base,), {"aliases": aliases, "perform": perform, "__module__": __name__}))


def test_the_aliases_of_a_class_are_declared_and_not_inherited() -> None:
    welcome = renamed(("GreetAction", "SaluteAction"))
    assert declared_type(welcome).declaration.aliases == ("GreetAction", "SaluteAction")
    loud = type("LoudWelcomeAction", (welcome,), {"__module__": __name__})
    assert declared_type(loud).declaration.aliases == ()
    assert b"aliases" not in declared_type(loud).payload


@pytest.mark.parametrize(
    ("aliases", "reason"),
    [
        ("GreetAction", r"its aliases 'GreetAction' are not a tuple of names"),
        ((1,), r"its aliases \(1,\) are not a tuple of names"),
        (("Greet Action",), r"its alias 'Greet Action' is not a name"),
        (("WelcomeAction",), r"its alias 'WelcomeAction' is its current dtype"),
        (
            ("PickUpAction",),
            r"its alias 'PickUpAction' is the dtype of pycrorm_async\.plan\.actions\.PickUpActionPerformable",
        ),
        (("EverythingAction",), r"its alias 'EverythingAction' is the dtype of one of its base classes"),
    ],
)
def test_an_invalid_alias_is_refused(aliases: Any, reason: str) -> None:
    with pytest.raises(DeclarationRefused, match=reason):
        declared_type(renamed(aliases, base=EverythingActionPerformable))


def test_two_live_classes_with_one_former_name_are_refused() -> None:
    live = Declarations(KnownTypes(built_in_declaration))
    welcome, hello = renamed(("GreetAction",)), renamed(("GreetAction",), "HelloAction")
    live.of(welcome, lambda _: None)
    with pytest.raises(DeclarationRefused, match=r"WelcomeAction already has the alias 'GreetAction'"):
        live.of(hello, lambda _: None)


def test_a_users_mapped_class_belongs_to_its_designator_and_not_to_its_descendants() -> None:
    class Mapped:
        __tablename__ = "my_sayings"

    @dataclass
    class SayActionPerformable(ActionAbstract):
        text: str
        orm_class = Mapped

        async def perform(self) -> None:
            """Succeed without doing anything."""

    @dataclass
    class WhisperActionPerformable(SayActionPerformable):
        volume: float = 0.1

    assert declared_type(SayActionPerformable).declaration.table == "my_sayings"
    assert declared_type(WhisperActionPerformable).declaration.table == "whisper_action"


def test_names_that_no_database_accepts_are_mapped_to_others_by_the_name_alone() -> None:
    long = "x" * 70
    for names in ((long, "true"), ("true", "other", long)):
        made: Any = dataclass(
            type(
                "BoundsAction", (ActionAbstract,), {"__annotations__": dict.fromkeys(names, float), "perform": perform}
            )
        )
        columns = {each.name: each.column for each in declared_type(made).declaration.fields}
        assert (columns[long], columns["true"]) == ("x" * 47 + "_" + columns[long][48:], "_true")
        assert len(columns[long]) == 60
    reach: Any = dataclass(
        type("Reach" * 20 + "Action", (ActionAbstract,), {"__annotations__": {}, "perform": perform})
    )
    table = declared_type(reach).declaration.table
    assert (len(table), table[:36]) == (48, "reach_reach_reach_reach_reach_reach_")


async def perform(self: Any) -> None:
    """Succeed without doing anything."""


# === vocabulary ===============================================================================================
#
# The words of the plan layer and of the log are the same, though neither imports the other.


def test_the_kind_and_the_status_of_a_node_are_the_same_in_a_plan_and_in_the_log() -> None:
    assert get_args(task.NodeKind) == get_args(types.NodeKind) == ("root", "action", "motion", "language")
    in_the_plan = {status.name: status.value for status in TaskStatus}
    assert in_the_plan == {word: word for word in get_args(types.NodeStatus)}
    assert len(in_the_plan) == 8


# === recorded types ===========================================================================================
#
# Types of nodes that an executive declares by names, and the fields that cannot keep theirs.

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
    concept = "SELECT payload ->> 'concept' FROM pycrorm_declaration"
    assert ask(tmp_path / "memory.db", concept) == [("PickingUp",)]


def test_a_type_is_declared_when_it_is_asked_for_and_has_a_table_without_a_node(tmp_path: Path) -> None:
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory, memory.recording.episode(description="d"):
        memory.recording.type("action", "Wipe", {"surface": "text"})
    assert declared_dtypes(tmp_path) == ["Wipe"]
    assert ask(tmp_path / "memory.db", "SELECT surface FROM wipe") == []
    assert_verified(tmp_path)


def test_threads_that_ask_for_one_type_at_once_get_one_declaration(tmp_path: Path) -> None:
    declared: list[Any] = []
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


def test_a_field_whose_name_cannot_be_a_column_gets_a_similar_one(tmp_path: Path) -> None:
    reserved = {"id": "id_", "object": "object_"}
    similar = {"target frame": "target_frame", "2nd": "field_2nd", "_x": "x", "Ω-1": "Ω_1"}
    kept = {**reserved, **similar, "é": "é", "plain": "plain"}
    assert recorded(tmp_path, "Odd", dict.fromkeys(kept, "text"), {name: f"a {name}" for name in kept}) == len(similar)
    columns = ", ".join(f'"{each}"' for each in kept.values())
    assert ask(tmp_path / "memory.db", f"SELECT {columns} FROM odd") == [tuple(f"a {name}" for name in kept)]


def test_a_type_whose_name_cannot_be_a_table_gets_a_similar_one(tmp_path: Path) -> None:
    kept = {"Say it!": "Say_it", "__start__": "start", "Event": "EventAction", "": "Unnamed", "7": "action_7"}

    def write(recording: Recording, episode: RecordedEpisode) -> None:
        for dtype in kept:
            episode.start(dtype, recording.type("action", dtype, {"text": "text"}), {"text": "hi"})
            episode.end(dtype)

    assert record(tmp_path, write).missing.total == len(kept)
    assert [dtype for dtype, *_ in nodes(tmp_path)] == [*kept.values()]


def test_a_node_of_a_type_that_cannot_be_declared_has_no_type(tmp_path: Path) -> None:
    assert recorded(tmp_path, "MoveTCPMotion", {}, {}) == 1  # it is a motion, not an action
    assert nodes(tmp_path) == [(None, None, "SUCCEEDED", None)]


def test_a_seam_keeps_a_reserved_name_as_designators_do_and_an_older_memory_as_it_began(tmp_path: Path) -> None:
    assert recorded(tmp_path, "Odd", {"kind_text": "text"}, {"kind_text": "old"}) == 0
    assert recorded(tmp_path, "Odd", {"kind": "text"}, {"kind": "new"}) == 1
    values = {"kind": "a", "Kind": 1.5, "kind_": "b"}
    assert recorded(tmp_path, "Even", {"kind": "text", "Kind": "real", "kind_": "text"}, values) == 0
    assert ask(tmp_path / "memory.db", "SELECT kind_text FROM odd ORDER BY id") == [("old",), ("new",)]
    assert ask(tmp_path / "memory.db", "SELECT kind__, Kind___, kind_ FROM even") == [("a", 1.5, "b")]


def test_values_of_fields_without_a_type_are_missing_with_the_reason(tmp_path: Path) -> None:
    fields: dict[str, Any] = {"thing": object, "kind": "colour", "number": int}
    values = {"thing": 1, "kind": "red", "number": "no number", "undeclared": 4}
    assert recorded(tmp_path, "Odd", fields, values) == 6  # two types, and four values
    (started,) = [each for each in events(tmp_path, "NodeStarted") if "designator" in each]
    assert all("missing" in each for each in started["parameters"].values())
    assert started["parameters"]["number"]["missing"] == "declared as int, got a str"
