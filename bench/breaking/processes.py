"""Processes that end: recorders and appenders killed at random moments, forks, exits with a full queue, two at once."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path

from bench.breaking.files import ROOMY, events_of, put
from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async.errors import SpoolClosed, SpoolFull
from pycrorm_async.events.envelope import LOST
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.store.address import DatabaseAddress
from tests.crash import recording
from tests.databases import ask
from tests.queue.writing import SMALL, make, node, recover
from tests.store.test_crash import PER_BATCH, append_all

__all__ = ["killed_recorders", "killed_appenders", "forks", "exits_with_a_full_queue", "second_openers"]

_SPAWN = multiprocessing.get_context("forkserver")
_SPAWN.set_forkserver_preload(["tests.crash.recording", "tests.store.test_crash"])
_LONGEST_LIFE_S = 0.1


def _said_until_killed(target: Callable[..., None], arguments: tuple[object, ...], life_s: float) -> list[list[str]]:
    """Every whole line the process had written when it was killed, so long after its first."""
    mine, its = _SPAWN.Pipe(duplex=False)
    process = _SPAWN.Process(target=_speaking, args=(its, target, *arguments))
    process.start()
    its.close()
    said = os.read(mine.fileno(), 1 << 16)
    time.sleep(life_s)
    process.kill()
    while chunk := os.read(mine.fileno(), 1 << 20):
        said += chunk
    process.join()
    mine.close()
    return [line.split() for line in said[: said.rfind(b"\n") + 1].decode().splitlines()]


def _speaking(out: Connection, target: Callable[..., None], *arguments: object) -> None:
    os.dup2(out.fileno(), 1)
    out.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    target(*arguments)


# --- recorders --------------------------------------------------------------------------------------------------


def _record(spool: str, seed: int, threads: int, doing: str) -> None:
    sys.argv = ["recording", spool, str(seed), str(threads), doing]
    recording.main()


def killed_recorders(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """`kill -9` at a random moment of a life of up to 0.1 s; all that putting returned for must be there."""
    outcome = Outcome(note="one to three threads; half of them with a consumer that stores meanwhile")
    for _ in range(rounds):
        spool = Path(tempfile.mkdtemp(dir=folder)) / "spool"
        seed, threads, doing = rng.randrange(2**31), rng.choice((1, 1, 2, 3)), rng.choice(("recording", "storing"))
        said = _said_until_killed(_record, (str(spool), seed, threads, doing), rng.random() * _LONGEST_LIFE_S)
        answered = {(line[1], int(line[2])) for line in said if line[0] == "put"}
        stored = {int(line[1]): (line[2], int(line[3]), line[4]) for line in said if line[0] == "stored"}
        (left,) = Spool(spool).recorders()
        there = dict(stored)
        twice = 0
        for each in asyncio.run(recover(left.path)):
            if each.episode is not None and each.payload != LOST:
                event = (episode_text(each.episode), each.sequence, each.payload.rstrip(b"x").decode())
                twice += there.get(each.position, event) != event
                there[each.position] = event
        found = [there[position] for position in sorted(there)]
        content: dict[tuple[str, int], Event] = {
            (name, sequence): (name, sequence, f"{name}/{sequence}/") for name, sequence, _ in found
        } | {(name, sequence): (name, sequence, f"{name}/{sequence}/") for name, sequence in answered}
        # Each thread may have been killed between the writing and the saying.
        outcome.changed += max(0, len(found) - len(answered) - threads) + twice
        outcome.compare([content[each] for each in answered], found, put=content.values())
        shutil.rmtree(spool.parent)
        step()
    return outcome


# --- appenders --------------------------------------------------------------------------------------------------


def _append(url: str, first: int) -> None:
    asyncio.run(append_all(DatabaseAddress.parse(url), count(first)))


def killed_appenders(url: str) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """The same for a process that appends batches to the database of this URL, again from the last one it reported."""

    def killed(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        del folder
        outcome = Outcome(note=f"batches of {2 * PER_BATCH} events of two episodes")
        known = 0
        for _ in range(rounds):
            said = _said_until_killed(_append, (url, max(known - 1, 0)), rng.random() * _LONGEST_LIFE_S)
            appended = max([known, *(int(line[1]) + 1 for line in said if line[0] == "appended")])
            heads = _settled(url)
            outcome.rounds += 1
            outcome.events = 2 * PER_BATCH * appended
            outcome.lost += sum(max(0, appended * PER_BATCH - head) for head in heads)
            outcome.misordered += sum(head % PER_BATCH != 0 for head in heads)  # half a batch
            known = heads[0] // PER_BATCH if heads else 0
            step()
        counts = "count(*), count(DISTINCT sequence), min(sequence), max(sequence)"
        rows = ask(url, f"SELECT episode, {counts} FROM event GROUP BY 1")
        for _, there, different, first, last in rows:
            outcome.duplicated += there - different
            outcome.lost += (last - first + 1 - different) + (first - 1)
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
            recording.say("put", sequence, payload)
            kind = "NodeStarted"
    recording.say("full", 0, "-")
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
        mine, its = _SPAWN.Pipe(duplex=False)
        how = rng.choice(("exit", "raise", "_exit"))
        process = _SPAWN.Process(target=_speaking, args=(its, _fill_and_exit, str(spool), how))
        process.start()
        its.close()
        said = b""
        while chunk := os.read(mine.fileno(), 1 << 20):
            said += chunk
        process.join()
        mine.close()
        (left,) = Spool(spool).recorders()
        found = events_of(asyncio.run(recover(left.path)))
        lines = [line.split() for line in said.decode().splitlines()]
        name = found[0][0] if found else ""
        outcome.compare([(name, int(line[1]), line[2]) for line in lines if line[0] == "put"], found)
        shutil.rmtree(spool.parent)
        step()
    return outcome


# --- two at once ------------------------------------------------------------------------------------------------


def _drain_if_mine(folder: str, barrier: object) -> None:
    barrier.wait()  # type: ignore[attr-defined]
    recovered = open_dead(Path(folder))
    if recovered is None:
        recording.say("not", "mine")
        return
    records = asyncio.run(recovered.get_batch(events_max=10_000, bytes_max=2**24, age_s_max=0.0))
    for name, sequence, payload in events_of(records):
        recording.say("drained", name, sequence, payload)
    asyncio.run(recovered.acknowledge(records[-1].position))
    recovered.remove()


def second_openers(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Four processes drain the folder of one dead recorder at the same moment: one of them does, once."""
    outcome = Outcome(note="four processes, released together")
    for _ in range(rounds):
        queue = make(Path(tempfile.mkdtemp(dir=folder)) / "spool", settings=ROOMY)
        sure = [put(queue, "EpisodeStarted", b"{}")]
        sure += [put(queue, "NodeStarted", b"x" * rng.randrange(200)) for _ in range(30)]
        queue.release()
        barrier = _SPAWN.Barrier(4)
        mine, its = _SPAWN.Pipe(duplex=False)
        drainers = [
            _SPAWN.Process(target=_speaking, args=(its, _drain_if_mine, str(queue.folder), barrier)) for _ in range(4)
        ]
        for each in drainers:
            each.start()
        its.close()
        said = b""
        while chunk := os.read(mine.fileno(), 1 << 20):
            said += chunk
        for each in drainers:
            each.join()
        mine.close()
        lines = [line.split() for line in said.decode().splitlines()]
        by_episode: defaultdict[str, list[Event]] = defaultdict(list)
        for line in lines:
            if line[0] == "drained":
                by_episode[line[1]].append((line[1], int(line[2]), line[3] if len(line) > 3 else ""))
        outcome.compare(sure, [event for events in by_episode.values() for event in events])
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome
