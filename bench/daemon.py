"""How fast the daemon empties spools: from one and from four living recorders, appended, and shown in the tables.

The recorders have recorded everything before the daemon starts, so it is as fast as it can be. Prints one JSON line:
events a second until the last one is stored, and until the last one shows. Run it with `python -m bench.daemon`, with
`--postgresql` on a server of its own; `--quick` for a hundredth of the events.
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
    """Episodes of a thousand events."""
    while memory.status.written < events:
        async with memory.episode(description="bench"):
            for index in range(499):
                await NoteActionPerformable(f"note {index}", index / 7).perform()


def start_daemon(url: str, spool: Path) -> subprocess.Popen[str]:
    """The daemon, when it is ready to drain."""
    command = [sys.executable, "-m", "pycrorm_async", "writer", "--url", url, "--spool", str(spool)]
    daemon = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert daemon.stderr is not None
    assert daemon.stderr.readline().startswith("draining")
    return daemon


def stop(daemon: subprocess.Popen[str]) -> None:
    daemon.terminate()
    daemon.communicate()


async def drained(url: str, spool: Path, recorders: int) -> dict[str, int]:
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
        stored_s = shown_s = 0.0
        while not shown_s:
            await asyncio.sleep(0.01)
            now_s = time.perf_counter() - began
            if not stored_s and sum(memory.status.stored for memory in memories) == total:
                stored_s = now_s
            if sum(memory.status.folded or 0 for memory in memories) == total:
                shown_s = now_s
    stop(daemon)
    return {"stored_per_s": round(total / stored_s), "shown_per_s": round(total / shown_s)}


async def measured(stack: ExitStack, *, postgresql: bool) -> dict[str, object]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
    server = stack.enter_context(server_in(folder / "pg")) if postgresql else None
    result: dict[str, object] = {"bench": "daemon", "database": "postgresql" if postgresql else "sqlite"}
    for recorders in (1, 4):
        url = server.new_database() if server else f"sqlite:///{folder}/{recorders}.db"
        result[f"from_{recorders}"] = await drained(url, folder / f"{recorders}.spool", recorders)
    return result | {"events": EVENTS}


if __name__ == "__main__":
    with ExitStack() as stack:
        print(json.dumps(asyncio.run(measured(stack, postgresql="--postgresql" in sys.argv))))
