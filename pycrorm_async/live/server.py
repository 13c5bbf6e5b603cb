"""Serve the live pages on the loopback address: the list of episodes, each episode, and their streams of events.

    /TOKEN/                            the list of episodes
    /TOKEN/events                      its stream
    /TOKEN/episode/NAME[?from=N]       an episode by number, id or `last`, from its event N on
    /TOKEN/episode/NAME/events         its stream, behind the event in `Last-Event-ID` or `?after=`

A page has the events up to its loading, and its stream brings the rest in parts (`text/event-stream`). The id of a part
is its last event, so a browser that lost the connection continues behind it, also with a server started again.
"""

import asyncio
import html
import math
import socket
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import nullcontext
from errno import EACCES, EADDRINUSE
from typing import Any

import msgspec

from pycrorm_async import __version__
from pycrorm_async.errors import CallerError, MissingExtra, PycrormError, UnknownEpisode
from pycrorm_async.live.access import HEADERS, refusal
from pycrorm_async.live.follower import OUTCOMES_S, EpisodeFeed, LogFollower, wait_unless
from pycrorm_async.report.overview import overview_page_of
from pycrorm_async.report.write import page_of

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response, StreamingResponse
    from starlette.routing import Route
    from starlette.types import ASGIApp, Message, Receive, Scope, Send
except ImportError as missing:
    install = "pip install 'pycrorm-async[live]'"
    raise MissingExtra(f"the live page needs Starlette and uvicorn ({missing}): {install}") from None

