"""What a perform costs with a memory, while its database is up, slow or gone: the plan is not to feel it.

    python -m bench.hook            20 turns of a second for each of seven plans, about five minutes
    python -m bench.hook --quick    two short ones

An action with object, arm and grasp that does nothing is performed in a Bullet world with a robot, whose state is read
and recorded; between two of them the plan computes, so that 2,000 events a second are recorded. One process holds all
plans, each in a task and a world of its own: one without a memory; three whose memory writes by a thread, to a
PostgreSQL that is up, that answers 20 ms late each time it is spoken to, and that went away; three for the daemon. They
take turns in random order, and a turn is over when its writer has nothing left to do. A percentile is the median over
the turns of that of a turn, and what a perform costs more is compared within a round, so a busy moment of the machine
counts little. Of performs in which the kernel gave the processor to somebody else only their number is told, and the
longest of all. Prints one JSON line, in µs; half of what a perform costs more is one hook. The table is on stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import platform
import random
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, nullcontext, suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from rich.console import Console
from rich.table import Table

from bench.breaking.speaking import Speaker
from bench.daemon import start_daemon, stop
from bench.material.turns import InTurns, NothingActionPerformable, nothing_action
from pycrorm_async import Memory, Settings
from pycrorm_async.errors import FlushTimeout
from pycrorm_async.settings import Writer
from pycrorm_async.world import BulletWorld
from tests.crash.step_robot import say
from tests.databases import Server, server_in

_LATE_S = 0.02
_PERFORMS_PER_S = 1_000
_WRITERS: tuple[Writer, ...] = ("thread", "daemon")
_PERCENTILES = {"median": 0.5, "p99": 0.99, "p99.9": 0.999}


class Kind(NamedTuple):
    """A memory to be measured: who writes, the state of its database, and where that is."""

    writer: Writer
    state: str
    url: str
    spool: Path

    @property
    def is_down(self) -> bool:
        return self.state == "down"


class Turn(NamedTuple):
    """What each perform took, ns: those that nobody interrupted, and the others."""

    whole: list[int]
    interrupted: list[int]


class Plan(InTurns):
    """With a memory or none; a turn is over when all of it is stored, if the database is there."""

    def __init__(self, kind: Kind | None) -> None:
        super().__init__()
        self.name = "none" if kind is None else f"{kind.writer}, {kind.state}"
        self.turns: list[Turn] = []
        self._kind = kind

    async def begin(self, stack: AsyncExitStack) -> Callable[[int], Awaitable[None]]:
        memory = None if self._kind is None else await stack.enter_async_context(_remembering(self._kind))
        stack.enter_context(BulletWorld())
        action = nothing_action()

        async def take(performs: int) -> None:
            self.turns.append(await _turn(action, performs))
            if memory is not None and self._kind is not None:
                await (memory.synced() if self._kind.is_down else memory.flush())

        return take


@asynccontextmanager
async def _remembering(kind: Kind) -> AsyncIterator[Memory]:
    settings = Settings(flush_timeout_s=1.0 if kind.is_down else 300.0)
    memory = Memory.open(kind.url, spool=kind.spool, writer=kind.writer, settings=settings)
    with suppress(FlushTimeout) if kind.is_down else nullcontext():
        async with memory, memory.episode(description="bench"):
            yield memory


async def _turn(action: NothingActionPerformable, performs: int) -> Turn:
    turn = Turn([], [])
    start = time.perf_counter_ns()
    for number in range(performs):
        _compute(until_ns=start + number * 1_000_000_000 // _PERFORMS_PER_S)
        before = _interruptions()
        began = time.perf_counter_ns()
        await action.perform()
        took = time.perf_counter_ns() - began
        (turn.whole if _interruptions() == before else turn.interrupted).append(took)
    return turn


def _interruptions() -> int:
    """How often the kernel took the processor from this thread. Waiting, as for the interpreter, is none."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw


def _compute(until_ns: int) -> None:
    number = 1
    while time.perf_counter_ns() < until_ns:
        number = number * 3 % 1_000_003


# --- databases that are slow, or gone -------------------------------------------------------------------------------


class _Way:
    """A process between us and the server: all that goes through it is late, until it is killed."""

    def __init__(self, server: Server, late_s: float) -> None:
        self._server = server
        self._process = Speaker(_pass_on, str(server.folder / ".s.PGSQL.5432"), late_s)
        self._process.wait_for("\n")
        [[_, self._port]] = self._process.said

    def new_database(self) -> str:
        return f"postgresql://postgres@127.0.0.1:{self._port}{urlsplit(self._server.new_database()).path}"

    def end(self) -> None:
        self._process.stop()


