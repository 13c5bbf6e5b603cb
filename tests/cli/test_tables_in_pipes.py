"""Programs read tables too: whole lines in a pipe, CSV that spreadsheets may open, exports of chosen episodes."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pycrorm_async.memory import Memory
from pycrorm_async.visible_text import without_formula
from tests.commands import answer, pycrorm

pytestmark = pytest.mark.slow
LONG = "ReachabilityFailure " * 30
FORMULAS = ("=1+1", "+1", "-1+2", "@SUM(A1)", "\t=1", "\r=1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a memory of five episodes: tagged good, good and noisy, noisy, none, and one that failed."""
    folder = tmp_path_factory.mktemp("tables")
    with Memory.sync(f"sqlite:///{folder / 'pycrorm.db'}") as memory:
        step = memory.recording.type("action", "StepAction", {"what": str, "level": float})
        for number, tags in enumerate((["good"], ["good", "noisy"], ["noisy"], [], [])):
            with memory.recording.episode(description=f"{number} {LONG}", tags=tags) as episode:
                for index, formula in enumerate(FORMULAS):
                    episode.start(index, step, {"what": formula, "level": 0.5 + number / 10})
                    failure = f"{LONG} {index}" if number == 4 else None
                    episode.end(index, "FAILED" if failure else "SUCCEEDED", failure)
        memory.flush()
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["episodes"],
        ["show", "5", "--full"],
        ["ask", "root_failures"],
        ["query", "SELECT description FROM process_metadata"],
    ],
)
def test_a_piped_table_breaks_no_line(words: list[str], folder: Path) -> None:
    done = pycrorm(*words, cwd=folder)
    whole = [line for line in done.stdout.splitlines() if "Reachability" in line]
    assert whole != []
    assert all(" ".join(line.split()).count(LONG.strip()) == 1 for line in whole)


@pytest.mark.parametrize(
    "words",
    [
        ["episodes"],
        ["ask", "durations"],
        ["ask", "root_failures", "--limit", "3"],
        ["recall", "StepAction"],
        ["recall", "--follows", "StepAction"],
        ["diff", "1", "5"],
        ["copy", "--to", "sqlite:///{OUT}/copy.db"],
        ["run", "{OUT}/greet.py", "--url", "sqlite:///{OUT}/run.db"],
        ["query", "SELECT description, id FROM process_metadata"],
    ],
)
def test_every_table_of_an_answer_is_csv_on_request(words: list[str], folder: Path, tmp_path: Path) -> None:
    (tmp_path / "greet.py").write_text("async def plan():\n    print('Hello!')\n")
    words = [each.format(OUT=tmp_path) for each in words]
    done = pycrorm(*words, "--csv", cwd=folder)
    assert done.returncode == 0
    head, *rows = csv.reader(io.StringIO(done.stdout))
    assert len(rows) > 0
    assert {len(row) for row in rows} == {len(head)}
    both = pycrorm(*words, "--csv", "--json", cwd=folder)
    assert (both.returncode, both.stdout) == (2, "")
    assert "exclude each other" in both.stderr


def test_csv_of_a_query_has_each_text_unchanged_or_without_formulas(folder: Path) -> None:
    sql = "SELECT what, level FROM step_action WHERE process_metadata_id = 1 ORDER BY id"
    exact = pycrorm("query", sql, "--csv", cwd=folder).stdout  # read as a text, in which a CR is a line end
    cells = [row[0] for row in csv.reader(io.StringIO(exact, newline=""))][1:]
    assert cells == [each.replace("\r", "\n") for each in FORMULAS]
    guarded = pycrorm("query", sql, "--csv-no-formulas", cwd=folder).stdout
    cells = [row[0] for row in csv.reader(io.StringIO(guarded))][1:]
    assert {each[0] for each in cells} == {"'"}
    assert ",0.5" in guarded  # a number is none
    assert [without_formula(each) for each in ("milk", "", "a=b", *FORMULAS)] == [
        "milk", "", "a=b", *(f"'{each}" for each in FORMULAS),
    ]  # fmt: skip


