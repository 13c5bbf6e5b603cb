"""Exports of rows as Parquet, CSV and JSON lines, their manifests, and the metadata for Datasette."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import fcntl
import json
import os
import sqlite3
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet
from sqlalchemy import Integer, LargeBinary, case, func, literal, select, true, type_coerce
from sqlalchemy.orm import aliased

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError, MissingExtra, UnknownEpisode
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, NodeEnded, NodeStarted
from pycrorm_async.export import formats
from pycrorm_async.export.export import FORMATS, datasette_metadata, export, export_again
from pycrorm_async.export.formats import CSV, GROUP, Format, Job, Written, _write_rows
from pycrorm_async.export.selection import read_manifest
from pycrorm_async.orm import Object, PickUpWithContextView, RootFailure, TaskTreeNode
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.world.pose import Arms
from tests.commands import one_line_of, pycrorm
from tests.databases import Server
from tests.export.conftest import write_script
from tests.full_disk import files_of_at_most
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, Script, append_and_fold, declarations, name_of
from tests.query.test_reading import episode

# === row exports ==============================================================================================
#
# Exports of rows as Parquet, CSV and JSON lines, and their manifests.

DISK_BYTES = 40_000
"""More than SQLite's own files need."""
ONE, OTHER = aliased(TaskTreeNode), aliased(TaskTreeNode)
NOISE = type_coerce(func.random(), Integer())
LARGE = select(ONE.dtype, *(NOISE.label(f"noise{n}") for n in range(4))).join(OTHER, true())


async def test_files_of_an_episode_with_failures_and_of_one_without_have_one_schema(
    reading: Reading, tmp_path: Path
) -> None:
    for name in ("1", "2", "4"):
        await export(reading, name, tmp_path / f"{name}.parquet")
        await export(reading, RootFailure, tmp_path / f"{name}.failures.parquet", episodes=[name])
    for suffix in ("parquet", "failures.parquet"):
        first, *others = [parquet.read_schema(tmp_path / f"{name}.{suffix}") for name in ("1", "2", "4")]
        assert all(each.equals(first, check_metadata=True) for each in others)
    reasons = pd.read_parquet([tmp_path / "1.parquet", tmp_path / "2.parquet"]).groupby("process_metadata_id").reason
    assert reasons.count().to_dict()[2] == 0 < reasons.count().to_dict()[1]
    assert parquet.read_metadata(tmp_path / "2.failures.parquet").num_rows == 0


async def test_every_format_has_the_rows_of_the_frame(database_url: str, tmp_path: Path) -> None:
    await write_script(database_url)
    view = PickUpWithContextView
    condition = view.process_metadata_id == 2
    async with Reading.open(database_url) as reading:
        frame = await reading.dataframe(select(view).where(condition), deferred=True)
        for name in ("rows.parquet", "rows.csv", "rows.jsonl"):
            exported = await export(reading, "PickUpWithContextView", tmp_path / name)
            assert (exported.rows, exported.episodes, exported.left_out) == (1, 1, 1)
    table = parquet.read_table(tmp_path / "rows.parquet")
    assert table.schema.field("arm").type == pa.dictionary(pa.int32(), pa.string())
    enums = dict.fromkeys(("arm", "grasp", "obj_type", "status"), "str")
    pd.testing.assert_frame_equal(table.to_pandas().astype(enums), frame)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "rows.csv"), frame, check_dtype=False)
    with (tmp_path / "rows.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert {name: row[name] for name in ("arm", "relative_x", "description")} == {
        "arm": "LEFT", "relative_x": "-0.5", "description": "episode 2",
    }  # fmt: skip
    (line,) = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert {name: each for name, each in json.loads(line).items() if each is not None} == frame.loc[
        0
    ].dropna().to_dict()


async def test_json_columns_are_values_in_json_lines_and_text_elsewhere(scripted: Reading, tmp_path: Path) -> None:
    await export(scripted, "2", tmp_path / "episode.jsonl")
    nodes = [json.loads(line) for line in (tmp_path / "episode.jsonl").read_text().splitlines()]
    assert [(each["dtype"], each["status"]) for each in nodes] == [
        (None, "SUCCEEDED"), ("NavigateAction", "SUCCEEDED"), ("SayingAction", "SUCCEEDED"), ("PickUpAction", "FAILED"),
    ]  # fmt: skip
    assert nodes[2]["parameters"] == {"text": "hi"}
    assert nodes[0]["start_time"] == "2023-11-14T22:13:22Z"
    await export(scripted, "2", tmp_path / "episode.csv")
    assert pd.read_csv(tmp_path / "episode.csv").parameters[2] == '{"text":"hi"}'


