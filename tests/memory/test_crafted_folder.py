"""A folder with crafted content does not prevent the folders beside it from being stored, in any mode of draining."""

import logging
import os
import random
from pathlib import Path

import pytest

from pycrorm_async import Memory, recover
from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.codec import encode
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted
from pycrorm_async.queue import Spool
from pycrorm_async.queue.maintenance import repair_folder
from tests.commands import pycrorm
from tests.databases import ask
from tests.memory.daemon_in_loop import QUICK, Daemon
from tests.memory.note_actions import NoteActionPerformable
from tests.queue.factories import FolderWriter, ended, episode, node, started
from tests.queue.forged_segments import change_a_frame
from tests.writer.writer_threads import until

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""

STORED = "SELECT count(*) FROM event"


@pytest.fixture
def crafted(spool: Path) -> FolderWriter:
    """Its only event has a name that is no text. It is the oldest folder, so that others are drained after it."""
    author = FolderWriter(spool, settings=QUICK)
    author.put(started(), encode(EpisodeStarted("crafted", "me", "host", "1.0", "3.11")))
    author.sync()
    change_a_frame(author.segments[0], random.Random(0), name=b"\xff\xfe")
    return author


@pytest.fixture
def whole(spool: Path, crafted: FolderWriter) -> FolderWriter:
    author = FolderWriter(spool, settings=QUICK, recorder=episode(99))
    author.put(started(2), encode(EpisodeStarted("whole", "me", "host", "1.0", "3.11")))
    author.put(ended(2), encode(EpisodeEnded("SUCCEEDED")))
    author.sync()
    return author


async def test_one_round_drains_the_next_folder(
    database_url: str, spool: Path, crafted: FolderWriter, whole: FolderWriter
) -> None:
    report = await recover(database_url, spool=spool)
    [(name, fault)] = report.failed.items()
    assert isinstance(fault, SpoolDamaged)
    assert (name, fault.path, fault.offset) == (crafted.folder.name, crafted.segments[0], crafted.places[0][1])
    assert ask(database_url, STORED) == [(2,)]
    assert [each.path for each in Spool(spool).recorders()] == [crafted.folder]


async def test_the_daemon_drains_the_next_folder(
    database_url: str, spool: Path, crafted: FolderWriter, whole: FolderWriter
) -> None:
    running = Daemon(database_url, spool)
    await running.wait_for_line("is not UTF-8; retrying with pauses$")
    await running.wait_for_line(f"{whole.folder.name} is recovered")
    await running.stop()
    assert ask(database_url, STORED) == [(2,)]


async def test_a_new_plan_adopts_the_next_folder(
    database_url: str, spool: Path, crafted: FolderWriter, whole: FolderWriter, caplog: pytest.LogCaptureFixture
) -> None:
    async with Memory.open(database_url, spool=spool, settings=QUICK) as memory:
        await NoteActionPerformable("beside").perform()
        await until(lambda: not whole.folder.exists())
        assert memory.status.unadopted.keys() == {crafted.folder.name}
    assert len([each for each in caplog.records if each.levelno >= logging.WARNING]) == 1


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
    assert ask(url, STORED) == [(2,)]


async def test_a_crafted_episode_is_stopped_and_the_one_beside_it_is_in_the_tables(
    database_url: str, spool: Path
) -> None:
    author = FolderWriter(spool, settings=QUICK)
    author.put(started(1), encode(EpisodeStarted("nonsense", "me", "host", "1.0", "3.11")))
    author.put(node(1), b'{"node":99999999999999999999999}')
    author.put(started(2), encode(EpisodeStarted("sound", "me", "host", "1.0", "3.11")))
    author.sync()
    report = await recover(database_url, spool=spool)
    assert (report.failed, len(report.drained.stopped)) == ({}, 1)
    assert ask(database_url, "SELECT description FROM process_metadata WHERE description = 'sound'") == [("sound",)]
