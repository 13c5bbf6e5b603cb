"""NEEMs of KnowRob become episodes, whatever is wrong with them."""

from __future__ import annotations

import gzip
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.imports import intake
from pycrorm_async.imports.neem import validate
from pycrorm_async.imports.registry import import_files
from tests.databases import ask
from tests.imports import neems
from tests.imports.importing import imported, poses, tree
from tests.imports.neems import BEGIN_S, SOMA
from tests.record.recordings import assert_verified

pytest.importorskip("bson")

UNREACHABLE = "ManipulationPoseUnreachable", f"{SOMA}CRAMManipulationPoseUnreachable_QWERTZUI"
TREE = [
    ("PhysicalTask", None, "UNKNOWN", 0.0, None),
    ("NavigateAction", "PhysicalTask", "SUCCEEDED", 1.0, 3.5),
    ("PickUpAction", "PhysicalTask", "FAILED", 4.0, 9.0),
    ("GripAction", "PickUpAction", "UNKNOWN", 5.0, 6.0),
    ("Accessing", "PickUpAction", "UNKNOWN", 6.0, 20.0),
    ("LookAtAction", None, "UNKNOWN", 7.0, None),
    ("Cutting", None, "UNKNOWN", 0.0, None),
]


def shown(file: Path) -> list[tuple[Any, ...]]:
    """Return the nodes with their times in s since the beginning, in an order of their own."""
    nodes = [
        (dtype, parent, status, start / 1e6 - BEGIN_S, None if end is None else round(end / 1e6 - BEGIN_S, 6))
        for dtype, parent, _kind, status, _reason, _message, start, end in tree(file)
    ]
    return sorted(nodes, key=lambda each: [row[0] for row in TREE].index(each[0]))


def test_a_neem_with_every_wart_keeps_its_tree_its_statuses_its_times_and_its_poses(tmp_path: Path) -> None:
    neem = neems.neem_folder(tmp_path / "neem")
    report = imported(tmp_path, "neem", neem)
    assert_verified(tmp_path)
    assert shown(tmp_path / "memory.db") == TREE
    [pick] = [each for each in tree(tmp_path / "memory.db") if each[0] == "PickUpAction"]
    assert pick[4:6] == UNREACHABLE
    [episode] = ask(
        tmp_path / "memory.db", "SELECT description, created_by, created_at, status, metadata FROM process_metadata"
    )
    assert episode[:4] == ("Breakfast", "ada", round(BEGIN_S * 1e6), "UNKNOWN")
    assert '"url":"https://example.org/neem"' in episode[4]
    tags = "SELECT tag FROM episode_tag ORDER BY tag"
    assert ask(tmp_path / "memory.db", tags) == [("kitchen",), ("pr2",)]
    columns = "SELECT iri, task_class, performer, role_item, grasp_type, label FROM pick_up_action"
    [pick_up] = ask(tmp_path / "memory.db", columns)
    assert pick_up == (
        f"{SOMA}Action_PICKAAAA", f"{SOMA}PickingUp", neems.PR2, neems.MILK, "TopGrasp", "lang(en,'pick it up')",
    )  # fmt: skip
    places = poses(tmp_path / "memory.db")
    assert [each for each in places if each[0] == "Bowl_ABCDEFGH"] == [
        ("Bowl_ABCDEFGH", "BOWL", 1.5, -2, 0.85, 0, 0, 1, 0)
    ]
    assert [round(each[2], 9) for each in places if each[0] == "PR2_0"] == [index / 100 for index in range(60)]
    assert [(round(each[2], 9), each[4]) for each in places if each[0] == "Milk_ABCDEFGH"][:2] == [
        (0.5, 0.75),
        (0.51, 0.75),
    ]
    assert report.left_out["triples", "they belong to an ontology, which every NEEM copies"] == 1
    assert report.left_out["triples", "they have neither `o` nor `v`"] == 1
    assert report.left_out["participants", "they are the literal NIL"] == 2
    assert report.left_out["checks", "actions that were never closed"] == 2
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory:
        camera = memory.samples("tf base_footprint camera")
        picked = memory.ask.success_rates(dtype="PickUpAction").rows()
    assert camera[["x", "z"]].drop_duplicates().to_numpy().tolist() == [[0.25, 1.5]]
    assert len(camera) == 60
    assert [(each.times, each.failed) for each in picked] == [(1, 1)]


