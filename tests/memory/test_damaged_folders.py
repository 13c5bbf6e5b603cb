"""Damaged or crafted folders of recorders are reported, and prevent nothing beside them from being stored."""

import logging
import os
import random
import uuid
from pathlib import Path

import pytest

from pycrorm_async import Memory, recover
from pycrorm_async.events.codec import Heading, encode
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, ObjectAdded, PoseValue
from pycrorm_async.operations.daemon import Folders
from pycrorm_async.queue import Spool
from pycrorm_async.queue.maintenance import repair_folder
from pycrorm_async.store.address import DatabaseAddress
from tests.commands import pycrorm
from tests.databases import ask
from tests.memory.note_actions import NoteActionPerformable
from tests.queue.factories import WALL_NS, FolderWriter, ended, episode, node, overwrite, started
from tests.queue.forged_segments import change_a_frame
from tests.writer.running_writers import QUICKLY_SYNCED, Daemon, until

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]


# === damaged folder ===========================================================================================
#
# A dead recorder's folder with damage in the middle: every drainer reports it, and stores what was synced before it.

STORED = "SELECT max(sequence), count(*) FROM event"
MISSING = "position 13 is missing"


@pytest.fixture
def damaged(spool: Path) -> FolderWriter:
    """Twenty synced events, two in each file, of which the thirteenth is changed."""
    author = FolderWriter(spool)
    author.put(started(), encode(EpisodeStarted("damaged further on", "me", "host", "1.0", "3.11")))
    added, here = Heading(episode(1), "ObjectAdded", 1), PoseValue((0, 0, 0), (0, 0, 0, 1), "map", WALL_NS)
    for number in range(2, 21):
        author.put(added, encode(ObjectAdded(f"{number} {'x' * 600}", "MILK", here)))
        author.sync()
    path, offset, _ = author.places[12]
    overwrite(path, offset + 68, b"#")
    return author


async def test_the_daemon_reports_damage_once_and_stores_what_a_repair_keeps_of_the_rest(
    database_url: str, spool: Path, damaged: FolderWriter
) -> None:
    running = Daemon(database_url, spool)
    await running.wait_for_line("is dead: recovering")
    await running.wait_for_line(f"{MISSING}, although .* retrying with pauses$")
    await running.stop()
    assert ask(database_url, STORED) == [(12, 12)]
    assert len([line for line in running.lines if MISSING in line]) == 1
    assert len(damaged.segments) > len(list(damaged.folder.glob("*.segment"))) > 1
    assert repair_folder(damaged.folder) is not None
    running = Daemon(database_url, spool)
    await running.wait_for_line(r"is recovered \(1 episode LOST\)")
    await running.stop()
    assert ask(database_url, STORED) == [(13, 13)]
    assert Spool(spool).recorders() == []


async def test_a_new_plan_reports_damage_once_and_continues(
    database_url: str, spool: Path, damaged: FolderWriter, caplog: pytest.LogCaptureFixture
) -> None:
    async with Memory.open(database_url, spool=spool, settings=QUICKLY_SYNCED) as memory:
        await NoteActionPerformable("beside").perform()
        await until(lambda: bool(memory.status.unadopted))
        assert memory.status.unadopted.keys() == {damaged.folder.name}
        await memory.flush()
        assert memory.status.drained
    [line] = [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING]
    assert MISSING in line
    assert ask(database_url, f"{STORED} WHERE wall_ns = {WALL_NS}") == [(12, 12)]
    assert [each.name for each in Spool(spool).recorders()] == [damaged.folder.name]


def test_a_folder_with_damage_is_scanned_whole_before_any_of_it_is_supplied_again(
    tmp_path: Path, spool: Path, damaged: FolderWriter
) -> None:
    look = Folders(Spool(spool), str(uuid.uuid4()), DatabaseAddress.parse(f"sqlite:///{tmp_path / 'memory.db'}"))
    first = look(())
    assert (len(first.held), first.failed) == (1, {})
    assert first.held[0].release() is None
    for _ in range(2):
        again = look(())
        assert again.held == []
        assert MISSING in str(again.failed[damaged.folder.name])


