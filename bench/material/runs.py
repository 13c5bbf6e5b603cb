"""Begin a measurement: its options, a folder with databases, and the records and memories that scripts measure."""

from __future__ import annotations

import argparse
import asyncio
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pycrorm_async import Memory
from pycrorm_async.events.codec import Record
from pycrorm_async.operations.recovery import recover
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.queue import Spool, open_dead
from tests.databases import Server, server_in

DATABASES: Final = ("sqlite", "postgresql")


def options(doc: str | None, *, quick: str) -> argparse.ArgumentParser:
    """Return the parser of a script, with its docstring as help and the option `--quick`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    return parser


@dataclass(frozen=True)
class Place:
    """A temporary folder, and a server of its own for memories on PostgreSQL."""

    database: str
    folder: Path
    server: Server | None

    def new_url(self, name: str) -> str:
        """Return the URL of an empty database; SQLite's has this name in the folder."""
        return self.server.new_database() if self.server else f"sqlite:///{self.folder}/{name}.db"


@contextmanager
def place(database: str) -> Iterator[Place]:
    """Make a place for databases of this kind; both end with the context."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        server = stack.enter_context(server_in(folder / "pg")) if database == "postgresql" else None
        yield Place(database, folder, server)


def store_all(url: str, spool: Path) -> None:
    """Store and fold what dead recorders have left in a spool."""
    report = asyncio.run(recover(url, spool=spool))
    assert not report.failed, report.failed
    assert not report.drained.stopped, report.drained.stopped


async def read_all(spool: Path) -> list[Record]:
    """Return the records of a spool's only recorder, which is dead."""
    [recorder] = Spool(spool).recorders()
    queue = open_dead(recorder.path)
    assert queue is not None
    records: list[Record] = []
    while batch := await queue.get_batch(events_max=10_000, bytes_max=2**22, age_s_max=0.0):
        records += batch
    queue.release()
    return records


@dataclass
class NoteActionPerformable(ActionAbstract):
    """An action that does nothing, with a text and a number."""

    text: str
    weight: float

    async def perform(self) -> None: ...


async def record_notes(memory: Memory, nodes: int) -> None:
    """Record so many notes in an episode."""
    async with memory.episode(description="bench"):
        for index in range(nodes):
            await NoteActionPerformable(f"note {index}", index / 7).perform()
