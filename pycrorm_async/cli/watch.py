"""Follow running episodes live, on a page or in the terminal.

Panel: Look at episodes, 3.
"""

from __future__ import annotations

import asyncio
import signal
import sys
import time
import webbrowser
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from pycrorm_async.cli.output import JsonOption, note, print_json, print_line, stdout
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.cli.show import tree_lines
from pycrorm_async.errors import CallerError, DatabaseUnavailable, UnknownEpisode
from pycrorm_async.live.access import kept_token
from pycrorm_async.live.follower import LogFollower, wait_unless
from pycrorm_async.query.replay import EpisodeReplay
from pycrorm_async.query.snapshot import Moment, NodeThen, moment_of
from pycrorm_async.store.log import episode_named
from pycrorm_async.store.stored import EpisodeRow
from pycrorm_async.visible_text import visible


def watch(
    *,
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
    place: ReadingPlace,
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
    memory = place.place
    follower = LogFollower(memory.shared_address, place.replica)
    memory.note_pending_events()
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
    from pycrorm_async.live.server import (
        LiveServer,
        listen,  # needs the extra `live`
    )

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
        if not await log.last_number():
            note(f"{follower.address} has no episode yet: waiting for the first.")
        elif episode is not None:
            await episode_named(log, episode)
    except DatabaseUnavailable as error:
        note(f"waiting: {error}")


# === terminal view ============================================================================================
#
# Draw running episodes in the terminal: one with its task tree, or all of them with their present actions.

_INTERVAL_S = 0.1
"""The pause in s between two pictures."""
_SHARE = 4
"""Drawing takes at most one part in this many of the time, also for a long tree."""
_HEAD_LINES = 6
"""The lines of the terminal that the tree leaves for the rest of the picture."""
_LISTED_ENDED = 10
"""Bounds the ended episodes that are listed below the running ones."""
_SIGNS = {"RUNNING": "cyan", "SUCCEEDED": "green", "LOST": "yellow", "INTERRUPTED": "yellow", "UNKNOWN": "yellow"}


async def draw_episode(follower: LogFollower, name: str, stop: asyncio.Event) -> None:
    """Draw an episode until it has ended; wait while the database is unavailable.

    Raises `UnknownEpisode`, `LogDamaged`, `DatabaseForeign`.
    """
    with _live() as live:
        begun = await _wait_for(follower, name, live, stop)
        drawing = _Drawing(follower, begun, live) if begun is not None else None
        while drawing is not None and not stop.is_set():
            began = time.monotonic()
            try:
                if await drawing.draw():
                    return
            except DatabaseUnavailable as error:
                live.update(Text(visible(f"waiting: {error}")), refresh=True)
            await wait_unless(stop, asyncio.sleep(max(_INTERVAL_S, _SHARE * (time.monotonic() - began))))


class _Drawing:
    """An episode as far as it was read, and the picture of it."""

    def __init__(self, follower: LogFollower, begun: EpisodeRow, live: Live) -> None:
        self._follower = follower
        self._live = live
        self._identity = begun.identity
        self._replay = EpisodeReplay(begun, follower.address)

    async def draw(self) -> bool:
        """Read the new events and draw them; return whether the episode has ended."""
        log, replay = await self._follower.log(), self._replay
        row = await log.episode(self._identity)
        if row is None:
            raise UnknownEpisode(f"{self._follower.address} no longer has episode {replay.number}")
        if row.head > replay.at.sequence:
            replay.dtypes = await log.dtypes()
            async for page in log.pages(row, after=replay.at.sequence):
                for event in page:
                    replay.read(event)
            self._live.update(_picture(moment_of(replay), _lines()), refresh=True)
        return row.ended_wall_ns is not None


async def _wait_for(follower: LogFollower, name: str, live: Live, stop: asyncio.Event) -> EpisodeRow | None:
    while not stop.is_set():
        try:
            log = await follower.log()
            if await log.last_number():
                return await episode_named(log, name)
            live.update(Text(f"{follower.address} has no episode yet: waiting for the first."), refresh=True)
        except DatabaseUnavailable as error:
            live.update(Text(visible(f"waiting: {error}")), refresh=True)
        await wait_unless(stop, asyncio.sleep(_INTERVAL_S * 2))
    return None


def _lines() -> int:
    """Return the lines for the tree: those that the terminal leaves, or all of it in a pipe."""
    return stdout.height - _HEAD_LINES if stdout.is_terminal else sys.maxsize


@contextmanager
def _live() -> Iterator[Live]:
    """Draw in place; a pipe gets the last picture, with an end of its last line."""
    with Live(console=stdout, auto_refresh=False) as live:
        yield live
    if not stdout.is_terminal:
        stdout.line()


def _picture(moment: Moment, lines_max: int) -> RenderableType:
    head = Text(visible(f"Episode {moment.number}: {moment.description}"), style="bold")
    head.append(f"  {moment.status}", style=_SIGNS.get(moment.status, "red"))
    failed = sum(each.status in ("FAILED", "ERROR", "LOST") for each in moment.tree)
    facts = [f"{moment.time_s:.2f} s", f"event {moment.sequence}", f"{len(moment.tree)} nodes"]
    facts += [f"{failed} failed"] if failed else []
    for robot in moment.world.robots:
        x, y, _ = robot.pose.position
        facts.append(f"{robot.name} at ({x:.2f}, {y:.2f})")
    facts += [f"{each.child} moves with {each.parent}" for each in moment.world.attachments]
    shown = in_sight(moment.tree, lines_max)
    hidden = len(moment.tree) - len(shown)
    if hidden:
        facts.append(f"{hidden} nodes that have ended are not drawn")
    lines = [head, Text(visible("  " + " · ".join(facts)), style="dim"), *tree_lines(shown)]
    for line in lines[2:]:
        line.no_wrap, line.overflow = True, "ellipsis"
    return Group(*lines)


def in_sight(nodes: Sequence[NodeThen], lines_max: int) -> list[NodeThen]:
    """Return the nodes to draw on `lines_max` lines: the running ones, then the newest, each with all its parents."""
    by_id = {each.id: each for each in nodes}
    kept: set[int] = set()
    newest = sorted(nodes, key=lambda each: (each.status != "RUNNING", -each.sequence))
    for node in newest:
        path: list[int] = []
        above: NodeThen | None = node
        while above is not None and above.id not in kept:
            path.append(above.id)
            above = by_id.get(above.parent_id) if above.parent_id is not None else None
        if kept and len(kept) + len(path) > max(lines_max, 1):
            break
        kept.update(path)
    return [each for each in nodes if each.id in kept]


async def draw_overview(follower: LogFollower, stop: asyncio.Event) -> None:
    """Draw the present action of each running episode, and the newest ended episodes, until stopped."""
    overview = follower.overview
    with _live() as live:
        async with follower.listening(overview):
            while not stop.is_set():
                turn = follower.turn
                overview = follower.overview  # another one if the database was replaced
                live.update(_table(follower), refresh=True)
                await wait_unless(stop, follower.changed_since(turn, 1.0))
                await wait_unless(stop, asyncio.sleep(_INTERVAL_S))


def _table(follower: LogFollower) -> RenderableType:
    entries = follower.overview.entries(0)
    running = [each for each in entries if each["status"] == "RUNNING"]
    ended = [each for each in entries if each["status"] != "RUNNING"][-_LISTED_ENDED:]
    table = Table(title=f"Episodes of {follower.address}", title_justify="left", title_style="bold")
    for name in ("episode", "robot", "does now", "nodes", "failed", "description"):
        table.add_column(name, justify="right" if name in ("episode", "nodes", "failed") else "left")
    for each in [*running, *reversed(ended)]:
        now = each["status"]
        if each["status"] == "RUNNING":
            now = " > ".join(each["now"]) or f"after {each['after']}" if each["now"] or each["after"] else "begins"
        cells = (each["number"], ", ".join(each["robots"]), now, each["nodes"], each["failed"], each["description"])
        table.add_row(*(escape(str(cell)) for cell in cells), style=None if each in running else "dim")
    if follower.fault is not None:
        return Group(Text(visible(f"waiting: {follower.fault}"), style="yellow"), table)
    return table if entries else Group(Text("No episode runs; waiting for the next."), table)
