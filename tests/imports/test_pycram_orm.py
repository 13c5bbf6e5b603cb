"""Databases of PyCRAM's ORM become episodes. The tables are those of PyCRAM's classes of 2024-07."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.imports.registry import import_files
from tests.databases import ask
from tests.imports.importing import imported, tree
from tests.record.recordings import assert_verified

TABLES = """
CREATE TABLE "ProcessMetaData" (id INTEGER PRIMARY KEY, created_at DATETIME DEFAULT CURRENT_TIMESTAMP,
 created_by VARCHAR(255), description VARCHAR(255), pycram_version VARCHAR(255));
CREATE TABLE "Position" (id INTEGER PRIMARY KEY, x FLOAT, y FLOAT, z FLOAT, process_metadata_id INTEGER);
CREATE TABLE "Quaternion" (id INTEGER PRIMARY KEY, x FLOAT, y FLOAT, z FLOAT, w FLOAT, process_metadata_id INTEGER);
CREATE TABLE "Pose" (id INTEGER PRIMARY KEY, time DATETIME, frame VARCHAR(255), position_id INTEGER,
 orientation_id INTEGER, process_metadata_id INTEGER);
CREATE TABLE "RobotState" (id INTEGER PRIMARY KEY, torso_height FLOAT, type VARCHAR(20), pose_id INTEGER,
 process_metadata_id INTEGER);
CREATE TABLE "Designator" (id INTEGER PRIMARY KEY, dtype VARCHAR(255), process_metadata_id INTEGER);
CREATE TABLE "TaskTreeNode" (id INTEGER PRIMARY KEY, action_id INTEGER, start_time DATETIME, end_time DATETIME,
 status VARCHAR(9), reason VARCHAR(255), parent_id INTEGER, process_metadata_id INTEGER);
CREATE TABLE "Object" (id INTEGER PRIMARY KEY, dtype VARCHAR(255), obj_type VARCHAR(20), name VARCHAR(255),
 pose_id INTEGER, process_metadata_id INTEGER);
CREATE TABLE "Action" (id INTEGER PRIMARY KEY, action_dtype VARCHAR(255), robot_state_id INTEGER);
CREATE TABLE "Motion" (id INTEGER PRIMARY KEY, motion_dtype VARCHAR(255));
CREATE TABLE "NavigateAction" (id INTEGER PRIMARY KEY, pose_id INTEGER);
CREATE TABLE "PickUpAction" (id INTEGER PRIMARY KEY, arm VARCHAR(5), grasp VARCHAR(5), object_id INTEGER);
CREATE TABLE "Release" (id INTEGER PRIMARY KEY, gripper VARCHAR(5), object_id INTEGER);
CREATE TABLE "MoveMotion" (id INTEGER PRIMARY KEY, pose_id INTEGER);
CREATE TABLE "WipeAction" (id INTEGER PRIMARY KEY, arm VARCHAR(5), strokes INTEGER, pose_id INTEGER);
INSERT INTO "ProcessMetaData" VALUES (1, '2024-07-01 10:00:00', 'jonas', 'rollouts', 'abc123'),
 (2, '2024-07-02 10:00:00', 'jonas', 'nothing', NULL);
INSERT INTO "Position" VALUES (1, 0.1, 0.2, 0.0, 1), (2, 1.25, -0.5, 0.0, 1), (3, 1.3, 0.7, 0.95, 1);
INSERT INTO "Quaternion" VALUES (1, 0, 0, 0, 1, 1), (2, 0, 0, 0.6, 0.8, 1);
INSERT INTO "Pose" VALUES (1, '2024-07-01 12:00:00', 'map', 1, 1, 1), (2, '2024-07-01 12:00:00', 'map', 2, 2, 1),
 (3, '2024-07-01 12:00:00', 'map', 3, 1, 1);
INSERT INTO "RobotState" VALUES (1, 0.3, 'ROBOT', 1, 1);
INSERT INTO "Object" VALUES (1, 'Object', 'MILK', 'milk', 3, 1), (2, 'BelieveObject', 'BOWL', 'bowl', 3, 1);
INSERT INTO "Designator" VALUES (1, 'NavigateAction', 1), (2, 'MoveMotion', 1), (3, 'PickUpAction', 1),
 (4, 'Release', 1), (5, 'WipeAction', 1), (6, 'NavigateAction', 1);
INSERT INTO "Action" VALUES (1, 'NavigateAction', 1), (3, 'PickUpAction', 1), (4, 'Release', 1), (5, 'WipeAction', 1),
 (6, 'NavigateAction', 1);
