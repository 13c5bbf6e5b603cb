"""Processes that end: recorders and appenders killed at random moments, forks, exits with a full queue, two at once."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import NamedTuple

from bench.breaking.files import ROOMY, events_of, put
from bench.breaking.outcome import Outcome, Step
from bench.breaking.speaking import SPAWN, Speaker, kill_me_after
from pycrorm_async.errors import SpoolClosed, SpoolFull
from pycrorm_async.events.envelope import LOST
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.store.address import DatabaseAddress
from tests.crash import recorder_process
from tests.databases import ask
from tests.queue.factories import SMALL, episode, make, node, recover
from tests.store.test_crash import PER_BATCH, append_all, batch

__all__ = ["killed_recorders", "killed_appenders", "forks", "exits_with_a_full_queue", "second_openers"]

_LONGEST_LIFE_S = 0.1
_AT_ONCE = 4
_LONGEST_CPU_S = 0.05


def _said_until_killed(target: Callable[..., None], arguments: tuple[object, ...], life_s: float) -> list[list[str]]:
    """Every whole line the process had written when it was killed, so long after its first."""
    process = Speaker(target, *arguments)
    process.wait_for("\n")
    time.sleep(life_s)
    return process.kill()


# --- recorders --------------------------------------------------------------------------------------------------


def _record(spool: str, seed: int, threads: int, doing: str, cpu_s: float) -> None:
    kill_me_after(cpu_s)
    sys.argv = ["recording", spool, str(seed), str(threads), doing]
    recorder_process.main()


class _Life(NamedTuple):
    """A recorder that is to be killed: where it records, with how many threads, and what it says."""

    spool: Path
    threads: int
    recorder: Speaker


def killed_recorders(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """`kill -9` after up to 0.05 s of processor time; all that putting returned for must be there."""
    outcome = Outcome(note="one to three threads; half of them with a consumer that stores meanwhile")
    lives: deque[_Life] = deque()
    for left in range(rounds, 0, -1):
        while len(lives) < min(_AT_ONCE, left):
            lives.append(_born(Path(tempfile.mkdtemp(dir=folder)), rng))
        life = lives.popleft()
        _compare_what_is_left(outcome, life)
        shutil.rmtree(life.spool.parent)
        step()
    return outcome


def _born(place: Path, rng: random.Random) -> _Life:
    spool, threads = place / "spool", rng.choice((1, 1, 2, 3))
    seed, doing, cpu_s = rng.randrange(2**31), rng.choice(("recording", "storing")), rng.random() * _LONGEST_CPU_S
    return _Life(spool, threads, Speaker(_record, str(spool), seed, threads, doing, cpu_s))


def _compare_what_is_left(outcome: Outcome, life: _Life) -> None:
    said = life.recorder.killed()
    answered = {(line[1], int(line[2])) for line in said if line[0] == "put"}
    there = {int(line[1]): (line[2], int(line[3]), line[4]) for line in said if line[0] == "stored"}
    for recorder in Spool(life.spool).recorders():
        for each in asyncio.run(recover(recorder.path)):
            if each.episode is not None and each.payload != LOST:
                event = (episode_text(each.episode), each.sequence, each.payload.rstrip(b"x").decode())
                outcome.changed += there.get(each.position, event) != event
                there[each.position] = event
    found = [there[position] for position in sorted(there)]
    outcome.changed += sum(text != f"{name}/{sequence}/" for name, sequence, text in found)
    # Each thread may have been killed between the writing and the saying.
    outcome.changed += max(0, len(found) - len(answered) - life.threads)
    outcome.compare([(*each, f"{each[0]}/{each[1]}/") for each in answered], found, put=found)


# --- appenders --------------------------------------------------------------------------------------------------

_STORED = (
    "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode ORDER BY episode.number, sequence"
)


def _append(url: str, first: int) -> None:
    asyncio.run(append_all(DatabaseAddress.parse(url), count(first)))


def killed_appenders(new_database: Callable[[Path], str]) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """The same for a process that appends batches to a database, again from the last one it reported."""

    def killed(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome, url = Outcome(note=f"batches of {2 * PER_BATCH} events of two episodes"), new_database(folder)
        known = appended = 0
        for _ in range(rounds):
            said = _said_until_killed(_append, (url, max(known - 1, 0)), rng.random() * _LONGEST_LIFE_S)
            appended = max([known, *(int(line[1]) + 1 for line in said if line[0] == "appended")])
            heads = _settled(url) or [0, 0]
            outcome.lost += sum(max(0, appended * PER_BATCH - head) for head in heads)
            outcome.misordered += sum(head % PER_BATCH != 0 for head in heads)  # half a batch
            known = heads[0] // PER_BATCH
            step()
        events = [
            (episode_text(each.episode), each.sequence, each.payload.decode())
            for number in range(known)
            for each in batch(number)
            if each.episode is not None
        ]
        outcome.compare(events[: 2 * PER_BATCH * appended], ask(url, _STORED), put=events)
        outcome.rounds = rounds
        return outcome

    return killed


def _settled(url: str) -> list[int]:
    """How far the episodes are, once nobody is committing any more: a server finishes what a dead client asked for."""
    before: list[int] = [-1]
    while True:
        heads = [row[0] for row in ask(url, "SELECT head FROM episode ORDER BY number")] if _is_made(url) else []
        if heads == before:
            return heads
        before = heads
        time.sleep(0.005 if url.startswith("postgresql") else 0)


def _is_made(url: str) -> bool:
    if url.startswith("postgresql"):
        return bool(ask(url, "SELECT to_regclass('pycrorm.episode') IS NOT NULL")[0][0])
    return bool(ask(url, "SELECT count(*) FROM sqlite_master WHERE name = 'episode'")[0][0])


# --- forks and exits --------------------------------------------------------------------------------------------


def forks(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """A child is forked while the parent records, tries to record too and exits or is killed."""
    outcome = Outcome(note="the child's puts are refused; it takes nothing from its parent")
    for _ in range(rounds):
        queue = make(Path(tempfile.mkdtemp(dir=folder)) / "spool", settings=ROOMY)
        sure = [put(queue, "EpisodeStarted", b"{}")]
        sure += [put(queue, "NodeStarted", b"before") for _ in range(rng.randrange(9))]
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not the bench's own way out, which takes all folders along
            with contextlib.suppress(SpoolClosed):
                queue.put_nowait(node(), b"of the child", reserved=True)
            queue.release()
            os.kill(os.getpid(), rng.choice((signal.SIGKILL, signal.SIGTERM)))
        sure += [put(queue, "NodeStarted", b"after") for _ in range(rng.randrange(9))]
        os.waitpid(child, 0)
        sure += [put(queue, "NodeStarted", b"alone again")]
        queue.release()
        outcome.compare(sure, events_of(asyncio.run(recover(queue.folder))))
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome


def _fill_and_exit(spool: str, how: str) -> None:
    queue = make(Path(spool), settings=SMALL)
    with contextlib.suppress(SpoolFull):
        kind = "EpisodeStarted"
        while True:
            _, sequence, payload = put(queue, kind, b"f" * 200)
            recorder_process.say("put", sequence, payload)
            kind = "NodeStarted"
    recorder_process.say("full", 0, "-")
    if how == "exit":
        raise SystemExit(3)
    if how == "raise":
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115, PTH123  the traceback is not ours to show
        raise ValueError("the plan ends so")
    os._exit(0)


def exits_with_a_full_queue(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """A process fills its spool, drains nothing and leaves: by exit, by an exception, by `os._exit`."""
    outcome = Outcome(note="sys.exit, an exception nobody catches, os._exit")
    for _ in range(rounds):
        spool = Path(tempfile.mkdtemp(dir=folder)) / "spool"
        said = Speaker(_fill_and_exit, str(spool), rng.choice(("exit", "raise", "_exit"))).end()
        (left,) = Spool(spool).recorders()
        found = events_of(asyncio.run(recover(left.path)))
        name = episode_text(episode(1))
        outcome.compare([(name, int(line[1]), line[2]) for line in said if line[0] == "put"], found)
        shutil.rmtree(spool.parent)
        step()
    return outcome


# --- two at once ------------------------------------------------------------------------------------------------


def _drain_if_mine(folder: str, barrier: object) -> None:
    barrier.wait()  # type: ignore[attr-defined]
    recovered = open_dead(Path(folder))
    if recovered is None:
        recorder_process.say("not", "mine")
        return
    records = asyncio.run(recovered.get_batch(events_max=10_000, bytes_max=2**24, age_s_max=0.0))
    for name, sequence, payload in events_of(records):
        recorder_process.say("drained", name, sequence, payload)
    asyncio.run(recovered.acknowledge(records[-1].position))
    recovered.release()


def second_openers(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Four processes drain the folder of one dead recorder at the same moment: one of them does, once."""
    outcome = Outcome(note="four processes, released together")
    for _ in range(rounds):
        queue = make(Path(tempfile.mkdtemp(dir=folder)) / "spool", settings=ROOMY)
        sure = [put(queue, "EpisodeStarted", b"{}")]
        sure += [put(queue, "NodeStarted", b"x" * rng.randrange(200)) for _ in range(30)]
        queue.release()
        barrier = SPAWN.Barrier(4)
        drainers = [Speaker(_drain_if_mine, str(queue.folder), barrier) for _ in range(4)]
        said = [line for each in drainers for line in each.end() if line[0] == "drained"]
        outcome.compare(sure, [(line[1], int(line[2]), line[3] if len(line) > 3 else "") for line in said])
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome
