"""`pycrorm report`: the file it writes, and one line for each mistake that prevents it."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from pycrorm_async import Reading
from pycrorm_async.cli import report as command
from pycrorm_async.report import document
from pycrorm_async.report.write import overview, write_page
from tests.commands import one_line_of, pycrorm
from tests.full_disk import files_of_at_most

pytestmark = pytest.mark.slow


def test_the_command_prints_the_file_and_its_size(recorded: Path, tmp_path: Path) -> None:
    done = pycrorm("report", "1", "--out", tmp_path / "a b.html", "--json", cwd=recorded)
    answer = json.loads(done.stdout)
    assert (answer["file"], answer["bytes"]) == (str(tmp_path / "a b.html"), (tmp_path / "a b.html").stat().st_size)
    assert (answer["first"], answer["last"]) == (1, answer["events"])


def test_without_a_name_the_file_is_named_after_the_episode(recorded: Path) -> None:
    done = pycrorm("report", "last", cwd=recorded)
    assert (done.returncode, done.stdout) == (0, "episode-3.html\n")
    assert (recorded / "episode-3.html").exists()


def test_a_file_that_exists_is_replaced_only_when_asked(recorded: Path, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text("mine")
    done = pycrorm("report", "1", "--out", file, cwd=recorded)
    assert done.returncode == 2
    assert one_line_of(done) == f"pycrorm: {file} exists: add --force to replace it, or give another name"
    assert file.read_text() == "mine"
    assert pycrorm("report", "1", "--out", file, "--force", cwd=recorded).returncode == 0
    assert file.read_text().startswith("<!doctype html>")


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


def test_a_memory_that_does_not_exist_is_one_line(tmp_path: Path) -> None:
    done = pycrorm("report", "1", cwd=tmp_path)
    assert done.returncode == 3
    assert "pycrorm.db" in one_line_of(done)
    assert list(tmp_path.iterdir()) == []


def test_all_episodes_are_a_table_with_pages_behind_it(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "my robots.html"
    done = pycrorm("report", "--all", "--out", out, "--json", cwd=recorded)
    assert json.loads(done.stdout) == {
        "file": str(out),
        "episodes": 3,
        "pages": 3,
        "left_out": 0,
        "unreadable": {},
    }
    names = [each.name for each in sorted((tmp_path / "my robots.pages").iterdir())]
    assert names == ["episode-1.html", "episode-2.html", "episode-3.html"]
    again = pycrorm("report", "--all", "--out", out, cwd=recorded)
    assert one_line_of(again) == f"pycrorm: {out} exists: add --force to replace it, or give another name"
    assert pycrorm("report", "--all", "--out", out, "--force", cwd=recorded).returncode == 0


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
    rows = msgspec.json.decode(out.read_text().partition('id="document">')[2].partition("</script>")[0])["episodes"]
    assert [(each["page"] is None, "event 5: " in each["unreadable"]) for each in rows] == [
        (False, False),
        (True, True),
        (False, False),
    ]


def test_a_disk_that_fills_leaves_no_partial_file(tmp_path: Path) -> None:
    with files_of_at_most(10_000), pytest.raises(OSError, match="File too large") as raised:
        write_page("x" * 100_000, tmp_path / "page.html")
    assert raised.value.filename == str(tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


async def test_a_disk_that_fills_leaves_no_page_and_no_folder_of_a_table_of_episodes(
    recorded: Path, tmp_path: Path
) -> None:
    async with Reading.open(f"sqlite:///{recorded / 'pycrorm.db'}") as reading:
        with files_of_at_most(10_000), pytest.raises(OSError, match="File too large"):
            await overview(reading, tmp_path / "all.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("first", "last", "continues"), [(None, None, True), (3, None, True), (None, 4, False)])
def test_a_full_page_names_the_next_window(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    first: int | None,
    last: int | None,
    *,
    continues: bool,
) -> None:
    notes: list[str] = []
    monkeypatch.setattr(document, "_NODES_MAX", 2)
    monkeypatch.setattr(command, "note", notes.append)
    url = f"sqlite:///{recorded / 'pycrorm.db'}"
    command.report("1", every=False, out=tmp_path / "page.html", first=first, last=last, url=url)
    assert any("the next page: --from " in each for each in notes) == continues