def _pass_on(server_socket: str, late_s: float) -> None:
    async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while chunk := await reader.read(1 << 16):
                await asyncio.sleep(late_s)
                writer.write(chunk)
                await writer.drain()
        writer.close()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_unix_connection(server_socket)
        await asyncio.gather(carry(reader, back), carry(there, writer))

    async def pass_on() -> None:
        listening = await asyncio.start_server(accept, "127.0.0.1", 0)
        say("port", listening.sockets[0].getsockname()[1])
        await listening.serve_forever()

    asyncio.run(pass_on())


# --- measuring ------------------------------------------------------------------------------------------------------


async def measured(stack: ExitStack, *, turns: int, performs: int, late_s: float) -> dict[str, object]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="h")))
    server = stack.enter_context(server_in(folder / "pg"))
    slow, gone = _Way(server, late_s), _Way(server, 0.0)
    stack.callback(slow.end)
    databases = {"up": server.new_database, "slow": slow.new_database, "down": gone.new_database}
    kinds = [
        Kind(writer, state, new_database(), folder / f"{writer}.{state}")
        for writer in _WRITERS
        for state, new_database in databases.items()
    ]
    for kind in kinds:
        if kind.writer == "daemon":
            stack.callback(stop, start_daemon(kind.url, kind.spool))
    plans = [Plan(None), *map(Plan, kinds)]
    async with asyncio.TaskGroup() as tasks:
        for plan in plans:
            tasks.create_task(plan.run(), name=plan.name)
        for plan in plans:  # whatever happens only once
            await plan.take_turn(10)
            plan.turns.clear()
        gone.end()
        order = random.Random(1)
        for _ in range(turns):
            for plan in order.sample(plans, len(plans)):
                await plan.take_turn(performs)
        for plan in plans:
            await plan.take_turn(0)
    return {
        "bench": "hook",
        "turns": turns,
        "performs_a_turn": performs,
        "python": platform.python_version(),
        **{plan.name: _figures(plan, plans[0]) for plan in plans},
    }


def _figures(plan: Plan, without: Plan) -> dict[str, object]:
    """µs."""
    spreads, plain = [_spread(turn) for turn in plan.turns], [_spread(turn) for turn in without.turns]
    typical = {name: statistics.median(each[name] for each in spreads) for name in _PERCENTILES}
    longest = max(max(turn.whole + turn.interrupted) for turn in plan.turns) / 1e3
    figures: dict[str, object] = {
        "perform_us": _rounded(typical | {"max": longest}),
        "interrupted": sum(len(turn.interrupted) for turn in plan.turns),
    }
    if plan is not without:
        more = {
            name: statistics.median(with_it[name] - none[name] for with_it, none in zip(spreads, plain, strict=True))
            for name in _PERCENTILES
        }
        figures |= {"more_us": _rounded(more), "hook_us": round(more["median"] / 2, 1)}
    return figures


def _spread(turn: Turn) -> dict[str, float]:
    ordered = sorted(turn.whole)
    return {name: ordered[round(share * (len(ordered) - 1))] / 1e3 for name, share in _PERCENTILES.items()}


def _rounded(figures: dict[str, float]) -> dict[str, float]:
    return {name: round(each, 1) for name, each in figures.items()}


def _table(result: dict[str, object]) -> Table:
    more = [f"more, {name}" for name in _PERCENTILES]
    columns = ("memory", *_PERCENTILES, "max", "interrupted", *more, "one hook")
    table = Table(title="A whole perform, µs, by writer and state of the database", title_justify="left")
    for name in columns:
        table.add_column(name, justify="left" if name == "memory" else "right")
    for name, found in result.items():
        if isinstance(found, dict):
            figures = [*found["perform_us"].values(), found["interrupted"], *found.get("more_us", {}).values()]
            table.add_row(name, *(f"{each:,}" for each in figures), str(found.get("hook_us", "")))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="two short turns each")
    quick = parser.parse_args().quick
    logging.disable(logging.WARNING)  # that the database is away is known here
    with ExitStack() as stack:
        turns, performs, late_s = (2, 100, _LATE_S / 20) if quick else (20, 1_000, _LATE_S)
        result = asyncio.run(measured(stack, turns=turns, performs=performs, late_s=late_s))
    print(json.dumps(result))
    Console(stderr=True, width=None if sys.stderr.isatty() else 140).print(_table(result))


if __name__ == "__main__":
    main()