# === crafted folder ===========================================================================================
#
# A folder with crafted content does not prevent the folders beside it from being stored, in any mode of draining.

STORED_EVENTS = "SELECT count(*) FROM event"


@pytest.fixture
def crafted(spool: Path) -> FolderWriter:
    """Its only event has a name that is no text. It is the oldest folder, so that others are drained after it."""
    author = FolderWriter(spool, settings=QUICKLY_SYNCED)
    author.put(started(), encode(EpisodeStarted("crafted", "me", "host", "1.0", "3.11")))
    author.sync()
    change_a_frame(author.segments[0], random.Random(0), name=b"\xff\xfe")
    return author


@pytest.fixture
def whole(spool: Path, crafted: FolderWriter) -> FolderWriter:
    author = FolderWriter(spool, settings=QUICKLY_SYNCED, recorder=episode(99))
    author.put(started(2), encode(EpisodeStarted("whole", "me", "host", "1.0", "3.11")))
    author.put(ended(2), encode(EpisodeEnded("SUCCEEDED")))
    author.sync()
    return author


async def test_the_daemon_drains_the_next_folder(
    database_url: str, spool: Path, crafted: FolderWriter, whole: FolderWriter
) -> None:
    running = Daemon(database_url, spool)
    await running.wait_for_line("is not UTF-8; retrying with pauses$")
    await running.wait_for_line(f"{whole.folder.name} is recovered")
    await running.stop()
    assert ask(database_url, STORED_EVENTS) == [(2,)]


def test_every_verb_reports_it_in_one_line(
    tmp_path: Path, spool: Path, crafted: FolderWriter, whole: FolderWriter
) -> None:
    (spool / os.fsdecode(b"\xff")).touch()
    crafted_folder, url = crafted.folder, f"sqlite:///{tmp_path / 'memory.db'}"
    (whole.folder / "drain").symlink_to("drain")
    done = pycrorm("writer", "--once", "--url", url, "--spool", spool, cwd=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (4, 2)
    assert f"{crafted_folder}/00000001.segment is damaged at byte 56" in done.stderr
    assert f"{whole.folder}/drain: Too many levels of symbolic links" in done.stderr
    done = pycrorm("status", "--url", url, "--spool", spool, cwd=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 2)
    assert "2 dead recorders left events" in done.stderr
    assert "Too many levels of symbolic links" in done.stderr
    for options in ((), ("--json",)):
        done = pycrorm("spool", "inspect", spool, *options, cwd=tmp_path)
        assert (done.returncode, len(done.stderr.splitlines())) == (4, 3)
    done = pycrorm("spool", "repair", spool, cwd=tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (3, False)
    assert repair_folder(crafted_folder) is None
    (whole.folder / "drain").unlink()
    done = pycrorm("writer", "--once", "--url", url, "--spool", spool, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert ask(url, STORED_EVENTS) == [(2,)]


async def test_a_crafted_episode_is_stopped_and_the_one_beside_it_is_in_the_tables(
    database_url: str, spool: Path
) -> None:
    author = FolderWriter(spool, settings=QUICKLY_SYNCED)
    author.put(started(1), encode(EpisodeStarted("nonsense", "me", "host", "1.0", "3.11")))
    author.put(node(1), b'{"parent":99999999999999999999999}')
    author.put(started(2), encode(EpisodeStarted("sound", "me", "host", "1.0", "3.11")))
    author.sync()
    report = await recover(database_url, spool=spool)
    assert (report.failed, len(report.drained.stopped)) == ({}, 1)
    assert ask(database_url, "SELECT description FROM process_metadata WHERE description = 'sound'") == [("sound",)]
