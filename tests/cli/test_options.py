"""The options that all verbs share."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

import pycrorm_async
from pycrorm_async.cli.main import app
from tests.cli.note_plan import NOTES_PLAN
from tests.commands import answer, environment, pycrorm

pytestmark = pytest.mark.slow


def test_every_verb_that_opens_a_database_accepts_its_spool_too() -> None:
    group = typer.main.get_command(app())
    assert isinstance(group, TyperGroup)
    options = {name: {option for each in verb.params for option in each.opts} for name, verb in group.commands.items()}
    assert {name for name, accepted in options.items() if "--url" in accepted and "--spool" not in accepted} == set()
    assert {"verify", "rebuild", "episodes"} <= {name for name, accepted in options.items() if "--url" in accepted}


def test_the_command_prints_its_version(tmp_path: Path) -> None:
    done = pycrorm("--version", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, f"pycrorm {pycrorm_async.__version__}\n")


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        pytest.param("pycrorm reb", "rebuild", marks=pytest.mark.soak),
        ("pycrorm run --wr", "--writer"),
        ("pycrorm spool rep", "repair"),
    ],
)
def test_a_shell_completes_verbs_and_their_options(tmp_path: Path, words: str, completed: str) -> None:
    typed = {"_PYCRORM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    script = Path(sys.executable).with_name("pycrorm")
    done = subprocess.run(
        [script], cwd=tmp_path, env=environment() | typed, capture_output=True, text=True, check=False
    )
    assert (done.stdout.strip(), done.stderr) == (completed, "")


@pytest.mark.parametrize("verb", ["verify", "rebuild"])
def test_verify_and_rebuild_name_the_events_that_wait_in_the_spool(tmp_path: Path, verb: str) -> None:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    spool = tmp_path / "elsewhere"
    assert pycrorm("run", "notes.py", "--spool", spool, cwd=tmp_path).returncode == 0
    assert pycrorm("run", "notes.py", "--spool", spool, "--writer", "daemon", cwd=tmp_path).returncode == 0
    done = pycrorm(verb, "--spool", spool, cwd=tmp_path)
    assert done.returncode == 0
    assert done.stderr == (
        "1 dead recorder left events that are not in the database: "
        f"run `pycrorm writer --once --url sqlite:///pycrorm.db --spool {spool}` to store them.\n"
    )
    assert answer(verb, cwd=tmp_path)["episodes"] == 1


@pytest.mark.parametrize("verb", ["verify", "rebuild"])
def test_a_temporary_database_is_refused_in_one_line(tmp_path: Path, verb: str) -> None:
    done = pycrorm(verb, "--url", "sqlite://", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "pycrorm: sqlite:// exists only in its own process, no other can open it: name a file\n"
