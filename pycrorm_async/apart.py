"""Processes that fold, beside the one that appends: so that each has a core.

    with folding_process(url, spool=spool, projections=projections) as process:
        asyncio.run(serve(url, ..., folding=process))

There are two of them, forked before anything is open; each opens the database for itself when it is asked for the first
time. The first one folds, when asked, batch after batch until there is no more, with an answer after each: it does not
wait for who asks, who is busy appending. Of a long way to go it leaves every other batch to the second one, its helper:
each reads and folds while the other one writes. They hold nothing: when one dies, whoever asked it folds from then on,
and when that one dies it ends too.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from pycrorm_async.adoption import LogAndTables, open_destination, shared_address
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import DatabaseError, DatabaseUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.projections.folding import Prepared
from pycrorm_async.projections.own import Projection
from pycrorm_async.projections.projector import Projector
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.rows import Span
from pycrorm_async.writer.ports import Shown

__all__ = ["folding_process", "FoldedApart"]

_NOT_FOR_IT = (signal.SIGINT, signal.SIGTERM)
"""What a terminal or a service manager sends to all processes at once: the one that appends ends it."""


class _Answer(msgspec.Struct, omit_defaults=True):
    """Whether there was something to fold, and another answer follows; or why not: the database is away, or else.
    `alone` if the helper has died."""

    more: bool = False
    alone: bool = False
    away: str | None = None
    fault: str | None = None


class _Ask(msgspec.Struct, omit_defaults=True):
    """What the helper is to do: to prepare these, or to write what it has prepared."""

    spans: list[Span] = []


class _Streams(NamedTuple):
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter


@contextmanager
def folding_process(url: str, *, spool: Path | None, projections: Sequence[Projection] = ()) -> Iterator[socket.socket]:
    """A process that folds this memory when asked through the socket, and its helper; both are gone when the context is
    left. To be called while this process has one thread.
    """
    with ExitStack() as held:
        helped, helper = (held.enter_context(each) for each in socket.socketpair())
        ours, theirs = (held.enter_context(each) for each in socket.socketpair())
        held.enter_context(_forked(lambda: _help_when_asked(helper, url), but=(ours, theirs, helped)))
        helper.close()
        held.enter_context(
            _forked(lambda: _fold_when_asked(theirs, helped, url, spool, projections), but=(ours, helper))
        )
        helped.close()
        theirs.close()
        yield ours


@contextmanager
def _forked(work: Callable[[], Coroutine[Any, Any, None]], *, but: Sequence[socket.socket]) -> Iterator[None]:
    """A process that does this, and closes what is not for it; killed when the context is left."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _NOT_FOR_IT)
    process = os.fork()
    if process == 0:
        try:
            for each in but:
                each.close()
            for number in _NOT_FOR_IT:
                signal.signal(number, signal.SIG_IGN)
            asyncio.run(work())
        finally:
            os._exit(0)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield
    finally:
        os.kill(process, signal.SIGKILL)  # nothing is lost: what it had not committed is folded again
        os.waitpid(process, 0)


