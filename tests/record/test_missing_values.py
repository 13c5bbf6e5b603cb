"""A plan that runs without a memory runs with one: an unrecordable value is missing, counted, and warned about once."""

from __future__ import annotations

import asyncio
import decimal
import enum
import logging
import math
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, Happening, NodeEnded, NodeStarted, ObjectAdded
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.record import values as missing_values
from pycrorm_async.settings import Settings
from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.models import built_in_urdf
from tests.record.fakes import NoteActionPerformable, findings, recorder_case


@dataclass
class Inner:
    depth: Any = 1.0
    """A value of no type that a column has."""
    width: float = 2.0


@dataclass
class AnythingActionPerformable(ActionAbstract):
    """An action whose fields all get the same value, whatever their types."""

    integer: int
    real: float
    text: str
    flag: bool
    arm: Arms
    pose: Pose
    thing: ObjectDesignator
    texts: list[str]
    reals: dict[str, float]
    odd: set[bytes]
    inner: Inner
    note: str = "kept"
    _raised: BaseException | None = None

    async def perform(self) -> Any:
        if self._raised is not None:
            raise self._raised
        return self.odd


nasty: ContextVar[bool] = ContextVar("nasty", default=False)
"""Other tests inspect every object of the process, and these values must permit that."""


class Raising(str):
    """A value that raises in every method that it can."""

    __slots__ = ()

    def __raise(self, *_: object) -> Any:
        if nasty.get():
            raise RuntimeError("read me not")
        return "raising"

    __repr__ = __str__ = __float__ = __len__ = __iter__ = encode = replace = __raise  # type: ignore[assignment]


class RaisingAny:
    def __getattribute__(self, name: str) -> Any:
        if nasty.get():
            raise LookupError(f"\x00\ud800{name}")
        return super().__getattribute__(name)

    def __repr__(self) -> str:
        if nasty.get():
            raise RuntimeError("no repr")
        return "raising"


class Foreign(enum.Enum):
    """A member of another enum than the declared one, whose names cannot be recorded."""

    ODD = math.nan


def circle() -> list[Any]:
    """Return a list that contains itself ten times, at every depth."""
    round_: list[Any] = []
    round_.extend([round_] * 10)
    return round_


LONG_NAMED = type("Long" * 30_000, (Exception,), {"__module__": "\ud800"})
SCALARS = [
    math.nan, math.inf, "\x00", "\ud800", "x" * 5_000, b"\xff", 2**70, decimal.Decimal("NaN"), object(), Raising("x"),
    RaisingAny(), Foreign.ODD, ObjectType.MILK, Pose([math.nan, 0, 0]), Pose(frame="\ud800"), np.float64("nan"),
    np.zeros((40, 40)), np.array(None), np.datetime64("NaT", "s"), lambda: None, int, asyncio, LookupError("\ud800"),
    range(10**12), {1: 2}, {"a": {"b": [math.nan]}}, memoryview(b"x"), circle(), Inner(math.nan, -1), 10**5_000,
]  # fmt: skip


class Nasty(NamedTuple):
    """A placeholder for one of `SCALARS`, some of which cannot even be printed."""

    number: int


NASTY = st.builds(Nasty, st.integers(0, len(SCALARS) - 1))
VALUES = st.recursive(
    NASTY | st.floats() | st.text() | st.binary() | st.integers() | st.none() | st.booleans(),
    lambda each: st.lists(each, max_size=4) | st.dictionaries(st.text(), each, max_size=4),
    max_leaves=6,
)
FAILURES = st.tuples(st.sampled_from([ValueError, LONG_NAMED, ExceptionGroup]), NASTY)


def meant(value: Any) -> Any:
    if isinstance(value, Nasty):
        return SCALARS[value.number]
    if isinstance(value, list):
        return [meant(each) for each in value]
    return {key: meant(each) for key, each in value.items()} if isinstance(value, dict) else value


def failure_of(kind: Any, value: Any) -> BaseException:
    return ExceptionGroup("many", [OSError(value)]) if kind is ExceptionGroup else kind(value)


