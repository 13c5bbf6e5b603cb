"""A disk that fails, fills or loses its power takes nothing that was synced, no record and no blob."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import random
import shutil
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolDamaged, SpoolFull, SpoolUnavailable
from pycrorm_async.events.codec import Record, is_computed_end
from pycrorm_async.events.types import references_in
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.queue.blobs import is_whole
from pycrorm_async.queue.format import EVENT, Segment, salt_of, sync_path
from pycrorm_async.settings import Settings
from tests.crash.disk_machine import (
    ON_A_SMALL_DISK,
    Machine,
    break_next_sync,
    disk_of_256_kib,
    live_through_cuts,
    machine_on,
)
from tests.queue.factories import (
    RECORDER,
    SLOW,
    drain,
    ended,
    eventually,
    lost,
    make,
    node,
    opened_dead,
    overwrite,
    record,
    recover,
    started,
)
from tests.queue.test_blobs import OBSERVED, referring

# === queue disk ===============================================================================================
#
# A disk that fails: a later sync does not hide a failed one, and a full disk raises an error and no signal.


async def test_a_failed_sync_refuses_all_records_but_those_synced_before(tmp_path: Path) -> None:
    queue = make(tmp_path, settings=SLOW)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    queue.put_nowait(node(), b"not synced")
    break_next_sync(queue)
    waiters = [asyncio.ensure_future(queue.synced_to()) for _ in range(3)]
    for waiter in waiters:
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            await waiter
    for _ in range(2):
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            queue.put_nowait(node(), b"{}", reserved=True)
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            await queue.synced_to()
    await queue.room()
    assert queue.block_until_room(1000.0)
    batch = await queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=1000.0)
    assert batch == [record(1, started(), 1, b"{}")]
    await queue.acknowledge(1)
    for _ in range(2):
        with pytest.raises(SpoolUnavailable, match="Invalid argument"):
            await queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=1000.0)
    assert (queue.written, queue.synced, queue.stored) == (2, 1, 1)
    queue.release()
    assert await recover(queue.folder) == [
        record(1, started(), 1, b"{}"),
        record(2, node(), 2, b"not synced"),
        lost(3, 1, 3),
    ]


async def test_a_sync_that_would_succeed_after_a_failed_one_does_not_hide_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = make(tmp_path, settings=SLOW)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    queue.put_nowait(node(), b"dropped by the kernel")
    fdatasync, failures = os.fdatasync, [OSError(errno.EIO, os.strerror(errno.EIO))]

    def fail_once(descriptor: int) -> None:  # as Linux does: the next call does not report the lost pages
        if failures:
            queue.put_nowait(node(), b"put meanwhile")
            raise failures.pop()
        fdatasync(descriptor)

    monkeypatch.setattr(os, "fdatasync", fail_once)
    with pytest.raises(SpoolUnavailable, match="Input/output error"):
        await queue.synced_to()
    queue.release()  # the sync thread takes its last turn
    assert (queue.written, queue.synced) == (3, 1)


async def test_a_record_refused_by_a_disk_that_failed_after_a_sync_is_not_reported_as_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> Segment:
        number = errno.EIO if queue.synced == queue.written else errno.ENOSPC  # which is tried again
        raise OSError(number, os.strerror(number))

    queue = make(tmp_path, settings=SLOW)
    queue.put_nowait(started(), b"{}")
    monkeypatch.setattr(Segment, "allocate", fail)
    with contextlib.suppress(SpoolFull):
        while True:  # until the segments that were prepared before are full
            queue.put_nowait(node(), b"x" * 500, reserved=True)
    await queue.synced_to()
    await eventually(lambda: queue.failure is not None)
    assert queue.synced == queue.written
    await queue.synced_to()  # all that was put is there
    with pytest.raises(SpoolUnavailable, match="Input/output error"):
        queue.put_nowait(node(), b"{}")
    for _ in range(2):
        with pytest.raises(SpoolUnavailable, match="Input/output error"):
            await queue.synced_to()
    queue.release()


async def test_a_failed_sync_ends_the_wait_of_the_writer(tmp_path: Path) -> None:
    queue = make(tmp_path, settings=SLOW)
    waiting = asyncio.ensure_future(queue.get_batch(events_max=10, bytes_max=2**20, age_s_max=1000.0))
    await asyncio.sleep(0)
    queue.put_nowait(started(), b"{}")
    break_next_sync(queue)
    with pytest.raises(SpoolUnavailable):
        await queue.synced_to()
    with pytest.raises(SpoolUnavailable):
        await waiting
    queue.release()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with disk_of_256_kib(tmp_path / "disk"):
        yield tmp_path / "disk"


async def test_a_full_disk_is_reported_as_a_full_spool_and_recording_resumes_when_there_is_space(
    small_disk: Path,
) -> None:
    queue = RecorderQueue.create(small_disk / "spool", settings=ON_A_SMALL_DISK, clock=SYSTEM_CLOCK, recorder=RECORDER)
    queue.put_nowait(started(), b"{}")
    put = 1
    with contextlib.suppress(SpoolFull):
        while True:
            put = queue.put_nowait(node(), b"x" * 1000, reserved=True)
    with pytest.raises(SpoolFull, match="No space left on device"):  # the disk is full and the spool is not
        queue.put_nowait(node(), b"x" * 1000, reserved=True)
    assert queue.full
    assert put > 150
    assert queue.block_until_room(0.02) is False
    await queue.synced_to()
    records = await queue.get_batch(events_max=10_000, bytes_max=2**22, age_s_max=0.0)
    assert [each.sequence for each in records] == list(range(1, put + 1))
    await queue.acknowledge(put)
    assert await asyncio.to_thread(queue.block_until_room, 30.0)
    await asyncio.wait_for(queue.room(), 30)
    assert queue.put_nowait(node(), b"x" * 1000) == put + 1
    queue.close()
    assert [each.sequence for each in await drain(queue)] == [put + 1]
    queue.release()


def test_a_queue_that_does_not_fit_on_the_disk_is_refused_in_one_line_and_leaves_no_files(small_disk: Path) -> None:
    with pytest.raises(SpoolUnavailable, match="No space left on device") as refused:
        RecorderQueue.create(
            small_disk / "spool",
            settings=Settings(segment_bytes=2**20, record_bytes_max=2**12),
            clock=SYSTEM_CLOCK,
            recorder=RECORDER,
        )
    assert "\n" not in str(refused.value)
    assert list((small_disk / "spool").iterdir()) == []


# === blob power ===============================================================================================
#
# A power cut before and after every sync takes no blob that a surviving record refers to.
#
# The machine is that of the power cuts below. A blob whose file was not synced may be missing, empty, zero or whole
# after a cut, whatever the cut leaves of the record that refers to it.


class BlobMachine:
    """A machine whose cuts take blobs that were not synced."""

    def __init__(self, machine: Machine, rng: random.Random, patch: pytest.MonkeyPatch) -> None:
        self.machine = machine
        self._rng = rng
        self._whole: set[str] = set()  # blobs whose content was synced
        self._named: set[str] = set()  # blobs, and their folder, whose name was synced
        fsync, sync_file, cut = os.fsync, sync_path, machine.cut

        def sync(path: Path) -> None:
            machine.cut()
            sync_file(path)
            machine.cut()

        def observed_fsync(descriptor: int) -> None:
            fsync(descriptor)
            path = Path(f"/proc/self/fd/{descriptor}").readlink()
            if path.is_dir():
                self._named.update(each.name for each in path.iterdir())
            elif path.parent.name == "blobs":
                self._whole.add(path.name)

        def cut_with_blobs() -> None:
            cut()
            self._keep_some(machine.cuts[-1][0] / "blobs")

        patch.setattr(os, "fsync", observed_fsync)
        patch.setattr("pycrorm_async.queue.blobs.sync_path", sync)
        patch.setattr(machine, "cut", cut_with_blobs)

    def put_referring(self) -> None:
        content = self._rng.randbytes(self._rng.randrange(1, 900))
        name = self.machine.queue.put_blob(content)
        assert name == sha256(content).hexdigest()
        self.machine.put(OBSERVED, referring(name, len(content)))
        self.machine.queue.release_blob(name)

    def _keep_some(self, target: Path) -> None:
        source = self.machine.queue.folder / "blobs"
        if not source.is_dir():
            return
        if "blobs" not in self._named and self._rng.random() < 0.5:
            return
        target.mkdir()
        for blob in source.iterdir():
            if blob.name in self._whole & self._named or self._rng.random() < 0.3:
                shutil.copy(blob, target / blob.name)
            elif self._rng.random() < 0.6:
                (target / blob.name).write_bytes(self._rng.choice([b"", bytes(blob.stat().st_size)]))


@pytest.fixture
def blob_machine(tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[BlobMachine]:
    rng = random.Random(seed)
    with machine_on(tmp_path, rng) as machine:
        yield BlobMachine(machine, rng, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 60))])
async def test_a_record_that_survives_a_power_cut_has_its_blob_and_a_synced_one_survives(
    blob_machine: BlobMachine, seed: int
) -> None:
    rng, machine = random.Random(seed + 3000), blob_machine.machine
    machine.put(started(1), b"{}")
    machine.put(started(2), b"{}")
    for _ in range(6):
        for _ in range(rng.randrange(1, 5)):
            if rng.random() < 0.5:
                blob_machine.put_referring()
            else:
                machine.put(node(2), b"n" * rng.randrange(900))
        machine.cut()
        machine.turn()
        machine.cut()
        if machine.queue.synced > machine.queue._source.reader.cursor.position and rng.random() < 0.5:
            batch = await machine.queue.get_batch(events_max=rng.choice([1, 4, 1000]), bytes_max=2**20, age_s_max=0.0)
            await machine.queue.acknowledge(batch[-1].position)
            machine.turn()
            machine.cut()
    machine.put(ended(1), b"{}")
    machine.cut()

    referred = 0
    for folder, synced, stored, _ in machine.cuts:
        records = await recover(folder)
        kept = [each for each in records if each.payload != b'{"status":"LOST"}']
        last = kept[-1].position if kept else stored
        assert synced <= last
        for each in kept:
            for reference in references_in(each.type, each.payload):
                assert each.position <= stored or is_whole(folder, reference.hash), each.position
                referred += each.position > stored
    assert referred > 20


# === queue power ==============================================================================================
#
# Cut the power before and after every sync, on a disk that keeps any subset of what was not synced.
#
# `disk_machine.py` describes the machine.


def ends_of(records: list[Record]) -> list[Record]:
    last: dict[int, int] = {}
    for each in records:
        number = next(n for n in (1, 2, 3) if started(n).episode == each.episode)
        last[number] = each.sequence
        if each.type == "EpisodeEnded":
            del last[number]
    return [lost(len(records) + 1 + index, number, last[number] + 1) for index, number in enumerate(sorted(last))]


def spoil(folder: Path, position: int) -> None:
    """Change one bit of the record at this position."""
    for path in folder.glob("*.segment"):
        content = path.read_bytes()
        salt = salt_of(RECORDER, int(path.stem)).to_bytes(4, "little")
        for at in range(0, len(content) - 64, 8):
            here = int.from_bytes(content[at + 8 : at + 16], "little")
            if content[at] == EVENT and here == position and content[at + 56 : at + 60] == salt:
                overwrite(path, at + 20, bytes([content[at + 20] ^ 1]))
                return
    raise AssertionError(position)


@pytest.fixture
def machine(tmp_path: Path, seed: int) -> Iterator[Machine]:
    with machine_on(tmp_path, random.Random(seed)) as running:
        yield running


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.soak) for seed in (0, *range(2, 200)))])
async def test_a_power_cut_costs_no_synced_record_and_is_never_reported_as_damage(machine: Machine, seed: int) -> None:
    rng = random.Random(seed + 1000)
    await live_through_cuts(machine, rng)

    assert len(machine.cuts) > 20
    for folder, synced, stored, count in machine.cuts:
        truth = machine.put_so_far[:count]
        records = await recover(folder)
        kept = [each for each in records if each.payload != b'{"status":"LOST"}']
        first = kept[0].position if kept else records[0].position if records else 1
        last = kept[-1].position if kept else first - 1
        assert first <= stored + 1
        assert synced <= last
        assert kept == truth[first - 1 : last]
        assert records[len(kept) :] == ends_of(truth[:last])
        if first <= synced and rng.random() < 0.2:
            spoil(folder, synced)
            with pytest.raises(SpoolDamaged):
                await recover(folder)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(4, 200))])
async def test_what_a_recovery_supplied_after_a_kill_is_supplied_again_after_a_power_cut(
    machine: Machine, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = random.Random(seed + 2000)
    for number in (1, 2, 3):
        machine.put(started(number), b"{}")
    for _ in range(rng.randrange(3)):
        for _ in range(rng.randrange(5)):
            machine.put(node(1), b"synced")
        machine.turn()
    for _ in range(12):
        number = rng.choice([1, 1, 2])
        machine.put(node(number), b"never synced" * rng.randrange(100))
    killed = machine.kill()
    safe: set[str] = set()
    fdatasync = os.fdatasync

    def watched(descriptor: int) -> None:
        fdatasync(descriptor)
        safe.add(Path(f"/proc/self/fd/{descriptor}").readlink().name)

    whole = [*machine.put_so_far, *ends_of(machine.put_so_far)]
    monkeypatch.setattr(os, "fdatasync", watched)
    recovered = opened_dead(killed)
    batch = await recovered.get_batch(events_max=rng.randrange(1, len(whole) + 1), bytes_max=2**20, age_s_max=0.0)
    assert batch == whole[: len(batch)]
    stored = rng.randrange(len(batch) + 1)
    await recovered.acknowledge(stored)
    recovered.release()
    monkeypatch.undo()

    # Records that no recovery supplied may be lost with the machine; the computed ends then follow from what is left.
    again = await recover(machine.cut_after_kill(killed, safe=safe))
    first, records = again[0].position, machine.put_so_far
    last = first - 1 + sum(not is_computed_end(each) for each in again)
    assert first <= stored + 1
    assert last >= min(batch[-1].position, len(records))
    assert again == [*records[first - 1 : last], *ends_of(records[:last])]
