"""An executive may hand over anything, at any moment, and no episode stops, hangs or loses the rest."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import (
    EpisodeEnded,
    FailureValue,
    NodeReference,
    ObjectReference,
    ObjectValue,
    PoseValue,
    RobotValue,
    SeenValue,
)
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.world import ObjectType
from pycrorm_async.world.pose import Pose
from tests.record.recordings import AT_END, HERE, Recorded, events, nodes, record, url_of

# === hostile values ===========================================================================================
#
# An executive may hand over anything, from anywhere, and no episode stops, hangs or loses the rest.

AT = PoseValue((1, 2, 3), (0, 0, 0, 1), "map", 0)


class Faulty:
    """Its methods raise."""

    def __float__(self) -> float:
        raise OverflowError("no number")

    def __str__(self) -> str:
        raise RuntimeError("no text")

    def __repr__(self) -> str:
        raise RuntimeError("no repr")

    def __hash__(self) -> int:
        raise RuntimeError("no hash")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("no comparison")


RECURSIVE: list[Any] = []
RECURSIVE.append(RECURSIVE)
BROKEN: list[Any] = [
    PoseValue((1, 2, 3), (0, 0, 0, 1), "map", "soon"),  # type: ignore[arg-type]
    PoseValue((True, 2, 3), (0, 0, 0, 1), "map", 0),
    PoseValue((1, 2), (0, 0, 0, 1), "map", 0),  # type: ignore[arg-type]
    PoseValue((math.nan, 2, 3), (0, 0, 0, 1), "map", 0),
    ObjectReference("a", "b"),  # type: ignore[arg-type]
    ObjectReference(0, 0),
    ObjectReference(99, 99),
    ObjectReference(2**63, 2**63),
    ObjectValue("Rubbish", "x"),  # type: ignore[arg-type]
    ObjectValue("Object", 3),  # type: ignore[arg-type]
    ObjectValue("Object", "x", None, PoseValue((1, 2), (0, 0, 0, 1), "map", 0)),  # type: ignore[arg-type]
    ObjectValue("ObjectPart", "x", None, None, ObjectReference(50, 50)),
    Faulty(),
    RECURSIVE,
    b"bytes",
    "\ud800",
    10**400,
    np.float32("nan"),
]


@pytest.mark.parametrize("kind", ["pose", "object", "real", "text"])
def test_no_parameter_stops_the_episode(tmp_path: Path, kind: Any) -> None:
    def write(recording: Recording, episode: RecordedEpisode) -> None:
        one = recording.type("action", "One", {"it": kind})
        many = recording.type("action", "Many", {"it": ("list", kind)})
        for number, value in enumerate(BROKEN):
            for key, declared, given in ((number, one, value), (-number - 1, many, [value])):
                episode.start(key, declared, {"it": given})
                episode.observe("it", {"it": given}, node=key)
                episode.end(key, "FAILED", FailureValue("a", "b", [value]), result=[value])

    record(tmp_path, write, Settings(fold="at_end"))
    assert len(nodes(tmp_path)) == 2 * len(BROKEN)
    assert {row[2] for row in nodes(tmp_path)} == {"FAILED"}


def test_a_faulty_part_costs_no_node_and_no_object(tmp_path: Path) -> None:
    broken: Any = RobotValue("here", "R")  # type: ignore[arg-type]
    robots: tuple[Any, ...] = ([1], broken, RobotValue(AT, "R", None, ObjectReference(0, 0)), "never added", Faulty())

    def write(recording: Recording, episode: RecordedEpisode) -> None:
        declared = recording.type("action", "Step", {"x": float})
        for number, anything in enumerate(robots):
            episode.start(number, declared, {"x": 1.0}, robot=anything)
            episode.end(number)
        parents: tuple[Any, ...] = ([1], Faulty(), "never")
        for number, anything in enumerate(parents, 100):
            episode.start(number, declared, {"x": 1.0}, parent=anything)
            episode.end(number)
        parameters: tuple[Any, ...] = (None, [1], 3, {Faulty: 1})
        for number, anything in enumerate(parameters, 200):
            episode.start(number, declared, anything)
            episode.end(number)
        parts: list[dict[str, Any]] = [
            {"joints": {"x": None, "y": 1.0, "z": math.nan, "n": np.float32(2.0)}},
            {"joints": 3},
            {"mass_kg": np.float32(1.0)},
            {"mass_kg": "heavy"},
            {"color": (1, 2, math.nan, 1)},
            {"color": "red"},
            {"urdf": 3},
            {"urdf": "no xml"},
            {"model": 3, "serial": Faulty()},
        ]
        for number, each in enumerate(parts):
            episode.object_added(number, "thing", ObjectType.MILK, HERE, **each)
            episode.object_moved(number, Pose([2, 0, 0]))
        episode.joints_moved(0, {"x": math.inf})

    missing = record(tmp_path, write, Settings(fold="at_end")).missing
    assert missing.last == "JointsMoved.joints: inf: it must be a finite number"
    assert [row[2] for row in nodes(tmp_path)] == ["SUCCEEDED"] * (len(robots) + 3 + 4)
    added = events(tmp_path, "ObjectAdded")
    assert [each["object_type"] for each in added] == ["MILK"] * 9
    assert added[0]["joints"] == {"y": 1.0, "n": 2.0}
    assert len(events(tmp_path, "ObjectMoved")) == 9


def test_percepts_and_tags_that_do_not_fit_are_left_out(tmp_path: Path) -> None:
    anything: Any = [SeenValue("m", "MILK", AT, ObjectReference(0, 0)), SeenValue("m", 3, AT), 7]  # type: ignore[arg-type]

    def write(_: Recording, episode: RecordedEpisode) -> None:
        episode.detected(anything)
        episode.tag("x" * 200)
        episode.tag(anything)
        episode.tag("good", remove=["never had"])
        episode.tag("good")
        episode.wait_for_room(anything)
        assert not episode.is_open(anything)
        assert episode.reference(anything) is None
        episode.node_reference(anything)

    status = record(tmp_path, write)
    assert status.faults.total >= 5
    ((detected,),) = ([each["seen"]] for each in events(tmp_path, "ObjectDetected"))
    assert "object" not in detected
    assert [each.get("added") for each in events(tmp_path, "EpisodeTagged")] == [["good"]]


@pytest.mark.slow
def test_no_argument_of_a_type_raises(tmp_path: Path) -> None:
    hostile: tuple[Any, ...] = ([], None, 3, Faulty(), "\ud800", "x" * 2_000_000)

    def write(recording: Recording, episode: RecordedEpisode) -> None:
        for number, anything in enumerate(hostile):
            types = [
                recording.type(anything, "A"),
                recording.type("action", anything),
                recording.type("action", "B", anything),
                recording.type("action", "C", {"a": anything}),
                recording.type("action", "D", {"a": ("list", anything)}),
                recording.type("action", "E", concept=anything),
                recording.type("action", "F", bases=anything),
                recording.type("action", "G", aliases=anything),
            ]
            for declared in types:
                episode.start(number, declared, {"a": 1})
                episode.end(number)

    record(tmp_path, write, Settings(fold="at_end"))
    assert {row[2] for row in nodes(tmp_path)} == {"SUCCEEDED"}


def test_arguments_of_an_episode_that_would_stop_it_are_refused(tmp_path: Path) -> None:
    arguments: list[dict[str, Any]] = [
        *({name: 3} for name in ("description", "convert", "tags", "failures", "thought_by")),
        {"failures": ValueError},
        {"seed": True},
        {"seed": 2**70},
        {"simulated": "yes"},
        {"thought_by": "abc"},
        {"thought_by": NodeReference("no uuid", 1)},
        {"thought_by": NodeReference("0197d8a0-0000-7000-8000-000000000000", 2**63)},
    ]
    with Memory.sync(url_of(tmp_path), settings=AT_END) as memory:
        for each in arguments:
            with pytest.raises(CallerError):
                memory.recording.episode(**each)


@pytest.mark.slow
def test_contradicting_declarations_are_kept_apart_and_very_many_fields_are_bounded(tmp_path: Path) -> None:
    pairs: list[tuple[tuple[str, dict[str, Any]], tuple[str, dict[str, Any]]]] = [
        (("Step", {"a": "real"}), ("Step", {"A": "text"})),
        (("Turn", {"a": "real"}), ("turn", {"a": "real"})),
        (("Drive", {"a_id": "real"}), ("Drive", {"a": "pose"})),
        (("PickUpAction", {"zz": "text"}), ("PickUpAction", {"Arm": "real"})),
        (("Wide", {f"f{each}": "real" for each in range(300)}), ("Wide", {f"g{each}": "real" for each in range(300)})),
    ]
    value = {"real": 1.0, "text": "one", "pose": HERE}

    def write_all(place: int) -> Any:
        def write(recording: Recording, episode: RecordedEpisode) -> None:
            for dtype, fields in (pair[place] for pair in pairs):
                parameters = {name: value[kind] for name, kind in fields.items()}
                episode.start(1, recording.type("action", dtype, fields), parameters)
                episode.end(1)

        return record(tmp_path, write)

    write_all(0)  # in a memory that has ended, and in this one
    missing = write_all(1).missing
    assert missing.total > 90
    assert len(nodes(tmp_path)) == 2 * len(pairs)


def test_no_argument_of_an_end_raises(tmp_path: Path) -> None:
    class Incomparable:
        def __eq__(self, other: object) -> bool:
            raise OSError

        __hash__ = None  # type: ignore[assignment]

    anything: Any = Incomparable()
    with closing(Recorded(tmp_path, Settings())) as recorded:
        episode = recorded.recording.episode()
        episode.start(anything, anything)
        episode.end(anything, anything, anything, anything, below=anything)
        episode.close(anything, anything)
        ((*_, (_, ended)),) = recorded.logs()
    assert isinstance(ended, EpisodeEnded)
    assert ended.status == "ERROR"


# === hostile moments ==========================================================================================
#
# Calls at hostile moments: inside a lookup of another episode's key, or while the memory closes.


def test_an_episode_opened_after_closing_has_begun_is_counted_and_stays_empty(tmp_path: Path) -> None:
    with closing(Recorded(tmp_path, Settings())) as recorded:
        recorded.episodes.refuse_new()
        with recorded.recording.episode(description="late") as episode:
            episode.start(1, recorded.recording.type("action", "Step"))
            episode.end(1)
        assert recorded.episodes.all == ()
        assert recorded.logs() == []
        total, last = recorded.emitter.faults
    assert total == 3
    assert last is not None