def outcome_of(action: ActionAbstract) -> list[Any]:
    """Return its result or what it raised; no task holds it, because asyncio prints the results of its tasks."""
    outcome: list[Any] = []

    async def plan() -> None:
        try:
            outcome.append(await action.perform())
        except BaseException as raised:  # noqa: BLE001  it is what is compared
            outcome.append(raised)

    asyncio.run(plan())
    return outcome


def started(events: list[tuple[int, Happening]]) -> NodeStarted:
    return next(event for _, event in events if isinstance(event, NodeStarted) and event.kind == "action")


@pytest.mark.slow
@pytest.mark.parametrize("bytes_max", [pytest.param(2**20, marks=pytest.mark.soak), 2**14])
@given(described=VALUES, fails=st.none() | FAILURES)
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
def test_a_memory_does_not_change_the_behaviour_of_a_plan(
    bytes_max: int, described: Any, fails: tuple[type, Any] | None
) -> None:
    value = meant(described)
    failure = failure_of(fails[0], meant(fails[1])) if fails is not None else None
    action = AnythingActionPerformable(
        value, value, value, value, value, value, value, value, value, value, Inner(value, 3.0), _raised=failure
    )
    (outcome,) = outcome_of(action)
    logging.disable()
    token = nasty.set(True)
    try:
        with recorder_case(Settings(record_bytes_max=bytes_max)) as case, case.episode() as episode:
            (recorded_outcome,) = outcome_of(action)
            is_same = recorded_outcome is outcome
            assert is_same
        assert case.emitter.faults.total == 0, case.emitter.faults.last
        events = case.sink.of(episode)
        assert findings(events) == []
        start = started(events)
        assert start.parameters["note"] == "kept"
        assert start.parameters["inner_width"] == 3.0
        end = next(event for _, event in events if isinstance(event, NodeEnded))
        assert end.status == ("SUCCEEDED" if failure is None else "ERROR")
    finally:
        nasty.reset(token)
        logging.disable(logging.NOTSET)


async def test_unrecordable_values_are_counted_and_warned_about_once_for_each_type_and_field(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with recorder_case() as case, case.episode() as episode:
        for _ in range(3):
            assert await NoteActionPerformable("a\x00", weight=math.nan).perform() == "a\x00"
    parameters = started(case.sink.of(episode)).parameters
    assert parameters["text"] == {"missing": "the text holds U+0000", "repr": "'a\\x00'"}
    assert parameters["weight"] == {"missing": "nan is not a finite number", "repr": "nan"}
    assert case.emitter.missing.count == (9, "NoteAction.result: the text holds U+0000")
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "NoteAction.text is recorded as missing",
        "NoteAction.weight is recorded as missing",
        "NoteAction.result is recorded as missing",
    ]


async def test_a_long_text_is_cut_and_marked_and_every_other_field_is_recorded() -> None:
    with recorder_case() as case, case.episode() as episode:
        await NoteActionPerformable("x" * 2**21, weight=2.5).perform()
    start = started(case.sink.of(episode))
    assert start.parameters["weight"] == 2.5
    assert (
        start.parameters["text"]["missing"]
        == "takes 2,097,154 bytes, 1,048,576 are allowed for the record (record_bytes_max)"
    )
    assert start.parameters["text"]["repr"].startswith("'xxxx")
    assert start.parameters["text"]["repr"].endswith("xxx'… (2,097,152 characters)")
    assert len(start.parameters["text"]["repr"]) < 250


@dataclass
class OddActionPerformable(ActionAbstract):
    """An action with a field of no type that a column has, one of an undefined type, and one with a reserved name."""

    odd: set[str]
    nowhere: Nowhere  # type: ignore[name-defined]  # noqa: F821  the fault here
    robot_state: str
    inner: Inner = field(default_factory=Inner)
    weight: float = 1.5

    async def perform(self) -> None:
        """Succeed without doing anything."""


