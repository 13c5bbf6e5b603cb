"""Draw running episodes in the terminal: one with its task tree, or all of them with their present actions."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from pycrorm_async.cli.output import stdout
from pycrorm_async.cli.tree import tree_of
from pycrorm_async.errors import DatabaseUnavailable, UnknownEpisode
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.live.follower import LogFollower
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.query.as_of import unreadable
from pycrorm_async.query.snapshot import Moment, NodeThen
from pycrorm_async.query.snapshot_fold import MomentFold
from pycrorm_async.store.episode_lookup import episode_named
from pycrorm_async.store.stored import EpisodeRow

_INTERVAL_S = 0.1
"""The pause in s between two pictures."""
_SHARE = 4
"""Drawing takes at most one part in this many of the time, also for a long tree."""
_HEAD_LINES = 6
"""The lines of the terminal that the tree leaves for the rest of the picture."""
_LISTED_ENDED = 10
"""Bounds the ended episodes that are listed below the running ones."""
_SIGNS = {"RUNNING": "cyan", "SUCCEEDED": "green", "LOST": "yellow", "INTERRUPTED": "yellow"}


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
                live.update(Text(f"waiting: {error}"), refresh=True)
            await _rest(stop, max(_INTERVAL_S, _SHARE * (time.monotonic() - began)))


class _Drawing:
    """An episode as far as it was read, and the picture of it."""

    def __init__(self, follower: LogFollower, begun: EpisodeRow, live: Live) -> None:
        self._follower = follower
        self._live = live
        self._identity = parse_episode_id(begun.id)
        self._fold = MomentFold(begun.number, begun.id)
        self._last = 0

    async def draw(self) -> bool:
        """Read the new events and draw them; return whether the episode has ended."""
        log = await self._follower.log()
        row = await log.episode(self._identity)
        if row is None:
            raise UnknownEpisode(f"{self._follower.address} no longer has episode {self._fold.number}")
        if row.head > self._last:
            dtypes = await log.dtypes()
            async for page in log.pages(row, after=self._last):
                for event in page:
                    try:
                        self._fold.read(event)
                    except CannotFold as reason:
                        raise unreadable(row.id, event, str(reason), log) from None
                    self._last = event.sequence
            self._live.update(_picture(self._fold.moment(dtypes, {}, {}), _lines()), refresh=True)
        return row.ended_wall_ns is not None


async def _wait_for(follower: LogFollower, name: str, live: Live, stop: asyncio.Event) -> EpisodeRow | None:
    while not stop.is_set():
        try:
            log = await follower.log()
            if await log.episodes():
                return await episode_named(log, name)
            live.update(Text(f"{follower.address} has no episode yet: waiting for the first."), refresh=True)
        except DatabaseUnavailable as error:
            live.update(Text(f"waiting: {error}"), refresh=True)
        await _rest(stop, _INTERVAL_S * 2)
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
    head = Text.from_markup(f"[bold]Episode {moment.number}: {escape(moment.description)}[/]")
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
    return Group(head, Text("  " + " · ".join(facts), style="dim"), tree_of(shown, no_wrap=True) or Text(""))


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
                waiting = asyncio.ensure_future(follower.changed_since(turn, 1.0))
                stopping = asyncio.ensure_future(stop.wait())
                await asyncio.wait([waiting, stopping], return_when=asyncio.FIRST_COMPLETED)
                for each in (waiting, stopping):
                    each.cancel()
                await _rest(stop, _INTERVAL_S)


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
        return Group(Text(f"waiting: {follower.fault}", style="yellow"), table)
    return table if entries else Group(Text("No episode runs; waiting for the next."), table)


async def _rest(stop: asyncio.Event, seconds: float) -> None:
    try:
        async with asyncio.timeout(seconds):
            await stop.wait()
    except TimeoutError:
        pass