PORT = 8137
"""The default port; it is fixed so that a bookmarked address stays valid."""
_ALIVE_S = 2.0
"""The longest silence of a stream; a page that receives nothing for four times as long has lost the server."""
_LIST_INTERVAL_S = 0.25
"""The shortest time between two parts of the list, whose text changes with every node of every robot."""
_STOP_S = 1
"""Bounds the wait for browsers that do not read when the server stops."""
_DIGITS_END = 16
"""The number of digits from which on a number in a request is ignored; fewer fit into a 64-bit integer."""
_WAITING = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="refresh" content="2">
<meta name="color-scheme" content="light dark"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'"><title>waiting</title></head>
<body><h1>Waiting for the memory</h1><p>{reason}</p><p>This page loads again every two seconds.</p></body></html>
"""
"""The page of an episode that cannot be read at the moment."""


def listen(port: int | None) -> socket.socket:
    """Open the port on the loopback address; by default `PORT`, or any free one if another process uses that.

    Raises `CallerError` if the requested port cannot be used.
    """
    try:
        return socket.create_server(("127.0.0.1", PORT if port is None else port))
    except OSError as error:
        if error.errno == EADDRINUSE and port is None:
            return socket.create_server(("127.0.0.1", 0))
        reason = {EADDRINUSE: "another process uses it", EACCES: "this user may not"}.get(error.errno or 0, str(error))
        raise CallerError(f"port {port} cannot be used ({reason}): give another, or leave out --port") from None


class LiveServer:
    """Serves the episodes that a follower reads, at an address with a token."""

    def __init__(self, follower: LogFollower, token: str) -> None:
        self._follower = follower
        self._token = token
        self._stopping = asyncio.Event()

    async def serve(self, listener: socket.socket, *, stop: asyncio.Event, ready: Callable[[], None]) -> None:
        """Serve until `stop` is set; `ready` is called when the server answers."""
        config = uvicorn.Config(
            self.application(),
            log_config=None,
            log_level="critical",
            access_log=False,
            lifespan="off",
            loop="asyncio",
            http="h11",
            ws="none",
            proxy_headers=False,
            server_header=False,
            timeout_graceful_shutdown=_STOP_S,
        )
        server = _PageServer(config)

        async def stop_server() -> None:
            await stop.wait()
            self._stopping.set()
            server.should_exit = True

        async with asyncio.TaskGroup() as tasks:
            following = tasks.create_task(self._follower.run(), name="follow the log")
            stopping = tasks.create_task(stop_server(), name="stop the server")
            listener.setblocking(False)  # noqa: FBT003  a positional argument of the standard library
            ready()
            await server.serve(sockets=[listener])
            stopping.cancel()
            following.cancel()

    def application(self) -> ASGIApp:
        """Return the ASGI application."""
        prefix = f"/{self._token}"
        routes = [
            Route(f"{prefix}/", self._list, methods=["GET"]),
            Route(f"{prefix}/events", self._list_stream, methods=["GET"]),
            Route(f"{prefix}/episode/{{name}}", self._episode, methods=["GET"]),
            Route(f"{prefix}/episode/{{name}}/events", self._episode_stream, methods=["GET"]),
        ]
        return _Guard(Starlette(routes=routes), self._token)

    # --- pages ------------------------------------------------------------------------------------------------

    async def _list(self, _request: Request) -> Response:
        document: Mapping[str, Any] = {"title": "Episodes", "total": 0, "episodes": []}
        try:
            document = await self._follower.overview.document(await self._follower.log())
        except PycrormError as error:
            self._follower.fault = str(error)  # the page waits and shows it
        live = {"stream": f"/{self._token}/events", "database": str(self._follower.address)}
        return await _html(overview_page_of, {**document, "live": live})

    async def _episode(self, request: Request) -> Response:
        name, first = request.path_params["name"], _number(request.query_params.get("from"), 1)
        try:
            feed = await self._follower.feed(name, first)
            if feed.fault is not None and feed.last == 0:
                return PlainTextResponse(feed.fault, 500)
            if feed.last < first:
                reason = f"episode {feed.number} has {feed.last} events, and none from event {first}"
                return PlainTextResponse(reason, 404)
            document = await feed.document(await self._follower.log())
        except UnknownEpisode as error:
            if name == "last":
                return RedirectResponse(f"/{self._token}/")
            if await self._waits_for_first_episode():
                return HTMLResponse(_WAITING.format(reason=html.escape(str(error))), 503)
            return PlainTextResponse(str(error), 404)
        except PycrormError as error:
            return HTMLResponse(_WAITING.format(reason=html.escape(str(error))), 503)
        stream = f"/{self._token}/episode/{feed.number}/events?from={first}&id={feed.id}"
        live = {"stream": stream, "list": f"/{self._token}/", "page": f"/{self._token}/episode/"}
        return await _html(page_of, {**document, "live": live})

    async def _waits_for_first_episode(self) -> bool:
        try:
            return not await (await self._follower.log()).last_number()
        except PycrormError:
            return True

    # --- streams ----------------------------------------------------------------------------------------------

    async def _list_stream(self, _request: Request) -> Response:
        return _stream(self._list_parts())

    async def _list_parts(self) -> AsyncIterator[str]:
        follower, since = self._follower, 0
        overview, epoch = follower.overview, follower.epoch
        async with follower.listening(overview):
            async for _ in self._turns():
                if follower.epoch != epoch:
                    yield _message("reload", {})
                    return
                turn = overview.turn
                if turn > since:
                    yield _message("part", {"episodes": overview.entries(since)})
                    since = turn
                yield self._state(None)
                await wait_unless(self._stopping, asyncio.sleep(_LIST_INTERVAL_S))

    async def _episode_stream(self, request: Request) -> Response:
        first, query = _number(request.query_params.get("from"), 1), request.query_params
        after = _number(request.headers.get("last-event-id"), _number(query.get("after"), 0))
        try:
            feed = await self._follower.feed(request.path_params["name"], first)
        except PycrormError as error:
            return PlainTextResponse(str(error), 503)  # the page tries again
        is_other = query.get("id", feed.id) != feed.id or after > feed.last
        return _stream(_reload() if is_other else self._episode_parts(feed, after))

    async def _episode_parts(self, feed: EpisodeFeed, after: int) -> AsyncIterator[str]:
        follower, epoch = self._follower, self._follower.epoch
        judged, asked_s = 0, -math.inf
        async with follower.listening(feed):
            async for _ in self._turns():
                if follower.epoch != epoch:
                    yield _message("reload", {})
                    return
                if feed.last > after:
                    part = await feed.document(await follower.log(), after)
                    after = part["episode"]["last"]
                    yield _message("part", part, after)
                if after > judged and time.monotonic() > asked_s + OUTCOMES_S:
                    asked_s = time.monotonic()
                    outcomes = await follower.overview.outcomes(await follower.log(), feed.number)
                    if outcomes is not None:
                        judged = after
                        yield _message("outcomes", outcomes)
                yield self._state(feed.fault)

    async def _turns(self) -> AsyncIterator[None]:
        """Yield at once, then after each turn in which something changed and at least every two seconds, until stopped.

        A stream writes at each of them, and so notices that its browser has left.
        """
        while not self._stopping.is_set():
            turn = self._follower.turn
            yield
            await wait_unless(self._stopping, self._follower.changed_since(turn, _ALIVE_S))

    def _state(self, fault: str | None) -> str:
        follower = self._follower
        return _message("state", {"version": __version__, "fault": follower.fault or fault, "began": follower.began})


async def _reload() -> AsyncIterator[str]:
    yield _message("reload", {})


def _message(kind: str, values: Mapping[str, Any], number: int | None = None) -> str:
    identity = "" if number is None else f"id: {number}\n"
    return f"{identity}event: {kind}\ndata: {msgspec.json.encode(values).decode()}\n\n"


def _stream(parts: AsyncIterator[str]) -> Response:
    return StreamingResponse(parts, media_type="text/event-stream")


async def _html(page: Callable[[Mapping[str, Any]], str], document: Mapping[str, Any]) -> Response:
    return HTMLResponse(await asyncio.to_thread(page, document))


def _number(text: str | None, otherwise: int) -> int:
    return (
        int(text) if text is not None and text.isascii() and text.isdigit() and len(text) < _DIGITS_END else otherwise
    )


class _Guard:
    """Answers requests that `refusal` refuses, and adds the headers of every answer."""

    def __init__(self, application: ASGIApp, token: str) -> None:
        self._application = application
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                added = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", ()), *added]}
            await send(message)

        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope.get("headers", ())}
        reason = refusal(scope["path"], headers, self._token)
        application = self._application if reason is None else PlainTextResponse(f"{reason}\n", 403)
        await application(scope, receive, send_with_headers)


class _PageServer(uvicorn.Server):
    """A server whose owner handles the signals."""

    def capture_signals(self) -> nullcontext[None]:  # type: ignore[override]  # any context manager serves
        return nullcontext()
