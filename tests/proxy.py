"""A proxy between a client and a PostgreSQL server that makes the faults of a network: cuts, resets, stalls, dribbles.

It speaks bytes, not the protocol: a fault is armed by what the client says or by how much of it has gone through.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import NoReturn
from urllib.parse import quote

from tests.databases import Server

__all__ = ["Proxy", "proxy_before"]

_CHUNK = 1 << 16


class Proxy:
    """Listens on TCP; every connection to it is one to the server.

    `connections` counts those made so far, `said` how often a client spoke, `faults` the armed faults that came to
    pass.
    """

    def __init__(self, server_socket: Path) -> None:
        self.port = 0
        self.connections = 0
        self.said = 0
        self.faults = 0
        self.made: Counter[str] = Counter()
        self.chunk_bytes = _CHUNK
        self._server_socket = server_socket
        self._refusing = False
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._links: set[_Link] = set()
        self._pattern: bytes | None = None
        self._seen: Callable[[_Link], None] = lambda _link: None
        self._budget: int | None = None
        self._lie = (b"", b"")

    def url(self, database: str, *, user: str = "postgres", password: str = "") -> str:
        who = f"{user}:{quote(password, safe='')}" if password else user
        return f"postgresql://{who}@127.0.0.1:{self.port}/{database}"

    # --- faults now -------------------------------------------------------------------------------------------

    def cut(self) -> None:
        """Every connection ends, as when the server's process does."""
        for link in list(self._links):
            link.end(reset=False)

    def reset(self) -> None:
        """Every connection is reset, as when a machine between forgot it."""
        for link in list(self._links):
            link.end(reset=True)

    def refuse(self, *, refusing: bool = True) -> None:
        """New connections are closed before a byte is said."""
        self._refusing = refusing

    def stall(self) -> None:
        """Not a byte goes through any more, and nobody is told."""
        self._flowing.clear()

    def flow(self) -> None:
        self._flowing.set()

    def dribble(self, chunk_bytes: int) -> None:
        """Everything goes through, so many bytes at a time."""
        self.chunk_bytes = chunk_bytes

    # --- faults to come ---------------------------------------------------------------------------------------

    def cut_before(self, said: bytes) -> None:
        """The next time the client says this the server does not hear it, and the connection ends."""
        self._arm(said, lambda link: link.end(reset=False))

    def swallow_reply_to(self, said: bytes) -> None:
        """The next time the client says this the server does it, and the connection ends instead of its answer."""
        self._arm(said, _Link.swallow)

    def falsify(self, said: bytes, heard: bytes) -> None:
        """Whatever the server says, the client hears the one instead of the other."""
        assert len(said) == len(heard), "the length of a message stands before it"
        self._lie = said, heard

    def cut_after_bytes(self, count: int) -> None:
        """The connection ends in the middle of whatever the client says, after so many bytes of it."""
        self._budget = count

    def _arm(self, said: bytes, act: Callable[[_Link], None]) -> None:
        self._pattern, self._seen = said, act

    # --- faults of every kind ---------------------------------------------------------------------------------

    async def trouble(self, rng: random.Random, *, pause_s: float) -> NoReturn:
        """One fault after the other, so long apart on average, until it is cancelled. `made` counts them."""
        lasting: dict[str, Callable[[], None]] = {
            "stall": self.stall,
            "refuse": self.refuse,
            "dribble": lambda: self.dribble(rng.randrange(16, 512)),
        }
        at_once: dict[str, Callable[[], None]] = {
            "cut": self.cut,
            "reset": self.reset,
            "lose the request to commit": lambda: self.cut_before(b"COMMIT"),
            "lose the reply to a commit": lambda: self.swallow_reply_to(b"COMMIT"),
            "cut inside": lambda: self.cut_after_bytes(rng.randrange(1, 40_000)),
        }
        try:
            while True:
                await asyncio.sleep(rng.random() * 2 * pause_s)
                kind, begin = rng.choice([*lasting.items(), *at_once.items()])
                self.made[kind] += 1
                begin()
                if kind in lasting:
                    await asyncio.sleep(rng.random() * 2 * pause_s)
                    if rng.random() < 0.5:
                        self.reset()
                    self.heal()
        finally:
            self.heal()

    def heal(self) -> None:
        """No fault now and none to come."""
        self._pattern = self._budget = None
        self._lie = (b"", b"")
        self._refusing = False
        self.chunk_bytes = _CHUNK
        self.flow()

    # --- what a link asks -------------------------------------------------------------------------------------

    def heard(self, link: _Link, chunk: bytes) -> bytes:
        """What of the client's bytes is passed on; may end the link."""
        self.said += 1
        if self._pattern is not None and self._pattern in chunk:
            self._pattern = None
            self.faults += 1
            self._seen(link)
        if self._budget is not None:
            if len(chunk) >= self._budget:
                chunk, self._budget = chunk[: self._budget], None
                self.faults += 1
                link.last = True
            else:
                self._budget -= len(chunk)
        return chunk

    def passed_on(self, chunk: bytes) -> bytes:
        """What the client hears of the server's bytes."""
        said, heard = self._lie
        return chunk.replace(said, heard) if said else chunk

    async def flowing(self) -> None:
        await self._flowing.wait()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        if self._refusing:
            writer.close()
            return
        try:
            upstream = await asyncio.open_unix_connection(str(self._server_socket))
        except OSError:  # the server is down
            writer.close()
            return
        link = _Link(self, (reader, writer), upstream)
        self._links.add(link)
        try:
            await link.run()
        finally:
            self._links.discard(link)


class _Link:
    """One connection, both ways."""

    def __init__(
        self,
        proxy: Proxy,
        client: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        server: tuple[asyncio.StreamReader, asyncio.StreamWriter],
    ) -> None:
        self._proxy = proxy
        self._client = client
        self._server = server
        self._swallowing = False
        self.last = False

    async def run(self) -> None:
        ways = [asyncio.create_task(self._up()), asyncio.create_task(self._down())]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            self.end(reset=False)

    def swallow(self) -> None:
        self._swallowing = True

    def end(self, *, reset: bool) -> None:
        for _, writer in (self._client, self._server):
            if reset:
                own: socket.socket = writer.get_extra_info("socket")
                with contextlib.suppress(OSError):
                    own.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            with contextlib.suppress(RuntimeError):
                writer.transport.abort() if reset else writer.close()

    async def _up(self) -> None:
        while chunk := await self._client[0].read(self._proxy.chunk_bytes):
            await self._proxy.flowing()
            passed = self._proxy.heard(self, chunk)
            if self._client[1].is_closing():
                return
            self._server[1].write(passed)
            await self._server[1].drain()
            if self.last:
                return

    async def _down(self) -> None:
        while chunk := await self._server[0].read(self._proxy.chunk_bytes):
            await self._proxy.flowing()
            if self._swallowing:
                return
            self._client[1].write(self._proxy.passed_on(chunk))
            await self._client[1].drain()


@asynccontextmanager
async def proxy_before(server: Server) -> AsyncIterator[Proxy]:
    """A proxy before this server, in the running loop."""
    proxy = Proxy(server.folder / ".s.PGSQL.5432")
    listening = await asyncio.start_server(proxy._accept, "127.0.0.1", 0)
    proxy.port = listening.sockets[0].getsockname()[1]
    try:
        yield proxy
    finally:
        listening.close()
        proxy.flow()
        proxy.reset()
        await asyncio.sleep(0)
        await listening.wait_closed()
