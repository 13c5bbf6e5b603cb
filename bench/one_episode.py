"""Measure what questions about one episode, recall, and a further batch cost as a memory grows, on both databases.

    python -m bench.one_episode                    50 and 5,000 episodes
    python -m bench.one_episode --than 2000 --episodes 20000     10^5 and 10^6 events
    python -m bench.one_episode --quick            50 and 200

The memories hold random episodes of some 50 events; the one that is asked about is the same in all of them, and in the
middle. The sizes take turns, and the least CPU time of the rounds counts. On SQLite it is the CPU time of the process,
which runs the database; its work is also given as the steps of SQLite's virtual machine, in hundreds, which are the
same on a busy machine. On PostgreSQL it is that of the client, and the server's work is given as the rows that all
steps of all plans read. `list` is `pycrorm episodes`, `append` a batch of 100 further episodes. The script prints one
JSON line: by database, question and size the CPU time in ms and the rows read or the steps, with the ratio of the CPU
time at the largest size to that at the smallest.
"""

from __future__ import annotations

import asyncio
import gc
import json
import re
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Self

from sqlalchemy import Engine, event

from bench.material.runs import options
from bench.reporting.figures import console
from pycrorm_async import Reading
from pycrorm_async.events.codec import Record
from pycrorm_async.export.export import export
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.named_queries import EpisodeChoice, percepts_of, searches_of
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.recall.recall import Recall
from pycrorm_async.report.write import report
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog, episode_named
from tests.databases import ask_to_change, server_in
from tests.projections.event_script import Script
from tests.query.random_memory import TYPES, RandomEpisode

_SEEDS = 25
_AT_ONCE = 100
_UNREAD = re.compile("set_config|FOR UPDATE|FOR SHARE")
"""In statements that read none of the rows in question, and that a read-only connection refuses."""

Ask = Callable[[], Awaitable[object]]
WRITING = ("append", "append and fold")


def records_of(numbers: range, asked: int) -> Iterator[Record]:
    """Yield the records of random episodes; that with the number `asked` is the same in every memory."""
    scripts = [RandomEpisode(seed, seed).records for seed in range(1, _SEEDS + 1) if seed % 5]  # all have ended
    about = max(scripts, key=len)
    for number in numbers:
        own = Script(number).episode
        for each in about if number == asked else scripts[number % len(scripts)]:
            yield each._replace(episode=own)