@pytest.mark.parametrize(
    "make",
    [
        lambda folder: neems.exported_folder(folder / "exported"),
        lambda folder: neems.interchange_file(folder / "neem.json"),
        lambda folder: neems.json_ld_file(folder / "neem.jsonld"),
        lambda folder: _compressed(neems.neem_folder(folder / "neem")),
    ],
    ids=["mongoexport", "interchange", "json-ld", "gzip"],
)
def test_each_format_gives_the_same_tree(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    imported(tmp_path, "neem", make(tmp_path))
    assert shown(tmp_path / "memory.db") == TREE


def _compressed(folder: Path) -> Path:
    for file in list(folder.rglob("*.bson")):
        file.with_name(f"{file.name}.gz").write_bytes(gzip.compress(file.read_bytes()))
        file.unlink()
    return folder


def test_the_same_neem_is_imported_once_and_several_neems_of_one_dump_each(tmp_path: Path) -> None:
    dump = tmp_path / "neems"
    for name in ("aaa", "bbb"):
        neems.bson_file(dump / f"{name}_triples.bson", neems.statements())
        neems.bson_file(dump / f"{name}_tf.bson", neems.moves(count=1))
    neems.bson_file(
        dump / "meta.bson", [{**neems.META, "_id": "bbb", "name": "b"}, {**neems.META, "_id": "aaa", "name": "a"}]
    )
    first, again = (imported(tmp_path, "neem", dump) for _ in range(2))
    assert [(each.description, each.state) for each in first.episodes] == [("a", "imported"), ("b", "imported")]
    assert [each.state for each in again.episodes] == ["already stored"] * 2
    assert ask(tmp_path / "memory.db", "SELECT count(*) FROM pick_up_action") == [(2,)]


@pytest.mark.parametrize("hours", [-2, 1])
def test_a_clock_of_tf_that_is_hours_off_is_corrected(tmp_path: Path, hours: int) -> None:
    neem = neems.neem_folder(tmp_path / "neem", neems.moves(hours, jump_at=30))
    report = imported(tmp_path, "neem", neem)
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory:
        stamps = memory.samples("tf base_footprint camera")["ns"].tolist()
    seconds = [round(each / 1e9 - BEGIN_S, 3) for each in stamps]
    assert seconds == [round(index / 10, 3) for index in range(60)]
    assert report.left_out["clocks", "tf jumps back by 1 h; its times are corrected"] == 1


def test_a_file_that_is_cut_gives_what_stands_before(tmp_path: Path) -> None:
    neem = neems.neem_folder(tmp_path / "neem")
    tf = neem / "tf/roslog/tf.bson"
    tf.write_bytes(tf.read_bytes()[:-100])
    report = imported(tmp_path, "neem", neem)
    assert report.cut == [f"{neem} ends in the middle of document 180; those before are imported"]
    assert shown(tmp_path / "memory.db") == TREE


@pytest.mark.parametrize(("name", "content"), [("triples.bson", b"\x00" * 40), ("x.json", b"no json"), ("x.json", b"")])
def test_what_is_no_neem_is_refused_in_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CallerError, match=r"is no|has no"):
        import_files("neem", [tmp_path / name], None)
    shutil.copy(tmp_path / name, tmp_path / "readme.txt")
    (tmp_path / name).unlink()
    with pytest.raises(CallerError, match="has no collection of a NEEM"):
        import_files("neem", [tmp_path], None)


def test_validation_counts_what_is_incomplete(tmp_path: Path) -> None:
    assert validate(neems.neem_folder(tmp_path / "neem")) == {
        "actions without a time interval": 1,
        "actions that were never closed": 2,
        "actions without participants": 5,
        "participants without a role": 1,
        "objects without a location": 1,
        "objects without a shape": 2,
    }


