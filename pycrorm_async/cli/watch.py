"""`pycrorm watch` serves the live page of an episode, or of all of them, on this machine; or draws in the terminal."""

from __future__ import annotations

import asyncio
import signal
import webbrowser
from collections.abc import Coroutine
from typing import Annotated, Any

import typer

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import note, print_json, print_line, stdout
from pycrorm_async.cli.pending_events import note_pending_events
from pycrorm_async.cli.terminal_view import draw_episode, draw_overview
from pycrorm_async.errors import CallerError, DatabaseUnavailable
from pycrorm_async.live.access import kept_token
from pycrorm_async.live.follower import LogFollower
from pycrorm_async.operations.destination import shared_address
from pycrorm_async.store.episode_lookup import episode_named


def watch(
    episode: Annotated[
        str | None,
        typer.Argument(help="The episode's number, its id or first digits of the id, or `last`; default: all of them."),
    ] = None,
    terminal: Annotated[bool, typer.Option("--terminal", help="Draw in this terminal instead of a page.")] = False,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port of the page; default: 8137, or a free one if that is in use."),
    ] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Open the page in this machine's browser.")] = False,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,
) -> None:
    """Follow running episodes live: the page of the report, served on this machine and read-only, until Ctrl-C.

    Prints the address, which has a token: only a browser on this machine that knows it gets the page. From another
    machine, open a tunnel: `ssh -L 8137:localhost:8137 ROBOT`. Without EPISODE the page lists the present activity of
    each robot and leads to each episode. It waits for a memory that has no episode yet. --json prints the address as
    one document.
    """
    if terminal and (port is not None or open_it or as_json):
        raise CallerError("--terminal serves no page: leave out --port, --open and --json")
    address = shared_address(url)
    note_pending_events(url, spool)
    follower = LogFollower(address)
    follow = _draw(follower, episode) if terminal else _serve(follower, episode, port, open_it=open_it, as_json=as_json)
    asyncio.run(_closed_after(follower, follow))


async def _closed_after(follower: LogFollower, following: Coroutine[Any, Any, None]) -> None:
    try:
        await following
    finally:
        await follower.close()


def _stop_at_signals() -> asyncio.Event:
    """Return an event that Ctrl-C and SIGTERM set."""
    stop = asyncio.Event()
    for each in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(each, stop.set)
    return stop


async def _draw(follower: LogFollower, episode: str | None) -> None:
    await _check(follower, episode)
    stop = _stop_at_signals()
    try:
        async with asyncio.TaskGroup() as tasks:
            following = tasks.create_task(follower.run(), name="follow the log")
            await (draw_overview(follower, stop) if episode is None else draw_episode(follower, episode, stop))
            following.cancel()
    except ExceptionGroup as errors:  # the command reports one error in one line
        raise errors.exceptions[0] from None


async def _serve(follower: LogFollower, episode: str | None, port: int | None, *, open_it: bool, as_json: bool) -> None:
    from pycrorm_async.live.server import LiveServer, listen  # needs the extra `live`

    await _check(follower, episode)
    token = kept_token()
    with listen(port) as listener:
        used = listener.getsockname()[1]
        path = f"episode/{episode}" if episode is not None else ""
        location = f"http://127.0.0.1:{used}/{token}/{path}"

        def announce() -> None:
            if as_json:
                print_json({"address": location, "port": used, "database": follower.address.to_type})
                stdout.file.flush()
            else:
                print_line(location)
                note("Only browsers on this machine that know this address get the page. Ctrl-C stops the server.")
            if open_it and not webbrowser.open(location):
                note("No browser could be opened: open the address in one.")

        await LiveServer(follower, token).serve(listener, stop=_stop_at_signals(), ready=announce)


async def _check(follower: LogFollower, episode: str | None) -> None:
    """Raise `UnknownEpisode` for a wrong name, and database errors that do not pass by waiting."""
    try:
        log = await follower.log()
        if not await log.episodes():
            note(f"{follower.address} has no episode yet: waiting for the first.")
        elif episode is not None:
            await episode_named(log, episode)
    except DatabaseUnavailable as error:
        note(f"waiting: {error}")
