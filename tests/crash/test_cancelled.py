"""Cancel a writer beside a plan, a flush, and the daemon at every one of their awaits in turn.

An event loop that steps its tasks counts their awaits, and cancels the work at the n-th from outside, as Ctrl-C or a
timeout does; n takes every value. What was acknowledged is stored, what was not is supplied again, and the next writer
finds no lock held and no part of a batch.
"""

from __future__ import annotations

import asyncio
import random
import types
from collections.abc import Awaitable, Callable, Collection, Coroutine, Generator
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Heading
from pycrorm_async.events.ids import episode_text
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, NodeEnded, NodeStarted
from pycrorm_async.operations.daemon import Folders
from pycrorm_async.operations.destination import LogAndTables, open_destination
from pycrorm_async.operations.recovery import recover
from pycrorm_async.queue import Spool
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.writer.daemon import Daemon
from pycrorm_async.writer.drain import ClaimedSource, ScanResult
from pycrorm_async.writer.plan_writer import BackgroundWriter
from tests.databases import ask
from tests.projections.event_script import SAYING, Script, declarations, name_of
from tests.queue.factories import make
from tests.writer.fakes import KeptSource

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""

STRIDES = pytest.mark.parametrize("stride", [16, pytest.param(1, marks=pytest.mark.soak)])
"""A run cancels at a sixteenth of the awaits, chosen by its seed, and the soak at all of them."""
SETTINGS = Settings(batch_events_max=10, idle_ms=1)
CLOSING = {"AsyncAdapt_aiosqlite_connection._terminate_graceful_close", "Connection._cancel"}
"""SQLAlchemy and asyncpg leave these tasks to the loop when they are cancelled while they close a connection."""
TEXTS = ["a", "b", "c", "d", "e"]


class Steps:
    """An event loop's task factory that counts the awaits of all tasks, and cancels `work` at one of them."""

    def __init__(self, at: int) -> None:
        self.at = at
        self.count = 0
        self.work: asyncio.Task[None] | None = None
        self.names: dict[asyncio.Task[Any], str] = {}

    def make(self, loop: asyncio.AbstractEventLoop, work: Any, **options: Any) -> asyncio.Task[Any]:
        """Make a task that counts its awaits."""
        task = asyncio.Task(self._run(work), loop=loop, **options)
        self.names[task] = work.__qualname__
        task.add_done_callback(lambda _: work.close())  # cancelled before its first step
        return task

    async def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return await self._stepped(work)

    @types.coroutine
    def _stepped(self, work: Coroutine[Any, Any, Any]) -> Generator[Any, Any, Any]:
        step: Callable[[], Any] = lambda: work.send(None)  # noqa: E731
        while True:
            try:
                awaited = step()
            except StopIteration as end:
                return end.value
            self.count += 1
            if self.count == self.at and self.work is not None:
                self.work.cancel()
            try:
                value = yield awaited
            except BaseException as error:  # noqa: BLE001  passed on into the work
                step = _throwing(work, error)
            else:
                step = _sending(work, value)


def _throwing(work: Coroutine[Any, Any, Any], error: BaseException) -> Callable[[], Any]:
    return lambda: work.throw(error)


def _sending(work: Coroutine[Any, Any, Any], value: object) -> Callable[[], Any]:
    return lambda: work.send(value)


async def cancelled_at(at: int, work: Coroutine[Any, Any, None], *, no_other_tasks: bool = True) -> bool:
    """Run the work to its end or to its n-th await, and return whether it was cancelled; no task of it still runs."""
    loop, steps = asyncio.get_running_loop(), Steps(at)
    before = asyncio.all_tasks()
    loop.set_task_factory(steps.make)
    try:
        steps.work = loop.create_task(work)
        async with asyncio.timeout(300):
            await asyncio.wait([steps.work])
    finally:
        loop.set_task_factory(None)
    left = asyncio.all_tasks() - before if no_other_tasks else set()
    assert {steps.names[task] for task in left} <= CLOSING
    for task in left:  # as `asyncio.run` does when it ends
        task.cancel()
    await asyncio.gather(*left, return_exceptions=True)
    if not steps.work.cancelled():
        steps.work.result()
        return False
    return True


async def at_every_await(round_: Callable[[int], Awaitable[bool]], *, stride: int, awaits_min: int = 30) -> None:
    """Run a round for every n, or each `stride`-th from a random one on, until one ends without being cancelled."""
    at = random.randint(1, stride)
    while await round_(at):
        at += stride
    print(f"{at} awaits")
    assert at > awaits_min, "it has more awaits than that"


