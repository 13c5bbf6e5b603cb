"""`pycrorm spool rebind` and a deleted database, for a new user."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.note_plan import NOTES_PLAN
from tests.commands import answer, one_line_of, pycrorm

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    return tmp_path


def test_the_next_run_makes_a_deleted_database_again(folder: Path) -> None:
    for _ in range(2):
        [episode] = answer("run", "notes.py", cwd=folder)["episodes"]
        assert (episode["number"], episode["status"]) == (1, "SUCCEEDED")
        (folder / "pycrorm.db").unlink()


def test_with_events_in_the_spool_the_refusal_names_the_command_that_stores_them(folder: Path) -> None:
    answer("run", "notes.py", cwd=folder)
    assert pycrorm("run", "notes.py", "--writer", "daemon", cwd=folder).returncode == 0
    (folder / "pycrorm.db").unlink()
    refused = pycrorm("run", "notes.py", cwd=folder)
    assert (refused.returncode, "with `pycrorm spool rebind`" in one_line_of(refused)) == (3, True)
    document = answer("spool", "rebind", cwd=folder)
    assert (document["events_found"], document["events_stored"], document["dead_letters"]) == (11, 11, {})
    assert document["log_before"] != document["log"]
    # The first event was stored in the deleted database, and comes from its kept segments.
    assert [each["description"] for each in answer("episodes", cwd=folder)] == ["Take three notes."] * 2
    assert len(answer("run", "notes.py", cwd=folder)["episodes"]) == 1
    again = pycrorm("spool", "rebind", cwd=folder)
    assert (again.returncode, again.stdout.startswith("0 dead recorders, 0 events stored")) == (0, True)
