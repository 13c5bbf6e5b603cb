"""LeRobot data sets of the versions 2.1 and 3.0, written with pyarrow and by our own export, become episodes."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.imports.registry import import_files
from pycrorm_async.world.pose import Pose
from tests.commands import pycrorm
from tests.databases import ask
from tests.imports.importing import imported, tree

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["pan", "lift"]}},
    "action": {"dtype": "float32", "shape": [2], "names": None},
    "observation.images.top": {"dtype": "video", "shape": [4, 4, 3], "names": None},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "next.success": {"dtype": "bool", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "subtask_index": {"dtype": "int64", "shape": [1], "names": None},
}


def frames(episode: int, count: int, *, succeeds: bool) -> pa.Table:
    states = np.arange(2 * count, dtype=np.float32).reshape(count, 2) + episode
    return pa.table(
        {
            "observation.state": pa.array(states.tolist(), pa.list_(pa.float32(), 2)),
            "action": pa.array((states + 1).tolist(), pa.list_(pa.float32(), 2)),
            "timestamp": pa.array(np.arange(count, dtype=np.float32) / 10),
            "next.success": pa.array([False] * (count - 1) + [succeeds]),
            "episode_index": pa.array([episode] * count),
            "subtask_index": pa.array([0] * 3 + [1] * (count - 3)),
        }
    )


def write_meta(folder: Path, version: str, data_path: str) -> None:
    (folder / "meta").mkdir(parents=True)
    info = {
        "codebase_version": version, "robot_type": "so100", "fps": 10, "chunks_size": 1000,
        "data_path": data_path, "features": FEATURES,
    }  # fmt: skip
    (folder / "meta" / "info.json").write_text(json.dumps(info))


def lines(rows: Sequence[dict[str, Any]]) -> str:
    return "".join(json.dumps(each) + "\n" for each in rows)


def version_2(folder: Path) -> Path:
    write_meta(folder, "v2.1", "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet")
    rows = [{"episode_index": n, "tasks": ["pick the cube"], "length": 5 + n} for n in range(2)]
    (folder / "meta" / "episodes.jsonl").write_text(lines(rows))
    names = [{"subtask_index": n, "subtask": text} for n, text in enumerate(("reach", "grasp"))]
    (folder / "meta" / "subtasks.jsonl").write_text(lines(names))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    for n in range(2):
        table = frames(n, 5 + n, succeeds=n == 0)
        parquet.write_table(table, folder / "data" / "chunk-000" / f"episode_{n:06d}.parquet")
    return folder


def version_3(folder: Path) -> Path:
    write_meta(folder, "v3.0", "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")
    rows = [
        {
            "episode_index": n, "tasks": ["pick the cube"], "length": 5 + n,
            "data/chunk_index": 0, "data/file_index": 0,
        }
        for n in range(2)
    ]  # fmt: skip
    (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    parquet.write_table(pa.Table.from_pylist(rows), folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    names = pa.table({"subtask_index": [0, 1], "subtask": ["reach", "grasp"]})
    parquet.write_table(names, folder / "meta" / "subtasks.parquet")
    (folder / "data" / "chunk-000").mkdir(parents=True)
    table = pa.concat_tables([frames(0, 5, succeeds=True), frames(1, 6, succeeds=False)])
    parquet.write_table(table, folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


@pytest.mark.parametrize("make", [version_2, version_3])
def test_each_episode_of_a_data_set_has_its_task_subtasks_samples_and_success(tmp_path: Path, make: Any) -> None:
    (tmp_path / "map.toml").write_text("start = 2023-11-14T22:13:20Z\npause_s = 1\n")
    report = imported(tmp_path, "lerobot", make(tmp_path / "set"), map_file=tmp_path / "map.toml")
    us = 1_700_000_000_000_000
    assert [row[6:] for row in tree(tmp_path / "memory.db", 1)] == [(us, us + 300_000), (us + 300_000, us + 500_000)]
    assert [row[6:] for row in tree(tmp_path / "memory.db", 2)] == [
        (us + 1_500_000, us + 1_800_000),
        (us + 1_800_000, us + 2_100_000),
    ]
    assert ask(tmp_path / "memory.db", "SELECT name FROM subtask ORDER BY id") == [("reach",), ("grasp",)] * 2
    assert ask(tmp_path / "memory.db", "SELECT status, description FROM process_metadata ORDER BY id") == [
        ("SUCCEEDED", "pick the cube"),
        ("FAILED", "pick the cube"),
    ]
    assert [each.samples for each in report.episodes] == [3 * 5, 3 * 6]

    async def states() -> Any:
        async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
            return await memory.samples("observation.state", episode=2)

    frame = asyncio.run(states())
    assert frame[["pan", "lift"]].to_numpy().tolist() == (np.arange(12).reshape(6, 2) + 1).tolist()
    assert dict(iter(report.left_out)) == {"the feature observation.images.top": "images and videos are not imported"}


def test_an_import_of_our_own_export_has_the_tree_and_the_statuses(tmp_path: Path) -> None:
    source = tmp_path / "source.db"
    with Memory.sync(f"sqlite:///{source}") as memory:
        drive = memory.recording.type("action", "Drive", {"speed": "real"})
        with memory.recording.episode(description="two drives") as episode:
            episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]), {"wheel": 0.0})
            for n in range(3):
                episode.start(n, drive, {"speed": 0.5}, parent=None if n < 2 else 1, robot="base")
                episode.object_moved("base", Pose([n + 1.0, 0, 0]), node=n)
                episode.joints_moved("base", {"wheel": n + 1.0}, node=n)
                if n != 1:
                    episode.end(n, "FAILED" if n == 0 else "SUCCEEDED", ("WheelSlipped", "left") if n == 0 else None)
            episode.end(1, "SUCCEEDED")
        memory.flush()
    command = "export", "1", "--format", "lerobot", "--out", "set", "--url", f"sqlite:///{source}"
    assert pycrorm(*command, cwd=tmp_path).returncode == 0
    imported(tmp_path, "lerobot", tmp_path / "set")
    assert [row[:6] for row in tree(tmp_path / "memory.db")] == [row[:6] for row in tree(source)]
    assert ask(tmp_path / "memory.db", "SELECT status FROM process_metadata") == [("SUCCEEDED",)]


def test_a_data_set_with_a_damaged_file_gives_its_other_episodes(tmp_path: Path) -> None:
    folder = version_2(tmp_path / "set")
    file = folder / "data" / "chunk-000" / "episode_000000.parquet"
    file.write_bytes(file.read_bytes()[:-20])
    report = imported(tmp_path, "lerobot", folder)
    [line] = report.cut
    assert "episode_000000.parquet cannot be read, so episode 0 is left out" in line
    assert [each.description for each in report.episodes] == ["pick the cube"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda info: info | {"codebase_version": "v1.6"}, "has the version v1.6, and 2.0, 2.1 and 3.0 can be read"),
        (lambda info: info | {"data_path": "../../{episode_index}"}, "names data outside of its folder"),
        (lambda info: info | {"data_path": "{nothing}"}, "describes its episodes otherwise"),
        (lambda info: info | {"data_path": "{episode_index.__class__}"}, "its fps or its data_path cannot be"),
        (lambda info: info | {"fps": 0}, "its fps or its data_path cannot be"),
        (lambda info: info | {"chunks_size": 0}, "Expected `int` >= 1 - at `$.chunks_size`"),
        (lambda info: info | {"fps": 1e-300}, "its fps or its data_path cannot be"),
        (lambda info: info | {"data_path": "{episode_index:0999999999999d}"}, "describes its episodes otherwise: Mem"),
        (lambda info: info | {"data_path": "\0"}, "describes its episodes otherwise: ValueError("),
        (lambda _: {}, "is not that of a LeRobot data set"),
        (None, "is no LeRobot data set: it has no meta/info.json"),
    ],
)
def test_a_wrong_data_set_is_one_line(tmp_path: Path, change: Any, line: str) -> None:
    folder = version_2(tmp_path / "set")
    file = folder / "meta" / "info.json"
    info = json.loads(file.read_text())
    if change is None:
        file.unlink()
    else:
        file.write_text(json.dumps(change(info)))
    with pytest.raises(CallerError, match=re.escape(line)) as refused:
        import_files("lerobot", [folder], None)
    assert "\n" not in str(refused.value)
