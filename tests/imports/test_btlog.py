"""Logs of BehaviorTree.CPP 4 become episodes. The bytes are made as its FileLogger2 and SqliteLogger write them."""

from __future__ import annotations

import re
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.imports.registry import import_files
from tests.databases import ask
from tests.imports.importing import imported, tree

START_US = 1_700_000_000_000_000
IDLE, RUNNING, SUCCESS, FAILURE, SKIPPED = range(5)
XML = """<root BTCPP_format="4">
 <BehaviorTree ID="Main" _fullpath="">
  <Sequence name="serve" _uid="1">
   <BatteryOk name="BatteryOk" _uid="2"/>
   <SubTree ID="Fetch" _fullpath="Fetch::3" _uid="3"/>
   <Inverter name="Inverter" _uid="6"><Wait name="Wait" msec="100" _uid="7"/></Inverter>
  </Sequence>
 </BehaviorTree>
 <BehaviorTree ID="Fetch" _fullpath="Fetch::3">
  <ReactiveSequence name="ReactiveSequence" _uid="4"><MoveBase name="go" goal="{table}" _uid="5"/></ReactiveSequence>
 </BehaviorTree>
 <TreeNodesModel>
  <Condition ID="BatteryOk"/><Action ID="MoveBase"/><Action ID="Wait"/><Control ID="Sequence"/>
 </TreeNodesModel>
</root>"""
TRANSITIONS = [
    (0, 1, RUNNING),
    (10, 2, SUCCESS),
    (11, 2, IDLE),
    (15, 2, SUCCESS),  # the same answer below the same activation
    (20, 3, RUNNING),
    (21, 4, RUNNING),
    (22, 5, RUNNING),
    (40, 5, IDLE),  # halted
    (41, 4, FAILURE),
    (42, 3, FAILURE),
    (50, 7, SUCCESS),  # the inverter above it never reported that it runs
    (51, 6, FAILURE),
    (55, 99, SUCCESS),
    (60, 1, FAILURE),
    (61, 1, IDLE),
    (70, 1, RUNNING),
]
NODES = [
    ("Sequence", None, "language", "FAILED", 0, 60),
    ("BatteryOk", "Sequence", "action", "SUCCEEDED", 10, 10),
    ("Fetch", "Sequence", "language", "FAILED", 20, 42),
    ("ReactiveSequence", "Fetch", "language", "FAILED", 21, 41),
    ("MoveBase", "ReactiveSequence", "action", "INTERRUPTED", 22, 40),
    ("Inverter", "Sequence", "language", "FAILED", 50, 51),
    ("Wait", "Inverter", "action", "SUCCEEDED", 50, 50),
    ("Sequence", None, "language", "UNKNOWN", 70, None),
]


def btlog(transitions: list[tuple[int, int, int]], xml: str = XML) -> bytes:
    encoded = xml.encode()
    header = b"BTCPP4-FileLogger2\1" + struct.pack("<i", len(encoded)) + encoded + struct.pack("<q", START_US)
    rows = (struct.pack("<Q", time % 2**48)[:6] + struct.pack("<HB", uid, status) for time, uid, status in transitions)
    return header + b"".join(rows)


def nodes(file: Path, episode: int = 1) -> list[tuple[object, ...]]:
    """Return dtype, dtype of the parent, kind, status, and start and end in µs since the start of the log."""
    return [
        (*row[:4], row[6] - START_US, row[7] - START_US if row[7] is not None else None) for row in tree(file, episode)
    ]


def test_activations_of_a_btlog_are_nodes_with_their_parents_statuses_and_times(tmp_path: Path) -> None:
    (tmp_path / "run.btlog").write_bytes(btlog(TRANSITIONS))
    report = imported(tmp_path, "btlog", tmp_path / "run.btlog")
    assert nodes(tmp_path / "memory.db") == NODES
    assert {what: count for (what, _), count in report.left_out.items()} == {
        "answers of conditions": 1,
        "transitions": 1,
    }
    assert ask(tmp_path / "memory.db", "SELECT name, goal FROM move_base") == [("go", "{table}")]
    assert ask(tmp_path / "memory.db", "SELECT status, description FROM process_metadata") == [
        ("FAILED", "serve (run.btlog)")
    ]


