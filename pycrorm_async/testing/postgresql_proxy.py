"""A TCP proxy before a PostgreSQL server makes the faults of a network: cuts, resets, stalls, lost replies.

    async with proxy_before(Path("/run/postgresql")) as proxy:
        async with Memory.open(proxy.url("memory")) as memory:
            proxy.cut()

The proxy copies bytes and does not know the protocol: a test arms a fault with a pattern of bytes that the client
sends, or with a number of bytes.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
from collections import Counter
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from urllib.parse import quote

__all__ = ["Proxy", "proxy_before"]

_CHUNK = 1 << 16
"""Bounds the bytes that are read at once."""


class Proxy:
    """Accepts TCP connections and opens a connection to the server for each.

    Attributes:
        port: of the proxy, on 127.0.0.1.
        connections: number of connections accepted so far.
        requests: number of pieces of bytes received from clients.
        faults: number of armed faults that happened.
        made: faults that `trouble` made, by kind.
    """

    def __init__(self, server_socket: Path) -> None:
        self.port = 0
        self.connections = 0
        self.requests = 0
        self.faults = 0
        self.made: Counter[str] = Counter()
        self.chunk_bytes = _CHUNK
        self._server_socket = server_socket
        self._refusing = False
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._links: set[_Link] = set()
        self._pattern: bytes | None = None
        self._act: Callable[[_Link], None] = lambda _link: None
        self._budget: int | None = None
        self._replacement = (b"", b"")

    def url(self, database: str, *, user: str = "postgres", password: str = "") -> str:
        who = f"{user}:{quote(password, safe='')}" if password else user
        return f"postgresql://{who}@127.0.0.1:{self.port}/{database}"

    # --- faults now -------------------------------------------------------------------------------------------

    def cut(self) -> None:
        """Close every connection, as a server does whose process ends."""
        for link in list(self._links):
            link.end(reset=False)

    def reset(self) -> None:
        """Reset every connection, as a router does that lost its state."""
        for link in list(self._links):
            link.end(reset=True)

    def refuse(self, *, refusing: bool = True) -> None:
        """Close new connections before a byte is copied."""
        self._refusing = refusing

    def stall(self) -> None:
        """Copy no more bytes, and leave all connections open."""
        self._flowing.clear()

    def flow(self) -> None:
        """Copy bytes again."""
        self._flowing.set()

    def dribble(self, chunk_bytes: int) -> None:
        """Copy at most this many bytes at a time."""
        self.chunk_bytes = chunk_bytes

    # --- faults to come ---------------------------------------------------------------------------------------

    def cut_before(self, pattern: bytes) -> None:
        """Close the connection when a client sends this for the first time; the server does not receive it."""
        self._arm(pattern, lambda link: link.end(reset=False))

    def swallow_reply_to(self, pattern: bytes) -> None:
        """Let the server execute this when a client sends it for the first time, and close before the reply."""
        self._arm(pattern, _Link.swallow)

    def falsify(self, original: bytes, replacement: bytes) -> None:
        """Replace one sequence of bytes in everything the server sends by another of the same length."""
        assert len(original) == len(replacement), "a message begins with its length, so the replacement must be as long"
        self._replacement = original, replacement

    def cut_after_bytes(self, count: int) -> None:
        """Close the connection after the client has sent this many more bytes, even in the middle of a message."""
        self._budget = count

    def _arm(self, pattern: bytes, act: Callable[[_Link], None]) -> None:
        self._pattern, self._act = pattern, act

    # --- faults of every kind ---------------------------------------------------------------------------------

    async def trouble(self, rng: random.Random, *, pause_s: float) -> NoReturn:
        """Make faults of every kind, `pause_s` seconds apart on average, until cancelled. `made` counts them."""
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
        """End the present fault and disarm all others."""
        self._pattern = self._budget = None
        self._replacement = (b"", b"")
        self._refusing = False
        self.chunk_bytes = _CHUNK
        self.flow()

    # --- called by a link -------------------------------------------------------------------------------------

    def from_client(self, link: _Link, chunk: bytes) -> bytes:
        """Return the part of a client's bytes that reaches the server; may end the link."""
        self.requests += 1
        if self._pattern is not None and self._pattern in chunk:
            self._pattern = None
            self.faults += 1
            self._act(link)
        if self._budget is not None:
            if len(chunk) >= self._budget:
                chunk, self._budget = chunk[: self._budget], None
                self.faults += 1
                link.last = True
            else:
                self._budget -= len(chunk)
        return chunk

    def from_server(self, chunk: bytes) -> bytes:
        """Return the bytes that the client receives in place of the server's."""
        original, replacement = self._replacement
        return chunk.replace(original, replacement) if original else chunk

    async def flowing(self) -> None:
        """Wait while the proxy is stalled."""
        await self._flowing.wait()

    async def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        try:
            if self._refusing:
                raise ConnectionRefusedError
            upstream = await asyncio.open_unix_connection(str(self._server_socket))
        except OSError:  # also of a server that is down
            writer.close()
            return
        link = _Link(self, (reader, writer), upstream)
        self._links.add(link)
        try:
            await link.run()
        finally:
            self._links.discard(link)


@dataclass(eq=False)
class _Link:
    """One connection, in both directions."""

    proxy: Proxy
    client: tuple[asyncio.StreamReader, asyncio.StreamWriter]
    server: tuple[asyncio.StreamReader, asyncio.StreamWriter]
    swallowing: bool = False
    last: bool = False

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
        self.swallowing = True

    def end(self, *, reset: bool) -> None:
        for _, writer in (self.client, self.server):
            if reset:
                own: socket.socket = writer.get_extra_info("socket")
                with contextlib.suppress(OSError):
                    own.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            with contextlib.suppress(RuntimeError):
                writer.transport.abort() if reset else writer.close()

    async def _up(self) -> None:
        while chunk := await self.client[0].read(self.proxy.chunk_bytes):
            await self.proxy.flowing()
            passed = self.proxy.from_client(self, chunk)
            if self.client[1].is_closing():
                return
            self.server[1].write(passed)
            await self.server[1].drain()
            if self.last:
                return

    async def _down(self) -> None:
        while chunk := await self.server[0].read(self.proxy.chunk_bytes):
            await self.proxy.flowing()
            if self.swallowing:
                return
            self.client[1].write(self.proxy.from_server(chunk))
            await self.client[1].drain()


@contextlib.asynccontextmanager
async def proxy_before(socket_folder: Path) -> AsyncIterator[Proxy]:
    """Run a proxy, in the running loop, before the PostgreSQL server whose Unix socket is in this folder."""
    proxy = Proxy(socket_folder / ".s.PGSQL.5432")
    listening = await asyncio.start_server(proxy.accept, "127.0.0.1", 0)
    proxy.port = listening.sockets[0].getsockname()[1]
    try:
        yield proxy
    finally:
        listening.close()
        proxy.flow()
        proxy.reset()
        await asyncio.sleep(0)
        await listening.wait_closed()
