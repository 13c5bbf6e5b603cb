"""Cut the power before and after every sync, on a disk that keeps any subset of what was not synced.

The queue and its files are real. The test calls each turn of the sync thread itself and observes each `fdatasync`. A
power cut mixes, sector by sector, the state that the last sync of a file made durable with all states since; a deleted
file may exist again if the deletion was not durable. The recorder may also be killed, and the power may fail after
another program has recovered its folder.
"""

import os
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolDamaged
from pycrorm_async.events.codec import Heading, Record, is_computed_end
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue import RecorderQueue, open_dead
from pycrorm_async.queue.appender import Span, SyncableAppender
from pycrorm_async.queue.format import EVENT, Segment, salt_of
from pycrorm_async.queue.sync_thread import SyncThread
from tests.queue.factories import RECORDER, SMALL, ended, episode, lost, make, node, overwrite, record, recover, started

pytestmark = pytest.mark.slow

SECTOR = 512
ROOMY = replace(SMALL, spool_bytes_max=64 * SMALL.segment_bytes)


class Machine:
    """A queue on a disk that forgets, and the record of what was put."""

    def __init__(self, place: Path, rng: random.Random) -> None:
        self.queue: RecorderQueue = make(place / "running", settings=ROOMY)
        self.put_so_far: list[Record] = []
        self.cuts: list[tuple[Path, int, int, int]] = []
        self._place = place
        self._rng = rng
        self.meanwhile: Callable[[], Heading] = node  # records of other threads
        self.sequences: dict[EpisodeId, int] = {}
        self._safe: dict[Path, bytes] = {}
        self._since: dict[Path, list[bytes]] = {}
        self._deleted: list[tuple[Path, bytes]] = []

    def put(self, heading: Heading, payload: bytes) -> None:
        assert heading.episode is not None
        sequence = self.sequences[heading.episode] = self.sequences.get(heading.episode, 0) + 1
        assert self.queue.put_nowait(heading, payload, reserved=True) == sequence
        self.put_so_far.append(record(len(self.put_so_far) + 1, heading, sequence, payload))
        path = self.queue._appender.begun[-1].path
        self._since.setdefault(path, []).append(path.read_bytes())

    def put_meanwhile(self) -> None:
        """Put what other threads put during a turn of the sync thread: nothing, a few records, or enough for a new
        segment.
        """
        for size in self._rng.choice([[], [], [], [], [], [10], [3000], [10, 3000]]):
            self.put(self.meanwhile(), b"m" * size)

    def synced(self, path: Path) -> None:
        self._safe[path], self._since[path] = path.read_bytes(), []

    def turn(self) -> None:
        """Run one turn of the sync thread."""
        before = {path: self._mixed(path) for path in self._files()}
        self.queue._turn()
        self._deleted += [(path, before[path]) for path in before if not path.exists()]

    def cut(self) -> None:
        """Keep the files as they may be after a power cut, with what the queue reports as synced at this moment."""
        folder = self._place / str(len(self.cuts)) / self.queue.name
        folder.mkdir(parents=True)
        (folder / "alive").touch()
        for path in self._files():
            (folder / path.name).write_bytes(self._mixed(path))
        for path, content in self._deleted[self._rng.randrange(len(self._deleted) + 1) :]:
            (folder / path.name).write_bytes(content)
        self.cuts.append((folder, self.queue.synced, self.queue.stored, len(self.put_so_far)))

    def kill(self) -> Path:
        """Return the folder as other processes find it while there is power, with everything that was written."""
        folder = self._place / "killed" / self.queue.name
        folder.mkdir(parents=True)
        (folder / "alive").touch()
        for path in self._files():
            (folder / path.name).write_bytes(path.read_bytes())
        return folder

    def cut_after_kill(self, killed: Path, *, safe: set[str]) -> Path:
        """Return what is left of that folder without power if the program that recovered it had made these files
        durable.
        """
        folder = self._place / "cut" / self.queue.name
        folder.mkdir(parents=True)
        (folder / "alive").touch()
        deleted = sum(not (killed / path.name).exists() for path in self._files())
        for path in self._files()[self._rng.randrange(deleted + 1) :]:
            (folder / path.name).write_bytes(path.read_bytes() if path.name in safe else self._mixed(path))
        return folder

    def _files(self) -> list[Path]:
        return sorted(self.queue.folder.glob("*.segment"))

    def _mixed(self, path: Path) -> bytes:
        now = path.read_bytes()
        states = [self._safe.get(path, bytes(len(now))), *self._since.get(path, []), now]
        if self._rng.random() < 0.2:
            states = [self._rng.choice(states)]
        return b"".join(self._rng.choice(states)[at : at + SECTOR] for at in range(0, len(now), SECTOR))


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


@contextmanager
def machine_on(place: Path, rng: random.Random) -> Iterator[Machine]:
    """Return a machine whose every sync is observed, with a power cut before and after each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SyncThread, "start", lambda self: None)
        machine = Machine(place, rng)
        sync = Segment.sync

        def watched(segment: Segment) -> None:
            machine.cut()
            machine.put_meanwhile()
            sync(segment)
            machine.synced(segment.path)
            machine.put_meanwhile()
            machine.cut()

        begin_sync = SyncableAppender.begin_sync

        def begun(appender: SyncableAppender) -> Span:
            span = begin_sync(appender)
            machine.put_meanwhile()
            return span

        patch.setattr(Segment, "sync", watched)
        patch.setattr(SyncableAppender, "begin_sync", begun)
        try:
            yield machine
        finally:
            machine.queue._appender.close()
            machine.queue._source.reader.close()


async def live_through_cuts(machine: Machine, rng: random.Random) -> None:
    """Run a recorder that puts, syncs, stores and deletes, with a power cut at every step."""
    for number in (1, 2, 3):
        machine.put(started(number), b"{}")
    for _ in range(6):
        for _ in range(rng.randrange(5)):
            number = rng.choice([1, 1, 2])
            machine.put(node(number), b"y" * rng.randrange(1500))
        machine.cut()
        machine.turn()
        machine.cut()
        if machine.queue.synced > machine.queue._source.reader.cursor.position and rng.random() < 0.7:
            batch = await machine.queue.get_batch(events_max=rng.choice([1, 4, 1000]), bytes_max=2**20, age_s_max=0.0)
            await machine.queue.acknowledge(batch[-1].position)
            machine.turn()
            machine.cut()
        if rng.random() < 0.1 and machine.sequences[episode(2)] > 0:
            machine.put(node(3), b"third")
    machine.put(ended(1), b"{}")
    machine.cut()


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
    recovered = open_dead(killed)
    assert recovered is not None
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
