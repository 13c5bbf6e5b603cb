"""Folders whose frames and headers were changed with all checksums made right: damage concerns its own folder alone."""

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
from pycrorm_async.queue.maintenance.inspection import inspect_spool
from pycrorm_async.queue.maintenance.repair import repair_folder
from tests.databases import ask
from tests.queue.factories import Author, ended, episode, node, started
from tests.queue.forged_segments import change_a_frame, change_the_header

__all__ = ["crafted_folders"]

_FOUND = "SELECT e.id, v.sequence, v.payload FROM event v JOIN episode e ON e.number = v.episode ORDER BY 1, 2"


_FOLDERS = 10
"""Changed in one round: most of its time goes into opening a database."""


def crafted_folders(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Ten of eleven folders are changed; the other is stored whole, and of each changed one all before the change."""
    outcome = Outcome()
    changed = refused = 0
    for _ in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        spool, url = place / "spool", f"sqlite:///{place / 'memory.db'}"
        authors = [_author(spool, number, rng) for number in range(1, _FOLDERS + 2)]
        whole = authors.pop(rng.randrange(len(authors)))
        sure = events_of(whole.records)
        for crafted in authors:
            path, changes, safe = rng.choice(crafted.segments), rng.choice((1, 1, 2, 5)), 0
            if rng.random() < 0.2:
                change_the_header(path, rng)
            else:
                safe = max(1, min(change_a_frame(path, rng, fitting=rng.random() < 0.8) for _ in range(changes))) - 1
            sure += events_of(crafted.records[:safe])
            changed += changes
        refused += _stored(url, spool)
        inspect_spool(spool)
        for each in Spool(spool).recorders():
            with suppress(PycrormError):  # a segment of another recorder: reported, and left alone
                repair_folder(each.path)
        _stored(url, spool)
        found = [(name, sequence, payload.encode().hex()) for name, sequence, payload in ask(url, _FOUND)]
        acknowledged = set(sure)
        outcome.compare(sure, [each for each in found if each in acknowledged])
        shutil.rmtree(place)
        step()
    outcome.note = f"{changed:,} changes; {refused:,} folders refused as damaged; the one beside them stored whole"
    return outcome


def _stored(url: str, spool: Path) -> int:
    """How many folders were refused; anything but a report of it ends the bench."""
    return len(asyncio.run(recover(url, spool=spool)).failed)


def _author(spool: Path, number: int, rng: random.Random) -> Author:
    author = Author(spool, settings=ROOMY, recorder=episode(90 + number))
    author.put(started(number))
    for _ in range(rng.randrange(12, 30)):
        author.put(node(number), b'{"n":"%s"}' % (b"n" * rng.randrange(900)))
        if rng.random() < 0.4:
            author.sync()
    author.put(ended(number))
    author.sync()
    author.appender.close()
    return author