INSERT INTO "Motion" VALUES (2, 'MoveMotion');
INSERT INTO "NavigateAction" VALUES (1, 2), (6, 2);
INSERT INTO "MoveMotion" VALUES (2, 2);
INSERT INTO "PickUpAction" VALUES (3, 'LEFT', 'FRONT', 1);
INSERT INTO "Release" VALUES (4, 'LEFT', 2);
INSERT INTO "WipeAction" VALUES (5, 'RIGHT', 7, 3);
INSERT INTO "TaskTreeNode" VALUES
 (1, NULL, '2024-07-01 12:00:00.000000', NULL, 'RUNNING', NULL, NULL, 1),
 (2, 1, '2024-07-01 12:00:01.000001', '2024-07-01 12:00:03.500000', 'SUCCEEDED', NULL, 1, 1),
 (3, 2, '2024-07-01 12:00:01.000002', '2024-07-01 12:00:03.400000', 'SUCCEEDED', NULL, 2, 1),
 (4, 3, '2024-07-01 12:00:04.000000', '2024-07-01 12:00:09.000000', 'FAILED',
  '<class ''pycram.plan_failures.ManipulationPoseUnreachable''>', 1, 1),
 (5, 4, '2024-07-01 12:00:10.000000', NULL, 'RUNNING', NULL, 1, 1),
 (6, 5, '2024-07-01 12:00:11.000000', '2024-07-01 12:00:12.000000', 'CREATED', NULL, 1, 1),
 (7, 6, NULL, NULL, 'CREATED', NULL, 1, 1);
"""
NOON_US = 1_719_828_000_000_000  # 2024-07-01T10:00:00Z, noon in Berlin


def orm_database(file: Path) -> Path:
    with closing(sqlite3.connect(file)) as database:
        database.executescript(TABLES)
        database.commit()
    return file


def test_a_database_of_pycrams_orm_keeps_its_tree_its_parameters_and_its_robot(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text('timezone = "Europe/Berlin"')
    database = orm_database(tmp_path / "orm.db")
    report = imported(tmp_path, "pycrorm", database, map_file=tmp_path / "map.toml")
    assert_verified(tmp_path)
    file = tmp_path / "memory.db"
    nodes = [
        (dtype, parent, kind, status, reason, (start - NOON_US) / 1e6, None if end is None else (end - NOON_US) / 1e6)
        for dtype, parent, kind, status, reason, _, start, end in tree(file)
    ]
    assert nodes == [
        ("NavigateAction", None, "action", "SUCCEEDED", None, 1.000001, 3.5),
        ("MoveMotion", "NavigateAction", "motion", "SUCCEEDED", None, 1.000002, 3.4),
        ("PickUpAction", None, "action", "FAILED", "ManipulationPoseUnreachable", 4.0, 9.0),
        ("ReleaseAction", None, "action", "UNKNOWN", None, 10.0, None),
        ("WipeAction", None, "action", "UNKNOWN", None, 11.0, 12.0),
    ]
    episode = "SELECT description, created_by, status FROM process_metadata"
    assert ask(file, episode) == [("rollouts", "jonas", "UNKNOWN")]
    assert ask(file, "SELECT arm, strokes FROM wipe_action") == [("RIGHT", 7.0)]
    with Memory.sync(f"sqlite:///{file}") as memory:
        columns = "arm, grasp, torso_height, relative_x, relative_y, obj_type, status"
        view = f'SELECT {columns} FROM "PickUpWithContextView"'
        [pick] = memory.query(view).rows
        target = "SELECT x, qz FROM navigate_action AS a JOIN pose ON pose.id = a.target_location_id"
        [place] = memory.query(target).rows
    assert tuple(pick) == ("LEFT", "FRONT", 0.3, 0.1 - 1.3, 0.2 - 0.7, "MILK", "FAILED")
    assert tuple(place) == (1.25, 0.6)
    assert report.left_out == {("nodes", "they have no start"): 1, ("ProcessMetaData", "it has no nodes"): 1}
    again = imported(tmp_path, "pycrorm", database, map_file=tmp_path / "map.toml")
    assert [each.state for each in again.episodes] == ["already stored"]


def test_what_is_no_such_database_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("no database" * 100)
    with closing(sqlite3.connect(tmp_path / "other.db")) as database:
        database.execute("CREATE TABLE x (y)")
    (tmp_path / "map.toml").write_text('timezone = "Bremen"')
    for path, map_file, reason in (
        (tmp_path / "text.db", None, "is no database of PyCRAM"),
        (tmp_path / "other.db", None, "it has no table Designator"),
        (tmp_path, None, "is a folder"),
        (orm_database(tmp_path / "orm.db"), tmp_path / "map.toml", "is none, such as Europe/Berlin"),
    ):
        with pytest.raises(CallerError, match=reason):
            import_files("pycrorm", [path], None, map_file=map_file)


def test_values_of_other_types_are_left_out_and_another_schema_is_one_line(tmp_path: Path) -> None:
    with closing(sqlite3.connect(orm_database(tmp_path / "orm.db"))) as database, database:
        database.execute("UPDATE RobotState SET torso_height = 'high'")
        database.execute("UPDATE Position SET x = 'left' WHERE id = (SELECT max(id) FROM Position)")
        database.execute("UPDATE TaskTreeNode SET end_time = '2300-01-01 00:00:00'")
    report = imported(tmp_path, "pycrorm", tmp_path / "orm.db")
    assert [each.nodes for each in report.episodes] == [5]
    assert report.left_out["poses", "a coordinate is no number"] > 0
    with closing(sqlite3.connect(tmp_path / "orm.db")) as database, database:
        database.execute("ALTER TABLE TaskTreeNode RENAME COLUMN status TO state")
    with pytest.raises(CallerError, match=r"no such column: node\.status"):
        import_files("pycrorm", [tmp_path / "orm.db"], None)
