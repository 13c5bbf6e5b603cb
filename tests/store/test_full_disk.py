"""A database whose disk is full is away: what is not stored is kept, and stored when there is room again."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pycrorm_async.config import Settings
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.backoff import Backoff
from pycrorm_async.writer.drain import Drain
from tests.databases import ask
from tests.store.making import episode, record
from tests.writer.ends import CountingFold, KeptSource


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 2 MiB of its own."""
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(tmp_path)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("there is no right to mount a small disk here")
    yield tmp_path
    subprocess.run(["umount", str(tmp_path)], check=True)


async def test_a_database_on_a_full_disk_is_away_and_everything_is_stored_once_when_there_is_room(
    small_disk: Path,
) -> None:
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(2**20))
    records = [record(episode(1), sequence, payload=b'"%s"' % (b"x" * 1000)) for sequence in range(1, 1001)]
    log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{small_disk / 'memory.db'}"), create=True)
    source = KeptSource(records, closed=True)
    backoff = Backoff(first_s=0.005, longest_s=0.02)
    drain = Drain(source, CountingFold(log), settings=Settings(batch_events_max=50), backoff=backoff)
    running = asyncio.create_task(drain.run())
    while drain.state.retries < 5:  # noqa: ASYNC110
        await asyncio.sleep(0.001)
    assert "database or disk is full" in (drain.state.away or "")
    assert 0 < len(source.kept) < 1000
    with pytest.raises(DatabaseUnavailable, match="full"):
        await log.append(records)
    ballast.unlink()
    await asyncio.to_thread(subprocess.run, ["mount", "-o", "remount,size=8m", str(small_disk)], check=True)
    await asyncio.wait_for(running, 60)
    await log.close()
    assert source.kept == []
    assert ask(small_disk / "memory.db", "SELECT count(*), min(sequence), max(sequence) FROM event") == [
        (1000, 1, 1000)
    ]
    assert ask(small_disk / "memory.db", "PRAGMA integrity_check") == [("ok",)]
