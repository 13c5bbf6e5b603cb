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
_NAMES = sorted({*_COUNTED.values(), "samples"})


def imported(
    folder: Path, file_format: str, *paths: Path, map_file: Path | None = None, faults: int = 0
) -> ImportReport:
    """Import files into `folder/memory.db`, after a dry run that must announce what the memory has then.

    Every part of every call must have been recorded as it was reported, but for the faults that are expected.
    """
    file = folder / "memory.db"
    url = f"sqlite:///{file}" if file.exists() else put_memory(file)
    before = _events(file)
    announced = import_files(file_format, paths, None, map_file=map_file)
    with Memory.sync(url, settings=Settings(fold="at_end")) as memory:
        report = import_files(file_format, paths, memory.recording, map_file=map_file)
        memory.flush()
        assert memory.status.faults.total == faults, memory.status.faults
        assert memory.status.missing.total == 0, memory.status.missing
    new = [each for each in report.episodes if each.state == "imported"]
    assert [each.refusal for each in report.episodes] == [None] * len(report.episodes)
    if len(new) == len(announced.episodes):
        assert [_counts(each) for each in announced.episodes] == [_counts(each) for each in report.episodes]
    assert announced.left_out == report.left_out
    stored = _events(file)
    stored.subtract(before)
    counted = Counter[str]()
    for each in new:
        counted.update({name: getattr(each, name) for name in _NAMES})
    counted["nodes"] += len(new)  # their roots
    assert {name: stored[name] for name in _NAMES} == {name: counted[name] for name in _NAMES}
    return report


def _counts(episode: Any) -> tuple[Any, ...]:
    return *(getattr(episode, name) for name in _NAMES), episode.statuses


def _events(file: Path) -> Counter[str]:
    counts = Counter[str]()
    for kind, count in ask(file, "SELECT type, count(*) FROM event GROUP BY type"):
        if kind in _COUNTED:
            counts[_COUNTED[kind]] += count
    blocks = "FROM event WHERE type = 'Observed' AND json_extract(payload, '$.values.data.media_type') LIKE '%samples'"
    [[number, samples]] = ask(file, f"SELECT count(*), sum(json_extract(payload, '$.values.samples')) {blocks}")
    counts["observations"] -= number
    counts["samples"] = samples or 0
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