async def test_fields_that_cannot_be_declared_are_missing_and_the_others_recorded() -> None:
    with recorder_case() as case, case.episode() as episode:
        await OddActionPerformable({"a"}, 3, "upright").perform()
    parameters = started(case.sink.of(episode)).parameters
    assert {name: value for name, value in parameters.items() if not isinstance(value, dict)} == {
        "robot_state_": "upright",
        "inner_width": 2.0,
        "weight": 1.5,
    }
    reasons = {name: value["missing"] for name, value in parameters.items() if isinstance(value, dict)}
    assert reasons.keys() == {"odd", "nowhere", "inner_depth"}
    assert reasons["odd"].startswith("has the type set[str], which has no column")
    assert reasons["nowhere"] == "has a type that cannot be resolved: name 'Nowhere' is not defined"
    assert parameters["odd"]["repr"] == "{'a'}"
    assert case.emitter.missing.count.total == 3
    (declared,) = [event for owner, _, event in case.sink.records if owner is None]
    assert [each.name for each in declared.fields] == ["robot_state_", "inner_width", "weight"]  # type: ignore[attr-defined]
    assert [each.slot for each in declared.fields] == [2, 3, 4]  # type: ignore[attr-defined]


async def test_nodes_of_a_class_that_cannot_be_declared_are_recorded_without_a_type() -> None:
    @dataclass
    class PoseActionPerformable(ActionAbstract):
        dtype = "Pose"
        text: str

        async def perform(self) -> str:
            return self.text

    with recorder_case() as case, case.episode() as episode:
        assert await PoseActionPerformable("a").perform() == "a"
    start = started(case.sink.of(episode))
    assert (start.designator, start.parameters) == (None, {"text": "a"})
    assert findings(case.sink.of(episode)) == []
    assert case.emitter.missing.count.total == 1
    assert "'pose', which the memory itself uses" in str(case.emitter.missing.count.last)


class Nameless(type):
    """The class of classes that raise where their names are read."""

    def __getattribute__(cls, name: str) -> Any:
        if nasty.get() and name in ("__name__", "__qualname__", "__module__"):
            raise RuntimeError(f"no {name}")
        return super().__getattribute__(name)


class NamelessValue(metaclass=Nameless):
    """A value whose class has no name that can be read."""


class NamelessError(Exception, metaclass=Nameless):
    """An error whose class has no name that can be read."""


async def test_nodes_end_although_the_names_of_classes_cannot_be_read(tmp_path: Path) -> None:
    anything: dict[str, Any] = dict.fromkeys(
        "integer real text flag arm pose thing texts reals odd".split(), NamelessValue()
    )
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="nameless"):
            nasty.set(True)
            await AnythingActionPerformable(**anything, inner=Inner()).perform()
            with pytest.raises(NamelessError):
                await AnythingActionPerformable(**anything, inner=Inner(), _raised=NamelessError("too dark")).perform()
            nasty.set(False)
        await memory.flush()
        assert memory.status.faults.total == 0
        ends = [(each.status, each.reason, each.failure_message) for each in await memory.tree(1)]
    assert ends[1:] == [("SUCCEEDED", None, None), ("ERROR", "NamelessError", "too dark")]


def test_warnings_are_bounded_by_a_number_of_fields(caplog: pytest.LogCaptureFixture) -> None:
    values = missing_values.MissingValues()
    for number in range(missing_values.WARNED_MAX + 50):
        values.note("AnAction", f"field_{number}", "it is odd")
    assert values.count.total == missing_values.WARNED_MAX + 50
    assert len(caplog.records) == missing_values.WARNED_MAX + 1
    warning = "more than 1000 fields have missing values; further ones are only counted in status"
    assert caplog.records[-1].getMessage() == warning
    assert len(values._warned) == missing_values.WARNED_MAX + 1


async def test_texts_of_an_episode_that_are_too_long_are_cut_and_marked() -> None:
    with recorder_case(Settings(record_bytes_max=4_000)) as case:
        episode = case.recorder.open_episode(description="d" * 3_000_000, plan="\x00p" * 6_000)
        case.recorder.close_episode(episode, None)
    start = case.sink.of(episode)[0][1]
    assert isinstance(start, EpisodeStarted)
    assert start.description == "d" * 1_000 + "… (3,000,000 characters)"
    assert start.plan == ("\\x00p" * 200) + "… (30,000 characters)"
    assert case.emitter.missing.count.total == 2


