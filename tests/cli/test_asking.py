"""`pycrorm ask`, `query`, `diff` and the choices of `episodes`, as a user types them."""

from __future__ import annotations

import csv
import io
import json
import shlex
import subprocess
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.cli.main import app
from pycrorm_async.cli.output import parse_since
from pycrorm_async.errors import CallerError
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.world import Pose
from tests.commands import COMMAND, answer, environment, one_line_of, pycrorm
from tests.databases import run_in_own_loop
from tests.projections.event_script import append_and_fold
from tests.query.random_memory import TYPES, RandomEpisode, root_failures_of

pytestmark = pytest.mark.slow

EPISODES = [RandomEpisode(number, seed=number) for number in range(1, 8)]
RECORDS = [*TYPES, *(record for each in EPISODES for record in each.records)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a memory as `pycrorm.db`."""
    folder = tmp_path_factory.mktemp("asking")
    run_in_own_loop(append_and_fold(f"sqlite:///{folder / 'pycrorm.db'}", RECORDS))
    return folder


# --- ask ------------------------------------------------------------------------------------------------------


def test_a_question_is_answered_as_a_table_and_as_json(folder: Path) -> None:
    document = answer("ask", "root_failures", "--object", "milk", "--recovered", cwd=folder)
    failures = [each for each in root_failures_of(EPISODES) if "milk" in (each.object or "") and each.recovered]
    assert failures
    assert [(each["episode"], each["sequence"], each["reason"]) for each in document] == [
        (each.episode, each.sequence, each.reason) for each in failures
    ]
    shown = pycrorm("ask", "durations", "--episode", "last", "--kind", "motion", cwd=folder)
    assert shown.returncode == 0
    assert "longest" in shown.stdout
    mistaken = pycrorm("ask", "durations", "--dtype", "PickUpActoin", cwd=folder)
    assert (mistaken.returncode, "has no type PickUpActoin; did you mean PickUpAction?" in mistaken.stderr) == (0, True)
    assert "MoveMotion" in shown.stdout


def test_without_a_name_the_questions_are_listed_and_with_sql_the_statement(folder: Path) -> None:
    listed = pycrorm("ask", cwd=folder)
    assert listed.returncode == 0
    assert all(each in listed.stdout for each in QUESTIONS)
    shown = pycrorm("ask", "moves_of", "milk", "--sql", "--limit", "3", cwd=folder)
    assert shown.stdout.startswith("WITH RECURSIVE")
    assert "lower(object.name) = lower('milk')" in shown.stdout
    assert pycrorm("query", shown.stdout, cwd=folder).returncode == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["root_failure"], "root_failures"),
        (["root_failures", "--objekt", "milk"], "--object"),
        (["root_failures", "--limit", "many"], "'--limit': Input should be a valid integer"),
        (["episodes", "--since", "yesterday"], "'yesterday' is not a time: write 2026-11-23"),
        (["moves_of"], "missing argument 'name'"),
        (["experience_at", "--x", "1"], "missing option '--y'"),
    ],
)
def test_a_wrong_name_option_or_value_is_answered_with_one_line(words: list[str], says: str, folder: Path) -> None:
    result = pycrorm("ask", *words, cwd=folder)
    assert result.returncode == 2
    assert says in one_line_of(result)


def test_each_question_is_a_verb_whose_options_have_a_help() -> None:
    group = app("ask").registered_groups[0].typer_instance
    assert group is not None
    assert tuple(each.name for each in group.registered_commands) == QUESTIONS


def test_a_closed_pipe_and_closed_streams_are_no_fault(folder: Path) -> None:
    def run(arguments: str, then: str) -> subprocess.CompletedProcess[str]:
        command = f"{shlex.join(COMMAND)} query {arguments} {then}"
        return subprocess.run(
            ["bash", "-c", command], cwd=folder, env=environment(), capture_output=True, text=True, check=True
        )

    piped = run("'SELECT a.* FROM event a, event b' --format csv --limit 0", "| head -1; echo ${PIPESTATUS[0]}")
    assert (piped.stdout, piped.stderr) == ("episode,sequence,type,version,wall_ns,monotonic_ns,payload\n0\n", "")
    run("'SELECT 1' --json", "<&- >&- 2>&-")


# --- query ----------------------------------------------------------------------------------------------------


def test_a_query_is_printed_as_a_table_as_csv_and_as_json(folder: Path) -> None:
    sql = "SELECT id AS n, status, NULL AS empty, 0.1 + 0.2 AS sum, x'ff00' AS bytes, 1 AS n FROM process_metadata"
    infinite = "SELECT 1e999 AS x, x'ff00' AS y"
    lines = list(csv.reader(io.StringIO(pycrorm("query", sql, "--format", "csv", cwd=folder).stdout)))
    assert lines[0] == ["n", "status", "empty", "sum", "bytes", "n"]
    assert lines[1] == ["1", lines[1][1], "", "0.30000000000000004", "ff00", "1"]
    assert len(lines) == 8
    document = answer("query", sql, cwd=folder)
    assert document["columns"] == ["n", "status", "empty", "sum", "bytes", "n_1"]
    assert document["rows"][0]["sum"] == 0.1 + 0.2
    assert not document["more"]
    assert answer("query", infinite, cwd=folder)["rows"] == [{"x": "Infinity", "y": "ff00"}]
    assert json.loads(pycrorm("query", sql, "--format", "json", cwd=folder).stdout) == document
    shown = pycrorm("query", sql, "--limit", "2", cwd=folder)
    assert "0.30000000000000004" in shown.stdout
    assert "the query has more rows: these are the first, up to 2 rows and 16 MB" in shown.stderr
    assert "more" not in pycrorm("query", sql, "--limit", "0", cwd=folder).stderr


def test_a_name_of_a_column_is_printed_as_it_is_also_in_brackets_and_colons(folder: Path) -> None:
    columns = "1 AS '[/x]', 2 AS '[red]y', 3 AS ':fire:'"
    for sql in (f"SELECT {columns}", f"SELECT task_tree_node.*, {columns} FROM task_tree_node LIMIT 1"):  # also a block
        shown = pycrorm("query", sql, cwd=folder)
        assert (shown.returncode, shown.stderr) == (0, "")
        assert "[/x]" in shown.stdout
        assert "[red]y" in shown.stdout
        assert ":fire:" in shown.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["DELETE FROM event"], "a query may only read: it is one SELECT, or WITH … SELECT; DELETE is not allowed"),
        (["SELECT 1", "--format", "xml"], "xml"),
        (["SELECT 1", "--json", "--format", "csv"], "exclude each other"),
    ],
)
def test_a_query_that_is_refused_is_answered_with_one_line(words: list[str], says: str, folder: Path) -> None:
    result = pycrorm("query", *words, cwd=folder)
    assert result.returncode == 2
    assert says in one_line_of(result)


# --- diff and episodes ----------------------------------------------------------------------------------------


def test_two_episodes_are_compared(folder: Path) -> None:
    shown = pycrorm("diff", "1", "last", cwd=folder)
    assert shown.returncode == 0
    assert "A: episode 1, run 1 of milk" in shown.stdout
    assert "B: episode 7, run 7 of milk" in shown.stdout
    assert "differences; " in shown.stderr
    document = answer("diff", "1", "7", cwd=folder)
    assert document["first"]["number"] == 1
    assert {each["of"] for each in document["differences"]} == {"episode", "node", "object"}
    assert pycrorm("diff", "1", "last", "--sql", cwd=folder).stdout.startswith("-- facts of episode 1\nSELECT ")
    assert "there is no episode '70'" in one_line_of(pycrorm("diff", "1", "70", cwd=folder))


def test_episodes_are_chosen_by_status_text_start_and_number(folder: Path) -> None:
    def numbers(*words: str) -> list[int]:
        return [each["number"] for each in answer("episodes", *words, cwd=folder)]

    assert numbers("--status", "running") == [5]
    assert numbers("--text", "RUN 3") == [3]
    assert numbers("--limit", "2") == [6, 7]
    assert numbers("--since", "2023-11-14") == list(range(1, 8))
    assert numbers("--since", "1d") == []
    assert numbers("--robot", "pr2") == []
    assert "did you mean RUNNING?" in one_line_of(pycrorm("episodes", "--status", "runing", cwd=folder))
    assert "is not a time" in one_line_of(pycrorm("episodes", "--since", "monday", cwd=folder))


def test_an_unknown_tag_or_robot_is_answered_with_the_nearest_one(tmp_path: Path) -> None:
    with (
        Memory.sync(f"sqlite:///{tmp_path / 'pycrorm.db'}") as memory,
        memory.recording.episode(description="a walk", tags=["kitchen"]) as episode,
    ):
        episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
    for options, mistake in {
        ("--tag", "kitchn"): "the memory has no tag kitchn; did you mean kitchen?",
        ("--tag", "kitchen", "--tag", "nihgt"): "the memory has no tag nihgt",
        ("--tag", ""): "the memory has no tag ''",
        ("--robot", "Turtle"): "the memory has no robot Turtle; did you mean turtle?",
        ("--tag", "kitchen", "--status", "FAILED"): "`pycrorm episodes` lists all",
    }.items():
        done = pycrorm("episodes", *options, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (0, "")
        assert done.stderr == f"no episode matches these options; {mistake}\n"


@pytest.mark.parametrize("text", ["", "7", "7 years", "2026-13-01", "9999999d", "999999w"])
def test_an_impossible_start_is_refused(text: str) -> None:
    with pytest.raises(CallerError, match="is not a time"):
        parse_since(text)
