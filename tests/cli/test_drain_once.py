"""The exit code of `pycrorm writer --once`: 1 if the database refused anything, with and without --json."""

from __future__ import annotations

from pathlib import Path

import pytest

from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, parse_episode_id
from pycrorm_async.queue.sources import DeadLetters
from pycrorm_async.queue.spool import make_folder
from tests.cli.note_plan import NOTES_PLAN
from tests.commands import answer, one_line_of, pycrorm
from tests.databases import ask, ask_to_change

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""

RECORDER, EPISODE = "0190a000-0000-7000-8000-000000000001", "0190a000-0000-7000-8000-000000000002"
FULL = (
    f"all {EPISODE_NUMBER_MAX:,} episode numbers of this memory are used: move its spool to a new memory with"
    " `pycrorm spool rebind`"
)


def use_up_episode_numbers(url: str) -> None:
    taken = f"INSERT INTO episode (number, id, head, started_wall_ns) VALUES ({EPISODE_NUMBER_MAX}, 'x', 0, 0)"
    ask_to_change(url, taken)
    if url.startswith("postgresql:"):
        ask_to_change(url, f"SELECT setval('pycrorm.episode_number', {EPISODE_NUMBER_MAX})")


def test_an_episode_without_a_number_is_a_problem_each_time_and_is_kept(database_url: str, tmp_path: Path) -> None:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    where = ("--url", database_url, "--spool", tmp_path / "spool")
    assert answer("writer", "--once", *where, cwd=tmp_path)["dead_letters"] == {}
    use_up_episode_numbers(database_url)
    pycrorm("run", "notes.py", "--writer", "daemon", *where, cwd=tmp_path)
    document = answer("writer", "--once", *where, cwd=tmp_path, code=1)
    [(episode, folder)] = document["dead_letters"].items()
    assert document["stopped"] == {episode: FULL}
    assert (document["failed"], document["events_stored"], Path(folder).is_dir()) == ({}, 1, True)
    done = pycrorm("writer", "--once", *where, cwd=tmp_path)
    assert done.returncode == 1
    assert one_line_of(done) == f"pycrorm: episode {episode} is stopped: {FULL}; its events are kept in {folder}"
    assert ask(database_url, "SELECT count(*) FROM event") == [(0,)]


@pytest.mark.parametrize("alive", [True, False])
def test_an_earlier_refusal_is_a_problem_even_while_its_recorder_is_alive(tmp_path: Path, *, alive: bool) -> None:
    spool = tmp_path / "pycrorm.db.spool"
    folder, lock = make_folder(spool, RECORDER)
    refused = DeadLetters(folder)
    refused.put([Record(1, parse_episode_id(EPISODE), 5, "NodeStarted", 1, 7, 8, b"{}")])
    refused.release()
    if not alive:
        lock.release()
    kept = f"its events are kept in {folder}.{EPISODE}.refused"
    done = pycrorm("writer", "--once", cwd=tmp_path)
    reason = "was refused" if alive else "is stopped: events 1 to 4 did not arrive before event 5"
    assert (done.returncode, one_line_of(done)) == (1, f"pycrorm: episode {EPISODE} {reason}; {kept}")
    assert list(answer("writer", "--once", cwd=tmp_path, code=1)["dead_letters"]) == [EPISODE]
    lock.release()