async def test_bytes_are_base64_in_files_of_text(scripted: Reading, tmp_path: Path) -> None:
    content = type_coerce(literal(b"\xff\x00\n"), LargeBinary)
    rows = select(case((ONE.dtype == "PickUpAction", content)).label("content"), ONE.id).order_by(ONE.id)
    for name in ("a.csv", "a.jsonl", "a.parquet"):
        await export(scripted, rows.where(ONE.process_metadata_id == 2), tmp_path / name)
    assert pd.read_csv(tmp_path / "a.csv").content.dropna().tolist() == ["/wAK"]
    assert json.loads((tmp_path / "a.jsonl").read_text().splitlines()[-1])["content"] == "/wAK"
    assert parquet.read_table(tmp_path / "a.parquet").column("content")[-1].as_py() == b"\xff\x00\n"


async def test_a_view_of_a_user_and_a_select_are_exported(reading: Reading, tmp_path: Path) -> None:
    assert (await export(reading, "longest", tmp_path / "longest.csv")).rows > 5
    assert [*pd.read_csv(tmp_path / "longest.csv")] == ["dtype", "s"]
    moments = len(await reading.dataframe(Object))  # three further classes share its view
    assert (await export(reading, "object", tmp_path / "objects.csv")).rows == moments > 0
    await export(reading, "concept", tmp_path / "concepts.parquet")
    assert {"name", "parent"} <= {*parquet.read_schema(tmp_path / "concepts.parquet").names}


