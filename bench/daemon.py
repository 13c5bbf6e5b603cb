"""Measure the rate at which the daemon drains the spools of one and of four running recorders.

    python -m bench.daemon               200,000 events on SQLite; --postgresql on a new server
    python -m bench.daemon --quick       2,000 events

The recorders record everything before the daemon starts, so the daemon runs at its full rate. The script prints one
JSON line: events a second until the last one is stored, and until the last one is visible in the tables.
"""

import asyncio
import json
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, ExitStack
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from tests.databases import server_in

EVENTS = 2_000 if "--quick" in sys.argv else 200_000


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    weight: float

    async def perform(self) -> None: ...


async def record(memory: Memory, events: int) -> None:
    """Record episodes of a thousand events each."""
    while memory.status.written < events:
        async with memory.episode(description="bench"):
            for index in range(499):
                await NoteActionPerformable(f"note {index}", index / 7).perform()


def start_daemon(url: str, spool: Path) -> subprocess.Popen[str]:
    """Start the daemon, and return it when it is ready to drain."""
    command = [sys.executable, "-m", "pycrorm_async", "writer", "--url", url, "--spool", str(spool)]
    daemon = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert daemon.stderr is not None
    assert daemon.stderr.readline().startswith("draining")
    return daemon


def stop(daemon: subprocess.Popen[str]) -> None:
    daemon.terminate()
    daemon.communicate()


async def drain(url: str, spool: Path, recorders: int) -> dict[str, int]:
    async with AsyncExitStack() as stack:
        memories = [
            await stack.enter_async_context(Memory.open(url, spool=spool, writer="daemon")) for _ in range(recorders)
        ]
        for memory in memories:
            await record(memory, EVENTS // recorders)
            await memory.synced()
        total = sum(memory.status.written for memory in memories)
        daemon = start_daemon(url, spool)
        began = time.perf_counter()
        stored_s = visible_s = 0.0
        while not visible_s:
            await asyncio.sleep(0.01)
            now_s = time.perf_counter() - began
            if not stored_s and sum(memory.status.stored for memory in memories) == total:
                stored_s = now_s
            if sum(memory.status.folded or 0 for memory in memories) == total:
                visible_s = now_s
    stop(daemon)
    return {"stored_per_s": round(total / stored_s), "shown_per_s": round(total / visible_s)}


async def measure(stack: ExitStack, *, postgresql: bool) -> dict[str, object]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
    server = stack.enter_context(server_in(folder / "pg")) if postgresql else None
    result: dict[str, object] = {"bench": "daemon", "database": "postgresql" if postgresql else "sqlite"}
    for recorders in (1, 4):
        url = server.new_database() if server else f"sqlite:///{folder}/{recorders}.db"
        result[f"from_{recorders}"] = await drain(url, folder / f"{recorders}.spool", recorders)
    return result | {"events": EVENTS}


if __name__ == "__main__":
    with ExitStack() as stack:
        print(json.dumps(asyncio.run(measure(stack, postgresql="--postgresql" in sys.argv))))
