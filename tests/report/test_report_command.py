"""`pycrorm report`: the files it writes whole or not at all, the table of episodes, and its mistakes."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import shutil
import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import msgspec
import pytest
from typer.testing import CliRunner

from pycrorm_async import Memory, Reading
from pycrorm_async.cli import report as command
from pycrorm_async.cli.main import app
from pycrorm_async.cli.output import Chosen
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.named_queries import EpisodeChoice
from pycrorm_async.report import document
from pycrorm_async.report import overview as overview_file
from pycrorm_async.report.output_files import new_file, new_folder, write_file
from pycrorm_async.report.overview import overview
from tests.commands import one_line_of, pycrorm
from tests.full_disk import files_of_at_most

# === report command ===========================================================================================
#
# `pycrorm report`: the file it writes, and one line for each mistake that prevents it.


@pytest.mark.slow
def test_a_page_has_the_name_of_its_episode_or_the_given_one_and_replaces_a_file_only_when_asked(
    recorded: Path, tmp_path: Path
) -> None:
    done = pycrorm("report", "last", cwd=recorded)
    assert (done.returncode, done.stdout) == (0, "episode-3.html\n")
    assert (recorded / "episode-3.html").exists()
    file = tmp_path / "a b.html"
    file.write_text("mine")
    done = pycrorm("report", "1", "--out", file, cwd=recorded)
    assert done.returncode == 2
    assert one_line_of(done) == f"pycrorm: {file} exists: add --force to replace it, or give another name"
    assert file.read_text() == "mine"
    answer = json.loads(pycrorm("report", "1", "--out", file, "--force", "--json", cwd=recorded).stdout)
    assert (answer["file"], answer["bytes"]) == (str(file), file.stat().st_size)
    assert (answer["first"], answer["last"]) == (1, answer["events"])
    assert file.read_text().startswith("<!doctype html>")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("77",), "pycrorm: there is no episode '77' (`pycrorm episodes` lists all 3)"),
        ((), "pycrorm: name an episode, for example `pycrorm report last`, or write all of them with --all"),
        (("1", "--all"), "pycrorm: name the episode 1 or write all of them with --all, not both"),
        (("1", "--tag", "x"), "pycrorm: an option chooses among all episodes (tag x): add --all"),
        (("--all", "--from", "3"), "pycrorm: --from and --to choose events of one episode: name it instead of --all"),
        (("--all", "--robot", "none"), "pycrorm: no episode matches these options; the memory has no robot none"),
        (("--all", "--status", "LOTS"), "LOST"),
        (("1", "--out", "none/page.html"), "pycrorm: the folder none does not exist: create it first"),
        (("1", "--from", "9999", "--out", "window.html"), "and none from event 9999 to"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_file(recorded: Path, arguments: tuple[str, ...], message: str) -> None:
    before = sorted(recorded.glob("*.html"))
    done = pycrorm("report", *arguments, cwd=recorded)
    assert done.returncode == 2
    assert message in one_line_of(done)
    assert sorted(recorded.glob("*.html")) == before


@pytest.mark.slow
def test_a_table_of_many_episodes_has_the_newest_and_says_how_many_it_left_out(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(overview_file, "_EPISODES_MAX", 2)
    monkeypatch.setattr(overview_file, "PAGES_MAX", 1)
    url = f"sqlite:///{recorded}/pycrorm.db"

    async def newest(choice: EpisodeChoice | None) -> tuple[list[int], int]:
        async with Reading.open(url) as reading:
            listed, total = await overview_file.newest_episodes(reading, choice)
            return [each.number for each in listed], total

    for choice, total in ((None, 3), (EpisodeChoice(limit=3), 3), (EpisodeChoice(limit=2), 2)):
        assert asyncio.run(newest(choice)) == ([2, 3], total)
    shown = CliRunner().invoke(app("report"), ["report", "--all", "--out", str(tmp_path / "all.html"), "--url", url])
    assert shown.exit_code == 0, shown.output
    assert shown.stderr.splitlines() == [
        "It has the newest 2 episodes of 3; pages of 1 are in all.pages beside it.",
        "--since, --status, --tag, --robot and --text choose others.",
        "The others have no page: `pycrorm report NUMBER` writes one.",
    ]
    assert [each.name for each in (tmp_path / "all.pages").iterdir()] == ["episode-3.html"]


@pytest.mark.slow
async def test_an_action_without_a_type_is_counted_in_the_table_of_all_episodes(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    async with Memory.open(url) as memory:
        with memory.recording.episode(description="untyped") as episode:
            episode.start("a", memory.recording.type("action", None))  # type: ignore[arg-type]
            episode.end("a")
    async with Reading.open(url) as reading:
        written = await overview(reading, tmp_path / "all.html")
    assert (written.episodes, written.unreadable) == (1, {})
    columns = in_page(tmp_path / "all.html")["episodes"]
    [[name, [good, tries, ended, _]]] = columns["actions"]
    assert (columns["texts"][name], good, tries, ended) == ("action", 1, 1, 1)


@pytest.mark.slow
def test_a_damaged_episode_has_a_row_with_the_reason_and_the_others_their_pages(recorded: Path, tmp_path: Path) -> None:
    shutil.copy(recorded / "pycrorm.db", tmp_path / "copy.db")
    with closing(sqlite3.connect(tmp_path / "copy.db")) as database, database:
        for (trigger,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            database.execute(f"DROP TRIGGER {trigger}")
        database.execute("UPDATE event SET payload = '{' WHERE episode = 2 AND sequence = 5")
    database.close()
    out = tmp_path / "all.html"
    done = pycrorm("report", "--all", "--out", out, "--json", "--url", f"sqlite:///{tmp_path}/copy.db", cwd=tmp_path)
    answer = json.loads(done.stdout)
    assert (done.returncode, answer["pages"], list(answer["unreadable"])) == (1, 2, ["2"])
    assert one_line_of(done).startswith("pycrorm: episode 2 has no page: episode ")
    assert "event 5: " in one_line_of(done)
    assert [each.name for each in sorted((tmp_path / "all.pages").iterdir())] == ["episode-1.html", "episode-3.html"]
    columns = in_page(out)["episodes"]
    assert [each is None for each in columns["page"]] == [False, True, False]
    assert ["event 5: " in columns["texts"][each] for each in columns["unreadable"]] == [False, True, False]


@pytest.mark.slow
async def test_a_disk_that_fills_leaves_no_page_and_no_folder_of_a_table_of_episodes(
    recorded: Path, tmp_path: Path
) -> None:
    async with Reading.open(f"sqlite:///{recorded / 'pycrorm.db'}") as reading:
        with files_of_at_most(10_000), pytest.raises(OSError, match="File too large"):
            await overview(reading, tmp_path / "all.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_full_page_names_the_next_window(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[str] = []
    monkeypatch.setattr(document, "_NODES_MAX", 2)
    monkeypatch.setattr("pycrorm_async.cli.output.note", notes.append)
    place = ReadingPlace(f"sqlite:///{recorded / 'pycrorm.db'}")
    for number, (first, last, continues) in enumerate(((None, None, True), (3, None, True), (None, 4, False))):
        notes.clear()
        page = tmp_path / f"page {number}.html"
        command.report(episode="1", chosen=Chosen(), out=page, first=first, last=last, place=place)
        assert any("the next page: --from " in each for each in notes) == continues


# === output files =============================================================================================
#
# A file or folder has its name only when it is complete and on the disk.


class WatchedSyncs:
    """Notes, for each sync, the file or folder, its bytes, and whether the target has its name already."""

    def __init__(self, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.noted: list[tuple[str, bytes | None, bool]] = []
        fsync = os.fsync

        def watched(descriptor: int) -> None:
            path = Path(f"/proc/self/fd/{descriptor}").readlink()
            content = path.read_bytes() if path.is_file() else None
            self.noted.append((path.name, content, target.exists()))
            fsync(descriptor)

        monkeypatch.setattr(os, "fsync", watched)


@pytest.mark.parametrize("force", [False, True])
def test_a_file_is_synced_before_it_gets_its_name_and_its_folder_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, force: bool
) -> None:
    target = tmp_path / "rows.csv"
    syncs = WatchedSyncs(target, monkeypatch)
    write_file(b"all of it", target, force=force)
    assert [(content, named) for _, content, named in syncs.noted] == [(b"all of it", False), (None, True)]
    assert syncs.noted[-1][0] == tmp_path.name
    assert [each.name for each in tmp_path.iterdir()] == ["rows.csv"]


def test_a_file_that_is_named_as_a_folder_is_called_a_file(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_bytes(b"notes")
    for below in (file / "rows.csv", file / "folder/rows.csv"):
        with pytest.raises(CallerError, match=f"{file} is a file, so {below} cannot be written below it: give the"):
            write_file(b"rows", below, force=True)
    assert file.read_bytes() == b"notes"


def test_a_file_that_another_process_made_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "rows.csv"
    with pytest.raises(CallerError, match="exists: add --force"), new_file(target, force=False) as written:
        written.write_bytes(b"all of it")
        target.write_bytes(b"of another process")
    assert target.read_bytes() == b"of another process"
    assert [each.name for each in tmp_path.iterdir()] == ["rows.csv"]


def test_all_files_of_a_folder_are_synced_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "set"
    syncs = WatchedSyncs(target, monkeypatch)
    with new_folder(target, force=False, marker="info") as written:
        (written / "info").write_bytes(b"1")
        (written / "data").mkdir()
        (written / "data" / "rows").write_bytes(b"2")
    *before, after = syncs.noted
    assert {name: content for name, content, _ in before} | {written.name: None} == {
        "info": b"1",
        "data": None,
        "rows": b"2",
        written.name: None,
    }
    assert [named for *_, named in before] == [False] * 4
    assert (after[0], after[2]) == (tmp_path.name, True)


@pytest.mark.parametrize("new", [new_file, partial(new_folder, marker="meta")])
def test_an_error_of_a_part_names_the_file_that_the_user_asked_for_and_another_keeps_its_name(
    new: Any, tmp_path: Path
) -> None:
    manifest = tmp_path / "a.manifest.json"
    with (
        pytest.raises(OSError, match="No space left") as refused,
        new_file(manifest, force=False),
        new(tmp_path / "a", force=False) as part,
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(part))
    assert refused.value.filename == str(tmp_path / "a")
    with pytest.raises(FileNotFoundError) as missing, new(tmp_path / "a", force=False):
        (tmp_path / "mesh.stl").read_bytes()
    assert missing.value.filename == str(tmp_path / "mesh.stl")
    assert list(tmp_path.iterdir()) == []


# === overview =================================================================================================
#
# The table of episodes has those that `pycrorm episodes` lists with the same options, and names the choice.


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the URL of a memory with three episodes: the second fails, the third has a tag."""
    address = f"sqlite:///{tmp_path_factory.mktemp('overview') / 'memory.db'}"
    with Memory.sync(address) as memory:
        grasp = memory.recording.type("action", "GraspAction", {"arm": str, "grams": float})
        for number in range(3):
            tags = ("night",) if number == 2 else ()
            with memory.recording.episode(description=f"grasp {'milk' if number else 'bowl'}", tags=tags) as episode:
                for arm in ("left", "right"):
                    episode.start(arm, grasp, {"arm": arm, "grams": 100.0 * number})
                    episode.end(arm, "FAILED" if number == 1 else "SUCCEEDED", "slipped")
        memory.flush()
    return address


