"""Kill recorders with SIGKILL at any moment: every record whose `put_nowait` returned is stored once and in order."""

import random
import shutil
import time
from collections import defaultdict
from pathlib import Path

import pytest

from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import Spool, open_dead
from tests.crash.forked_processes import ForkedProcess
from tests.crash.recorder_process import record

pytestmark = pytest.mark.slow

TOGETHER = 4
"""Recorders that are alive at the same time, each with a spool of its own."""
LIFE_S_MAX = 0.015
LOST = b'{"status":"LOST"}'


def start(spool: Path, rng: random.Random, seed: int) -> ForkedProcess:
    return ForkedProcess(record, str(spool), seed, rng.choice([1, 1, 2, 3]), rng.choice(["recording", "storing"]), 400)


async def recover_folder(folder: Path) -> list[Record]:
    recovered = open_dead(folder)
    assert recovered is not None
    records: list[Record] = []
    while batch := await recovered.get_batch(events_max=777, bytes_max=2**20, age_s_max=0.0):
        records += batch
    recovered.release()
    return records


async def kill_and_verify(folder: Path, seeds: range) -> None:
    for seed, lines in killed(folder, seeds).items():
        print(f"seed {seed}")
        await verify_killed_recorder(folder / str(seed), lines)
        shutil.rmtree(folder / str(seed))


def killed(folder: Path, seeds: range) -> dict[int, list[list[str]]]:
    """The output of recorders with these seeds, which run concurrently and are killed one after another."""
    recorders = {seed: start(folder / str(seed), random.Random(seed), seed) for seed in seeds}
    for each in recorders.values():
        each.wait_for_first_output()
    for seed, each in recorders.items():
        time.sleep(random.Random(seed).random() * LIFE_S_MAX)
        each.kill()
    return {seed: [line.split() for line in each.lines] for seed, each in recorders.items()}


async def verify_killed_recorder(spool: Path, lines: list[list[str]]) -> None:
    put = {(name, int(sequence)) for what, name, sequence, *_ in lines if what == "put"}
    stored = [(int(line[1]), line[2], int(line[3]), line[4]) for line in lines if line[0] == "stored"]
    (folder,) = Spool(spool).recorders()
    assert not folder.alive
    records = await recover_folder(folder.path)
    assert await recover_folder(folder.path) == records

    ends = [each for each in records if each.payload == LOST]
    kept = [
        (each.position, episode_text(each.episode), each.sequence, each.payload.rstrip(b"x").decode())
        for each in records
        if each.episode is not None and each.payload != LOST
    ]
    # Recovery supplies only what was put, and the same records as the recorder supplied before the kill.
    everything = dict.fromkeys(stored)
    assert len({position for position, *_ in everything}) == len(everything)
    everything |= dict.fromkeys(kept)
    assert [position for position, *_ in sorted(everything)] == list(range(1, len(everything) + 1))
    assert [position for position, *_ in kept] == list(range(len(everything) - len(kept) + 1, len(everything) + 1))
    assert all(payload == f"{name}/{sequence}/" for _, name, sequence, payload in everything)
    # It supplies all that was put, and for each of three threads at most one record that was not reported.
    sequences_in_order = [(name, sequence) for _, name, sequence, _ in sorted(everything)]
    assert len(set(sequences_in_order)) == len(sequences_in_order)
    assert put <= set(sequences_in_order)
    assert len(sequences_in_order) <= len(put) + 3
    # Sequences have no gaps; computed ends follow them, one for each episode without an end.
    last: defaultdict[str, int] = defaultdict(int)
    for name, sequence in sequences_in_order:
        assert sequence == last[name] + 1
        last[name] = sequence
    assert [each.position for each in ends] == list(
        range(len(sequences_in_order) + 1, len(sequences_in_order) + 1 + len(ends))
    )
    for each in ends:
        assert each.episode is not None
        assert each.type == "EpisodeEnded"
        assert each.sequence == last.pop(episode_text(each.episode)) + 1
    assert len(ends) <= 3


async def test_every_written_record_survives_a_kill_once_and_in_order(tmp_path: Path) -> None:
    first = random.SystemRandom().randrange(2**20)
    for seed in range(first, first + 24, TOGETHER):
        await kill_and_verify(tmp_path, range(seed, seed + TOGETHER))


@pytest.mark.soak
async def test_every_written_record_survives_ten_thousand_kills(tmp_path: Path, in_turn: bool) -> None:
    for seed in range(0, 1_000 if in_turn else 10_000, TOGETHER):
        await kill_and_verify(tmp_path, range(seed, seed + TOGETHER))
