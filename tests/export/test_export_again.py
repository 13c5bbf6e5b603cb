"""An export is made again from its manifest, which names what differs."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest
from sqlalchemy import select

from pycrorm_async import Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, NodeEnded, NodeStarted
from pycrorm_async.export.export import export, export_again
from pycrorm_async.export.selection import read_manifest
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.world.pose import Arms
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, Script, declarations, name_of
from tests.projections.factories import append_and_fold
from tests.query.test_reading import episode

ID = "00000000-0000-7000-8000-000000000002"


async def test_the_manifest_makes_the_same_bytes_again(reading: Reading, tmp_path: Path) -> None:
    for name, what in (("view.parquet", "PickUpWithContextView"), ("nodes.jsonl", ["2", "1"]), ("all.csv", "action")):
        exported = await export(reading, what, tmp_path / name)
        remade = await export_again(reading, tmp_path / f"{name}.manifest.json", tmp_path / f"again-{name}")
        assert (remade.same, remade.differences) == (True, ())
        assert (tmp_path / name).read_bytes() == (tmp_path / f"again-{name}").read_bytes()
        assert exported.manifest == read_manifest(tmp_path / f"{name}.manifest.json")
        compared = await export_again(reading, tmp_path / f"{name}.manifest.json")
        assert (compared.same, compared.exported) == (True, None)
    assert len(list(tmp_path.iterdir())) == 12
    own = select(TaskTreeNode.dtype).order_by(TaskTreeNode.id)
    await export(reading, own, tmp_path / "own.csv")
    with pytest.raises(CallerError, match="a program's own select"):
        await export_again(reading, tmp_path / "own.csv.manifest.json")
    assert (await export_again(reading, tmp_path / "own.csv.manifest.json", statement=own)).same


async def test_what_differs_from_the_manifest_is_named(either: Reading, tmp_path: Path) -> None:
    await export(either, "2", tmp_path / "nodes.csv")
    file = tmp_path / "nodes.csv.manifest.json"
    text = file.read_text()
    cases = {
        '"events": 11': (
            '"events": 12',
            f"episode 2 ({ID}) has 11 events instead of 12",
        ),
        '"pyarrow": "': ('"pyarrow": "0.', f"version of pyarrow: {pa.__version__} instead of 0.{pa.__version__}"),
        '"kind": "string"': ('"kind": "int64"', "type of the column kind: string instead of int64"),
    }
    for old, (new, line) in cases.items():
        file.write_text(text.replace(old, new))
        assert (await export_again(either, file)).differences == (line,)
    file.write_text(text.replace("8000-000000000002", "8000-000000000009"))
    remade = await export_again(either, file)
    assert not remade.same
    assert remade.differences == (f"episode 2 ({ID[:-1]}9) is not in this memory",)
    for broken in ("{}", "not json"):
        file.write_text(broken)
        with pytest.raises(CallerError, match="is not a manifest of an export"):
            await export_again(either, file)
    file.unlink()
    with pytest.raises(CallerError, match=r"^the manifest \S+ cannot be read: No such file or directory$"):
        await export_again(either, file)


async def test_a_question_is_exported_and_made_again_by_name_and_arguments(reading: Reading, tmp_path: Path) -> None:
    arguments = {"episode": 1, "object": "milk", "arm": Arms.LEFT, "limit": 1}
    exported = await export(reading, "root_failures", tmp_path / "failures.csv", arguments=arguments)
    assert (exported.rows, exported.episodes) == (1, 1)
    first = exported.manifest.episodes[0].id
    assert exported.manifest.options == {"arguments": {"episode": first, "object": "milk", "arm": "LEFT", "limit": 1}}
    frame = await reading.ask.root_failures(episode=1, object="milk", arm="LEFT", limit=1)
    assert pd.read_csv(tmp_path / "failures.csv").message.tolist() == frame.message.tolist()
    assert (await export_again(reading, tmp_path / "failures.csv.manifest.json")).same
    since = {"since": datetime(2020, 1, 1, tzinfo=UTC)}
    assert (await export(reading, "episodes", tmp_path / "episodes.parquet", arguments=since)).rows == 4
    assert (await export_again(reading, tmp_path / "episodes.parquet.manifest.json")).same
    question = reading.ask.durations(episode="last")
    await export(reading, question, tmp_path / "durations.parquet")
    again = await export_again(reading, tmp_path / "durations.parquet.manifest.json", statement=question)
    assert (again.same, again.differences) == (True, ())


async def test_a_question_is_made_again_about_the_same_episodes_when_more_are_recorded(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    await append_and_fold(url, [*declarations(NAVIGATE, PICK_UP, SAYING), *episode(2).records])
    cases: Any = ("last", {"episode": "last"}), ("digits", {"episode": "0000"}), ("all", {})
    async with Reading.open(url) as reading:
        for name, arguments in cases:
            exported = await export(reading, "durations", tmp_path / f"{name}.csv", arguments=arguments)
            assert exported.manifest.options == ({"arguments": {"episode": ID}} if arguments else {})
        of_digits = reading.ask.durations(episode="0000")
        assert await reading.rows(of_digits.statement) == await of_digits.rows() != []
        every = reading.ask.durations()
        await export(reading, every, tmp_path / "every.csv")
    script = Script(3)
    script.put(EpisodeStarted("another", "me", "host", "1.0", "3.11"))
    say = script.put(NodeStarted("action", None, name_of(SAYING), {"text": "hi"}))
    script.put(NodeEnded(say, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    await append_and_fold(url, script.records)
    async with Reading.open(url) as reading:
        assert (await reading.episode("last")).number == 2
        for name, _ in cases:
            again = await export_again(reading, tmp_path / f"{name}.csv.manifest.json")
            assert (again.same, again.differences) == (True, ()), name
        every = reading.ask.durations()
        assert (await export_again(reading, tmp_path / "every.csv.manifest.json", statement=every)).same
