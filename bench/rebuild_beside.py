"""Who goes on while tables are made anew: processes that record, and processes that ask all the time.

Each says at its end, in one line of JSON, how long it had to wait, in the calm before and since it was told that the
rebuild begins. One that asks ends with an error if it ever sees less than it saw before.
"""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from contextlib import ExitStack
from pathlib import Path

from sqlalchemy import func, select

from pycrorm_async import Memory, Reading
from pycrorm_async.orm import Action, PickUpAction, PickUpWithContextView, ProcessMetaData, TaskTreeNode
from pycrorm_async.settings import Settings
from tests.crash.forked_processes import Forked
from tests.memory.note_actions import NoteActionPerformable

__all__ = ["Company"]

_ACTIONS = 50
_PATIENT = Settings(connect_timeout_s=120, flush_timeout_s=600)
_COUNTED = (ProcessMetaData, TaskTreeNode, Action, PickUpAction)


class Company:
    """Those processes, from `begin` to `end`; left, none of them is there any more."""

    def __init__(self, stack: ExitStack, url: str, spool: Path, *, recorders: int, readers: int) -> None:
        self._recorders = [Forked(_record_until_told, url, spool) for _ in range(recorders)]
        self._readers = [Forked(_ask_until_told, url) for _ in range(readers)]
        self._all = [*self._recorders, *self._readers]
        for each in self._all:
            stack.callback(each.process.kill)
        for each in self._all:
            each.wait_for_its_first_words()

    def rebuilding(self) -> None:
        """From now on what they wait is counted as waited beside a rebuild."""
        for each in self._all:
            each.tell()

    def end(self) -> dict[str, list[dict[str, object]]]:
        """What each of them says. Raises if one of them failed."""
        for each in self._all:
            each.tell_to_stop()
        codes = [each.wait() for each in self._all]
        assert codes == [0] * len(codes), [each.said[-3:] for each in self._all]
        said = {"recorders": self._recorders, "readers": self._readers}
        return {name: [json.loads(each.said[-1]) for each in some] for name, some in said.items()}


class _Told:
    """What the one who began this process has told it so far."""

    def __init__(self) -> None:
        self.phase = "calm"
        self.over = False
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while os.read(0, 1):
            self.phase = "rebuilding"
        self.over = True


class _Waits:
    """How often something was done, and how long it took at most."""

    def __init__(self) -> None:
        self.found = {phase: {"times": 0, "longest_ms": 0.0} for phase in ("calm", "rebuilding")}

    def add(self, phase: str, began_s: float) -> None:
        found = self.found[phase]
        found["times"] += 1
        found["longest_ms"] = max(found["longest_ms"], round((time.perf_counter() - began_s) * 1e3, 1))


def _record_until_told(url: str, spool: Path) -> None:
    asyncio.run(_record(url, spool, _Told()))


async def _record(url: str, spool: Path, told: _Told) -> None:
    """Episodes of actions that do nothing, so that performing one is both of its hooks; each episode is flushed."""
    performed, flushed, episodes = _Waits(), _Waits(), 0
    async with Memory.open(url, spool=spool, settings=_PATIENT) as memory:
        print("records", flush=True)
        while not told.over:
            async with memory.episode(description="beside a rebuild"):
                for turn in range(_ACTIONS):
                    action = NoteActionPerformable(str(turn))
                    phase, began_s = told.phase, time.perf_counter()
                    await action.perform()
                    performed.add(phase, began_s)
            phase, began_s = told.phase, time.perf_counter()
            await memory.flush()
            flushed.add(phase, began_s)
            episodes += 1
        faults = memory.status.faults.total
    assert faults == 0, faults
    print(json.dumps({"episodes": episodes, "both_hooks": performed.found, "flush": flushed.found}), flush=True)


def _ask_until_told(url: str) -> None:
    asyncio.run(_ask(url, _Told()))


async def _ask(url: str, told: _Told) -> None:
    """Counts episodes, nodes, actions and pick-ups, and reads those of one episode with what was around them."""
    asked, seen = _Waits(), (0,) * (len(_COUNTED) + 1)
    first = select(PickUpWithContextView).where(PickUpWithContextView.process_metadata_id == 1)
    async with Reading.open(url) as reading:
        while not told.over:
            phase, began_s = told.phase, time.perf_counter()
            async with reading.session() as session:
                counts = [(await session.scalars(select(func.count()).select_from(each))).one() for each in _COUNTED]
                now = (*counts, len((await session.scalars(first)).all()))
            assert all(before <= after for before, after in zip(seen, now, strict=True)), f"{now} after {seen}"
            asked.add(phase, began_s)
            if not any(seen):
                print("asks", flush=True)
            seen = now
    print(json.dumps({"saw_at_last": seen, "question": asked.found}), flush=True)
