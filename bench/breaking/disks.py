"""A disk that fills up under a recorder, on each kind of file system, and a spool that is deleted under one."""

from __future__ import annotations

import asyncio
import os
import random
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Final

from bench.breaking.files import events_of, put
from bench.breaking.images import NOT_MADE, DiskImage
from bench.breaking.outcome import Event, Outcome, Step
from bench.breaking.speaking import Speaker
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolDamaged, SpoolFull, SpoolUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import episode_id, episode_text
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.settings import Settings
from tests.queue.factories import drain, episode, node, started
from tests.queue.test_deleted_files import DELETIONS

__all__ = ["FullDisksOn", "deleted_spools"]

_SIZE: Final = {"ext4": "64M", "xfs": "320M", "btrfs": "128M"}
"""As small as its mkfs makes it."""
_SETTINGS: Final = Settings(
    sync_interval_ms=1, segment_bytes=2**17, spool_bytes_max=2**24, spool_reserve_bytes=2**18, record_bytes_max=2**12
)
_LONGEST_LIFE_S: Final = 0.2
_UNDISTURBED: Final = 25
"""So many events are safe before the first file goes."""
_DELETIONS_APART: Final = 40
"""After how many puts the files go once more, on the average."""


# --- a full disk ---------------------------------------------------------------------------------------------------


