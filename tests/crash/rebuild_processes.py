"""Processes around a rebuild: one that rebuilds until it is killed at a statement, one that records, one that reads."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from pathlib import Path

from sqlalchemy import event, func, select
from sqlalchemy.engine import Engine

from pycrorm_async import Memory, Reading
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import Action, PickUpWithContextView, TaskTreeNode
from pycrorm_async.projections import rebuild as steps
from pycrorm_async.settings import Settings
from tests.memory.note_actions import NoteActionPerformable

__all__ = ["rebuild_until", "record_until_told", "read_until_told"]


_PATIENT = Settings(connect_timeout_s=120, flush_timeout_s=300)


def rebuild_until(url: str, last: int, workers: int, batch_events: int) -> None:
    """Dies before its statement of that number; with 0 it comes to its end, and says how many there were."""
    steps._BATCH_EVENTS = batch_events
    count = 0

    def counted(*_: object) -> None:
        nonlocal count
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)

    event.listen(Engine, "before_cursor_execute", counted)
    event.listen(Engine, "commit", counted)
    print("began", flush=True)
    asyncio.run(rebuild_memory(url, workers=workers))
    print(count, flush=True)


def _told() -> threading.Event:
    """Set when nobody holds the other end of the input any more."""
    told = threading.Event()

    def listen() -> None:
        os.read(0, 1)
        told.set()

    threading.Thread(target=listen, daemon=True).start()
    return told


def record_until_told(url: str, spool: Path) -> None:
    """Episodes of notes, each flushed; says how many there were and the longest wait for a flush, in s."""
    asyncio.run(_record(url, spool, _told()))


async def _record(url: str, spool: Path, told: threading.Event) -> None:
    longest_s, episodes = 0.0, 0
    async with Memory.open(url, spool=spool, settings=_PATIENT) as memory:
        print("records", flush=True)
        while not told.is_set():
            async with memory.episode(description="beside a rebuild"):
                for turn in range(50):
                    await NoteActionPerformable(str(turn)).perform()
            began = time.monotonic()
            await memory.flush()
            longest_s, episodes = max(longest_s, time.monotonic() - began), episodes + 1
    print("recorded", episodes, longest_s, flush=True)


def read_until_told(url: str) -> None:
    """Says what it counts, again and again: episodes, nodes, actions, pick-ups; and the longest wait for it, in s."""
    asyncio.run(_read(url, _told()))


async def _read(url: str, told: threading.Event) -> None:
    longest_s = 0.0
    async with Reading.open(url) as reading:
        while not told.is_set():
            began = time.monotonic()
            episodes = len(await reading.episodes())
            async with reading.session() as session:
                nodes = (await session.scalars(select(func.count()).select_from(TaskTreeNode))).one()
                actions = len((await session.scalars(select(Action.id))).all())
                picked = (await session.scalars(select(func.count()).select_from(PickUpWithContextView))).one()
            longest_s = max(longest_s, time.monotonic() - began)
            print("counted", episodes, nodes, actions, picked, flush=True)
    print("waited", longest_s, flush=True)
