"""Record the same actions with this package and with other ways, and kill each to count what is left.

    python -m bench.rivals            20 turns of 500 actions, warm and cold; 3 kills each; two minutes
    python -m bench.rivals --quick    2 turns of 20 actions, one kill each

An action is a start, with object, arm, grasp and the robot's pose, and an end. Ours also reads the robot's state,
checks the values and orders the events, and is a whole `perform`; the others get a ready dict. *warm*: all ways take
turns in one process; the least CPU time of the plan's thread for an action. *cold*: the plan computes for a millisecond
before each action, which evicts code and data from the processor's caches; the median. *times* divides by JSON lines
with a flush in the same run. The exporter's thread of OpenTelemetry is not counted. *left*: a process reports each
start and each end when the call has returned, and gets SIGKILL after some hundred of them; the number of those
reported, and of those that can be read back.

A library that is not installed (`pip install '.[bench]'`) is named and left out. The script prints one JSON line; the
table on stderr is the one of `bench/README.md`.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import importlib
import json
import logging
import os
import signal
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, closing, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

from bench.gate import ENDED, STARTED, core
from bench.material.baseline import engine_of, store
from bench.material.rollouts import Tree, tree_of
from bench.material.runs import options
from bench.material.turns import nothing_action
from bench.reporting.figures import MISSING, console
from pycrorm_async import Memory, Settings
from pycrorm_async.operations.recovery import recover
from pycrorm_async.plan.execution import recorder
from pycrorm_async.plan.task import TaskTreeNode
from pycrorm_async.world import BulletWorld, Pose
from tests.databases import ask

_SETTINGS: Final = Settings(spool_bytes_max=2**33, segment_bytes=2**26)
_PAUSE_S: Final = 0.001
_EVENTS_BEFORE_KILL: Final = 200


class Way(NamedTuple):
    """An open recording: `start` and `end` of an action return when the event is as safe as this way makes it."""

    start: Callable[[], Any]
    end: Callable[[], Any]
    is_async: bool = False
    perform: Callable[[], Awaitable[object]] | None = None
    """Performs a whole action, with its start and its end; only its cost is measured."""


class Rival(NamedTuple):
    """One way to record: `open` it in a folder, and `count` the events that a reader finds there afterwards."""

    open: Callable[[AsyncExitStack, Path], Awaitable[Way]]
    count: Callable[[Path], int]
    answers: str
    module: str | None = None


# === ways =====================================================================================================


async def ours(stack: AsyncExitStack, folder: Path) -> Way:
    memory = await _memory(stack, folder)
    await stack.enter_async_context(memory.episode(description="rivals"))
    stack.enter_context(BulletWorld())
    action, observer = nothing_action(), recorder.get()
    assert observer is not None
    nodes: list[TaskTreeNode] = []

    def start() -> None:
        nodes.append(TaskTreeNode(action, "action", None, time.monotonic_ns()))
        observer.node_started(nodes[-1])

    return Way(start, lambda: observer.node_ended(nodes.pop()), perform=action.perform)


async def of_other_executives(stack: AsyncExitStack, folder: Path) -> Way:
    recording = (await _memory(stack, folder)).recording
    fields: Any = {"object_designator": "object", "arm": "text", "grasp": "text"}
    kind = recording.type("action", "NothingAction", fields)
    episode = stack.enter_context(recording.episode(description="rivals"))
    episode.object_added("pr2", "pr2", "ROBOT", Pose(), {"torso": 0.1}, torso_joint="torso")
    episode.object_added("milk", "milk", "MILK", Pose())
    parameters = {"object_designator": "milk", "arm": "LEFT", "grasp": "FRONT"}
    return Way(lambda: episode.start(17, kind, parameters, robot="pr2"), lambda: episode.end(17))


async def _memory(stack: AsyncExitStack, folder: Path) -> Memory:
    opened = Memory.open(f"sqlite:///{folder}/memory.db", writer="daemon", settings=_SETTINGS)  # nothing drains it
    return await stack.enter_async_context(opened)


def _count_ours(folder: Path) -> int:
    report = asyncio.run(recover(f"sqlite:///{folder}/memory.db"))
    assert not report.failed, report.failed
    actions = "SELECT count(*) FROM event WHERE type = 'NodeEnded' OR type = 'NodeStarted' AND payload LIKE '%LEFT%'"
    return int(ask(f"sqlite:///{folder}/memory.db", actions)[0][0])


async def json_lines(stack: AsyncExitStack, folder: Path) -> Way:
    file = stack.enter_context((folder / "lines.jsonl").open("w"))

    def write(event: dict[str, Any]) -> None:
        file.write(json.dumps(event) + "\n")
        file.flush()

    return Way(lambda: write(STARTED), lambda: write(ENDED))


def _count_lines(folder: Path) -> int:
    return (folder / "lines.jsonl").read_bytes().count(b"\n")


async def mcap(stack: AsyncExitStack, folder: Path, *, chunked: bool = False) -> Way:
    writing = importlib.import_module("mcap.writer")
    file = stack.enter_context((folder / "log.mcap").open("wb"))
    writer = writing.Writer(file, use_chunking=chunked)
    writer.start()
    schema = writer.register_schema("event", "jsonschema", b'{"type":"object"}')
    channel = writer.register_channel("events", "json", schema)

    def write(event: dict[str, Any]) -> None:
        data = json.dumps(event).encode()
        writer.add_message(channel, log_time=event["wall_ns"], data=data, publish_time=event["wall_ns"])
        if not chunked:  # a chunk is written when it is full
            file.flush()

    return Way(lambda: write(STARTED), lambda: write(ENDED))


async def mcap_chunked(stack: AsyncExitStack, folder: Path) -> Way:
    return await mcap(stack, folder, chunked=True)


def _count_mcap(folder: Path) -> int:
    reading = importlib.import_module("mcap.stream_reader")
    count = 0
    with (folder / "log.mcap").open("rb") as file, suppress(Exception):  # a file without its end is read so far
        for each in reading.StreamReader(file).records:
            count += type(each).__name__ == "Message"
    return count


async def opentelemetry(stack: AsyncExitStack, folder: Path) -> Way:
    trace, export = (importlib.import_module(f"opentelemetry.sdk.trace{part}") for part in ("", ".export"))
    file = stack.enter_context((folder / "lines.jsonl").open("w"))
    exporter = export.ConsoleSpanExporter(out=file, formatter=lambda span: span.to_json(indent=None) + "\n")
    provider = trace.TracerProvider()
    provider.add_span_processor(export.BatchSpanProcessor(exporter))
    stack.callback(provider.shutdown)
    tracer = provider.get_tracer("rivals")
    spans: list[Any] = []
    flat = {**STARTED["parameters"], **STARTED["robot"], "type": STARTED["type"], "parent": STARTED["parent"]}

    def end() -> None:
        span = spans.pop()
        span.set_attribute("status", ENDED["status"])
        span.end()

    return Way(lambda: spans.append(tracer.start_span("PickUpAction", attributes=flat)), end)


async def sqlite_autocommit(stack: AsyncExitStack, folder: Path) -> Way:
    connection = stack.enter_context(closing(sqlite3.connect(folder / "events.db", isolation_level=None)))
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("CREATE TABLE event (id INTEGER PRIMARY KEY, type TEXT, payload TEXT)")

    def write(event: dict[str, Any]) -> None:
        connection.execute("INSERT INTO event (type, payload) VALUES (?, ?)", (event["event"], json.dumps(event)))

    return Way(lambda: write(STARTED), lambda: write(ENDED))


async def persist_queue(_stack: AsyncExitStack, folder: Path) -> Way:
    queue = importlib.import_module("persistqueue").SQLiteQueue(str(folder), auto_commit=True)
    return Way(lambda: queue.put(STARTED), lambda: queue.put(ENDED))


async def eventsource_py(stack: AsyncExitStack, folder: Path) -> Way:
    eventsource = importlib.import_module("eventsource")

    class Happened(eventsource.DomainEvent):  # type: ignore[misc, name-defined]
        aggregate_type: str = "Episode"
        body: str

    file = eventsource.SQLiteEventStore(str(folder / "events.db"))
    stack.push_async_callback(file.close)
    aggregate, any_version = uuid.uuid4(), eventsource.ExpectedVersion.any_()
    stream = eventsource.StreamId(aggregate, "Episode")

    async def write(event: dict[str, Any]) -> None:
        await file.append(stream, [Happened(aggregate_id=aggregate, body=json.dumps(event))], any_version)

    return Way(lambda: write(STARTED), lambda: write(ENDED), is_async=True)


async def eventsourcing(stack: AsyncExitStack, folder: Path) -> Way:
    persistence = importlib.import_module("eventsourcing.persistence")
    names = {"PERSISTENCE_MODULE": "eventsourcing.sqlite", "SQLITE_DBNAME": str(folder / "events.db")}
    factory = persistence.InfrastructureFactory.construct(persistence.Environment("bench", names))
    stack.callback(factory.close)
    file, name, versions = factory.application_recorder(), uuid.uuid4(), iter(range(1, 10**9))

    def write(event: dict[str, Any]) -> None:
        body = json.dumps(event).encode()
        file.insert_events([persistence.StoredEvent(name, next(versions), event["event"], body)])

    return Way(lambda: write(STARTED), lambda: write(ENDED))


async def orm_of_the_thesis(stack: AsyncExitStack, folder: Path) -> Way:
    """Keep the tree in memory, as the system of the thesis does, and store it when the episode ends."""
    rollout = tree_of([1]).rollouts[0].children[0]
    nodes: list[Any] = []

    def commit() -> None:
        store(Tree(nodes, 2), engine_of(f"sqlite:///{folder}/thesis.db"))

    stack.callback(commit)
    return Way(lambda: nodes.append(rollout), lambda: None)


def _rows(file: str, table: str) -> Callable[[Path], int]:
    def count(folder: Path) -> int:
        if not (folder / file).exists():
            return 0
        with closing(sqlite3.connect(folder / file)) as connection:
            return int(connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])

    return count


RIVALS: Final = {
    "this package, a plan of ours": Rival(ours, _count_ours, "SQL, data frames, mapped classes"),
    "this package, another executive": Rival(of_other_executives, _count_ours, "the same"),
    "JSON lines, flush": Rival(json_lines, _count_lines, "by reading all"),
    "MCAP, flush": Rival(mcap, _count_mcap, "by time", "mcap"),
    "MCAP, chunks of 1 MiB": Rival(mcap_chunked, _count_mcap, "by time", "mcap"),
    "OpenTelemetry, batch exporter": Rival(
        opentelemetry, lambda folder: 2 * _count_lines(folder), "by reading all", "opentelemetry.sdk"
    ),
    "sqlite3, commit each": Rival(sqlite_autocommit, _rows("events.db", "event"), "SQL over JSON"),
    "persist-queue, SQLite": Rival(persist_queue, _rows("data.db", "queue_default"), "in order, once", "persistqueue"),
    "eventsource-py, SQLite": Rival(eventsource_py, _rows("events.db", "events"), "SQL over JSON", "eventsource"),
    "eventsourcing, SQLite": Rival(eventsourcing, _rows("events.db", "stored_events"), "by aggregate", "eventsourcing"),
    "the thesis' ORM": Rival(orm_of_the_thesis, _rows("thesis.db", "Action"), "SQL, mapped classes"),
}
_LINES: Final = "JSON lines, flush"


# === cost =====================================================================================================


async def costs(names: list[str], *, turns: int, actions: int) -> dict[str, dict[str, float]]:
    """Return for each way the µs of an action, warm (the least of the turns) and cold (the median)."""
    warm: dict[str, list[float]] = {name: [] for name in names}
    cold: dict[str, list[float]] = {name: [] for name in names}
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        async with AsyncExitStack() as stack:
            ways = {}
            for number, name in enumerate(reversed(names)):  # the memory opened last records the plan
                (place := Path(folder) / str(number)).mkdir()
                ways[name] = await RIVALS[name].open(stack, place)
            gc.collect()
            gc.freeze()
            for _ in range(turns):
                for name, way in ways.items():
                    warm[name].append(await _act(way, actions))
                for _ in range(actions // 2):
                    for name, way in ways.items():
                        _compute()
                        cold[name].append(await _act(way, 1))
    return {
        name: {"warm_us": round(min(warm[name]), 2), "cold_us": round(statistics.median(cold[name]), 2)}
        for name in names
    }


async def _act(way: Way, actions: int) -> float:
    """Perform actions; return the CPU time of this thread in µs for one of them."""
    began_ns = time.thread_time_ns()
    if way.perform is not None:
        for _ in range(actions):
            await way.perform()
    elif way.is_async:
        for _ in range(actions):
            await way.start()
            await way.end()
    else:
        for _ in range(actions):
            way.start()
            way.end()
    return (time.thread_time_ns() - began_ns) / actions / 1e3


def _compute() -> None:
    number, until_s = 1, time.perf_counter() + _PAUSE_S
    while time.perf_counter() < until_s:
        number = number * 3 % 1_000_003


# === kills ====================================================================================================


def record_until_killed(name: str, folder: Path) -> None:
    """Record actions for ever, and write a byte to stdout whenever a start or an end has returned."""

    async def run() -> None:
        async with AsyncExitStack() as stack:
            way = await RIVALS[name].open(stack, folder)
            while True:
                for call in (way.start, way.end):
                    answer = call()
                    if way.is_async:
                        await answer
                    os.write(1, b".")

    logging.disable(logging.WARNING)
    asyncio.run(run())


def kill(name: str, events: int) -> tuple[int, int]:
    """Kill a process after it reported so many events; return how many it reported, and how many can be read back."""
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        command = [sys.executable, "-m", "bench.rivals", "--record", name, "--in", folder]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            reported = len(process.stdout.read(events))
            process.send_signal(signal.SIGKILL)
            reported += len(process.stdout.read())
        return reported, RIVALS[name].count(Path(folder))


# === rivals ===================================================================================================


def measure(*, turns: int, actions: int, kills: int) -> dict[str, Any]:
    logging.disable(logging.WARNING)  # nothing drains the memories, of which closing them warns
    names = [name for name, rival in RIVALS.items() if _is_installed(name, rival)]
    figures: dict[str, Any] = dict.fromkeys(RIVALS, MISSING)
    figures |= asyncio.run(costs(names, turns=turns, actions=actions))
    for name in names:
        console().print(f"  killing {name}")
        results = [kill(name, _EVENTS_BEFORE_KILL + 37 * number) for number in range(kills)]
        reported, left = (sum(each) for each in zip(*results, strict=True))
        lost = sum(max(0, each - kept) for each, kept in results)
        lines = figures[_LINES]
        figures[name] |= {
            "times_warm": round(figures[name]["warm_us"] / lines["warm_us"], 2),
            "times_cold": round(figures[name]["cold_us"] / lines["cold_us"], 2),
            "reported": reported, "left": left, "lost": lost, "answers": RIVALS[name].answers,
        }  # fmt: skip
    return figures


def _is_installed(name: str, rival: Rival) -> bool:
    with suppress(ModuleNotFoundError):  # raised if the package is missing that holds the module
        if rival.module is None or find_spec(rival.module) is not None:
            return True
    console().print(f"  {name} is left out: pip install '.[bench]'", markup=False)
    return False


def main() -> None:
    parser = options(__doc__, quick="2 turns of 20 actions, one kill each")
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--record", help=argparse.SUPPRESS)
    parser.add_argument("--in", type=Path, dest="folder", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.record:
        record_until_killed(arguments.record, arguments.folder)
        return
    turns, actions, kills = (2, 20, 1) if arguments.quick else (arguments.turns, 500, arguments.kills)
    result = {"bench": "rivals", "turns": turns, "actions": actions, "kills": kills, "core": core()}
    result |= {"ways": measure(turns=turns, actions=actions, kills=kills)}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
