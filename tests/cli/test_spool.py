"""`pycrorm spool`: the files of a spool for an operator, repaired, and bound to a new database."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.queue.sources import DeadLetters
from tests.commands import NOTES_PLAN, Started, answer, one_line_of, pycrorm
from tests.queue.factories import FolderWriter, overwrite, started

pytestmark = pytest.mark.slow


# === spool ====================================================================================================
#
# `pycrorm spool`: the files of a spool for an operator, and the events that are stored after a repair.

PLAN = '''
import itertools, os
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class NoteActionPerformable(ActionAbstract):
    index: int
    async def perform(self):
        return None

async def forever(memory):
    """Takes notes until killed; a dot says that one is safe."""
    async with memory.episode(description="notes"):
        for index in itertools.count():
            await NoteActionPerformable(index).perform()
            await memory.synced()
            os.write(1, b".")
'''


@pytest.fixture
def left(tmp_path: Path) -> Path:
    """Return the spool that a killed plan left; its writer may have stored some of it."""
    (tmp_path / "notes.py").write_text(PLAN)
    plan = Started("run", "notes.py:forever", cwd=tmp_path)
    count = 0
    while count < 200:
        dots = os.read(plan.stdout.fileno(), 1000)
        assert dots, plan.communicate()
        count += len(dots)
    plan.kill()
    plan.communicate()
    return tmp_path / "pycrorm.db.spool"


def segment(spool: Path) -> Path:
    (found,) = [path for path in spool.rglob("00000001.segment") if path.parent.suffix == ""]
    return found


def test_a_killed_plans_spool_is_reported_and_is_no_problem(left: Path) -> None:
    document = answer("spool", "inspect", left, cwd=left.parent)
    [recorder] = document["recorders"]
    assert (recorder["alive"], recorder["damage"], recorder["refused"], recorder["first"]) == (False, None, None, 1)
    assert recorder["types"]["NodeStarted"] >= 200
    assert recorder["records"] == sum(recorder["types"].values())
    assert len(recorder["open"]) == 1
    assert document["log_id"]
    shown = pycrorm("spool", "inspect", left, cwd=left.parent)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert recorder["name"] in shown.stdout
    assert recorder["open"][0]["id"] in shown.stdout
    whole = pycrorm("spool", "repair", left, cwd=left.parent)
    assert (whole.returncode, whole.stdout, whole.stderr) == (0, "nothing is damaged\n", "")


def test_a_damaged_spool_is_repaired_and_its_whole_records_are_stored(left: Path) -> None:
    path = segment(left)
    content = path.read_bytes()
    at = content.index(b'"index":150') if b'"index":150' in content else content.index(b"150", 20_000)
    overwrite(path, at, b"#")
    inspected_text = pycrorm("spool", "inspect", left, cwd=left.parent)
    assert inspected_text.returncode == 4
    line = one_line_of(inspected_text)
    assert f"{path} is damaged at byte" in line
    assert f"repair it with: pycrorm spool repair {left}" in line
    refused = pycrorm("writer", "--once", cwd=left.parent)
    assert refused.returncode == 4
    line = one_line_of(refused)
    assert f"{path} is damaged at byte" in line
    assert line.endswith(f"; repair it with: pycrorm spool repair {left}")

    document = answer("spool", "repair", left, cwd=left.parent, code=1)
    [repaired] = document["repaired"]
    assert Path(repaired["set_aside"], path.name).read_bytes()[at : at + 1] == b"#"
    assert len(repaired["unreadable"]) == 1
    [[first, last]] = repaired["unreadable"]
    assert first == last
    assert (repaired["kept"], repaired["complete"], len(repaired["given_up"])) == (first - 1, False, 1)

    report = answer("writer", "--once", cwd=left.parent)
    assert len(report["lost"]) == 1
    nodes = answer("show", "last", cwd=left.parent)["tree"]
    indices = [node["parameters"]["index"] for node in nodes if node["dtype"] == "NoteAction"]
    assert indices == list(range(len(indices)))
    assert len(indices) >= 140  # more, if the plan's own writer had stored what comes after the damage
    after = answer("spool", "inspect", left, cwd=left.parent)
    assert (after["recorders"], after["set_aside"]) == ([], [Path(repaired["set_aside"]).name])


def test_a_repaired_spool_names_the_next_command(left: Path) -> None:
    overwrite(segment(left), 20_000, bytes(8))
    done = pycrorm("spool", "repair", left, cwd=left.parent)
    assert done.returncode == 1
    assert done.stderr == f"Store the kept records with: pycrorm writer --once --url DATABASE --spool {left}\n"
    lines = done.stdout.splitlines()
    assert lines[0].endswith("behind it are salvaged")
    assert lines[1] == f"  original folder: {segment(left).parent}.damaged"
    assert any(line.startswith("  not kept: position ") for line in lines)


def test_a_live_plans_spool_is_reported_and_not_repaired(tmp_path: Path) -> None:
    (tmp_path / "notes.py").write_text(PLAN)
    plan = Started("run", "notes.py:forever", cwd=tmp_path)
    spool = tmp_path / "pycrorm.db.spool"
    try:
        assert plan.stdout.read(1) == "."
        plan.send_signal(signal.SIGSTOP)
        document = answer("spool", "inspect", spool, cwd=tmp_path)
        assert [each["alive"] for each in document["recorders"]] == [True]
        overwrite(segment(spool), 300, bytes(64))
        damaged = pycrorm("spool", "inspect", spool, cwd=tmp_path)
        refused = pycrorm("spool", "repair", spool, cwd=tmp_path)
    finally:
        plan.kill()
        plan.communicate()
    assert damaged.returncode == 4
    assert "stop its process first" in one_line_of(damaged)
    assert refused.returncode == 3
    assert "its recorder is alive" in one_line_of(refused)


def test_a_folder_of_a_newer_format_is_named_and_exits_with_3(tmp_path: Path) -> None:
    author = FolderWriter(tmp_path / "spool")
    author.put(started())
    overwrite(author.segments[0], 8, b"\x02")
    done = pycrorm("spool", "inspect", tmp_path / "spool", cwd=tmp_path)
    assert done.returncode == 3
    assert "is in format 2 of a newer program; this one reads format 1" in one_line_of(done)


@pytest.mark.parametrize("verb", ["inspect", "repair"])
def test_a_folder_that_is_no_spool_is_one_line(tmp_path: Path, verb: str) -> None:
    (tmp_path / "photos").mkdir()
    for name, reason in (("photos", "is not a spool"), ("none", "does not exist")):
        done = pycrorm("spool", verb, name, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (3, "")
        assert reason in one_line_of(done)
    for arguments, folder in (
        ((), "pycrorm.db.spool"),
        (("--url", "sqlite:///a.db"), "a.db.spool"),
        (("--spool", "b"), "b"),
        (("c", "--spool", "b"), "c"),
    ):
        done = pycrorm("spool", verb, *arguments, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (3, "")
        assert f"{folder}: does not exist" in one_line_of(done)


def test_dead_letters_are_reported_with_their_place_by_status_and_inspect(tmp_path: Path) -> None:
    folder = tmp_path
    assert pycrorm("writer", "--once", cwd=folder).returncode == 0
    spool = folder / "pycrorm.db.spool"
    recorder, identity = "0190a000-0000-7000-8000-000000000001", "0190a000-0000-7000-8000-000000000002"
    refused = DeadLetters(spool / recorder)
    refused.put([Record(1, parse_episode_id(identity), 5, "NodeStarted", 1, 7, 8, b"{}")])
    refused.release()
    place = spool / f"{recorder}.{identity}.refused"
    document = answer("status", cwd=folder, code=1)
    assert document["refused"] == [
        {"episode": identity, "folder": str(place), "bytes": (place / "00000001.segment").stat().st_size}
    ]
    assert document["recorders"] == []
    status = pycrorm("status", cwd=folder)
    assert (status.returncode, one_line_of(status)) == (
        1,
        f"pycrorm: the database refused events of episode {identity}; they are kept in {place}",
    )
    [inspected] = answer("spool", "inspect", spool, cwd=folder)["recorders"]
    assert (inspected["name"], inspected["types"]) == (place.name, {"NodeStarted": 1})
    assert pycrorm("episodes", "--json", cwd=folder).stderr == ""  # unchanged each time
    once = answer("writer", "--once", cwd=folder, code=1)
    assert list(once["stopped"].values()) == ["events 1 to 4 did not arrive before event 5"]
    assert place.exists()


# === rebind ===================================================================================================
#
# `pycrorm spool rebind` and a deleted database, for a new user.


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