class FoldedApart(Shown):
    """A destination of which the other process folds the tables."""

    def __init__(self, destination: LogAndTables, streams: _Streams, say: Callable[[str], None]) -> None:
        self._destination = destination
        self._streams: _Streams | None = streams
        self._is_folding = False
        self._told_alone = False
        self._say = say

    @classmethod
    async def connect(
        cls, destination: LogAndTables, process: socket.socket, say: Callable[[str], None]
    ) -> FoldedApart:
        """Takes over the socket of `folding_process`; `say` is told if that dies."""
        return cls(destination, _Streams(*await asyncio.open_connection(sock=process)), say)

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        return await self._destination.append(records)

    async def fold(self) -> int:
        return await self._destination.fold()

    async def fold_some(self) -> bool:
        if self._streams is None:
            return await self._destination.fold_some()
        line = await self._next_answer(self._streams)
        if not line:
            self._say("the process that folds has died: from now on this one does")
            return await self._destination.fold_some()
        answer = msgspec.json.decode(line, type=_Answer)
        self._is_folding = answer.more
        if answer.alone and not self._told_alone:
            self._told_alone = True
            self._say("the process that helps to fold has died: folding is slower from now on")
        if answer.away is not None:
            raise DatabaseUnavailable(answer.away)
        if answer.fault is not None:
            raise DatabaseError(answer.fault)
        return answer.more

    async def behind(self) -> Mapping[str, int]:
        return await self._destination.behind()

    async def stopped(self) -> Mapping[str, str]:
        return await self._destination.stopped()

    def close(self) -> None:
        """Asks no more."""
        if self._streams is not None:
            self._streams.writer.close()
            self._streams = None

    async def _next_answer(self, streams: _Streams) -> bytes:
        """Empty if nobody is there any more."""
        line = b""
        try:
            with suppress(ConnectionError):
                if not self._is_folding:
                    streams.writer.write(b"\n")
                    await streams.writer.drain()
                line = await streams.reader.readline()
        finally:
            if not line:  # nobody is there, or an answer is on its way that nobody waits for any more
                self.close()
        return line


class _Helped:
    """The helper as the other one sees it. Implements `Helper`."""

    def __init__(self, streams: _Streams) -> None:
        self._streams = streams
        self.is_there = True

    def prepare(self, spans: Sequence[Span]) -> None:
        self._streams.writer.write(msgspec.json.encode(_Ask(list(spans))) + b"\n")

    async def write(self) -> int:
        line = b""
        with suppress(ConnectionError):
            self._streams.writer.write(msgspec.json.encode(_Ask()) + b"\n")
            await self._streams.writer.drain()
            line = await self._streams.reader.readline()
        self.is_there = line != b""
        return int(line or 0)

    def close(self) -> None:
        self._streams.writer.close()


async def _help_when_asked(asked: socket.socket, url: str) -> None:
    """Until nobody is there who could ask. What fails here the one that asked does, who meets it too and tells."""
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)
    log: EventLog | None = None
    projector: Projector | None = None
    batch: Prepared | None = None
    async with AsyncExitStack() as stack:
        with suppress(ConnectionError), asked.makefile("rwb") as stream:
            while line := stream.readline():
                ask = msgspec.json.decode(line, type=_Ask)
                count = 0
                try:
                    if log is None:
                        log = await EventLog.open(shared_address(url), create=True)
                        stack.push_async_callback(log.close)
                    if projector is None:
                        opened = Projector(log)
                        await opened.open()
                        projector = opened
                    if ask.spans:
                        batch = await projector.prepare(ask.spans)
                    elif batch is not None:
                        count, batch = await projector.write(batch), None
                except Exception:  # noqa: BLE001 - see above
                    batch = None
                if not ask.spans:
                    stream.write(b"%d\n" % count)
                    stream.flush()


async def _fold_when_asked(
    asked: socket.socket,
    helped: socket.socket,
    url: str,
    spool: Path | None,
    projections: Sequence[Projection],
) -> None:
    """Until nobody is there who could ask."""
    # What is notable when the memory is opened was told by the one that asks.
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)
    address = shared_address(url)
    place = Spool(spool or address.default_spool)
    destination: LogAndTables | None = None
    async with AsyncExitStack() as stack:
        helper = stack.enter_context(closing(_Helped(_Streams(*await asyncio.open_connection(sock=helped)))))
        with suppress(ConnectionError), asked.makefile("rwb") as stream:
            while stream.readline():
                answer = _Answer(more=True)
                while answer.more:
                    try:
                        if destination is None:
                            destination = await stack.enter_async_context(
                                open_destination(
                                    address, place, clock=SYSTEM_CLOCK, projections=projections, helper=helper
                                )
                            )
                        answer = _Answer(more=await destination.fold_some(), alone=not helper.is_there)
                    except DatabaseUnavailable as error:
                        answer = _Answer(away=str(error))
                    except Exception as error:  # noqa: BLE001 - told to the one that asks
                        answer = _Answer(fault=str(error) or repr(error))
                    stream.write(msgspec.json.encode(answer) + b"\n")
                    stream.flush()
