"""Run a plan in a process that the tests kill, and compare the rows of its steps with what it printed before.

Every line is written at once, so that the pipe keeps it when the process dies: `did PLACE STEP` when `perform` of a
step has returned, `synced` after a sync of all of them, `ended PLACE` when the episode has ended, and `faults COUNT`
before the memory is closed.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import select
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from pycrorm_async import Memory, Settings
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.settings import Writer
from tests.databases import ask

SETTINGS = Settings(
    sync_interval_ms=5,
    segment_bytes=2**16,
    record_bytes_max=2**14,
    spool_bytes_max=2**24,
    spool_reserve_bytes=2**18,
    flush_timeout_s=60,
)
_PATIENT = replace(SETTINGS, connect_timeout_s=3600, flush_timeout_s=3600, keep_stored_s=0.0)
"""Timeouts that no busy machine reaches: opening a database may take a minute there. Nothing is kept that is stored,
because kept segments would refill what a drain has lost."""


@dataclass
class StepActionPerformable(ActionAbstract):
    place: str
    step: int

    async def perform(self) -> None:
        """Succeed without doing anything."""


def report(*words: object) -> None:
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def stop_requested() -> bool:
    return bool(select.select([0], [], [], 0)[0])


def walk(url: str, spool: str, writer: Writer, name: str, seed: int, lanes: int = 1) -> None:
    """Perform steps until the input is closed; each lane is a plan with episodes of its own, beside the others."""
    asyncio.run(_walk(url, Path(spool), writer, name, seed, lanes))


async def _walk(url: str, spool: Path, writer: Writer, name: str, seed: int, lanes: int) -> None:
    async with Memory.open(url, spool=spool, writer=writer, settings=_PATIENT) as memory:
        plans = [_walk_lane(memory, f"{name}.{lane}", random.Random(f"{seed} {lane}")) for lane in range(lanes)]
        await asyncio.gather(*plans)
        report("faults", memory.status.faults.total)


async def _walk_lane(memory: Memory, name: str, rng: random.Random) -> None:
    for number in itertools.count():
        place = f"{name}.{number}"
        async with memory.episode(description=place):
            for step in range(1, rng.randrange(2, 60)):
                await StepActionPerformable(place, step).perform()
                report("did", place, step)
                chance = rng.random()
                if chance < 0.5:
                    await asyncio.sleep(rng.random() * 0.005)
                elif chance < 0.55:
                    await memory.synced()
                    report("synced")
        report("ended", place)
        if stop_requested():
            return


# === comparison ===============================================================================================

Event = tuple[str, int, str]
"""An episode, a sequence in it, and the content of the event."""


def verify_kept(acknowledged: Iterable[Event], existing: Iterable[Event], *, possible: Iterable[Event] = ()) -> None:
    """Verify that each acknowledged event exists once and in order, and no other one but those that are `possible`.

    Possible are events that a process tried to record without an acknowledgement before it died.
    """
    expected, events = set(acknowledged), list(existing)
    found = set(events)
    assert expected - found == set(), "lost"
    assert found - expected - set(possible) == set(), "changed, or never recorded"
    last: defaultdict[str, int] = defaultdict(int)
    for episode, sequence, _ in events:
        assert sequence == last[episode] + 1, f"doubled or out of order: {episode} {sequence}"
        last[episode] = sequence


class RecordedSteps:
    """The steps that plans printed: `certain` ones must be in the tables, `possible` ones may be.

    `ended` holds the places whose episodes ended before the plan was killed.
    """

    def __init__(self) -> None:
        self.certain: list[Event] = []
        self.possible: list[Event] = []
        self.ended: set[str] = set()

    def add(self, lines: list[list[str]], *, when_synced: bool = False) -> None:
        """Add the lines of one plan. With `when_synced` only the steps before the last `synced` are certain."""
        sync = max([-1, *(index for index, line in enumerate(lines) if line[0] == "synced")])
        end = sync if when_synced else len(lines)
        last: dict[str, tuple[str, int]] = {}
        for index, line in enumerate(lines):
            if line[0] == "ended" and index < end:
                self.ended.add(line[1])
            if line[0] == "did":
                place, step = line[1], int(line[2])
                last[place.rpartition(".")[0]] = place, step
                if index < end:
                    self.certain.append((place, step, "SUCCEEDED"))
                else:
                    self.possible += [(place, step, status) for status in ("SUCCEEDED", "LOST")]
        for lane, (place, step) in last.items():  # died in the next step of the episode or the first of the next one
            following = [(place, step + 1), (f"{lane}.{int(place.rpartition('.')[2]) + 1}", 1)]
            self.possible += [(*each, status) for each in following for status in ("SUCCEEDED", "LOST")]

    def verify(self, url: str) -> None:
        """Compare with the rows of a database into which no process writes any more."""
        rows = ask(
            url,
            "SELECT place, step, status FROM step_action JOIN task_tree_node ON step_action.id = task_tree_node.id"
            " ORDER BY step_action.id",
        )
        verify_kept(self.certain, rows, possible=self.possible)
        incomplete = ask(
            url,
            "SELECT * FROM episode WHERE refused IS NOT NULL OR parked IS NOT NULL OR head <> folded OR head <>"
            " (SELECT count(*) FROM event WHERE event.episode = episode.number)",
        )
        assert incomplete == []
        episodes = ask(url, "SELECT description, status FROM process_metadata")
        statuses = dict(episodes)
        assert len(statuses) == len(episodes)
        assert {place: statuses[place] for place in self.ended} == dict.fromkeys(self.ended, "SUCCEEDED")