def test_numbers_that_are_none_and_hostile_names_are_survived(tmp_path: Path) -> None:
    rows = neems.statements()
    hostile = "x\0'); DROP TABLE event;--\ud800"
    rows += [
        *neems.action("Action_HOSTILEA", "Stirring", "not a number", math.nan, participants=[hostile], state="Odd"),
        {"s": f"{SOMA}Action_HOSTILEA", "p": f"{SOMA}{hostile}", "o": hostile},
        {"s": hostile, "p": neems.TYPE, "o": f"{SOMA}{hostile}"},
        {"s": 7, "p": neems.TYPE, "o": 7},
        {"nothing": 1},
    ]
    (tmp_path / "neem").mkdir()
    (tmp_path / "neem/triples.json").write_text("".join(f"{json.dumps(each)}\n" for each in rows))
    report = imported(tmp_path, "neem", tmp_path / "neem")
    assert_verified(tmp_path)
    assert [each.nodes for each in report.episodes] == [8]
    assert report.left_out["documents", "they are no triples: subject or predicate is missing"] == 2


def test_the_questions_of_the_page_have_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(tmp_path, "neem", neems.neem_folder(tmp_path / "neem"))
    page = (Path(intake.__file__).parent / "neem.md").read_text()
    monkeypatch.chdir(tmp_path)
    wide = ("display.width", 10_000, "display.max_columns", None, "display.max_colwidth", None)
    with pd.option_context(*wide):
        exec(page.split("```python\n")[1].split("```")[0], {"__name__": "page"})
    answers = capsys.readouterr().out
    for each in ("GripAction", "ManipulationPoseUnreachable", "Breakfast", "tf base_footprint camera", "Accessing"):
        assert each in answers


def test_numbers_of_mongodb_times_and_metadata_of_any_kind_end_no_import(tmp_path: Path) -> None:
    rows = neems.statements()
    strange = ({"$numberDecimal": "abc"}, {"$numberLong": "x"}, {"$numberInt": None}, 10**400, 9e15)
    for index, value in enumerate(strange):
        rows += neems.action(f"Action_STRANGE{index}", "Stirring", BEGIN_S, value)
    (tmp_path / "neem").mkdir()
    lines = "".join(f"{json.dumps(each)}\n" for each in rows)
    (tmp_path / "neem/triples.json").write_text(lines + '{"o": ' + "[" * 100_000 + "]" * 100_000 + "}")
    (tmp_path / "neem/annotations.json").write_bytes(b"")  # what mongoexport writes of an empty collection
    (tmp_path / "neem/meta.json").write_text(json.dumps({"_id": "\ud800", "keywords": 5}))
    report = imported(tmp_path, "neem", tmp_path / "neem")
    assert_verified(tmp_path)
    assert [each.nodes for each in report.episodes] == [12]
    assert report.left_out["times", "they are before 1677 or after 2262; the nearest moment takes their place"] == 2
    assert len(report.cut) == 1


def test_a_failed_action_of_a_neem_in_which_nothing_ended_ends_with_the_last_start(tmp_path: Path) -> None:
    rows = [each | {"o": "Infinity"} if each["p"].endswith("End") else each for each in neems.statements()]
    (tmp_path / "triples.json").write_text("".join(f"{json.dumps(each)}\n" for each in rows))
    imported(tmp_path, "neem", tmp_path / "triples.json")
    [[ended]] = ask(
        tmp_path / "memory.db", "SELECT min(wall_ns) FROM event WHERE type IN ('NodeEnded', 'EpisodeEnded')"
    )
    assert ended == round((BEGIN_S + 7) * 1000) * 1_000_000


@pytest.mark.parametrize("damage", [lambda content: content[:-9], lambda content: content[:60] + b"\xff" * 60])
def test_a_compressed_file_that_is_damaged_is_one_line_of_the_report(tmp_path: Path, damage: Any) -> None:
    neem = neems.neem_folder(tmp_path / "neem")
    file = neem / "annotations/roslog/annotations.bson"
    noise = json.dumps([str(each**7) for each in range(500)])
    neems.bson_file(file, [{"s": f"{SOMA}Milk", "p": "comment", "v": noise}])
    file.with_name("annotations.bson.gz").write_bytes(damage(gzip.compress(file.read_bytes())))
    file.unlink()
    report = imported(tmp_path, "neem", neem)
    assert [len(report.cut), shown(tmp_path / "memory.db")] == [1, TREE]