@pytest.mark.soak
def test_an_export_of_csv_has_no_formulas_on_request_and_is_made_again_alike(folder: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{folder / 'pycrorm.db'}"
    for options in ([], ["--no-formulas"]):
        out = tmp_path / f"steps{len(options)}.csv"
        done = pycrorm("export", "step_action", "--out", out, *options, "--url", url, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        with out.open(newline="") as file:
            texts = [row["what"] for row in csv.DictReader(file)]
        assert {each in FORMULAS for each in texts} == {not options}
        assert {each.startswith("'") for each in texts} == {bool(options)}
        again = pycrorm("export", "--again", f"{out}.manifest.json", "--url", url, cwd=tmp_path)
        assert (again.returncode, again.stdout) == (0, "the same bytes\n")
    refused = pycrorm("export", "1", "--out", "x.jsonl", "--no-formulas", "--url", url, cwd=tmp_path)
    assert (refused.returncode, "format csv" in refused.stderr) == (2, True)


@pytest.mark.parametrize(
    ("options", "numbers"),
    [
        (["--tag", "good"], [1, 2]),
        (["--tag", "good", "--tag", "noisy"], [2]),
        (["--without-tag", "noisy"], [1, 4, 5]),
        (["--tag", "good", "--without-tag", "noisy"], [1]),
        (["--status", "SUCCEEDED", "--without-tag", "good", "--without-tag", "noisy"], [4, 5]),
    ],
)
def test_an_export_has_the_episodes_with_and_without_tags(
    options: list[str], numbers: list[int], folder: Path, tmp_path: Path
) -> None:
    url = f"sqlite:///{folder / 'pycrorm.db'}"
    done = answer("export", *options, "--out", tmp_path / "chosen.jsonl", "--url", url, cwd=tmp_path)
    assert done["episodes"] == len(numbers)
    manifest = json.loads((tmp_path / "chosen.jsonl.manifest.json").read_text())
    assert [each["number"] for each in manifest["episodes"]] == numbers


def test_an_export_of_no_episode_is_refused_with_the_condition(folder: Path) -> None:
    done = pycrorm("export", "--tag", "god", "--out", "none.csv", cwd=folder)
    assert (done.returncode, (folder / "none.csv").exists()) == (2, False)
    assert "god" in done.stderr
    both = pycrorm("export", "1", "--tag", "good", "--out", "none.csv", cwd=folder)
    assert both.returncode == 2


def test_the_number_of_recalled_actions_has_two_names(folder: Path) -> None:
    limited = [answer("recall", "StepAction", option, "2", cwd=folder) for option in ("--limit", "--k")]
    assert [len(each["cases"]) for each in limited] == [2, 2]


def test_the_text_of_a_status_and_of_the_questions_has_what_is_present(folder: Path) -> None:
    with Memory.sync(f"sqlite:///{folder / 'pycrorm.db'}") as memory:
        memory.flush()  # the writer's thread drains from now on
        status, questions = repr(memory.status), repr(memory.ask)
    assert (status.startswith("MemoryStatus("), "drained=True" in status, "None" in status) == (True, True, False)
    assert "durations" in questions


def test_a_column_that_the_view_of_all_nodes_has_is_named_with_the_join(folder: Path) -> None:
    for column in ("status", "step_action.status"):
        done = pycrorm("query", f"SELECT {column} FROM step_action", cwd=folder)
        assert done.returncode == 2
        assert "task_tree_node has status: JOIN task_tree_node USING (id)" in done.stderr
    assert "task_tree_node" not in pycrorm("query", "SELECT nothing FROM step_action", cwd=folder).stderr
    joined = answer("query", "SELECT DISTINCT status FROM step_action JOIN task_tree_node USING (id)", cwd=folder)
    assert [row["status"] for row in joined["rows"]] == ["SUCCEEDED", "FAILED"]


def test_a_pipe_gets_no_colour_and_no_bar_where_notebooks_and_services_set_force_color(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path / 'pycrorm.db'}") as memory:
        memory.recording.episode(description="\x1b red").close()
    words = [sys.executable, "-m", "pycrorm_async"]
    for verb in (["episodes", "--csv"], ["copy", "--from", "sqlite:///pycrorm.db", "--to", "sqlite:///b.db"]):
        done = subprocess.run(
            [*words, *verb], cwd=tmp_path, env=os.environ | {"FORCE_COLOR": "1"}, capture_output=True, check=True
        )
        assert done.stdout.count(b"\x1b") == verb.count("--csv")  # the text of the episode
        assert done.stderr == b""