async def test_names_in_the_world_that_cannot_be_recorded_are_cleaned_and_cut() -> None:
    with recorder_case(Settings(record_bytes_max=8_000)) as case, case.episode() as episode, BulletWorld():
        carton = built_in_urdf("milk", ObjectType.MILK)
        Object("milk\x00" * 3_000, ObjectType.MILK, carton)
        cup = Object("cup\ud800", ObjectType.MILK, carton)
        cup.set_pose(Pose([1, 0, 0]))
    names = [event.name for _, event in case.sink.of(episode) if isinstance(event, ObjectAdded)]
    assert names == ["milk\\x00" * 125 + "… (24,000 characters)", "cup\\ud800"]
    assert findings(case.sink.of(episode)) == []
    assert case.emitter.faults.total == 0


async def test_of_two_worlds_in_one_episode_only_the_first_is_recorded(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with recorder_case() as case, case.episode() as episode, BulletWorld():
        Object("pr2", ObjectType.ROBOT, pose=Pose([1, 0, 0]))
        with BulletWorld() as second:
            other = Object("pr2", ObjectType.ROBOT, pose=Pose([2, 0, 0]))
            other.set_pose(Pose([3, 0, 0]))
            await NoteActionPerformable("in the second").perform()
            assert len(second.objects) == 1
        await NoteActionPerformable("in the first").perform()
    events = case.sink.of(episode)
    assert [event.pose.position[0] for _, event in events if isinstance(event, ObjectAdded)] == [1.0]
    robots = {
        event.parameters["text"]: event.robot and case.sink.robot_pose(episode, event).position[0]
        for _, event in events
        if isinstance(event, NodeStarted) and event.kind == "action"
    }
    assert robots == {"in the second": None, "in the first": 1.0}
    assert findings(events) == []
    assert isinstance(events[-1][1], EpisodeEnded)
    assert events[-1][1].status == "SUCCEEDED"
    assert case.emitter.faults.total == 0
    assert case.emitter.missing.count.total == 2
    assert [record.getMessage().partition(" is ")[0] for record in caplog.records] == [
        "Episode.second world",
        "Episode.robot of a second world",
    ]


# === missing ==================================================================================================
#
# A value that cannot be recorded is missing in the tables, all others are there, and no plan stops.


class HailActionPerformable(ActionAbstract):
    """A designator that is no dataclass: its fields are the parameters of its constructor."""

    def __init__(self, text: str, *names: str, loud: bool = False, tone=None) -> None:  # type: ignore[no-untyped-def]
        self.greeting = f"{text} {' '.join(names)}"
        self.tone = tone
        self.loud = not loud  # the argument is recorded, and not the attribute made of it

    async def perform(self) -> str:
        return self.greeting


class BellowActionPerformable(HailActionPerformable):
    def __init__(self, volume: float, **options: Any) -> None:
        super().__init__(**options)
        self.volume = volume


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_a_designator_that_is_no_dataclass_is_recorded_with_its_constructor_arguments(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode():
            await HailActionPerformable("hello", "ada", "bob", tone="warm").perform()
            await BellowActionPerformable(9.5, text="hey").perform()
        await memory.flush()
        greetings: Any = memory.mapped(HailActionPerformable)
        shouts: Any = memory.mapped(BellowActionPerformable)
        async with memory.session() as session:
            (greeting,) = (await session.scalars(select(greetings).where(greetings.dtype == "HailAction"))).all()
            (shout,) = (await session.scalars(select(shouts))).all()
            assert (greeting.text, greeting.loud) == ("hello", False)
            assert [(each.field, each.text) for each in greeting.items] == [("names", "ada"), ("names", "bob")]
            assert (shout.volume, shout.text, shout.loud) == (9.5, "hey", False)
        assert memory.status.missing.total == 1
        assert memory.status.missing.last == (
            "HailAction.tone: has no type: annotate it in `__init__`, for example `tone: str`"
        )
