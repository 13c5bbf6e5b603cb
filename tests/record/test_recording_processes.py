"""Threads and processes that record together: limits, forks, kills, and contradicting declarations."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pycrorm_async.events.codec import declaration_of
from pycrorm_async.events.types import NodeStarted
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.projections import columns as union
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import environment, pycrorm, run_script
from tests.databases import ask
from tests.projections.event_script import Script, declarations, declared, field, name_of
from tests.projections.sql_queries import stored_and_folded
from tests.record.recordings import events, nodes, opened, url_of
from tests.table_comparison import differences, tables_of
from tests.writer.running_writers import Daemon

# === recording processes ======================================================================================
#
# Threads and processes that record: they reach limits together, outlive the episode, fork, wait, and are killed.


def test_a_thread_that_outlives_the_episode_is_counted_and_disturbs_nothing(tmp_path: Path) -> None:
    with opened(tmp_path) as memory:
        kind = memory.recording.type("action", "Step")
        ended = threading.Event()
        with memory.recording.episode(description="d") as episode:
            episode.start("in time", kind)

            def late() -> None:
                ended.wait()
                episode.end("in time")
                episode.start("late", kind)
                episode.observe("late", 1.0)

            thread = threading.Thread(target=late)
            thread.start()
            episode.end("in time")
        ended.set()
        thread.join()
        assert memory.status.faults.total == 3
    assert len(nodes(tmp_path)) == 1
    assert events(tmp_path, "Observed") == []


@pytest.mark.slow
def test_a_forked_child_records_nothing_and_does_not_hang(tmp_path: Path) -> None:
    script = (
        "import os, sys, threading\n"
        "from pycrorm_async import Memory\n"
        "with Memory.sync(sys.argv[1]) as memory, memory.recording.episode(description='d') as episode:\n"
        "    kind = memory.recording.type('action', 'Step')\n"
        "    episode.start('a', kind)\n"
        "    recording = memory.recording\n"
        "    with episode._writer._calls._lock, recording._lock:\n"
        "        child = os.fork()\n"
        "        if child == 0:\n"
        "            def work():\n"
        "                episode.start('child', recording.type('action', 'Other'))\n"
        "                episode.node_reference('a')\n"
        "                episode.tag('late')\n"
        "            late = threading.Thread(target=work, daemon=True)\n"
        "            late.start()\n"
        "            late.join(10)\n"
        "            memory.__exit__(None, None, None)\n"
        "            os._exit(8 if late.is_alive() else 7)\n"
        "    _, status = os.waitpid(child, 0)\n"
        "    assert os.waitstatus_to_exitcode(status) == 7\n"
        "    episode.end('a')\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, url_of(tmp_path)],
        env=environment(), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0
    assert done.stderr.startswith("a call of `start` leaves no record, because this process was forked"), done.stderr
    assert done.stderr.count("\n") == 1
    assert nodes(tmp_path) == [("Step", None, "SUCCEEDED", None)]


# === contradicting processes ==================================================================================
#
# Processes that declare one type with other fields, and record at the same time through a daemon.

_RECORD = """
import sys
from pycrorm_async import Memory

url, spool, kind, text = sys.argv[1:]
value = {"integer": int, "text": str, "boolean": bool}[kind](text)
with Memory.sync(url, spool=spool, writer="daemon") as memory:
    with memory.recording.episode(description=kind) as episode:
        for number in range(3):
            wave = memory.recording.type("action", "Wave", {"times": kind, "arm": "text"})
            episode.start(number, wave, {"times": value, "arm": "LEFT"})
            episode.end(number)
    memory.flush()
    assert memory.status.missing.total == 0
"""


@pytest.mark.soak_on("postgresql")
@pytest.mark.slow
@pytest.mark.soak_on("sqlite")
async def test_each_type_of_a_field_has_a_column_and_no_episode_is_parked(database_url: str, tmp_path: Path) -> None:
    spool = tmp_path / "spool"
    daemon = Daemon(database_url, spool)
    values = {"integer": "3", "text": "three", "boolean": "x"}
    runs = (asyncio.to_thread(run_script, _RECORD, database_url, spool, *each) for each in values.items())
    assert [(each.returncode, each.stderr) for each in await asyncio.gather(*runs)] == [(0, "")] * 3
    await daemon.stop()
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    try:
        assert await log.stopped() == []
        first, *later = [declaration_of(each).fields[0].type for each in await log.declarations()]
        result = await verify(log)
        assert (result.damages, result.differences, result.unmade) == ([], [], {})
    finally:
        await log.close()
    columns = ", ".join(("times", *(f"times_{each}" for each in later), "arm"))
    rows = ask(database_url, f"SELECT {columns} FROM wave ORDER BY id")
    recorded = {"integer": 3, "text": "three", "boolean": True}
    for place, kind in enumerate((first, *later)):
        assert [row[place] for row in rows if row[place] is not None] == [recorded[kind]] * 3
    assert [row[3] for row in rows] == ["LEFT"] * 9
    lines = [
        f"warning: Wave.times is declared as {first} and as {each}; the {each} is kept as times_{each}"
        for each in later
    ]
    status = await asyncio.to_thread(pycrorm, "status", "--url", database_url, "--spool", spool, cwd=tmp_path)
    assert (status.returncode, [each for each in status.stderr.splitlines() if "Wave" in each]) == (0, lines)
    before = tables_of(database_url)
    await rebuild_memory(database_url)
    assert differences(before, tables_of(database_url)) == []


@pytest.mark.slow
async def test_episodes_that_an_earlier_version_parked_are_folded_when_the_tables_are_opened_or_rebuilt(
    database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_layout: object, _declared: object, reason: Exception) -> None:
        raise reason

    types = declared("Wave", "wave", field("times", "integer", 2)), declared("Wave", "wave", field("times", "text", 2))
    scripts = Script(1), Script(2)
    scripts[0].put(NodeStarted("action", None, name_of(types[0]), {"times": 3}))
    scripts[1].put(NodeStarted("action", None, name_of(types[1]), {"times": "three"}))
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    try:
        with monkeypatch.context() as earlier:
            earlier.setattr(union, "_fit", refuse)
            await stored_and_folded(log, [*declarations(*types), *scripts[0].records, *scripts[1].records])
            assert [each.number for each in await log.stopped()] == [2]
        await rebuild_memory(database_url)
        assert await log.stopped() == []
        assert ask(database_url, "SELECT times, times_text FROM wave ORDER BY id") == [(3, None), (None, "three")]
    finally:
        await log.close()
