"""Measure the cost of a `perform` with a memory while its database is up, slow or unavailable.

    python -m bench.hook            20 turns of a second for each of seven plans, about five minutes
    python -m bench.hook --quick    two short turns

An action with object, arm and grasp that does nothing is performed in a Bullet world with a robot, whose state is read
and recorded. Between two actions the plan computes, so that 2,000 events a second are recorded. One process runs all
plans, each in its own task and world: one without a memory; three with a writer thread, whose PostgreSQL is up, or
answers each request 20 ms late, or is unavailable; and three with the daemon. The plans take turns in random order, and
a turn ends when its writer is idle. Each percentile is the median of the percentile over all turns, and the additional
cost is the difference within one round, so that a busy moment of the machine has little influence. Performs during
which the kernel preempted the thread are only counted, and included in the maximum. The script prints one JSON line, in
µs; one hook is half of the additional cost of a perform. The table is on stderr.
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

from bench.breaking.processes import ChildProcess
from bench.daemon import start_daemon, stop
from bench.material.turns import NothingActionPerformable, TurnTaker, nothing_action
from pycrorm_async import Memory, Settings
from pycrorm_async.errors import FlushTimeout
from pycrorm_async.settings import Writer
from pycrorm_async.world import BulletWorld
from tests.crash.step_robot import report
from tests.databases import Server, server_in

_LATE_S = 0.02
_PERFORMS_PER_S = 1_000
_WRITERS: tuple[Writer, ...] = ("thread", "daemon")
_PERCENTILES = {"median": 0.5, "p99": 0.99, "p99.9": 0.999}


class Kind(NamedTuple):
    """A memory to measure: its writer, the state of its database, its URL and its spool."""

    writer: Writer
    state: str
    url: str
    spool: Path

    @property
    def is_down(self) -> bool:
        return self.state == "down"


class Turn(NamedTuple):
    """Durations of performs, ns: those without a preemption, and the interrupted ones."""

    uninterrupted: list[int]
    interrupted: list[int]


class Plan(TurnTaker):
    """A plan with or without a memory; a turn ends when its events are stored, or synced if the database is down."""

    def __init__(self, kind: Kind | None) -> None:
        super().__init__()
        self.name = "none" if kind is None else f"{kind.writer}, {kind.state}"
        self.turns: list[Turn] = []
        self._kind = kind

    async def begin(self, stack: AsyncExitStack) -> Callable[[int], Awaitable[None]]:
        memory = None if self._kind is None else await stack.enter_async_context(_open_memory(self._kind))
        stack.enter_context(BulletWorld())
        action = nothing_action()

        async def take(performs: int) -> None:
            self.turns.append(await _turn(action, performs))
            if memory is not None and self._kind is not None:
                await (memory.synced() if self._kind.is_down else memory.flush())

        return take


@asynccontextmanager
async def _open_memory(kind: Kind) -> AsyncIterator[Memory]:
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
        elapsed_ns = time.perf_counter_ns() - began
        (turn.uninterrupted if _interruptions() == before else turn.interrupted).append(elapsed_ns)
    return turn


def _interruptions() -> int:
    """Return how often the kernel preempted this thread; waiting, as for the interpreter lock, does not count."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw


def _compute(until_ns: int) -> None:
    number = 1
    while time.perf_counter_ns() < until_ns:
        number = number * 3 % 1_000_003


# --- slow and unavailable databases ---------------------------------------------------------------------------------


class _Proxy:
    """A proxy process in front of the server that delays all data, until it is killed."""

    def __init__(self, server: Server, late_s: float) -> None:
        self._server = server
        self._process = ChildProcess(_run_proxy, str(server.folder / ".s.PGSQL.5432"), late_s)
        self._process.wait_for("\n")
        [[_, self._port]] = self._process.lines

    def new_database(self) -> str:
        return f"postgresql://postgres@127.0.0.1:{self._port}{urlsplit(self._server.new_database()).path}"

    def end(self) -> None:
        self._process.stop()


def _run_proxy(server_socket: str, late_s: float) -> None:
    async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while chunk := await reader.read(1 << 16):
                await asyncio.sleep(late_s)
                writer.write(chunk)
                await writer.drain()
        writer.close()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        server_reader, server_writer = await asyncio.open_unix_connection(server_socket)
        await asyncio.gather(carry(reader, server_writer), carry(server_reader, writer))

    async def serve() -> None:
        proxy = await asyncio.start_server(accept, "127.0.0.1", 0)
        report("port", proxy.sockets[0].getsockname()[1])
        await proxy.serve_forever()

    asyncio.run(serve())


# --- measuring ------------------------------------------------------------------------------------------------------


async def measure(stack: ExitStack, *, turns: int, performs: int, late_s: float) -> dict[str, object]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="h")))
    server = stack.enter_context(server_in(folder / "pg"))
    slow, unavailable = _Proxy(server, late_s), _Proxy(server, 0.0)
    stack.callback(slow.end)
    databases = {"up": server.new_database, "slow": slow.new_database, "down": unavailable.new_database}
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
        for plan in plans:  # warm up: connections, tables, declarations
            await plan.take_turn(10)
            plan.turns.clear()
        unavailable.end()
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
    """Return the figures of one plan, in µs."""
    spreads, spreads_without = [_spread(turn) for turn in plan.turns], [_spread(turn) for turn in without.turns]
    typical = {name: statistics.median(each[name] for each in spreads) for name in _PERCENTILES}
    longest = max(max(turn.uninterrupted + turn.interrupted) for turn in plan.turns) / 1e3
    figures: dict[str, object] = {
        "perform_us": _rounded(typical | {"max": longest}),
        "interrupted": sum(len(turn.interrupted) for turn in plan.turns),
    }
    if plan is not without:
        additional = {
            name: statistics.median(
                with_it[name] - without_it[name] for with_it, without_it in zip(spreads, spreads_without, strict=True)
            )
            for name in _PERCENTILES
        }
        figures |= {"more_us": _rounded(additional), "hook_us": round(additional["median"] / 2, 1)}
    return figures


def _spread(turn: Turn) -> dict[str, float]:
    ordered = sorted(turn.uninterrupted)
    return {name: ordered[round(share * (len(ordered) - 1))] / 1e3 for name, share in _PERCENTILES.items()}


def _rounded(figures: dict[str, float]) -> dict[str, float]:
    return {name: round(each, 1) for name, each in figures.items()}


def _table(result: dict[str, object]) -> Table:
    more = [f"more, {name}" for name in _PERCENTILES]
    columns = ("memory", *_PERCENTILES, "max", "interrupted", *more, "one hook")
    table = Table(title="A whole perform, µs, by writer and state of the database", title_justify="left")
    for name in columns:
        table.add_column(name, justify="left" if name == "memory" else "right")
    for name, figures in result.items():
        if isinstance(figures, dict):
            cells = [*figures["perform_us"].values(), figures["interrupted"], *figures.get("more_us", {}).values()]
            table.add_row(name, *(f"{each:,}" for each in cells), str(figures.get("hook_us", "")))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="two short turns for each plan")
    quick = parser.parse_args().quick
    logging.disable(logging.WARNING)  # the memory warns that the database is unavailable, which is intended here
    with ExitStack() as stack:
        turns, performs, late_s = (2, 100, _LATE_S / 20) if quick else (20, 1_000, _LATE_S)
        result = asyncio.run(measure(stack, turns=turns, performs=performs, late_s=late_s))
    print(json.dumps(result))
    Console(stderr=True, width=None if sys.stderr.isatty() else 140).print(_table(result))


if __name__ == "__main__":
    main()
