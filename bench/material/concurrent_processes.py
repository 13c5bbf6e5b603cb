"""Processes that record or query without a pause while a rebuild runs.

At its end each process prints one line of JSON with the number and the longest duration of its operations, before and
during the rebuild. A reader fails if it ever sees fewer rows than before.
"""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from contextlib import ExitStack
from operator import le
from pathlib import Path

from sqlalchemy import func, select

from pycrorm_async import Memory, Reading
from pycrorm_async.orm import Action, PickUpAction, PickUpWithContextView, ProcessMetaData, TaskTreeNode
from pycrorm_async.settings import Settings
from tests.crash.forked_processes import ForkedProcess
from tests.memory.note_actions import NoteActionPerformable

__all__ = ["ConcurrentProcesses"]

_ACTIONS = 50
_SETTINGS = Settings(connect_timeout_s=120, flush_timeout_s=600)
_COUNTED = (ProcessMetaData, TaskTreeNode, Action, PickUpAction)


class ConcurrentProcesses:
    """Start the processes; leaving the exit stack kills those that still run."""

    def __init__(self, stack: ExitStack, url: str, spool: Path, *, recorders: int, readers: int) -> None:
        self._recorders = [ForkedProcess(_record_until_stopped, url, spool) for _ in range(recorders)]
        self._readers = [ForkedProcess(_query_until_stopped, url) for _ in range(readers)]
        self._all = [*self._recorders, *self._readers]
        for each in self._all:
            stack.callback(each.process.kill)
        for each in self._all:
            each.wait_for_first_output()

    def rebuild_begins(self) -> None:
        """Count operations from now on as concurrent with the rebuild."""
        for each in self._all:
            each.send_byte()

    def stop(self) -> dict[str, list[dict[str, object]]]:
        """Stop all processes and return their lines. Raise `AssertionError` if one of them failed."""
        for each in self._all:
            each.request_stop()
        codes = [each.wait() for each in self._all]
        assert codes == [0] * len(codes), [each.lines[-3:] for each in self._all]
        processes = {"recorders": self._recorders, "readers": self._readers}
        return {name: [json.loads(each.lines[-1]) for each in some] for name, some in processes.items()}


class _Commands:
    """The commands that the parent process has sent on stdin so far."""

    def __init__(self) -> None:
        self.phase = "calm"
        self.over = False
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while os.read(0, 1):
            self.phase = "rebuilding"
        self.over = True


class _Durations:
    """The number and the longest duration of one kind of operation, by phase."""

    def __init__(self) -> None:
        self.by_phase = {phase: {"times": 0, "longest_ms": 0.0} for phase in ("calm", "rebuilding")}

    def add(self, phase: str, began_s: float) -> None:
        operations = self.by_phase[phase]
        operations["times"] += 1
        operations["longest_ms"] = max(operations["longest_ms"], round((time.perf_counter() - began_s) * 1e3, 1))


def _record_until_stopped(url: str, spool: Path) -> None:
    asyncio.run(_record(url, spool, _Commands()))


async def _record(url: str, spool: Path, commands: _Commands) -> None:
    """Record episodes of actions that do nothing, so that a `perform` is both of its hooks; flush each episode."""
    performed, flushed, episodes = _Durations(), _Durations(), 0
    async with Memory.open(url, spool=spool, settings=_SETTINGS) as memory:
        print("records", flush=True)
        while not commands.over:
            async with memory.episode(description="beside a rebuild"):
                for turn in range(_ACTIONS):
                    action = NoteActionPerformable(str(turn))
                    phase, began_s = commands.phase, time.perf_counter()
                    await action.perform()
                    performed.add(phase, began_s)
            phase, began_s = commands.phase, time.perf_counter()
            await memory.flush()
            flushed.add(phase, began_s)
            episodes += 1
        faults = memory.status.faults.total
    assert faults == 0, faults
    print(json.dumps({"episodes": episodes, "both_hooks": performed.by_phase, "flush": flushed.by_phase}), flush=True)


def _query_until_stopped(url: str) -> None:
    asyncio.run(_query(url, _Commands()))


async def _query(url: str, commands: _Commands) -> None:
    """Count episodes, nodes, actions and pick-ups, and read one episode's pick-ups with their context."""
    queried, previous = _Durations(), (0,) * (len(_COUNTED) + 1)
    first = select(PickUpWithContextView).where(PickUpWithContextView.process_metadata_id == 1)
    async with Reading.open(url) as reading:
        while not commands.over:
            phase, began_s = commands.phase, time.perf_counter()
            async with reading.session() as session:
                totals = [(await session.scalars(select(func.count()).select_from(each))).one() for each in _COUNTED]
                counts = (*totals, len((await session.scalars(first)).all()))
            assert all(map(le, previous, counts)), f"{counts} after {previous}"
            queried.add(phase, began_s)
            if not any(previous):
                print("asks", flush=True)
            previous = counts
    print(json.dumps({"saw_at_last": previous, "question": queried.by_phase}), flush=True)