def report(url: str, out: Path, *options: str) -> tuple[int, str]:
    done = CliRunner().invoke(app("report"), ["report", "--all", "--out", str(out), "--url", url, *options])
    return done.exit_code, done.output


def in_page(page: Path) -> Any:
    return msgspec.json.decode(page.read_text().partition('id="document">')[2].partition("</script>")[0])


@pytest.mark.parametrize(
    ("options", "numbers", "title"),
    [
        ((), [1, 2, 3], "Episodes"),
        (("--tag", "night", "--status", "succeeded"), [3], "Episodes: status succeeded; tag night"),
        (
            ("--since", "2026-01-02 03:04", "--limit", "2"),
            [2, 3],
            "Episodes: since 2026-01-02 03:04:00 UTC; the newest 2",
        ),
    ],
)
def test_a_table_has_the_chosen_episodes_and_their_pages(
    url: str, tmp_path: Path, options: tuple[str, ...], numbers: list[int], title: str
) -> None:
    assert report(url, tmp_path / "all.html", *options)[0] == 0
    document = in_page(tmp_path / "all.html")
    assert (document["title"], document["total"]) == (title, len(numbers))
    assert document["episodes"]["number"] == numbers
    assert sorted(each.stem for each in (tmp_path / "all.pages").iterdir()) == [f"episode-{each}" for each in numbers]


