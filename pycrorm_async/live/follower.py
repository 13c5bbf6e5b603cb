"""Read new events of the log as they are stored, for any number of pages that follow one episode or all of them.

Theory of operation. One task, `LogFollower.run`, asks the log every 100 ms which episodes have grown, as long as a page
listens, and folds the new events of those that are followed: each `EpisodeFeed` once, however many pages show it. After
each turn it wakes the listeners, and each takes the part of the document behind the event that it has sent last. A feed
has a lock, because a part must not be taken while events are folded. The log is only read. If the database does not
exist yet or does not answer, `fault` has the reason and the task tries again; if it was replaced, the feeds are thrown
away and `epoch` counts it, and the pages load again. A replica that does not answer counts as replaced, by the memory
itself; of one that is behind, `fault` has how far.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Awaitable, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, LogDamaged, PycrormError, TablesPending
from pycrorm_async.events import types as event_types
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX
from pycrorm_async.events.reasons import reason_of
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.projections.row_batch import CannotFold
from pycrorm_async.query.frames import TRIED
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import parameters_text, with_object_names
from pycrorm_async.report.document import EpisodePage, document_behind, read_into
from pycrorm_async.report.overview import (
    NO_REASON,
    OBJECTS_MAX,
    causes_of,
    commit_text,
    newest_episodes,
    overview_document,
)
from pycrorm_async.report.write import outcomes_of
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog, episode_named, grown_episodes, is_simulated
from pycrorm_async.store.replica import lag_line, open_to_read
from pycrorm_async.store.stored import EpisodeRow, StoredEvent

_INTERVAL_S = 0.1
"""The pause in s between two reads of the log."""
_RETRY_S = 0.5
"""Delays the next attempt if the database does not answer."""
_LAG_INTERVAL_S = 5.0
"""The time between two checks whether a replica is behind, each with a new connection to its primary."""
OUTCOMES_S = 1.0
"""The shortest time between two queries of the outcomes of failures, which need the tables and not the events."""
_FEEDS_MAX = 8
"""Bounds the folded episodes that are kept for pages without a listener, which load again or come back."""


class EpisodeFeed:
    """The page of an episode, from event `first` on, as far as its events were read.

    Attributes:
        listeners: number of pages that follow it.
        fault: why its events cannot be read any further, or None.
    """

    def __init__(self, row: EpisodeRow, address: DatabaseAddress, first: int) -> None:
        self.id, self.number = row.id, row.number
        self._page = EpisodePage(row, address, first)
        self._reading = asyncio.Lock()
        self.listeners = 0
        self.fault: str | None = row.refused

    @property
    def last(self) -> int:
        """The sequence of the last event that was read."""
        return self._page.at.sequence

    async def catch_up(self, log: EventLog, row: EpisodeRow) -> None:
        """Read the events that were stored since the last call."""
        async with self._reading:
            page = self._page
            page.row = row
            self.fault = row.refused or self.fault
            if page.is_full or row.head <= page.at.sequence or self.fault is not None:
                return
            try:
                await read_into(page, log, log.pages(row, after=page.at.sequence))
            except (LogDamaged, DatabaseForeign) as error:
                self.fault = str(error)
            except PycrormError:
                raise
            except Exception as error:  # noqa: BLE001  one episode must not end the server of all
                self.fault = f"its events cannot be shown: {type(error).__name__}: {error}"

    async def document(self, log: EventLog, after: int = 0) -> dict[str, Any]:
        """Return the document, or the part of it behind event `after`."""
        async with self._reading:
            return await document_behind(self._page, log, after)


class LogFollower:
    """Follows the log at an address, on its replica if one is given.

    Attributes:
        fault: why the log cannot be read at the moment, or how far the replica is behind; None if neither is so.
        turn: counts the turns in which something changed.
        epoch: counts how often the database was replaced.
        began: number of the newest episode, except simulations, that began while the log was followed; 0 without one.
        overview: the present activity of each episode.
    """

    def __init__(self, address: DatabaseAddress, replica: DatabaseAddress | None = None) -> None:
        self.address = address
        self._replica = replica
        self._is_lost = False
        self._lag: tuple[float, str | None] = -math.inf, None
        self.fault: str | None = None
        self.turn = 0
        self.epoch = 0
        self.began = 0
        self.overview = LiveOverview(address, replica)
        self._log: EventLog | None = None
        self._file: tuple[int, int] | None = None
        self._newest: int | None = None
        """Number of the newest episode, simulations included; None before the first turn."""
        self._feeds: dict[tuple[int, int], EpisodeFeed] = {}
        self._growing: set[int] = set()
        self._listeners = 0
        self._wanted = asyncio.Event()
        self._changed = asyncio.Condition()
        self._opening = asyncio.Lock()

    async def run(self) -> None:
        """Follow the log until cancelled; rest while nothing listens."""
        try:
            while True:
                await self._wanted.wait()
                fault = self.fault
                try:
                    changed = await self._take_turn()
                    self.fault = await self._lag_now()
                except (DatabaseUnavailable, DatabaseForeign) as error:
                    changed, self.fault = False, str(error)
                    self._is_lost = self._replica is not None
                if changed or fault != self.fault:
                    async with self._changed:
                        self.turn += 1
                        self._changed.notify_all()
                await asyncio.sleep(_INTERVAL_S if self.fault is None else _RETRY_S)
        finally:
            await self.close()

    async def close(self) -> None:
        """Close the connections to the database."""
        log, self._log = self._log, None
        await _close(self.overview, log)

    async def log(self) -> EventLog:
        """Return the open log. Raises `DatabaseUnavailable`, `DatabaseForeign`."""
        async with self._opening:
            file = self._identity()
            if self._log is not None and file == self._file and not self._is_lost:
                return self._log
            opened = await open_to_read(self.address, self._replica)  # fails as long as there is none
            former, self._log, self._file = self._log, opened, file  # before a wait, which may be cancelled
            self._is_lost = False
            if former is not None:
                overview, self.overview = self.overview, LiveOverview(self.address, self._replica)
                self._feeds.clear()
                self._growing.clear()
                self.began, self._newest = 0, None
                self.epoch += 1
                await _close(overview, former)
            return opened

    async def _lag_now(self) -> str | None:
        """Return the line about a replica that is behind, as of the last check."""
        checked_s, line = self._lag
        if self._replica is not None and time.monotonic() >= checked_s + _LAG_INTERVAL_S:
            line = await lag_line(await self.log(), self.address)
            self._lag = time.monotonic(), line
        return line

    def _identity(self) -> tuple[int, int] | None:
        """Return device and inode of a SQLite file, by which a file that replaces it differs."""
        if not self.address.is_sqlite:
            return None
        try:
            status = self.address.path.stat()
        except OSError:
            return None
        return status.st_dev, status.st_ino

    async def feed(self, name: str, first: int = 1) -> EpisodeFeed:
        """Return the feed of an episode, folded up to its last stored event. Raises `UnknownEpisode`."""
        log = await self.log()
        row = await episode_named(log, name)
        key = (row.number, first)
        feed = self._feeds.pop(key, None)
        if feed is None or feed.id != row.id or row.head < feed.last:
            feed = EpisodeFeed(row, self.address, first)
        self._feeds[key] = feed
        for idle in [each for each, other in self._feeds.items() if not other.listeners][:-_FEEDS_MAX]:
            del self._feeds[idle]
        await feed.catch_up(log, row)
        return feed

    @asynccontextmanager
    async def listening(self, followed: EpisodeFeed | LiveOverview) -> AsyncIterator[None]:
        """Keep the feed or the overview up to date inside the context."""
        followed.listeners += 1
        self._listeners += 1
        self._wanted.set()
        try:
            yield
        finally:
            followed.listeners -= 1
            self._listeners -= 1
            if self._listeners == 0:
                self._wanted.clear()

    async def changed_since(self, turn: int, timeout_s: float) -> bool:
        """Wait until a turn behind this one has changed something; return False after the timeout."""
        try:
            async with asyncio.timeout(timeout_s), self._changed:
                await self._changed.wait_for(lambda: self.turn > turn)
        except TimeoutError:
            return False
        return True

    async def _take_turn(self) -> bool:
        """Fold the events stored since the last turn; return whether there were any."""
        epoch, log = self.epoch, await self.log()
        if self._newest is None:
            self._newest = await log.last_number()
        rows = {each.number: each for each in await grown_episodes(log, above=self._newest, numbers=self._growing)}
        self._growing = {each.number for each in rows.values() if each.ended_wall_ns is None}
        added = [each for each in rows.values() if each.number > self._newest]
        for row in added:
            self._newest = row.number
            if not await is_simulated(log, row):
                self.began = row.number
        changed = epoch != self.epoch or bool(added)
        for feed in [each for each in self._feeds.values() if each.listeners]:
            if (grown := rows.get(feed.number)) is not None:
                before = feed.last, feed.fault
                await feed.catch_up(log, grown)
                changed = changed or before != (feed.last, feed.fault)
        if self.overview.listeners:
            changed = await self.overview.catch_up(log, rows.values()) or changed
        return changed


async def wait_unless(stop: asyncio.Event, waiting: Awaitable[Any]) -> None:
    """Wait until the awaitable ends or `stop` is set, whichever is first, and cancel the other wait."""
    tasks = [asyncio.ensure_future(waiting), asyncio.ensure_future(stop.wait())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for each in tasks:
            each.cancel()


async def _close(overview: LiveOverview, log: EventLog | None) -> None:
    try:
        await overview.close()
    finally:
        if log is not None:
            await log.close()


# === overview =================================================================================================
#
# Keep the list of episodes up to date: those that had ended from the tables, the others from their events.

_LISTED_MAX = 10_000
"""Bounds the episodes of the list that are read from the tables."""
_ENDED_MAX = 500
"""Bounds the activities that are kept of episodes that have ended meanwhile."""
_PAGE_EVENTS = 2_000
"""Bounds the events that are read at once."""


class LiveOverview:
    """The present activity of each running episode.

    Attributes:
        listeners: number of pages that follow it.
        turn: counts the turns in which an entry changed.
    """

    def __init__(self, address: DatabaseAddress, replica: DatabaseAddress | None) -> None:
        self.listeners = self.turn = 0
        self._reading = Reading(address, replica=replica)
        self._activities: dict[int, Activity] = {}
        self._changed_at: dict[int, int] = {}
        """The turn in which an episode's entry changed last, by its number."""
        self._folding = asyncio.Lock()
        self._unjudged: set[int] = set()
        """Numbers of the episodes whose failures may have other outcomes by now."""
        self._asked_s = -math.inf

    async def close(self) -> None:
        await self._reading.close()

    async def outcomes(self, log: EventLog, number: int) -> dict[str, str] | None:
        """Return the outcomes of an episode's failures; None while the tables do not show all its events."""
        is_behind = any(each.number == number for each in await log.behind())
        return None if is_behind else await outcomes_of(self._reading, number)

    async def catch_up(self, log: EventLog, rows: Iterable[EpisodeRow]) -> bool:
        """Fold the new events of these episodes; return whether any entry changed."""
        async with self._folding:
            grown = [each for each in rows if self._is_behind(each)]
            designators = await log.dtypes() if grown else {}
            turn = self.turn + 1
            for row in grown:
                activity = self._activities.setdefault(row.number, Activity(row))
                activity.row = row
                await self._read(activity, log, designators)
                self._changed_at[row.number] = turn
                self._unjudged.add(row.number)
            judged = await self._judge(log)
            if not grown and not judged:
                return False
            self._changed_at |= dict.fromkeys(judged, turn)
            self.turn = turn
            self._forget()
            return True

    async def _judge(self, log: EventLog) -> list[int]:
        """Read the outcomes of failures from the tables, once these show all events; return the episodes judged."""
        if not self._unjudged or time.monotonic() < self._asked_s + OUTCOMES_S:
            return []
        self._asked_s = time.monotonic()
        shown = (self._unjudged - {each.number for each in await log.behind()}) & self._activities.keys()
        try:
            causes = await causes_of(self._reading, shown) if shown else {}
        except (DatabaseUnavailable, TablesPending):  # the list shows what the events say
            return []
        self._unjudged -= shown
        for each in shown:
            self._activities[each].judged = causes.get(each, [])
        return sorted(shown)

    def _is_behind(self, row: EpisodeRow) -> bool:
        activity = self._activities.get(row.number)
        if activity is None:
            return row.head > 0
        return activity.fault is None and (row.head > activity.last or row.refused != activity.row.refused)

    async def _read(self, activity: Activity, log: EventLog, designators: dict[str, str]) -> None:
        while activity.last < activity.row.head:
            page = await log.events(activity.row.number, after=activity.last, limit=_PAGE_EVENTS)
            if not page:
                return
            for event in page:
                try:
                    activity.read(event, designators)
                except Exception as reason:  # noqa: BLE001  one episode must not end the list of all
                    kind = "" if isinstance(reason, CannotFold) else f"{type(reason).__name__}: "
                    activity.fault = f"event {event.sequence}: {kind}{reason}"
                    return

    def _forget(self) -> None:
        ended = [number for number, each in self._activities.items() if each.has_ended]
        for number in ended[:-_ENDED_MAX]:
            del self._activities[number], self._changed_at[number]
        self._unjudged &= self._activities.keys()

    def entries(self, since: int) -> list[dict[str, Any]]:
        """Return the entries that changed behind a turn, without those of simulations."""
        numbers = sorted(number for number, turn in self._changed_at.items() if turn > since)
        return [self._activities[each].entry() for each in numbers if not self._activities[each].simulated]

    async def document(self, log: EventLog) -> dict[str, Any]:
        """Return the document of the list: the newest episodes of the tables, running ones, and those not folded."""
        unended = [number for number, each in self._activities.items() if not each.has_ended]
        running = await grown_episodes(log, above=EPISODE_NUMBER_MAX, numbers=unended)
        self._asked_s = -math.inf
        await self.catch_up(log, {each.number: each for each in [*await log.behind(), *running]}.values())
        try:
            episodes, total = await newest_episodes(self._reading)
            episodes = episodes[-_LISTED_MAX:]
            pages = {each.number: f"episode/{each.number}" for each in episodes}
            document = await overview_document(self._reading, "Episodes", episodes, total, pages, {})
        except DatabaseUnavailable:  # it has no tables yet
            document = {"title": "Episodes", "total": 0, "episodes": []}
        entries = {each["number"]: each for each in document["episodes"]}
        entries |= {each["number"]: each for each in self.entries(0)}
        total = max(document["total"], len(entries))
        return {**document, "total": total, "episodes": [entries[each] for each in sorted(entries)]}


