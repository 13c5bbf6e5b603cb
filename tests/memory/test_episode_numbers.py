"""A memory that has used up its episode numbers keeps further episodes in its spool; it warns before."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import EpisodeParked
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.recovery import recover
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import answer, pycrorm
from tests.databases import ask, ask_to_change
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.store.factories import episode, run_of

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""


def take_numbers_up_to(url: str, last: int) -> None:
    """Make the database assign episode numbers up to this one."""
    ask_to_change(url, f"INSERT INTO episode (number, id, head, started_wall_ns) VALUES ({last}, 'x', 0, 0)")
    if url.startswith("postgresql"):  # PostgreSQL takes the numbers from a sequence
        ask_to_change(url, f"SELECT setval('pycrorm.episode_number', {last})")


async def record_one(url: str) -> None:
    await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()


async def test_the_last_number_is_used_and_further_episodes_are_kept_in_the_spool_and_tried_again(
    database_url: str, tmp_path: Path
) -> None:
    await record_one(database_url)
    take_numbers_up_to(database_url, EPISODE_NUMBER_MAX - 1)
    spool = tmp_path / "spool"
    async with Memory.open(database_url, spool=spool) as memory:
        await NoteActionPerformable("the last").perform()
        await NoteActionPerformable("one too many").perform()
        with pytest.raises(EpisodeParked, match="all 4,194,303 episode numbers"):
            await memory.flush()
        assert await texts(memory) == ["the last"]
        assert memory.status.writer is not None
        last, beyond = memory.recent_episodes
    assert ask(database_url, f"SELECT id, head FROM episode WHERE number = {EPISODE_NUMBER_MAX}") == [(last, 6)]
    assert ask(database_url, "SELECT max(id) < 9007199254740992 FROM task_tree_node") in ([(1,)], [(True,)])
    async with Reading.open(database_url) as reading:
        assert [(each.id, each.nodes) for each in await reading.episodes()] == [(last, 2)]
    (kept,) = [each for each in Spool(spool).recorders() if each.refused is not None]
    assert kept.refused == beyond

    recovered = await recover(database_url, spool=spool)  # as the next start does
    assert recovered.dead_letters.keys() == {beyond}
    assert "all 4,194,303 episode numbers" in recovered.drained.stopped[beyond]
    assert [each.refused for each in Spool(spool).recorders() if each.refused is not None] == [beyond]
    other = f"sqlite:///{tmp_path}/other.db"
    await copy_episodes(database_url, other)
    assert ask(other, f"SELECT number, head FROM episode WHERE id = '{last}'") == [
        (1, 6)
    ]  # a new memory assigns new numbers
    done = pycrorm("spool", "rebind", "--url", other, "--spool", spool, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert ask(other, f"SELECT number, head, refused FROM episode WHERE id = '{beyond}'") == [(2, 6, None)]
    assert [each for each in Spool(spool).recorders() if each.refused is not None] == []


async def test_status_and_log_warn_once_nine_tenths_of_the_episode_numbers_are_used(
    database_url: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    await record_one(database_url)
    take_numbers_up_to(database_url, 3_774_871)
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    with caplog.at_level(logging.WARNING, logger="pycrorm_async"):
        await log.append(run_of(episode(1), 1, 2))
        assert (await log.limits_near(), caplog.messages) == ([], [])
        for number in (2, 3):
            await log.append(run_of(episode(number), 1, 2))
    warning = "{} of 4,194,303 episode numbers are used (90 %): record into a new database before none is left"
    assert await log.limits_near() == [warning.format("3,774,874")]
    assert [each[-len(warning) - 7 :].strip() for each in caplog.messages] == [warning.format("3,774,873")]
    await log.close()
    options = ("--url", database_url, "--spool", tmp_path / "spool")
    assert answer("status", *options, cwd=tmp_path)["warnings"] == [warning.format("3,774,874")]
    assert f"warning: {warning.format('3,774,874')}" in pycrorm("status", *options, cwd=tmp_path).stderr


async def test_status_and_log_warn_once_nine_tenths_of_an_episodes_sequences_are_used(
    database_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    await log.append(run_of(episode(1), 1, 2))
    first = 60_397_977
    ask_to_change(database_url, f"UPDATE episode SET head = {first - 2}")
    with caplog.at_level(logging.WARNING, logger="pycrorm_async"):
        for sequence in range(first - 1, first + 2):
            await log.append(run_of(episode(1), sequence, sequence))
    assert len(caplog.messages) == 1
    (warning,) = await log.limits_near()
    assert warning.startswith("episode 1 (")
    assert "has 60,397,978 of 67,108,863 events (90 %): it continues in a follow-up episode" in warning
    await log.close()