async def fill(url: str, episodes: int) -> None:
    """Store and fold so many episodes; the one in the middle is the one to ask about."""
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    try:
        projector = Projector(log, installed=own_projections())
        await projector.open()
        await log.append(TYPES)
        for first in range(1, episodes + 1, _AT_ONCE):
            await log.append([*records_of(range(first, min(first + _AT_ONCE, episodes + 1)), episodes // 2)])
            await projector.catch_up()
    finally:
        await log.close()


@asynccontextmanager
async def questions_of(url: str, number: int, folder: Path) -> AsyncIterator[dict[str, Ask]]:
    """Yield the questions about one episode by name, to an open memory."""
    files = count()
    writer = await EventLog.open(DatabaseAddress.parse(url), create=True)
    projector = Projector(writer, installed=own_projections())
    await projector.open()

    async def append() -> None:
        first = await writer.last_number() + 1
        await writer.append([*records_of(range(first, first + _AT_ONCE), 0)])

    async def append_and_fold() -> None:
        await append()
        await projector.catch_up()

    async with Reading.open(url) as reading:
        log, identity = await reading.log(), (await reading.episode(str(number))).id

        def asked(name: str, episode: str | int) -> Ask:
            about = {"name": "milk"} if name in ("object_history", "moves_of") else {}
            return lambda: getattr(reading.ask, name)(episode=episode, **about).rows()

        async def show() -> None:
            await reading.tree(await reading.episode(str(number)))
            async with reading.session(simulated=True) as session:
                await percepts_of(session, number)
                await searches_of(session, number)

        async def check() -> None:
            assert not (await verify(log, episode=await episode_named(log, str(number)))).damage

        async def page() -> None:
            await report(reading, number, folder / f"{next(files)}.html")

        def exported(file_format: str, what: str | int, **options: Any) -> Ask:
            return lambda: export(reading, what, folder / f"{next(files)}.{file_format}", **options)

        async def copied(source: str, target: str, episode: str) -> None:
            [done] = (await copy_episodes(source, target, episodes=[episode])).episodes
            assert done.damage is None

        names = [each for each in QUESTIONS if each not in ("episodes", "experience_at")]
        questions: dict[str, Ask] = {name: asked(name, number) for name in names}
        questions["root_failures by id"] = asked("root_failures", identity[:36])
        questions["the newest episode"] = lambda: reading.episode("last")
        questions["show"] = show
        questions["at a moment"] = lambda: reading.as_of(number, sequence=20)
        questions["diff"] = lambda: reading.diff(number, number)
        questions["verify"] = check
        questions["report"] = page
        questions["export csv"] = exported("csv", number)
        questions["export view"] = exported("csv", "action", episodes=[number])
        questions["export question"] = exported("csv", "root_failures", arguments={"episode": number})
        questions["export mcap"] = exported("mcap", number)
        small = f"sqlite:///{folder}/copy.db"
        questions["copy out"] = partial(copied, url, small, str(number))
        await questions["copy out"]()
        questions["copy in"] = partial(copied, small, url, "1")
        questions["list"] = lambda: reading.episodes(EpisodeChoice(limit=50))
        recall = Recall.of(reading)
        case = next(each for each in await recall(await a_type(reading, number), k=50))
        questions["recall"] = lambda: recall.like(case)
        questions |= zip(WRITING, (append, append_and_fold), strict=True)
        yield questions
    await writer.close()


async def a_type(reading: Reading, number: int) -> str:
    """Return the type of an action of the episode."""
    return next(each.dtype for each in await reading.tree(number) if each.kind == "action" and each.dtype)


async def cpu_s(question: Ask) -> float:
    """Return the CPU time that a question took in this process."""
    gc.collect()
    began = time.process_time()
    await question()
    return time.process_time() - began


@contextmanager
def noted_statements() -> Iterator[list[tuple[str, Any]]]:
    """Yield the list of the statements that PostgreSQL executes inside, with their parameters."""
    statements: list[tuple[str, Any]] = []

    def note(connection: Any, _cursor: Any, text: str, parameters: Any, _context: Any, _many: bool) -> None:
        if connection.dialect.name == "postgresql":
            statements.append((text, parameters))

    event.listen(Engine, "before_cursor_execute", note)
    try:
        yield statements
    finally:
        event.remove(Engine, "before_cursor_execute", note)


class Steps:
    """Counts the steps of SQLite's virtual machine, in hundreds, on all connections that are opened inside."""

    def __init__(self) -> None:
        self.hundreds = 0

    def __enter__(self) -> Self:
        event.listen(Engine, "connect", self._count)
        return self

    def __exit__(self, *_exception: object) -> None:
        event.remove(Engine, "connect", self._count)

    def _count(self, connection: Any, _record: Any) -> None:
        if (file := getattr(connection.driver_connection, "_conn", None)) is not None:
            file.set_progress_handler(self._hundred, 100)

    def _hundred(self) -> int:
        self.hundreds += 1
        return 0


async def rows_read(url: str, question: Ask) -> int:
    """Return the rows that all steps of the plans of a question read on PostgreSQL."""
    with noted_statements() as statements:
        await question()
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    rows = 0.0
    try:
        async with log.engine.connect() as connection:
            for text, parameters in statements:
                if not text.lstrip().startswith(("SELECT", "WITH")) or _UNREAD.search(text):
                    continue
                plan: Any = await connection.exec_driver_sql(
                    f"EXPLAIN (ANALYZE, FORMAT JSON) {text}", tuple(parameters)
                )
                plan = plan.scalar_one()
                pending = [(json.loads(plan) if isinstance(plan, str) else plan)[0]["Plan"]]
                while pending:
                    step = pending.pop()
                    pending += step.get("Plans", [])
                    read = sum(
                        value for name, value in step.items() if name.startswith(("Actual Rows", "Rows Removed"))
                    )
                    rows += read * step["Actual Loops"]
    finally:
        await log.close()
    return round(rows)


async def measure(url_of: dict[int, str], rounds: int) -> dict[str, dict[str, Any]]:
    """Return CPU time and rows read, or steps, by question and number of episodes."""
    figures: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        least: dict[tuple[str, int], float] = {}
        for _ in range(rounds):
            for size, url in url_of.items():
                own = Path(tempfile.mkdtemp(dir=folder))
                async with questions_of(url, size // 2, own) as questions:
                    for name, question in questions.items():
                        await question()
                        least[name, size] = min(least.get((name, size), 1e9), await cpu_s(question))
        for size, url in url_of.items():
            own = Path(tempfile.mkdtemp(dir=folder))
            with Steps() as steps:
                async with questions_of(url, size // 2, own) as questions:
                    for name, question in questions.items():
                        entry = figures.setdefault(name, {"cpu_ms": {}, "rows": {}, "hundred_steps": {}})
                        entry["cpu_ms"][size] = round(least[name, size] * 1000, 2)
                        if not url.startswith("postgresql"):
                            steps.hundreds = 0
                            await question()
                            entry["hundred_steps"][size] = steps.hundreds
                        elif name not in WRITING:
                            entry["rows"][size] = await rows_read(url, question)
    first, last = min(url_of), max(url_of)
    for each in figures.values():
        each["ratio"] = round(each["cpu_ms"][last] / each["cpu_ms"][first], 2)
    return figures


def main() -> None:
    parser = options(__doc__, quick="200 episodes and one round, to check that it works")
    parser.add_argument("--episodes", type=int, default=5_000, help="of the large memory")
    parser.add_argument("--than", type=int, default=50, help="episodes of the small memory")
    parser.add_argument("--databases", nargs="+", default=["sqlite", "postgresql"])
    parser.add_argument("--rounds", type=int, default=7)
    arguments = parser.parse_args()
    sizes = (arguments.than, 200 if arguments.quick else arguments.episodes)
    line: dict[str, Any] = {"bench": "one_episode", "episodes": list(sizes)}
    gc.disable()
    with tempfile.TemporaryDirectory(prefix="pg") as folder, server_in(Path(folder) / "server", syncs=False) as server:
        urls = {
            "sqlite": {size: f"sqlite:///{folder}/{size}.db" for size in sizes},
            "postgresql": {size: server.new_database() for size in sizes},
        }
        for database in arguments.databases:
            url_of = urls[database]
            for size, url in url_of.items():
                asyncio.run(fill(url, size))
                if database == "postgresql":
                    ask_to_change(url, "ANALYZE")
                console().print(f"{database}: {size} episodes are stored")
            line[database] = asyncio.run(measure(url_of, 1 if arguments.quick else arguments.rounds))
            for name, each in line[database].items():
                console().print(f"{name:24} {each}")
    print(json.dumps(line))


if __name__ == "__main__":
    main()
