"""Actions that write notes, and queries for the notes that a memory holds."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.plan import ActionAbstract
from tests.databases import put_memory


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str

    async def perform(self) -> None:
        """Succeed without doing anything."""


async def texts(memory: Memory | Reading) -> list[str]:
    async with memory.session() as session:
        notes: Any = memory.mapped(NoteActionPerformable)
        return list(await session.scalars(select(notes.text).order_by(notes.id)))


def url_of(folder: Path) -> str:
    """Return the URL of the memory in this folder. The first call makes it."""
    return put_memory(folder / "memory.db")
