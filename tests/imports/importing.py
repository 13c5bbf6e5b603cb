"""Import files into a memory, and compare what it has with the report and with what the source had."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from pycrorm_async import Memory, Settings
from pycrorm_async.imports.intake import ImportReport
from pycrorm_async.imports.registry import import_files
from tests.databases import ask, put_memory

_COUNTED = {
    "NodeStarted": "nodes",
    "ObjectAdded": "objects",
    "ObjectMoved": "changes",
    "JointsMoved": "changes",
    "ObjectRemoved": "removals",
    "Observed": "observations",
}


def imported(folder: Path, file_format: str, *paths: Path, map_file: Path | None = None) -> ImportReport:
    """Import files into `folder/memory.db`, after a dry run that must announce what the memory has then.

    Every part of every call must have been recorded as it was reported.
    """
    file = folder / "memory.db"
    url = f"sqlite:///{file}" if file.exists() else put_memory(file)
    before = _events(file)
    announced = import_files(file_format, paths, None, map_file=map_file)
    with Memory.sync(url, settings=Settings(fold="at_end")) as memory:
        report = import_files(file_format, paths, memory.recording, map_file=map_file)
        memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults
        assert memory.status.missing.total == 0, memory.status.missing
    new = [each for each in report.episodes if each.state == "imported"]
    assert [each.refusal for each in report.episodes] == [None] * len(report.episodes)
    if len(new) == len(announced.episodes):
        assert [_counts(each) for each in announced.episodes] == [_counts(each) for each in report.episodes]
    assert announced.left_out == report.left_out
    stored = _events(file) - before
    counted = Counter[str]()
    for each in new:
        counted.update({name: getattr(each, name) for name in set(_COUNTED.values())})
    counted["nodes"] += len(new)  # their roots
    assert {name: stored[name] for name in set(_COUNTED.values())} == {
        name: counted[name] for name in set(_COUNTED.values())
    }
    return report


def _counts(episode: Any) -> tuple[Any, ...]:
    return *(getattr(episode, name) for name in sorted(set(_COUNTED.values()))), episode.samples, episode.statuses


def _events(file: Path) -> Counter[str]:
    is_block = "payload LIKE '%application/x-npy; samples%'"  # of a stream, which a report counts by its samples
    rows = ask(file, f"SELECT type, count(*) FROM event WHERE NOT ({is_block}) GROUP BY type")
    counts = Counter[str]()
    for kind, count in rows:
        if kind in _COUNTED:
            counts[_COUNTED[kind]] += count
    return counts


def tree(file: Path, episode: int = 1) -> list[tuple[Any, ...]]:
    """Return dtype, dtype of the parent, status, failure and times in µs of each node but the root, by its start."""
    return [
        tuple(row)
        for row in ask(
            file,
            "SELECT node.dtype, parent.dtype, node.kind, node.status, node.reason, node.failure_message,"
            " node.start_time, node.end_time FROM task_tree_node AS node JOIN task_tree_node AS parent"
            f" ON parent.id = node.parent_id WHERE node.process_metadata_id = {episode} ORDER BY node.id",
        )
    ]


def poses(file: Path, episode: int = 1) -> list[tuple[Any, ...]]:
    """Return name, type, position and orientation of each state of each object, in order."""
    return [
        tuple(row)
        for row in ask(
            file,
            "SELECT object.name, object.obj_type, pose.x, pose.y, pose.z, pose.qx, pose.qy, pose.qz, pose.qw"
            " FROM object JOIN pose ON pose.id = object.pose_id"
            f" WHERE object.process_metadata_id = {episode} ORDER BY object.id",
        )
    ]
