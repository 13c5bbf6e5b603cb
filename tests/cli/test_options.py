"""The options that all verbs share."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

from pycrorm_async.cli.main import app
from tests.cli.note_plan import NOTES_PLAN
from tests.commands import answer, pycrorm


def test_every_verb_that_opens_a_database_takes_its_spool_too() -> None:
    group = typer.main.get_command(app())
    assert isinstance(group, TyperGroup)
    options = {name: {option for each in verb.params for option in each.opts} for name, verb in group.commands.items()}
    assert {name for name, known in options.items() if "--url" in known and "--spool" not in known} == set()
    assert {"verify", "rebuild", "episodes"} <= {name for name, known in options.items() if "--url" in known}


@pytest.mark.slow
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
def test_a_private_database_is_refused_in_one_line(tmp_path: Path, verb: str) -> None:
    done = pycrorm(verb, "--url", "sqlite://", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "pycrorm: sqlite:// exists only in its own process, no other can open it: name a file\n"
