"""Let the n-th system call on the disk fail, in the queue alone and in a whole memory (`faulty_disk.c`).

Every n has its turn up to the end of a small plan, with the error of a broken disk (EIO), which any call may meet, and
with that of a full one (ENOSPC), which calls meet that take space.
"""

import asyncio
import errno
from pathlib import Path

import pytest

from tests.crash.faulty_disk import EPISODES, STEPS, DiskProcess, FaultyDisk
from tests.queue.factories import recover

pytestmark = pytest.mark.slow

ALL = {(episode, step) for episode in range(EPISODES) for step in range(STEPS)}
EIO, ENOSPC = errno.EIO, errno.ENOSPC


def recovered(spool: Path) -> set[int]:
    """Return the sequences that recovery supplies from all folders of the spool."""
    folders = [path for path in spool.glob("*-*-*") if any(path.glob("*.segment"))]
    return {each.sequence for folder in folders for each in asyncio.run(recover(folder))}


def check_queue(process: DiskProcess, place: Path, n: int, number: int) -> bool:
    """Fail the n-th call of a queue; return whether there was one."""
    disk = FaultyDisk(process, place)
    ended = disk.record_with_fault(n, number=number)
    assert ended.code == 0, (n, ended)
    put, stored = ({int(line[1]) for line in ended.lines if line[0] == word} for word in ("put", "stored"))
    assert put <= stored | recovered(disk.disk / "spool"), (n, ended)
    return ended.calls >= n


@pytest.mark.parametrize(
    "number", [pytest.param(EIO, marks=pytest.mark.soak, id="EIO"), pytest.param(ENOSPC, id="ENOSPC")]
)
@pytest.mark.parametrize("turn", [0, *(pytest.param(n, marks=pytest.mark.soak) for n in range(1, 4))])
def test_no_failing_call_of_a_queue_stops_its_recorder_or_takes_a_record_that_was_put(
    process: DiskProcess, tmp_path: Path, number: int, turn: int
) -> None:
    n = 1 + turn
    while check_queue(process, tmp_path / str(n), n, number):
        n += 4
    assert n > {EIO: 150, ENOSPC: 50}[number]


def check_memory(process: DiskProcess, place: Path, n: int, number: int) -> bool:
    """Fail the n-th call of a memory, from its opening to its closing; return whether there was one."""
    disk = FaultyDisk(process, place)
    ended = disk.perform_with_fault(n, number=number)
    assert ended.code == 0, (n, ended)
    performed = ended.steps("status")
    assert performed == ALL or (not performed and ended.refusals), (n, ended)
    found = disk.found()
    assert found.problems == [], (n, ended)
    assert ended.steps("synced") | ended.steps("stored") <= found.steps, (n, ended)
    assert found.steps == performed or ended.faults, (n, ended)
    return ended.calls >= n


TURNS = 500
"""Each turn takes every 500th call, of some 2,500 that may meet EIO and 1,100 that may meet ENOSPC."""


@pytest.mark.parametrize("number", [EIO, ENOSPC], ids=["EIO", "ENOSPC"])
@pytest.mark.parametrize("turn", [71, *(pytest.param(n, marks=pytest.mark.soak) for n in range(TURNS) if n != 71)])
def test_no_failing_call_stops_a_plan_or_takes_what_was_acknowledged(
    process: DiskProcess, tmp_path: Path, turn: int, number: int
) -> None:
    n = 1 + turn
    while check_memory(process, tmp_path / str(n), n, number):
        n += TURNS
