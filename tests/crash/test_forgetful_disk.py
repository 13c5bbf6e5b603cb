"""Cut the power before any sync of a whole plan, on a disk that keeps only what was synced (`faulty_disk.c`).

`test_disk` mixes states of the queue's files sector by sector. Here the whole memory runs: queue, blobs, writer
and SQLite. The disk drops everything that no sync made durable: pages of mapped segments, names in folders, deletions.
"""

from pathlib import Path

import pytest

from tests.crash.faulty_disk import EPISODES, STEPS, DiskProcess, FaultyDisk

pytestmark = pytest.mark.slow

ALL = {(episode, step) for episode in range(EPISODES) for step in range(STEPS)}
SYNCS_MAX = 90
"""More than the plan takes, which differs by a few because the writer's batches differ."""


def cut_every(process: DiskProcess, place: Path, cuts: range) -> int:
    """Cut the power before these syncs, each on a new disk; return how many of the plans lived to be cut."""
    alive = 0
    for cut in cuts:
        disk = FaultyDisk(process, place / str(cut))
        ended = disk.perform(cut=cut)
        disk.cut_power()
        found = disk.found()
        assert found.problems == [], cut
        assert ended.steps("synced") | ended.steps("stored") <= found.steps <= ALL, cut
        alive += ended.code != 0
    return alive


@pytest.mark.parametrize("turn", [4, *(pytest.param(turn, marks=pytest.mark.soak) for turn in range(30) if turn != 4)])
def test_a_power_cut_before_any_sync_takes_nothing_synced_or_stored(
    process: DiskProcess, tmp_path: Path, turn: int
) -> None:
    assert cut_every(process, tmp_path, range(1 + turn, SYNCS_MAX, 30)) >= 2


def test_a_power_cut_after_the_end_takes_nothing(process: DiskProcess, tmp_path: Path) -> None:
    disk = FaultyDisk(process, tmp_path)
    ended = disk.perform()
    assert (ended.code, ended.steps("stored"), ended.refusals) == (0, ALL, [])
    disk.cut_power()
    assert disk.found() == (ALL, [])
