"""One recorder on its way through a daemon: drained into the log, and followed until all of it shows in the tables."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.writer.drain import Drain, DrainState
from pycrorm_async.writer.ports import ClaimedSource, Destination, Source

__all__ = ["VisibilityTracker"]

_UNSHOWN_MAX = 256
"""Batches that are followed each for itself; further ones are followed together, however long the tables lag."""


class VisibilityTracker(Source):
    """The source of its own drain: it notes what it passes on, and tells the recorder when that can be seen.

    How far the tables are is asked of the log, episode by episode, so it does not matter who folded.
    """

    def __init__(
        self,
        held: ClaimedSource,
        destination: Destination,
        *,
        settings: Settings,
        on_append: Callable[[], None],
        say: Callable[[str], None],
    ) -> None:
        self.held = held
        self._drain = Drain(self, destination, settings=settings, on_append=on_append, say=say)
        self._unshown: deque[tuple[int, dict[str, int]]] = (
            deque()
        )  # position, and each episode's last sequence up to it
        self._stopped: dict[str, str] = {}
        self._noted = asyncio.Event()

    async def run(self) -> None:
        """Until the recorder's folder is drained and shows. Raises as `Drain.run` does."""
        await self._drain.run()
        while self._unshown:
            self._noted.clear()
            await self._noted.wait()

    @property
    def state(self) -> DrainState:
        return self._drain.state

    @property
    def appended(self) -> int:
        """Position of the last record the log was given."""
        return self._drain.appended

    def note(self, appended: int, behind: Mapping[str, int], stopped: Mapping[str, str]) -> None:
        """Tells the recorder what shows.

        Args:
            appended: as it was before the others were asked for.
            behind: by episode, how far the tables show it, of those that do not show all yet.
            stopped: by episode, why it is refused or parked.
        """
        shown, stopped = 0, {**self.state.refused, **stopped}
        while self._unshown and self._unshown[0][0] <= appended:
            position, lasts = self._unshown[0]
            if any(behind.get(episode, last) < last for episode, last in lasts.items()):
                break
            self._stopped |= {episode: stopped[episode] for episode in lasts if episode in stopped}
            self._unshown.popleft()
            shown = position
        if shown:
            self.held.mark_visible(shown, self._stopped)
            self._noted.set()

    # --- as a source ------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self.held.name

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
        batch = await self.held.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
        if batch:
            lasts = {each.episode: each.sequence for each in batch if each.episode is not None}
            self._follow(batch[-1].position, {episode_text(episode): last for episode, last in lasts.items()})
        return batch

    async def acknowledge(self, position: int) -> None:
        await self.held.acknowledge(position)

    def dead_letter(self, records: Sequence[Record]) -> bool:
        return self.held.dead_letter(records)

    def fail(self, reason: str) -> None:
        self.held.fail(reason)

    def _follow(self, position: int, lasts: dict[str, int]) -> None:
        if len(self._unshown) >= _UNSHOWN_MAX:
            _, before = self._unshown.pop()
            lasts = before | lasts
        self._unshown.append((position, lasts))