def test_a_btlog_cut_in_a_transition_is_imported_up_to_it_and_a_clock_set_back_is_kept(tmp_path: Path) -> None:
    (tmp_path / "run.btlog").write_bytes(btlog([(5, 1, RUNNING), (-7, 2, SUCCESS), (9, 1, SUCCESS)])[:-4])
    report = imported(tmp_path, "btlog", tmp_path / "run.btlog")
    assert report.cut == [f"{tmp_path}/run.btlog ends in the middle of a transition: its last 5 bytes are left out"]
    assert nodes(tmp_path / "memory.db") == [
        ("Sequence", None, "language", "UNKNOWN", 5, None),
        ("BatteryOk", "Sequence", "action", "SUCCEEDED", -7, -7),
    ]


def test_each_session_of_a_sqlite_log_is_an_episode(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "log.db3")) as database, database:
        database.execute(
            "CREATE TABLE Transitions (timestamp INTEGER PRIMARY KEY NOT NULL, session_id INTEGER NOT NULL,"
            " node_uid INTEGER NOT NULL, duration INTEGER, state INTEGER NOT NULL, extra_data VARCHAR)"
        )
        database.execute(
            "CREATE TABLE Definitions (session_id INTEGER PRIMARY KEY, date TEXT NOT NULL, xml_tree TEXT NOT NULL)"
        )
        for session in (1, 2, 3):
            database.execute("INSERT INTO Definitions VALUES (?, '2026', ?)", (session, XML))
        for time, uid, status in TRANSITIONS:
            row = "INSERT INTO Transitions VALUES (?, ?, ?, 0, ?, NULL)"
            database.execute(row, (START_US + time, 1, uid, status))
        database.execute(row, (START_US + 100, 2, 1, SUCCESS))
    report = imported(tmp_path, "btlog", tmp_path / "log.db3")
    assert nodes(tmp_path / "memory.db") == NODES
    assert nodes(tmp_path / "memory.db", 2) == [("Sequence", None, "language", "SUCCEEDED", 100, 100)]
    assert report.left_out["sessions", "they have no transitions"] == 1


BOMB = '<!DOCTYPE r [<!ENTITY a "aaaa">]><root>&a;</root>'


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"BTCPP4-FileLogger2\2" + bytes(40), "has the protocol 2, and this version reads 1"),
        (b"SQLite format 3\0" + bytes(100), "is no log of BehaviorTree.CPP 4"),
        (b"", "is no log of BehaviorTree.CPP 4, which begins with BTCPP4-FileLogger2"),
        (btlog([], "<root>"), "has a tree that is no XML"),
        (btlog([], BOMB), "has a tree with a document type"),
        (btlog([], "<root><BehaviorTree><A/></BehaviorTree></root>"), "has a tree without ids of its nodes"),
        (btlog([], XML.replace('"7"', '"6"')), "has a tree with two nodes of the id 6"),
    ],
)
def test_a_wrong_log_is_one_line(tmp_path: Path, content: bytes, line: str) -> None:
    (tmp_path / "run.btlog").write_bytes(content)
    with pytest.raises(CallerError, match=re.escape(line)) as refused:
        import_files("btlog", [tmp_path / "run.btlog"], None)
    assert "\n" not in str(refused.value)


def test_a_log_cut_in_its_header_is_reported(tmp_path: Path) -> None:
    (tmp_path / "run.btlog").write_bytes(btlog([])[:40])
    report = import_files("btlog", [tmp_path / "run.btlog"], None)
    assert (report.episodes, ["ends before its first transition" in each for each in report.cut]) == ([], [True])


def test_rows_of_other_values_and_times_out_of_range_end_no_import(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "log.db3")) as database, database:
        database.execute("CREATE TABLE Definitions (session_id, xml_tree)")
        database.execute("CREATE TABLE Transitions (timestamp, session_id, node_uid, state)")
        database.execute("INSERT INTO Definitions VALUES (1, ?)", (XML,))
        rows = [(0, 1, RUNNING), (1.5, 1, RUNNING), (2**62, 1, SUCCESS), ("x", 1, RUNNING), (b"y", 1, RUNNING)]
        database.executemany("INSERT INTO Transitions VALUES (?, 1, ?, ?)", [*rows, (None, 1, RUNNING)])
    report = imported(tmp_path, "btlog", tmp_path / "log.db3")
    assert [(each.nodes, each.statuses) for each in report.episodes] == [(1, {"SUCCEEDED": 1})]
    assert report.left_out["transitions", "their time, node or status is no whole number"] == 4
    assert sum(report.left_out.values()) == 5  # and the time behind 2262
