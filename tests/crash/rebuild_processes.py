"""Processes that compete with a rebuild: a rebuild that is killed at one statement, a recorder, and a reader."""

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

__all__ = ["rebuild_until", "record_until_stopped", "read_until_stopped"]


_PATIENT = Settings(connect_timeout_s=120, flush_timeout_s=300)


def rebuild_until(url: str, last: int, workers: int, batch_events: int) -> None:
    """Rebuild, and die before statement number `last`; with 0 rebuild to the end and print the count of statements."""
    steps._BATCH_EVENTS = batch_events
    count = 0

    def die_at_last(*_: object) -> None:
        nonlocal count
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)

    event.listen(Engine, "before_cursor_execute", die_at_last)
    event.listen(Engine, "commit", die_at_last)
    print("began", flush=True)
    asyncio.run(rebuild_memory(url, workers=workers))
    print(count, flush=True)


def _input_closed() -> threading.Event:
    """Return an event that is set when the other end of the input is closed."""
    stop = threading.Event()

    def listen() -> None:
        os.read(0, 1)
        stop.set()

    threading.Thread(target=listen, daemon=True).start()
    return stop


def record_until_stopped(url: str, spool: Path, pause_s: float) -> None:
    """Record and flush episodes of notes, with a pause after each flush; print their number and the longest flush in
    seconds.
    """
    asyncio.run(_record(url, spool, pause_s, _input_closed()))


async def _record(url: str, spool: Path, pause_s: float, stop: threading.Event) -> None:
    longest_s, episodes = 0.0, 0
    async with Memory.open(url, spool=spool, settings=_PATIENT) as memory:
        print("records", flush=True)
        while not stop.is_set():
            async with memory.episode(description="beside a rebuild"):
                for turn in range(50):
                    await NoteActionPerformable(str(turn)).perform()
            began = time.monotonic()
            await memory.flush()
            longest_s, episodes = max(longest_s, time.monotonic() - began), episodes + 1
            await asyncio.sleep(pause_s)
    print("recorded", episodes, longest_s, flush=True)


def read_until_stopped(url: str, pause_s: float) -> None:
    """Print counts of episodes, nodes, actions and pick-ups, with pauses, until the input is closed, and then the
    longest query.
    """
    asyncio.run(_read(url, pause_s, _input_closed()))


async def _read(url: str, pause_s: float, stop: threading.Event) -> None:
    longest_s = 0.0
    async with Reading.open(url) as reading:
        while not stop.is_set():
            began = time.monotonic()
            episodes = len(await reading.episodes())
            async with reading.session() as session:
                nodes = (await session.scalars(select(func.count()).select_from(TaskTreeNode))).one()
                actions = len((await session.scalars(select(Action.id))).all())
                picked = (await session.scalars(select(func.count()).select_from(PickUpWithContextView))).one()
            longest_s = max(longest_s, time.monotonic() - began)
            print("counted", episodes, nodes, actions, picked, flush=True)
            await asyncio.sleep(pause_s)
    print("waited", longest_s, flush=True)
