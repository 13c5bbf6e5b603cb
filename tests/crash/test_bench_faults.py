"""Run the bench of faults: it makes every fault, and none of them loses, doubles, reorders or changes an event.

The bench detects such errors: with a deliberately broken product its counts rise.
"""

from __future__ import annotations

import json
import random
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from bench.breaking import databases, files
from bench.breaking.outcome import Outcome, Step
from pycrorm_async.events.codec import LOST, Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue import DeadSource, RecorderQueue
from pycrorm_async.store.log import EventLog

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
FAULTS = [
    "kill -9 of a recorder",
    "kill -9 of an appender, SQLite",
    "kill -9 of an appender, PostgreSQL",
    "kill -9 of a plan and its writer",
    "kill -9 of the daemon, SQLite",
    "kill -9 of the daemon, PostgreSQL",
    "killed fold workers, SQLite",
    "killed fold workers, PostgreSQL",
    "torn write at every byte",
    "flipped bit",
    "power cut, simulated disk",
    "power cut, real disk",
    "failed sync",
    "disk full, spool",
    "disk full, ext4",
    "disk full, XFS",
    "disk full, btrfs",
    "crafted frames",
    "deleted database",
    "disk full, database",
    "clock jumps",
    "fork",
    "exit with a full queue",
    "second opener",
    "lost COMMIT reply",
    "cut connection",
    "cancelled append",
    "locked database",
    "stopped server",
    "killed server",
    "foreign declarations, SQLite",
    "foreign declarations, PostgreSQL",
    "failover to an asynchronous replica",
    "failover to a synchronous replica",
    "failover by Patroni",
    "restored PostgreSQL",
    "restored SQLite file",
    "all of it at random, simulated",
]
SLOW = [
    each
    for each in FAULTS
    if each.startswith(("killed fold", "stopped fold", "deleted database", "foreign", "failover", "restored"))
]
"""A round of these faults starts servers or many processes."""
CHEAP = [
    "torn write at every byte",
    "flipped bit",
    "failed sync",
    "clock jumps",
    "fork",
    "second opener",
    "crafted frames",
    "lost COMMIT reply",
    "cancelled append",
]
"""Rounds of these faults need no process and no server of their own; together they take a few seconds."""
COST = ("lost", "duplicated", "misordered", "changed", "broke")


def faults(*arguments: str | Path) -> tuple[int, list[dict[str, Any]], str]:
    """Return the exit code, the outcome of each fault, and the error output of the bench."""
    command = [sys.executable, "-m", "bench.faults", "--quick", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()], done.stderr


def test_the_list_of_faults_is_complete() -> None:
    assert re.findall(r'^ +Fault\("(.+?)"', (ROOT / "bench/faults.py").read_text(), re.MULTILINE) == FAULTS


@pytest.mark.parametrize(
    "names",
    [
        pytest.param([each for each in FAULTS if each in CHEAP], id="cheap rows", marks=pytest.mark.soak),
        pytest.param([each for each in FAULTS if each not in SLOW + CHEAP], id="quick rows", marks=pytest.mark.soak),
        pytest.param(SLOW, id="slow rows", marks=pytest.mark.soak),
    ],
)
def test_the_quick_run_makes_every_fault_and_loses_no_event(names: list[str]) -> None:
    code, outcomes, lines = faults(*(each for name in names for each in ("--only", name)))
    bad = [each for each in outcomes if any(each[name] for name in COST)]
    assert (code, bad) == (0, []), lines
    assert [each["fault"] for each in outcomes] == names
    performed = [each for each in outcomes if not each["note"].startswith("skipped: ")]
    assert all(each["rounds"] >= 2 and each["events"] >= 20 for each in performed)
    assert all(each["told"] > 0 for each in outcomes if each["fault"] == "flipped bit")


@pytest.mark.soak
def test_a_run_continues_from_its_report_and_a_recorded_loss_is_a_problem(tmp_path: Path) -> None:
    arguments = ("--only", "clock", "--seed", "7", "--report", tmp_path / "faults.md")
    code, [first], _ = faults(*arguments)
    lines = (tmp_path / "faults.md.jsonl").read_text()
    assert (code, first["rounds"], len(lines.splitlines())) == (0, 20, 1)

    (tmp_path / "faults.md.jsonl").write_text(lines + '{"half a line')
    assert faults(*arguments)[:2] == (0, [first])
    assert "| clock jumps | 20 |" in (tmp_path / "faults.md").read_text()

    (tmp_path / "faults.md.jsonl").write_text(lines.replace('"lost": 0', '"lost": 3'))
    code, [mounted_fault], _ = faults(*arguments)
    assert (code, mounted_fault["lost"]) == (1, 3)
    code, [other], _ = faults(*arguments, "--seed", "8")
    assert (code, other["lost"], other["seed"]) == (0, 0, 8)


# --- a product that is broken on purpose ------------------------------------------------------------------------------

Given = Callable[[list[Record]], list[Record]]


def _is_kept(record: Record) -> bool:
    return record.payload != LOST


def forgets_the_last(records: list[Record]) -> list[Record]:
    last = max((each.position for each in records if _is_kept(each)), default=0)
    return [each for each in records if each.position != last]


def repeats_the_last(records: list[Record]) -> list[Record]:
    return [*records, *[each for each in records if _is_kept(each)][-1:]]


def swaps_two(records: list[Record]) -> list[Record]:
    return [*reversed(records[:2]), *records[2:]]


def changes_one(records: list[Record]) -> list[Record]:
    return [each._replace(payload=b"!") if each.sequence == 2 else each for each in records]


_BREAKS = [
    (forgets_the_last, "lost"),
    (repeats_the_last, "duplicated"),
    (swaps_two, "misordered"),
    (changes_one, "corrupted"),
]
_SEEN = [(fault, *each) for fault in (files.torn_writes, files.failed_syncs, files.clock_jumps) for each in _BREAKS]


@pytest.mark.parametrize(("fault", "breaks", "count"), _SEEN)
def test_the_bench_detects_a_recovery_that_loses_doubles_swaps_or_changes_records(
    fault: Callable[[int, random.Random, Path, Step], Outcome],
    breaks: Given,
    count: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    get_batch = DeadSource.get_batch

    async def broken(queue: DeadSource, **limits: Any) -> list[Record]:
        return breaks(await get_batch(queue, **limits))

    monkeypatch.setattr(DeadSource, "get_batch", broken)
    outcome = fault(3, random.Random(1), tmp_path, lambda: None)
    assert getattr(outcome, count) > 0
    assert not outcome.clean
    assert outcome.rounds_failed


def test_the_bench_detects_a_queue_that_reports_records_as_synced_without_a_sync(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def careless(queue: RecorderQueue, **_: object) -> None:
        span = queue._appender.begin_sync()
        queue._safe_number, queue._synced = span.segments[-1].number, span.position
        queue._notifier.notify_all()

    monkeypatch.setattr(RecorderQueue, "_sync", careless)
    assert files.power_cuts(40, random.Random(1), tmp_path, lambda: None).lost > 0


def test_the_bench_detects_a_log_that_reports_events_as_stored_without_storing_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = EventLog.append

    async def forgetful(log: EventLog, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        return await append(log, [each for each in records if each.position != 800])

    monkeypatch.setattr(EventLog, "append", forgetful)
    outcome = databases.locked_files(2, random.Random(1), tmp_path, lambda: None)
    assert (outcome.events, outcome.lost) == (800, 1)