async def test_a_question_without_rows_about_an_unknown_name_is_exported_with_the_nearest_one(
    reading: Reading, tmp_path: Path
) -> None:
    unknown = "the memory has no object mlik; did you mean milk?"
    by_name = await export(reading, "root_failures", tmp_path / "a.csv", arguments={"object": "mlik"})
    assert (by_name.rows, by_name.unknown_name) == (0, unknown)
    assert (await export(reading, reading.ask.moves_of("mlik"), tmp_path / "b.csv")).unknown_name == unknown
    of_milk = {"object": "milk", "message": "no such text"}
    named = await export(reading, "root_failures", tmp_path / "c.csv", arguments=of_milk)
    assert (named.rows, named.unknown_name) == (0, "")


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("root_failure", {"object": "milk"}, "root_failure is a view, and arguments are for questions: root_failures"),
        ("root_failuers", {}, "did you mean root_failures"),
        ("root_failures", {"objct": "milk"}, r"root_failures has no argument 'objct'; did you mean object\?; it has"),
        ("object_history", {}, "object_history needs name: give it as an argument"),
        ("durations", {"episode": 99}, "there is no episode '99'"),
        (
            "durations",
            {"episode": 1, "episodes": [2]},
            "the argument `episode`, which chooses it already",
        ),
    ],
)
async def test_a_question_with_a_wrong_argument_is_refused(
    reading: Reading, tmp_path: Path, name: str, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(CallerError, match=message):
        await export(reading, name, tmp_path / "a.csv", episodes=arguments.pop("episodes", ()), arguments=arguments)
    assert list(tmp_path.iterdir()) == []


async def test_every_question_is_exported_with_declared_types_of_episodes_that_have_ended(
    scripted: Reading, tmp_path: Path
) -> None:
    arguments: dict[str, dict[str, Any]] = {
        "object_history": {"name": "milk"}, "moves_of": {"name": "milk"}, "experience_at": {"x": 0.5, "y": 0},
    }  # fmt: skip
    changed = set()
    for name in QUESTIONS:
        exported = await export(scripted, name, tmp_path / f"{name}.parquet", arguments=arguments.get(name, {}))
        assert ([each.number for each in exported.manifest.episodes], exported.left_out) == ([2], 1)
        table = parquet.read_table(tmp_path / f"{name}.parquet")
        assert pa.null() not in table.schema.types, name
        if (
            await getattr(scripted.ask, name)(**arguments.get(name, {})).frame(to="arrow")
        ).to_pylist() != table.to_pylist():
            changed.add(name)
    assert changed == {*QUESTIONS} - {"successful_pick_ups", "moves_of", "steps_before_failures", "streams"}


async def _write_count(job: Job, path: Path) -> Written:
    path.write_text(f"{len(job.selection.episodes)} episodes\n")
    return Written(len(job.selection.episodes))


COUNT = Format(_write_count, noun="episode", holds="episodes", packages=())


async def test_a_format_of_an_installed_package_is_found_by_its_suffix_and_has_a_manifest(
    reading: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = EntryPoint("count", f"{__name__}:COUNT", GROUP)
    monkeypatch.setattr(formats, "entry_points", lambda **_: [entry])
    monkeypatch.setattr(EntryPoint, "load", lambda _: COUNT)
    exported = await export(reading, ["1", "2"], tmp_path / "two.count")
    assert (exported.rows, (tmp_path / "two.count").read_text()) == (2, "2 episodes\n")
    assert (await export_again(reading, tmp_path / "two.count.manifest.json")).same
    with pytest.raises(CallerError, match="the format count holds whole episodes, and action is a view"):
        await export(reading, "action", tmp_path / "a.count")


async def test_a_full_disk_leaves_no_file(reading: Reading, tmp_path: Path) -> None:
    for name in ("a.parquet", "a.csv", "a.jsonl"):
        with files_of_at_most(DISK_BYTES), pytest.raises(OSError, match="File too large") as refused:
            await export(reading, LARGE, tmp_path / name)
        assert refused.value.filename == str(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


async def test_a_cancelled_export_closes_its_file_after_the_last_write(
    reading: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    begun, goes_on = asyncio.Event(), threading.Event()
    loop = asyncio.get_running_loop()

    @contextmanager
    def slow_writer(*_: object) -> Iterator[Any]:
        def write(_batch: object) -> None:
            loop.call_soon_threadsafe(begun.set)
            goes_on.wait(20)
            steps.append("written")

        try:
            yield write
        finally:
            steps.append("closed")

    monkeypatch.setitem(FORMATS, "csv", CSV._replace(write=partial(_write_rows, slow_writer)))
    task = asyncio.create_task(export(reading, "1", tmp_path / "a.csv"))
    await begun.wait()
    for _ in range(3):  # as a user who presses Ctrl-C again
        task.cancel()
        await asyncio.sleep(0.01)
    goes_on.set()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert steps == ["written", "closed"]
    assert list(tmp_path.iterdir()) == []


async def test_parts_of_killed_exports_are_deleted_and_those_of_running_ones_kept(
    scripted: Reading, tmp_path: Path
) -> None:
    dead, running, new, other = (
        tmp_path / name
        for name in (".a.csv.deadbeef.part", ".a.csv.lockedxx.part", ".a.csv.newwwwww.part", ".b.csv.deadbeef.part")
    )
    for each in (dead, running, new, other):
        each.write_text("a part")
        if each != new:
            os.utime(each, (1_000_000_000, 1_000_000_000))
    with running.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        await export(scripted, "2", tmp_path / "a.csv")
    assert sorted(tmp_path.glob(".*")) == [running, new, other]


async def test_a_file_is_replaced_only_when_asked(reading: Reading, tmp_path: Path) -> None:
    file = tmp_path / "mine.csv"
    file.write_text("mine")
    with pytest.raises(CallerError, match=r"mine.csv exists: add --force"):
        await export(reading, "1", file)
    assert [each.name for each in tmp_path.iterdir()] == ["mine.csv"]
    with files_of_at_most(DISK_BYTES), pytest.raises(OSError, match="File too large"):
        await export(reading, LARGE, file, force=True)
    assert file.read_text() == "mine"
    manifest = tmp_path / "new.csv.manifest.json"
    manifest.write_text("mine")
    with pytest.raises(CallerError, match=r"new.csv.manifest.json exists: add --force"):
        await export(reading, "1", tmp_path / "new.csv")
    assert (manifest.read_text(), (tmp_path / "new.csv").exists()) == ("mine", False)
    await export(reading, "1", file, force=True)
    assert file.read_text().startswith('"id"')


async def test_a_running_episode_is_refused_by_name_and_left_out_of_a_view(scripted: Reading, tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="episode 1 is still running, so its rows change"):
        await export(scripted, "1", tmp_path / "a.csv")
    exported = await export(scripted, "task_tree_node", tmp_path / "a.csv")
    assert (exported.rows, exported.left_out) == (4, 1)


async def test_an_episode_that_the_tables_hold_in_part_is_left_out(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    records = [*declarations(NAVIGATE, PICK_UP, SAYING), *episode(2).records]
    await append_and_fold(url, records[:-4])
    await append_and_fold(url, records[-4:], folded=False)
    async with Reading.open(url) as opened:
        exported = await export(opened, "task_tree_node", tmp_path / "a.csv")
    assert (exported.rows, exported.left_out) == (0, 1)


@pytest.mark.parametrize(
    ("what", "episodes", "name", "error", "message"),
    [
        ("PickUpWithContextVeiw", (), "a.csv", CallerError, "did you mean PickUpWithContextView?"),
        ("99", (), "a.csv", UnknownEpisode, "there is no episode '99'"),
        ("PickUpWithContextView", ("99",), "a.csv", UnknownEpisode, "there is no episode '99'"),
        ("concept", ("2",), "a.csv", CallerError, "the rows of concept are of no episode"),
        ("2", ("2",), "a.csv", CallerError, "episodes are exported whole"),
        (("2", "concept"), (), "a.csv", CallerError, "of one view or question: export concept to a file of its own"),
        (
            "2",
            (),
            "a.xlsx",
            CallerError,
            r"names no format: add --format .* one of parquet, csv",
        ),
        ("2", (), "none/a.csv", CallerError, "none does not exist: create it first"),
        ("2", (), "\udcff.csv", CallerError, r"\\udcff.csv. is not UTF-8: give another name"),
    ],
)
async def test_mistakes_are_named_and_leave_no_file(
    scripted: Reading,
    tmp_path: Path,
    what: str | tuple[str, ...],
    episodes: tuple[str, ...],
    name: str,
    error: type,
    message: str,
) -> None:
    with pytest.raises(error, match=message):
        await export(scripted, what, tmp_path / name, episodes=episodes)
    assert list(tmp_path.iterdir()) == []


async def test_without_pyarrow_the_error_names_the_extra(
    scripted: Reading, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match=r"pip install 'pycrorm-async\[frames\]'"):
        await export(scripted, "2", tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


def test_a_memory_without_asyncio_exports_too(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory:
        with memory.recording.episode(description="a walk"):
            pass
        memory.flush()
        exported = memory.export("last", tmp_path / "walk.csv")
        asked = memory.export(memory.ask.episodes(), tmp_path / "episodes.csv")
        assert memory.dataframe(memory.ask.episodes()).description.tolist() == ["a walk"]
    assert (exported.rows, exported.episodes) == (1, 1)
    assert (asked.rows, asked.episodes) == (1, 1)


@pytest.mark.slow
def test_the_command_writes_compares_and_names_mistakes_in_one_line(kitchen: Path, tmp_path: Path) -> None:
    done = pycrorm("export", "1", "2", "--out", tmp_path / "both.parquet", "--json", cwd=kitchen)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert (answer["format"], answer["episodes"], [*answer["files"]]) == ("parquet", 2, ["both.parquet"])
    done = pycrorm("export", "--again", tmp_path / "both.parquet.manifest.json", cwd=kitchen)
    assert (done.returncode, done.stdout) == (0, "the same bytes\n")
    done = pycrorm("export", "3", "--out", tmp_path / "three.rrd", cwd=kitchen)
    assert " changes of 1 episode; " in done.stderr
    done = pycrorm("export", "--again", tmp_path / "three.rrd.manifest.json", cwd=kitchen)
    assert (done.returncode, done.stdout) == (0, "the same episode and changes; rerun gives random ids\n")
    done = pycrorm("export", "1", "--out", tmp_path / "both.parquet", cwd=kitchen)
    assert (done.returncode, "exists: add --force" in one_line_of(done)) == (2, True)
    with_milk = "--with", "object=milk", "--with", "limit=1", "--with", "recovered=true"
    done = pycrorm("export", "root_failures", *with_milk, "--out", tmp_path / "f.csv", "--json", cwd=kitchen)
    assert json.loads(done.stdout)["rows"] == 1
    done = pycrorm("export", "root_failures", "--with", "object=mlik", "--out", tmp_path / "no.csv", cwd=kitchen)
    assert done.stderr.endswith("no row answers; the memory has no object mlik; did you mean milk?\n")
    done = pycrorm("export", "root_failures", "--with", "limit=many", "--out", tmp_path / "g.csv", cwd=kitchen)
    assert one_line_of(done) == "pycrorm: limit of root_failures must be of the type int, got 'many'"
    done = pycrorm("export", "root_failures", "--with", "limit=1", "--with", "limit=2", cwd=kitchen)
    assert one_line_of(done) == "pycrorm: limit of root_failures is given twice: give one value"
    done = pycrorm("export", "1", "--out", tmp_path / "h.mcap", "--fps", "5", cwd=kitchen)
    assert (done.returncode, "choose the clock `event`" in one_line_of(done)) == (2, True)
    for name in ("a/b", ""):
        done = pycrorm("export", name, cwd=kitchen)
        assert one_line_of(done) == f"pycrorm: the memory has no episode, view, class or question '{name}'"
    done = pycrorm("export", "last", "--again", tmp_path / "both.parquet.manifest.json", cwd=kitchen)
    assert one_line_of(done) == "pycrorm: name last or make an export again with --again, not both"
    done = pycrorm("export", cwd=kitchen)
    assert (done.returncode, one_line_of(done)[:32]) == (2, "pycrorm: name what to export, fo")


async def test_an_empty_memory_has_views_without_rows_and_no_episode(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/empty.db") as memory:
        await memory.flush()
        exported = await memory.export(RootFailure, tmp_path / "none.parquet")
        assert (exported.rows, exported.episodes) == (0, 0)
        assert parquet.read_schema(tmp_path / "none.parquet").field("reason").type == pa.string()
        with pytest.raises(UnknownEpisode, match="there is no episode 'last'"):
            await memory.export("last", tmp_path / "last.parquet")


# === datasette ================================================================================================
#
# The metadata for Datasette: hidden tables, described views, and queries that SQLite answers.

WITH_BYTES = {"recall_block"}
"""The views with a column of bytes, whose pages Datasette answers with an error."""


@pytest.fixture
async def described(reading: Reading) -> dict[str, Any]:
    """Return the description of the one database."""
    metadata = await datasette_metadata(reading)
    assert [*metadata["databases"]] == ["pycrorm"]
    database: dict[str, Any] = metadata["databases"]["pycrorm"]
    return database


async def test_internal_tables_are_hidden_and_views_are_described_sorted_and_faceted(
    described: dict[str, Any], kitchen: Path
) -> None:
    tables = described["tables"]
    with contextlib.closing(sqlite3.connect(kitchen / "pycrorm.db")) as plain:
        names = dict(plain.execute("SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')").fetchall())
    assert tables.keys() == names.keys()
    shown = {name for name, each in tables.items() if not each.get("hidden")}
    assert {name for name in shown if names[name] == "table"} == {"event", "episode"}
    assert {name for name in names if names[name] == "view"} - shown == WITH_BYTES
    columns = tables["root_failure"].pop("columns")
    assert columns["message"] == "its message"
    assert columns["start_time"] == "when the node started; µs since 1970-01-01 00:00 UTC"
    assert tables["root_failure"] == {
        "description": " ".join((RootFailure.__doc__ or "").partition("\n\n")[0].split()),
        "sort_desc": "id",
        "facets": ["dtype", "status", "reason", "arm"],
    }


async def test_every_question_is_a_query_with_parameters_for_what_it_needs(
    described: dict[str, Any], kitchen: Path
) -> None:
    queries = described["queries"]
    assert queries.keys() == {*QUESTIONS}
    given = {"name": "Milk", "x": "0.7", "y": "0.55"}
    with contextlib.closing(sqlite3.connect(f"file:{kitchen}/pycrorm.db?mode=ro", uri=True)) as plain:
        rows = {name: plain.execute(each["sql"], given).fetchall() for name, each in queries.items()}
    assert len(rows["episodes"]) == 4
    assert len(rows["root_failures"]) == 2
    for name, words in (("object_history", ":name"), ("moves_of", ":name"), ("experience_at", ":x")):
        assert words in queries[name]["sql"]
        assert rows[name]


async def test_a_server_is_refused(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    async with Memory.open(url, spool=tmp_path), Reading.open(url) as reading:
        with pytest.raises(CallerError, match="Datasette opens SQLite files: copy"):
            await datasette_metadata(reading)


@pytest.mark.slow
def test_the_command_prints_the_metadata(kitchen: Path) -> None:
    done = pycrorm("datasette-metadata", cwd=kitchen)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["databases"].keys() == {"pycrorm"}


# === export again =============================================================================================
#
# An export is made again from its manifest, which names what differs.

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


async def test_what_differs_from_the_manifest_is_named(scripted: Reading, tmp_path: Path) -> None:
    await export(scripted, "2", tmp_path / "nodes.csv")
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
        assert (await export_again(scripted, file)).differences == (line,)
    file.write_text(text.replace("8000-000000000002", "8000-000000000009"))
    remade = await export_again(scripted, file)
    assert not remade.same
    assert remade.differences == (f"episode 2 ({ID[:-1]}9) is not in this memory",)
    for broken in ("{}", "not json"):
        file.write_text(broken)
        with pytest.raises(CallerError, match="is not a manifest of an export"):
            await export_again(scripted, file)
    file.unlink()
    with pytest.raises(CallerError, match=r"^the manifest \S+ cannot be read: No such file or directory$"):
        await export_again(scripted, file)


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
        of_digits = await reading.ask.durations(episode="0000").rows()
        assert await reading.rows(reading.ask.durations(episode=ID).statement) == of_digits != []
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