def script_of(number: int) -> Script:
    """An episode of five nodes: 14 records and a declaration, in two batches."""
    script = Script(number)
    script.put(EpisodeStarted(f"episode {number}", "me", "host", "1.0", "3.11"))
    root = script.put(NodeStarted("root"))
    for text in TEXTS:
        node = script.put(NodeStarted("action", root, name_of(SAYING), {"text": text}))
        script.put(NodeEnded(node, "SUCCEEDED"))
    script.put(NodeEnded(root, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return script


def verify_stored_in_order(url: str, script: Script) -> None:
    """Verify that the episode is in the log once and in order, and in the tables."""
    name = episode_text(script.episode)
    [(number, head, folded, refused, parked)] = ask(
        url, f"SELECT number, head, folded, refused, parked FROM episode WHERE id = '{name}'"
    )
    assert (head, folded, refused, parked) == (14, 14, None, None)
    events = ask(url, f"SELECT sequence, type, payload FROM event WHERE episode = {number} ORDER BY sequence")
    assert events == [(each.sequence, each.type, each.payload.decode()) for each in script.records]
    rows = ask(
        url,
        "SELECT text, status FROM saying_action JOIN task_tree_node ON task_tree_node.id = saying_action.id"
        f" WHERE saying_action.id / {2**31} = {number} ORDER BY saying_action.id",
    )
    assert rows == [(text, "SUCCEEDED") for text in TEXTS]


def stored(url: str, script: Script) -> int:
    """Return how many events of the episode are in the log."""
    heads = ask(url, f"SELECT head FROM episode WHERE id = '{episode_text(script.episode)}'")
    return int(heads[0][0]) if heads else 0


def verify_no_lock_is_held(url: str) -> None:
    ask(url, "SELECT 1 FROM episode FOR UPDATE NOWAIT" if url.startswith("postgresql") else "BEGIN IMMEDIATE")


def opened(url: str, spool: Path) -> AbstractAsyncContextManager[LogAndTables]:
    return open_destination(DatabaseAddress.parse(url), Spool(spool), clock=SYSTEM_CLOCK)


def writer_of(source: KeptSource, destination: LogAndTables) -> BackgroundWriter:
    return BackgroundWriter(source, destination, adopt=list, settings=SETTINGS)


def kept_source(script: Script) -> KeptSource:
    """Return a source that supplies the declaration first."""
    records = [*declarations(SAYING), *script.records]
    return KeptSource([each._replace(position=at) for at, each in enumerate(records, 1)], closed=True)


@STRIDES
async def test_an_opening_that_is_cancelled_at_any_await_leaves_no_lock_held(
    database_url: str, tmp_path: Path, stride: int
) -> None:
    async def life() -> None:
        async with opened(database_url, tmp_path / "spool"):
            pass

    async def round_(at: int) -> bool:
        was_cancelled = await cancelled_at(at, life())
        verify_no_lock_is_held(database_url)
        return was_cancelled

    await life()
    await at_every_await(round_, stride=stride, awaits_min=20)
    async with opened(database_url, tmp_path / "spool") as destination:
        await writer_of(kept_source(script_of(1)), destination).run()
    verify_stored_in_order(database_url, script_of(1))


@STRIDES
async def test_a_writer_cancelled_at_any_await_leaves_the_log_complete_and_ordered(
    database_url: str, tmp_path: Path, stride: int
) -> None:
    async with opened(database_url, tmp_path / "spool") as destination:

        async def round_(at: int) -> bool:
            script = script_of(at)
            source = kept_source(script)
            was_cancelled = await cancelled_at(at, writer_of(source, destination).run())
            acknowledged = max(source.acknowledgements, default=0)
            assert stored(database_url, script) >= acknowledged - 1
            verify_no_lock_is_held(database_url)
            again = source.reopened()
            await writer_of(again, destination).run()
            assert again.kept == []
            verify_stored_in_order(database_url, script)
            return was_cancelled

        await at_every_await(round_, stride=stride)


@STRIDES
async def test_a_flush_cancelled_at_any_await_leaves_the_writer_able_to_store_the_rest(
    database_url: str, tmp_path: Path, stride: int
) -> None:
    async with opened(database_url, tmp_path / "spool") as destination:

        async def round_(at: int) -> bool:
            script = script_of(at)
            source = kept_source(script)
            writer = writer_of(source, destination)
            running = asyncio.create_task(writer.run())
            was_cancelled = await cancelled_at(at, writer.flush(15), no_other_tasks=False)
            await running
            assert source.kept == []
            verify_stored_in_order(database_url, script)
            return was_cancelled

        await at_every_await(round_, stride=stride, awaits_min=2)


@STRIDES
async def test_a_daemon_cancelled_at_any_await_loses_and_doubles_nothing(
    database_url: str, tmp_path: Path, stride: int
) -> None:
    held: list[ClaimedSource] = []
    async with opened(database_url, tmp_path / "spool") as destination:

        async def life(spool: Path) -> None:
            leave = asyncio.Event()

            def report(line: str) -> None:
                if "has ended" in line:
                    leave.set()

            class NotedFolders(Folders):
                def __call__(self, but: Collection[str]) -> ScanResult:
                    result = super().__call__(but)
                    held.extend(result.held)
                    return result

            folders = NotedFolders(Spool(spool), destination.log_id, DatabaseAddress.parse(database_url))
            await Daemon(destination, folders, settings=SETTINGS, report=report).run(leave)

        async def round_(at: int) -> bool:
            script = script_of(at)
            spool = tmp_path / str(at)
            queue = make(spool, offered=True)
            for each in (*declarations(SAYING), *script.records):
                queue.put_nowait(Heading(each.episode, each.type, each.version), each.payload, reserved=True)
            await queue.synced_to()
            queue.close()
            was_cancelled = await cancelled_at(at, life(spool))
            while held:  # the process of a cancelled daemon ends, which releases its locks
                held.pop().release()
            assert stored(database_url, script) >= queue.stored - 1
            verify_no_lock_is_held(database_url)
            queue.release()
            if Spool(spool).recorders():  # the next daemon finds the folder of a dead recorder
                report = await recover(database_url, spool=spool)
                assert (report.failed, report.lost, report.drained.stopped) == ({}, (), {})
                assert Spool(spool).recorders() == []
            await destination.fold()
            verify_stored_in_order(database_url, script)
            return was_cancelled

        await at_every_await(round_, stride=stride)
