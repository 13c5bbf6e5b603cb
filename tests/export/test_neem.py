"""An exported NEEM is the folder that KnowRob reads, and our import of it gives the same episode."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.imports.registry import import_files
from pycrorm_async.world.pose import Pose
from tests.databases import ask
from tests.imports import neems
from tests.imports.importing import poses, tree
from tests.record.recordings import assert_verified, opened

bson = pytest.importorskip("bson")

SECOND = 1_000_000_000
START = 1_556_700_000 * SECOND + 123_456_789
SOMA = "http://www.ease-crc.org/ont/SOMA.owl#"
PLACE = "JOIN pose ON pose.id = object.pose_id"
DUL = "http://www.ontologydesignpatterns.org/ont/dul/DUL.owl#"


SAME = [
    "SELECT description, created_by, created_at, status FROM process_metadata",
    "SELECT tag FROM episode_tag ORDER BY tag",
    "SELECT result FROM task_tree_node WHERE result IS NOT NULL",
    f"SELECT arm, grasp, name, x FROM pick_up_action AS a JOIN object ON object.id = a.object_designator_id {PLACE}",
    "SELECT speed, note, x, y, frame FROM move_motion AS m LEFT JOIN pose ON pose.id = m.target_id ORDER BY m.id",
    f"SELECT object.time, x, y FROM object {PLACE} ORDER BY object.id",
]
"""Questions that a memory and the import of its export answer alike."""


def record(folder: Path) -> None:
    """Record an episode with all statuses, nested nodes, objects of one name, and poses less than a ms apart."""
    with opened(folder) as memory:
        recording = memory.recording
        pick = recording.type("action", "PickUpAction", {"object_designator": "object", "arm": "enum", "grasp": "enum"})
        drive = recording.type("motion", "MoveMotion", {"target": "pose", "speed": "real", "note": "text"})
        every = recording.type("language", "Sequential", {})
        tags = ["kitchen", "night"]
        with recording.episode(description="breakfast", at=START, created_by="ada", tags=tags) as episode:
            episode.object_added("robot", "pr2", "ROBOT", Pose([0.1, 0.2, 0]), at=START)
            episode.object_added("milk", "milk", "MILK", Pose([1, 2, 0.75], [0, 0, 0.6, 0.8]), at=START + 1)
            episode.object_added("other", "milk", "MILK", Pose([3, 2, 0.75]), at=START + 2)
            episode.start("all", every, at=START + SECOND)
            values = {"target": Pose([1 / 3, 0, 0]), "speed": 0.1, "note": "to\nthe <table>"}
            episode.start("drive", drive, values, parent="all", robot="robot", at=START + SECOND + 7)
            for step in range(5):
                episode.object_moved("robot", Pose([step / 7, 0, 0]), node="drive", at=START + SECOND + 10_000 * step)
            episode.end("drive", "SUCCEEDED", at=START + 2 * SECOND + 999, result={"way": 1.5})
            values = {"object_designator": "other", "arm": "LEFT", "grasp": "TOP"}
            episode.start("pick", pick, values, parent="all", robot="robot", at=START + 2 * SECOND + 1_001)
            failure = "NavigationGoalNotReached", "0.3 m away"
            episode.end("pick", "FAILED", failure, at=START + 3 * SECOND)
            for status in ("ERROR", "CANCELLED", "INTERRUPTED", "UNKNOWN", "LOST"):
                episode.start(status, drive, {}, parent="all", at=START + 3 * SECOND)
                episode.end(status, status, at=START + 4 * SECOND, untimed=status == "UNKNOWN")
            episode.end("all", "FAILED", at=START + 5 * SECOND)
            episode.close(status="FAILED", at=START + 6 * SECOND)
        memory.flush()


def exported(folder: Path, target: Path, episode: str = "last") -> Path:
    with Memory.sync(f"sqlite:///{folder}/memory.db") as memory:
        memory.export(episode, target, file_format="neem")
    return target


def imported(folder: Path, neem: Path) -> Path:
    folder.mkdir()
    with opened(folder) as memory:
        import_files("neem", [neem], memory.recording)
        assert memory.status.faults.total == 0, memory.status.faults
    assert_verified(folder)
    return folder / "memory.db"


def test_an_import_of_an_export_gives_the_same_tree_statuses_times_and_poses(tmp_path: Path) -> None:
    record(tmp_path)
    again = imported(tmp_path / "again", exported(tmp_path, tmp_path / "neem"))
    source = tmp_path / "memory.db"
    assert len(tree(source)) == 8
    assert tree(again) == tree(source)
    assert poses(again) == poses(source)
    for statement in SAME:
        assert ask(again, statement) == ask(source, statement), statement


def test_the_folder_is_that_of_knowrob(tmp_path: Path) -> None:
    record(tmp_path)
    neem = exported(tmp_path, tmp_path / "neem")
    files = sorted(str(each.relative_to(neem)) for each in neem.rglob("*.*") if "manifest" not in each.name)
    assert files == sorted(
        f"{kind}/roslog/{kind}.{suffix}"
        for kind in ("annotations", "inferred", "meta", "tf", "triples")
        for suffix in ("bson", "metadata.json")
    )
    facts: list[dict[str, Any]] = bson.decode_all((neem / "triples/roslog/triples.bson").read_bytes())
    assert {frozenset(each) for each in facts} == {frozenset(("_id", "s", "p", "o", "p*", "o*", "graph", "scope"))}
    of = {(each["s"], each["p"]): each["o"] for each in facts}
    [pick] = [each["s"] for each in facts if each["o"] == f"{SOMA}PickingUp"]
    [action] = [each["s"] for each in facts if each["p"] == f"{DUL}executesTask" and each["o"] == pick]
    assert of[action, f"{SOMA}hasExecutionState"] == f"{SOMA}ExecutionState_Failed"
    assert of[action, f"{DUL}satisfies"].startswith(f"{SOMA}NavigationGoalNotReached_")
    interval = of[action, f"{DUL}hasTimeInterval"]
    begin, end = (of[interval, f"{SOMA}hasInterval{each}"] for each in ("Begin", "End"))
    assert (begin, end) == (1_556_700_002.123457, 1_556_700_003.123456)
    [above] = [each["o*"] for each in facts if each["o"] == f"{SOMA}PickingUp"]
    assert above[:3] == [f"{SOMA}PickingUp", f"{SOMA}Manipulating", f"{SOMA}PhysicalTask"]
    notes: list[dict[str, Any]] = bson.decode_all((neem / "annotations/roslog/annotations.bson").read_bytes())
    assert {frozenset(each) for each in notes} == {frozenset(("_id", "s", "p", "v"))}
    assert {each["p"] for each in notes} == {f"{neems.RDFS}label", "urn:pycrorm:neem#node"}
    assert not {each["p"] for each in facts} & {each["p"] for each in notes}
    indexes = {
        kind: [
            [*each["key"]] for each in json.loads((neem / f"{kind}/roslog/{kind}.metadata.json").read_text())["indexes"]
        ]
        for kind in ("triples", "annotations", "tf", "inferred")
    }
    assert indexes == {
        "triples": [
            ["_id"], ["s"], ["p"], ["o"], ["p*"], ["o*"], ["s", "p"], ["s", "o"], ["o", "p"], ["s", "p*"], ["s", "o*"],
            ["o", "p*"], ["p", "o*"], ["s", "o", "p"], ["s", "o", "p*"], ["s", "o*", "p"],
        ],
        "annotations": [["_id"], ["s"], ["p"], ["s", "p"]],
        "tf": [["_id"], ["header.stamp"], ["header.stamp", "child_frame_id"]],
        "inferred": [["_id"]],
    }  # fmt: skip
    [first, *_] = bson.decode_all((neem / "tf/roslog/tf.bson").read_bytes())
    assert (first["header"]["frame_id"], first["child_frame_id"], first["transform"]["translation"]["x"]) == (
        "map", "pr2", 0.1,
    )  # fmt: skip


def test_a_neem_goes_out_as_it_came_in(tmp_path: Path) -> None:
    source = imported(tmp_path / "first", neems.neem_folder(tmp_path / "neem"))
    again = imported(tmp_path / "second", exported(tmp_path / "first", tmp_path / "out"))
    assert tree(again) == tree(source)
    assert sorted(poses(again)) == sorted(poses(source))
    iris = "SELECT iri, task, task_class, performer FROM pick_up_action"
    assert ask(again, iris) == ask(source, iris)
    frames = []
    for folder in ("first", "second"):
        with Memory.sync(f"sqlite:///{tmp_path}/{folder}/memory.db") as memory:
            frames.append(memory.samples("tf base_footprint camera"))
    assert frames[0].equals(frames[1])


def test_a_neem_holds_one_episode(tmp_path: Path) -> None:
    record(tmp_path)
    record(tmp_path)
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory, pytest.raises(CallerError, match="one"):
        memory.export([1, 2], tmp_path / "neem", file_format="neem")