class FullDisksOn:
    """The fault on one kind of file system: a full disk is an error for a put, and never the end of the process."""

    def __init__(self, kind: str) -> None:
        self._kind = kind

    def __call__(self, rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome(note=f"{self._kind} on a loop image, filled up to the last block under a recorder")
        try:
            if not DiskImage.can_make(self._kind):
                raise FileNotFoundError(self._kind)
            disk = DiskImage(folder, kind=self._kind, size=_SIZE[self._kind])
            with disk.mounted():
                pass
        except (OSError, subprocess.CalledProcessError):
            outcome.note = NOT_MADE
            return outcome
        with disk.mounted():
            for _ in range(rounds):
                if self._kind == "btrfs":
                    _refused(outcome, disk.root, folder, rng)
                else:
                    _filled(outcome, disk.root, rng)
                step()
        if self._kind == "btrfs":
            outcome.note = "a spool on btrfs is refused when it is opened; the events are of one beside the full btrfs"
        return outcome


def _filled(outcome: Outcome, root: Path, rng: random.Random) -> None:
    spool = root / "spool"
    recorder = Speaker(_record_on_a_full_disk, str(spool), rng.randrange(2**31))
    try:
        recorder.wait_for("ready")
        _fill(root)
        recorder.wait_for("full")
        time.sleep(rng.random() * _LONGEST_LIFE_S / 4)
        said = recorder.kill()  # raises if it ended by itself, as a SIGBUS ends it
    finally:
        recorder.stop()
    put_before = [(episode_text(_EPISODE), int(words[1]), words[2]) for words in said if words[0] == "put"]
    (root / "filler").unlink()
    found = [each for folder in Spool(spool).recorders() for each in events_of(asyncio.run(_recovered(folder.path)))]
    trying = [(episode_text(_EPISODE), len(put_before) + 1, each[2]) for each in found[len(put_before) :][:1]]
    outcome.compare(put_before, found, put=trying)
    shutil.rmtree(spool)


def _fill(root: Path) -> None:
    """Takes the last block, without writing any."""
    with (root / "filler").open("wb") as file:
        end, size = 0, 2**26
        while size >= 2**12:
            try:
                os.posix_fallocate(file.fileno(), end, size)
                end += size
            except OSError:
                size //= 2


def _refused(outcome: Outcome, root: Path, folder: Path, rng: random.Random) -> None:
    try:
        _queue(root / "spool").release()
    except SpoolUnavailable as refusal:
        if "lies on btrfs" not in str(refusal):
            raise
    else:
        outcome.changed += 1
    queue = _queue(folder / "spool")
    _fill(root)
    sure = [put(queue, "EpisodeStarted", b"{}")]
    sure += [put(queue, "NodeStarted", rng.randbytes(40).hex().encode()) for _ in range(rng.randrange(10, 60))]
    queue.release()
    outcome.compare(sure, events_of(asyncio.run(_recovered(queue.folder))))
    shutil.rmtree(folder / "spool")
    (root / "filler").unlink()


def _record_on_a_full_disk(spool: str, seed: int) -> None:
    """Puts until it may not, tries again for ever, and says what it put."""
    rng = random.Random(seed)
    queue = _queue(Path(spool))
    _say_put(put(queue, "EpisodeStarted", b"{}"))
    said_full = False
    for number in count():
        try:
            _say_put(put(queue, "NodeStarted", rng.randbytes(rng.randrange(1, 900)).hex().encode()))
        except SpoolFull:
            if not said_full:
                print("full", flush=True)
            said_full = True
            time.sleep(0.001)
        if number == 20:
            print("ready", flush=True)
        if 20 < number < 200:
            time.sleep(0.0005)  # the disk fills up meanwhile


def _say_put(event: Event) -> None:
    print("put", event[1], event[2], flush=True)


# --- a deleted spool -----------------------------------------------------------------------------------------------


def deleted_spools(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Files go at random under a recorder that is killed: what it was told is safe is there, or named as lost."""
    outcome = Outcome(note="folder, segment, lock or spool deleted, replaced or renamed; told: named as lost")
    for _ in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        recorder = Speaker(_record_while_files_go, str(place / "spool"), rng.randrange(2**31))
        try:
            recorder.wait_for("synced")
            time.sleep(rng.random() * _LONGEST_LIFE_S)
            said = recorder.kill()
        finally:
            recorder.stop()
        unnoticed = said[-1][0] == "deleting"
        _compare(outcome, said, asyncio.run(_folders(place / "spool", unnoticed=unnoticed)))
        shutil.rmtree(place)
        step()
    return outcome


def _compare(outcome: Outcome, said: list[list[str]], folders: list[tuple[list[Record], bool]]) -> None:
    """`folders` in the order of recovery: the records of each, and whether an episode is open in it."""
    safe, lost, deleting = 0, set[int](), False
    for word, *numbers in said:
        if word == "synced":
            safe, deleting = int(numbers[0]), False
        elif word == "lost":
            lost |= set(range(int(numbers[0]), int(numbers[1]) + 1))
        else:
            deleting = True
    if deleting:  # killed before it could notice: no process is left that could say so
        safe = 0
    found: dict[int, Event] = {}
    for number, (records, is_open) in enumerate(folders):
        found |= {each[1]: each for each in events_of(records)}
        outcome.changed += is_open and any(later for later, _ in folders[number + 1 :])  # ended, though it goes on
    whole = [_event(sequence) for sequence in range(1, safe + 1)]
    last = max(found, default=0)
    gone = [each for each in range(1, max(last, safe) + 1) if each not in found and (deleting or each in lost)]
    outcome.told += sum(each <= safe for each in gone)
    # What is named stands in its place, so that the order of the others is compared all the same.
    there = found | {each: _event(each) for each in gone}
    outcome.compare(whole, [there[each] for each in sorted(there)], put=[_event(each) for each in range(1, last + 1)])


def _event(sequence: int) -> Event:
    return episode_text(_EPISODE), sequence, _payload(sequence).hex()


async def _folders(spool: Path, *, unnoticed: bool = False) -> list[tuple[list[Record], bool]]:
    recovered = []
    for folder in Spool(spool).recorders():
        try:
            queue = open_dead(folder.path)
            assert queue is not None, "its process is dead"
            records = await drain(queue)
        except SpoolDamaged:
            if not unnoticed:
                raise
            continue  # reported, and so not silent: of its files some are gone, and no process has seen that
        recovered.append((records, bool(queue.lost)))
        queue.release()
    return recovered


def _record_while_files_go(spool: str, seed: int) -> None:
    rng = random.Random(seed)
    settings = Settings(
        sync_interval_ms=rng.choice((1, 1000)),
        segment_bytes=rng.choice((2**13, 2**20)),
        spool_bytes_max=2**26,
        spool_reserve_bytes=2**14,
        record_bytes_max=2**11,
    )
    queue = _queue(Path(spool), settings)
    queue.put_nowait(started(), _payload(1))
    asyncio.run(_go_on(queue, rng))


async def _go_on(queue: RecorderQueue, rng: random.Random) -> None:
    reported = 0
    for sequence in count(2):
        while True:
            try:
                queue.put_nowait(node(), _payload(sequence))
                break
            except SpoolUnavailable:  # its segments are full, and no folder was made yet
                await asyncio.sleep(0.001)
        if sequence > _UNDISTURBED and rng.random() < 1 / _DELETIONS_APART:
            print("deleting", flush=True)
            with suppress(OSError):  # it is moving at this moment
                rng.choice(DELETIONS)(queue)
        if sequence == _UNDISTURBED or (sequence > _UNDISTURBED and rng.random() < 0.2):
            with suppress(SpoolUnavailable):
                await queue.synced_to()
                for line in queue.lost[reported:]:
                    print("lost", line.split()[1], line.split()[3].rstrip(":"), flush=True)
                reported = len(queue.lost)
                print("synced", sequence, flush=True)


_EPISODE: Final = episode(1)


def _payload(sequence: int) -> bytes:
    return b"%d " % sequence * 8


def _queue(spool: Path, settings: Settings = _SETTINGS) -> RecorderQueue:
    recorder = episode_id(SYSTEM_CLOCK.wall_ns(), os.urandom(10))
    return RecorderQueue.create(spool, settings=settings, clock=SYSTEM_CLOCK, recorder=recorder)


async def _recovered(folder: Path) -> list[Record]:
    """Of the only recorder there."""
    [(records, _)] = await _folders(folder.parent)
    return records
