"""Killed with SIGKILL at any moment: whatever putting returned for is there once, in order, and nothing else is."""

import random
import shutil
import time
from collections import defaultdict
from pathlib import Path

import pytest

from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import Spool, open_dead
from tests.crash.forked_processes import Forked
from tests.crash.recorder_process import record

pytestmark = pytest.mark.slow

TOGETHER = 4
"""How many recorders live at the same time; each has a spool of its own."""
LIFE_S_MAX = 0.015
LOST = b'{"status":"LOST"}'


def start(spool: Path, rng: random.Random, seed: int) -> Forked:
    return Forked(record, str(spool), seed, rng.choice([1, 1, 2, 3]), rng.choice(["recording", "storing"]), 400)


async def recovered_by(folder: Path) -> list[Record]:
    recovered = open_dead(folder)
    assert recovered is not None
    records: list[Record] = []
    while batch := await recovered.get_batch(events_max=777, bytes_max=2**20, age_s_max=0.0):
        records += batch
    recovered.release()
    return records


async def kill_and_prove(folder: Path, seeds: range) -> None:
    for seed, said in killed(folder, seeds).items():
        print(f"seed {seed}")
        await prove(folder / str(seed), said)
        shutil.rmtree(folder / str(seed))


def killed(folder: Path, seeds: range) -> dict[int, list[list[str]]]:
    """What recorders with these seeds said; they live at once and are killed one after the other."""
    recorders = {seed: start(folder / str(seed), random.Random(seed), seed) for seed in seeds}
    for each in recorders.values():
        each.wait_for_its_first_words()
    for seed, each in recorders.items():
        time.sleep(random.Random(seed).random() * LIFE_S_MAX)
        each.kill()
    return {seed: [line.split() for line in each.said] for seed, each in recorders.items()}


async def prove(spool: Path, said: list[list[str]]) -> None:
    put = {(name, int(sequence)) for what, name, sequence, *_ in said if what == "put"}
    stored = [(int(line[1]), line[2], int(line[3]), line[4]) for line in said if line[0] == "stored"]
    (folder,) = Spool(spool).recorders()
    assert not folder.alive
    records = await recovered_by(folder.path)
    assert await recovered_by(folder.path) == records

    ends = [each for each in records if each.payload == LOST]
    kept = [
        (each.position, episode_text(each.episode), each.sequence, each.payload.rstrip(b"x").decode())
        for each in records
        if each.episode is not None and each.payload != LOST
    ]
    # Nothing is there that was not put, nothing differs between what was given before and after the kill.
    everything = dict.fromkeys(stored)
    assert len({position for position, *_ in everything}) == len(everything)
    everything |= dict.fromkeys(kept)
    assert [position for position, *_ in sorted(everything)] == list(range(1, len(everything) + 1))
    assert [position for position, *_ in kept] == list(range(len(everything) - len(kept) + 1, len(everything) + 1))
    assert all(payload == f"{name}/{sequence}/" for _, name, sequence, payload in everything)
    # All that putting returned for is there, and at most one more of each of three threads.
    there = [(name, sequence) for _, name, sequence, _ in sorted(everything)]
    assert len(set(there)) == len(there)
    assert put <= set(there)
    assert len(there) <= len(put) + 3
    # Sequences have no gaps; the computed ends follow, one for each episode that has none.
    last: defaultdict[str, int] = defaultdict(int)
    for name, sequence in there:
        assert sequence == last[name] + 1
        last[name] = sequence
    assert [each.position for each in ends] == list(range(len(there) + 1, len(there) + 1 + len(ends)))
    for each in ends:
        assert each.episode is not None
        assert each.type == "EpisodeEnded"
        assert each.sequence == last.pop(episode_text(each.episode)) + 1
    assert len(ends) <= 3


async def test_every_written_record_survives_a_kill_once_and_in_order(tmp_path: Path) -> None:
    first = random.SystemRandom().randrange(2**20)
    for seed in range(first, first + 100, TOGETHER):
        await kill_and_prove(tmp_path, range(seed, seed + TOGETHER))


@pytest.mark.soak
async def test_every_written_record_survives_ten_thousand_kills(tmp_path: Path, in_turn: bool) -> None:
    for seed in range(0, 1_000 if in_turn else 10_000, TOGETHER):
        await kill_and_prove(tmp_path, range(seed, seed + TOGETHER))
