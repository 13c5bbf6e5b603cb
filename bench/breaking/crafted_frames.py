"""Change frames and headers of folders and correct all checksums; damage must not affect any other folder."""

from __future__ import annotations

import asyncio
import random
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

from bench.breaking.files import ROOMY, events_of
from bench.breaking.outcome import Outcome, Step
from pycrorm_async.errors import PycrormError
from pycrorm_async.operations.recovery import recover
from pycrorm_async.queue import Spool
from pycrorm_async.queue.maintenance import inspect_spool, repair_folder
from tests.databases import ask
from tests.queue.factories import FolderWriter, ended, episode, node, started
from tests.queue.forged_segments import change_a_frame, change_the_header

__all__ = ["crafted_folders"]

_STORED_EVENTS = "SELECT e.id, v.sequence, v.payload FROM event v JOIN episode e ON e.number = v.episode ORDER BY 1, 2"


_FOLDERS = 10
"""Folders to change in one round; several share a round, because opening the database takes most of its time."""


def crafted_folders(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Change ten of eleven folders; the other is stored completely, and each changed one up to its first change."""
    outcome = Outcome()
    changes_total = refused = 0
    for _ in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        spool, url = place / "spool", f"sqlite:///{place / 'memory.db'}"
        authors = [_author(spool, number, rng) for number in range(1, _FOLDERS + 2)]
        intact_author = authors.pop(rng.randrange(len(authors)))
        expected = events_of(intact_author.records)
        for crafted in authors:
            path, changes_of_folder, intact_records = rng.choice(crafted.segments), rng.choice((1, 1, 2, 5)), 0
            if rng.random() < 0.2:
                change_the_header(path, rng)
            else:
                intact_records = (
                    max(1, min(change_a_frame(path, rng, fitting=rng.random() < 0.8) for _ in range(changes_of_folder)))
                    - 1
                )
            expected += events_of(crafted.records[:intact_records])
            changes_total += changes_of_folder
        refused += _recover_spool(url, spool)
        inspect_spool(spool)
        for each in Spool(spool).recorders():
            with suppress(PycrormError):  # a segment of another recorder is reported and not repaired
                repair_folder(each.path)
        _recover_spool(url, spool)
        stored = [(name, sequence, payload.encode().hex()) for name, sequence, payload in ask(url, _STORED_EVENTS)]
        expected_events = set(expected)
        outcome.compare(expected, [each for each in stored if each in expected_events])
        shutil.rmtree(place)
        step()
    outcome.note = f"{changes_total:,} changes; {refused:,} folders refused as damaged; all intact folders stored"
    return outcome


def _recover_spool(url: str, spool: Path) -> int:
    """Recover the spool; return the number of folders that were refused. Any other error ends the benchmark."""
    return len(asyncio.run(recover(url, spool=spool)).failed)


def _author(spool: Path, number: int, rng: random.Random) -> FolderWriter:
    author = FolderWriter(spool, settings=ROOMY, recorder=episode(90 + number))
    author.put(started(number))
    for _ in range(rng.randrange(12, 30)):
        author.put(node(number), b'{"n":"%s"}' % (b"n" * rng.randrange(900)))
        if rng.random() < 0.4:
            author.sync()
    author.put(ended(number))
    author.sync()
    author.appender.close()
    return author