def test_successes_over_any_columns_of_the_chosen_episodes_are_in_the_page(url: str, tmp_path: Path) -> None:
    plots = ("--plot", "arm,grams,GraspAction", "--plot", "kind, dtype, action")
    assert report(url, tmp_path / "all.html", "--text", "milk", *plots) == (0, ANY)
    grasps, actions = in_page(tmp_path / "all.html")["successes"]
    assert (grasps["of"], grasps["x"]["name"], grasps["y"]["name"]) == ("GraspAction", "arm", "grams")
    assert (grasps["succeeded"], grasps["rows"], grasps["x"]["labels"]) == (2, 4, ["left", "right"])
    assert sorted(rows for *_, rows in grasps["cells"]) == [1, 1, 1, 1]
    assert (actions["of"], actions["rows"], actions["y"]["labels"]) == ("action", 4, ["GraspAction"])


@pytest.mark.parametrize(
    ("plot", "message"),
    [
        ("arm", "--plot 'arm' must be X,Y or X,Y,VIEW, for example arm,grasp,PickUpAction"),
        ("arm,grasp,GraspActoin", "there is no view 'GraspActoin'; did you mean grasp_action"),
        ("arm,gram,GraspAction", "GraspAction has no column 'gram'; did you mean grams?"),
        ("arm,grasp", "no row of PickUpWithContextView succeeded or failed and has arm and grasp"),
    ],
)
def test_a_plot_that_cannot_be_drawn_is_one_line_and_leaves_no_file(
    url: str, tmp_path: Path, plot: str, message: str
) -> None:
    code, text = report(url, tmp_path / "all.html", "--plot", plot)
    assert (code, text.count("\n")) == (2, 1)
    assert message in text
    assert list(tmp_path.iterdir()) == []
