"""The writer as a process of its own: drains all recorders of a spool, of living and of dead processes, and folds.

Three kinds of tasks: one looks round for recorders, one for each recorder moves its records into the log, one folds.
None waits for another's database: what is away is asked again with pauses, and the recorders keep their events on disk.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable
from contextlib import suppress
from typing import Final, NamedTuple

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, FilesError, PycrormError, SpoolForeign
from pycrorm_async.settings import Settings
from pycrorm_async.writer.availability import AvailabilityMonitor
from pycrorm_async.writer.drain import run_to_completion
from pycrorm_async.writer.ports import ClaimedSource, ScanResult, SourceScanner, Tables
from pycrorm_async.writer.retry import PATIENT, Backoff
from pycrorm_async.writer.visibility import VisibilityTracker

__all__ = ["Daemon", "DaemonSummary", "LEAVE_S"]

LEAVE_S: Final = 10.0
"""How long leaving may take. What is not stored by then stays in its folder, and the next daemon finds it."""
_LOOK_S: Final = 0.2
_CONFIRM_S: Final = 5.0
"""How often the database is asked whether it still holds what was stored last: one row, in a tenth of a millisecond."""
_REST = Backoff(first_s=1.0, longest_s=60.0)
"""Before a folder is tried again that could not be drained to its end: it is damaged, or nothing can be set aside."""


class DaemonSummary(NamedTuple):
    """What a daemon did: recorders it let go of, and records it gave to the log."""

    recorders: int
    records: int


class Daemon:
    """Belongs to the loop that runs it. `say` gets one line for each notable thing."""

    def __init__(
        self,
        destination: Tables,
        look: SourceScanner,
        *,
        settings: Settings,
        say: Callable[[str], None],
        randomness: Callable[[], float] = random.random,
    ) -> None:
        self._destination = AvailabilityMonitor(
            destination, now_s=self._now_s, on_away=self._note_away, on_back=self._note_back
        )
        self._look = look
        self._settings = settings
        self._say = say
        self._randomness = randomness
        self._serving: dict[str, VisibilityTracker] = {}
        self._rests: dict[str, tuple[int, float]] = {}  # by name: how often it was tried, when it may be again
        self._news = asyncio.Event()
        self._away: str | None = None
        self._said: dict[str, str] = {}  # by what it is about, the last line
        self._recorders = self._records = 0

    async def run(self, leave: asyncio.Event) -> DaemonSummary:
        """Until `leave` is set. Then takes hold of nothing new, drains what is synced at that moment, folds, returns.

        Returns after `LEAVE_S` in any case, when the database lets it; nothing is lost by that. Raises `SpoolForeign`
        when the spool has become another database's, and `DatabaseForeign` when the database has become another.
        """
        foreign: SpoolForeign | DatabaseForeign | None = None
        async with asyncio.TaskGroup() as tasks:
            folding = tasks.create_task(self._fold_as_it_comes(), name="pycrorm fold")
            confirming = tasks.create_task(self._confirm_now_and_then(), name="pycrorm confirm")
            served: set[asyncio.Task[None]] = set()
            while not leave.is_set() and foreign is None:
                try:
                    for held in await self._look_round():
                        task = tasks.create_task(self._serve(held), name=f"pycrorm drain {held.name}")
                        served.add(task)
                        task.add_done_callback(served.discard)
                except (SpoolForeign, DatabaseForeign) as error:
                    foreign = error
                await _wait(leave, _LOOK_S)
            for each in self._serving.values():
                each.held.finish()
            if served:
                patience_s = 0.0 if isinstance(foreign, DatabaseForeign) else LEAVE_S
                _, late = await asyncio.wait(served, timeout=patience_s)
                for task in late:
                    task.cancel()
                if late and foreign is None:
                    self._say(f"not finished after {LEAVE_S:g} s: what is left is safe in the spool")
            folding.cancel()
            confirming.cancel()
        if foreign is not None:
            raise foreign
        return DaemonSummary(self._recorders, self._records)

    # --- looking round ----------------------------------------------------------------------------------------

    async def _look_round(self) -> list[ClaimedSource]:
        now_s = self._now_s()
        resting = {name for name, (_, until_s) in self._rests.items() if until_s > now_s}
        but = self._serving.keys() | resting
        found = ScanResult([], {})

        def look() -> None:
            nonlocal found
            found = self._look(but)

        try:
            await run_to_completion(asyncio.to_thread(look))
        except asyncio.CancelledError:
            for held in found.held:  # the next daemon, which may be in this process, is to find them free
                with suppress(PycrormError):
                    held.release_folder()
            raise
        except SpoolForeign:
            raise
        except FilesError as error:
            self._say_news(f"cannot look for recorders: {error}", "look")
            return []
        self._said.pop("look", None)
        for name, fault in found.failed.items():
            self._rest(name, str(fault))
        return list(found.held)

    def _rest(self, name: str, reason: str, *, again: bool = True) -> None:
        attempt = self._rests.get(name, (0, 0.0))[0] + 1
        pause_s = _REST.pause_s(attempt, self._randomness()) if again else math.inf
        assert pause_s is not None, "it is tried for ever"
        self._rests[name] = attempt, self._now_s() + pause_s
        when = "now and then" if again else "by the next writer"
        self._say_news(f"recorder {name}: {reason}; tried again {when}", f"{name} rests")

    # --- one recorder -----------------------------------------------------------------------------------------

    async def _serve(self, held: ClaimedSource) -> None:
        name = held.name
        serving = VisibilityTracker(
            held,
            self._destination,
            settings=self._settings,
            on_append=self._news.set,
            say=lambda line: self._say_news(line, name),
        )
        self._serving[name] = serving
        if name not in self._rests:
            self._say(f"recorder {name} " + ("appeared" if held.is_alive else "is dead: recovering what it left"))
        fault: str | None = None
        try:
            if self._away is not None:
                held.mark_unavailable(self._away)
            await serving.run()
        except Exception as error:  # noqa: BLE001 - told, and tried again; the other recorders go on
            fault = _in_a_line(error)
        finally:
            await run_to_completion(self._let_go(serving, fault))

    async def _let_go(self, serving: VisibilityTracker, fault: str | None) -> None:
        name, state, again = serving.name, serving.state, True
        try:
            left = await asyncio.to_thread(serving.held.release_folder)
            again = left.again
            if fault is None and not left.whole:
                fault = next(
                    (f"episode {episode} {why}" for episode, why in state.refused.items()), "not all is stored"
                )
            if fault is None:
                self._say(f"recorder {name} {left.what}; {state.records} events stored")
        except PycrormError as error:
            fault = fault or str(error)
        del self._serving[name]
        self._recorders += 1
        self._records += state.records
        if fault is None:
            self._rests.pop(name, None)
            self._said.pop(name, None)
            self._said.pop(f"{name} rests", None)
        else:
            self._rest(name, fault, again=again)

    # --- the tables -------------------------------------------------------------------------------------------

    async def _fold_as_it_comes(self) -> None:
        self._news.set()  # something may have been left behind before
        attempt = 0
        while True:
            await self._news.wait()
            self._news.clear()
            try:
                while await self._destination.fold_next_batch():
                    await self._tell_what_shows()
                await self._tell_what_shows()
            except Exception as error:  # noqa: BLE001 - told, and tried again; appending goes on
                attempt += 1
                if not isinstance(error, DatabaseUnavailable):
                    self._say_news(f"the tables cannot be brought up to date: {_in_a_line(error)}", "fold")
                self._news.set()
                await asyncio.sleep(PATIENT.pause_s(attempt, self._randomness()) or 0.0)
            else:
                attempt = 0
                self._said.pop("fold", None)

    async def _confirm_now_and_then(self) -> None:
        """A log that went back is healed also while no recorder appends."""
        while True:
            try:
                await self._destination.confirm()
                self._said.pop("confirm", None)
            except Exception as error:  # noqa: BLE001 - told, and tried again
                if not isinstance(error, DatabaseUnavailable):
                    self._say_news(f"what was stored cannot be confirmed: {_in_a_line(error)}", "confirm")
            await asyncio.sleep(_CONFIRM_S)

    async def _tell_what_shows(self) -> None:
        before = [(each, each.appended) for each in self._serving.values()]
        behind, stopped = await self._destination.behind(), await self._destination.stopped()
        for serving, appended in before:
            try:
                serving.note(appended, behind, stopped)
            except FilesError as error:  # whoever waits there waits on; the drain meets the same disk
                self._say(f"recorder {serving.name}: {error}")

    # --- what is notable --------------------------------------------------------------------------------------

    def _note_away(self, reason: str) -> None:
        self._away = reason
        self._say(f"the database is away: {reason}; trying again")
        self._tell_away()

    def _note_back(self, after_s: float) -> None:
        self._away = None
        self._say(f"the database is back after {after_s:.1f} s")
        self._tell_away()

    def _tell_away(self) -> None:
        for serving in self._serving.values():
            try:
                serving.held.mark_unavailable(self._away)
            except FilesError as error:
                self._say(f"recorder {serving.name}: {error}")

    def _say_news(self, line: str, about: str) -> None:
        """Says it unless it was the last thing said about that."""
        if self._said.get(about) != line:
            self._said[about] = line
            self._say(line)

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()


async def _wait(event: asyncio.Event, seconds: float) -> None:
    try:
        async with asyncio.timeout(seconds):
            await event.wait()
    except TimeoutError:
        return


def _in_a_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, PycrormError) else f"{type(error).__name__}: {text}"