# === activity =================================================================================================
#
# Fold the events of an episode into the present activity of its robot, and into its row in the list of episodes.
#
# Events of motion are skipped undecoded, so that an episode of a million events is read in seconds.

_READ = frozenset({"EpisodeStarted", "EpisodeEnded", "NodeStarted", "NodeEnded", "ObjectAdded", "EpisodeTagged"})
_FAILED = frozenset({"FAILED", "ERROR"})
_TRIED = frozenset(each.name for each in TRIED)
_TEXT_MAX = 200
"""Bounds the characters of a description, and of the text of the running nodes."""
_NODES_IN_FULL = 2
"""Bounds the innermost nodes that are shown with parameters."""


class _RunningNode(NamedTuple):
    """A node that has not ended; `start_ns` is of the monotonic clock."""

    parent: int | None
    dtype: str
    is_action: bool
    start_ns: int


class Activity:
    """The present activity of an episode, up to the last event that was read.

    Attributes:
        last: sequence of the last event that was read.
        simulated: True for a simulation, performed in a copy of the world.
        fault: the reason for which its events cannot be read any further, or None.
        judged: the causes of its failures with their objects and outcomes, from the tables; None until they are read,
            and again from the next failure on.
    """

    def __init__(self, row: EpisodeRow) -> None:
        self.row = row
        self.judged: list[list[Any]] | None = None
        self.last = 0
        self.simulated = False
        self.fault: str | None = None
        self._description = ""
        self._status = "RUNNING"
        self._nodes = self._failed = 0
        self._nodes_running: dict[int, _RunningNode] = {}
        self._running: dict[int, str] = {}
        self._parameters: dict[int, dict[str, Any]] = {}
        """The parameters of the nodes that run, to which those of nodes inside them may refer."""
        self._tries: dict[str, list[float]] = {}
        """Successes, tries, ended ones and their seconds, of actions by type."""
        self._latest = ""
        """The action that ended last."""
        self._causes: set[int] = set()
        """The running nodes below which a node failed."""
        self._failures: dict[tuple[str, str], list[Any]] = {}
        """The causes of failures by reason and type, as in the tables, without objects and outcomes."""
        self._plan = self._commit = ""
        self._tags: set[str] = set()
        self._robots: dict[str, None] = {}
        self._objects: dict[str, None] = {}
        self._names: dict[int, str] = {}
        self._start_ns = 0
        self._seconds: float | None = None

    @property
    def has_ended(self) -> bool:
        return self._status != "RUNNING"

    def read(self, event: StoredEvent, designators: Mapping[str, str]) -> None:
        """Apply the next event. Raises `CannotFold`."""
        self.last = event.sequence
        if event.type not in _READ:
            return
        match happening_of(event):
            case event_types.EpisodeStarted() as started:
                self._start_ns = event.monotonic_ns
                self._description, self.simulated = started.description[:_TEXT_MAX], started.simulated
                self._plan, self._tags = started.plan or "", set(started.tags)
                self._commit = commit_text(started.git_commit, is_dirty=started.git_dirty)
            case event_types.EpisodeTagged() as tagged:
                self._tags = (self._tags | set(tagged.added)) - set(tagged.removed)
            case event_types.NodeStarted() as started:
                self._nodes += 1
                dtype = designators.get(started.designator or "", "")
                self._parameters[event.sequence] = whole = event_types.with_poses(
                    started.parameters, self._parameters.get
                )
                parameters = with_object_names(whole, lambda each: self._names.get(each["object"]))
                node = _RunningNode(started.parent, dtype, started.kind == "action", event.monotonic_ns)
                self._nodes_running[event.sequence] = node
                self._running[event.sequence] = f"{dtype or started.kind} {parameters_text(parameters)}".strip()
            case event_types.NodeEnded() as ended:
                self._node_ended(ended, event.monotonic_ns)
            case event_types.ObjectAdded() as added:
                self._names[event.sequence] = added.name
                if added.object_type == "ROBOT":
                    self._robots[added.name] = None
                elif added.object_type != "ENVIRONMENT":
                    self._objects[added.name] = None
            case event_types.EpisodeEnded() as ended_episode:
                self._status, self._seconds = ended_episode.status, (event.monotonic_ns - self._start_ns) / 1e9
                if ended_episode.status == "LOST":
                    self._failed += len(self._running)
                self._running.clear()
                self._parameters.clear()
            case _:
                pass

    def _node_ended(self, ended: event_types.NodeEnded, now_ns: int) -> None:
        text = self._running.pop(ended.node, "")
        self._parameters.pop(ended.node, None)
        node = self._nodes_running.pop(ended.node, None)
        if node is None:
            return
        if node.is_action:
            self._latest = text
            tries = self._tries.setdefault(node.dtype or "action", [0, 0, 0, 0.0])
            tries[0] += ended.status == "SUCCEEDED"
            tries[1] += ended.status in _TRIED
            tries[2] += 1
            tries[3] += (now_ns - node.start_ns) / 1e9
        if ended.status not in _FAILED:
            return
        self._failed += 1
        if ended.node not in self._causes:
            reason = reason_of(ended.failure) if ended.failure is not None else NO_REASON
            cause = self._failures.setdefault((reason, node.dtype), [reason, node.dtype, "", "open", 0, ended.node])
            cause[4] += 1
            self.judged = None
        self._causes.discard(ended.node)
        if node.parent is not None:
            self._causes.add(node.parent)

    @property
    def now(self) -> list[str]:
        """The nodes from the root's child down to the one that started last, the innermost ones with parameters."""
        path: list[str] = []
        node: int | None = max(self._running, default=None)
        while (running := self._nodes_running.get(node or 0)) is not None and running.parent is not None:
            text = self._running.get(node or 0, "")
            path.append(text if len(path) < _NODES_IN_FULL else text.partition(" ")[0])
            node = running.parent
        return [each[:_TEXT_MAX] for each in reversed(path) if each]

    def entry(self) -> dict[str, Any]:
        """Return its row, with the keys of `report.overview`; its times are those of the tables, in µs."""
        return {
            "number": self.row.number,
            "started": self.row.started_wall_ns // 10**9,
            "description": self._description,
            "plan": self._plan,
            "commit": self._commit,
            "tags": sorted(self._tags),
            "objects": sorted(self._objects)[:OBJECTS_MAX],
            "status": self._status,
            "seconds": None if self._seconds is None else round(self._seconds, 6),
            "nodes": self._nodes,
            "failed": self._failed,
            "failed_actions": int(sum(tries - good for good, tries, *_ in self._tries.values())),
            "actions": {dtype: [*each[:3], float(f"{each[3]:.4g}")] for dtype, each in self._tries.items()},
            "causes": self.judged if self.judged is not None else [[*each] for each in self._failures.values()],
            "page": f"episode/{self.row.number}",
            "unreadable": self.row.refused or self.fault or "",
            "robots": list(self._robots),
            "now": self.now,
            "after": "" if self.now else self._latest[:_TEXT_MAX],
        }
