"""Drain one recorder for a daemon, and track which of its records are visible in the tables."""

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

_BATCHES_MAX = 256
"""Bounds the batches tracked separately, so that memory stays flat while the tables lag; later ones are merged."""


class VisibilityTracker(Source):
    """A source that forwards to the claimed one and notes the batches, so that it can publish their visibility.

    Visibility comes from the log, per episode, so it does not matter which process folded.
    """

    def __init__(
        self,
        source: ClaimedSource,
        destination: Destination,
        *,
        settings: Settings,
        on_append: Callable[[], None],
        say: Callable[[str], None],
    ) -> None:
        self.source = source
        self._drain = Drain(self, destination, settings=settings, on_append=on_append, say=say)
        self._invisible: deque[tuple[int, dict[str, int]]] = (
            deque()
        )  # position, and each episode's last sequence up to it
        self._stopped: dict[str, str] = {}
        self._updated = asyncio.Event()

    async def run(self) -> None:
        """Run until the folder is drained and all its records are visible. Raises as `Drain.run` does."""
        await self._drain.run()
        while self._invisible:
            self._updated.clear()
            await self._updated.wait()

    @property
    def state(self) -> DrainState:
        return self._drain.state

    @property
    def appended(self) -> int:
        """Position of the last appended record."""
        return self._drain.appended

    def note(self, appended: int, behind: Mapping[str, int], stopped: Mapping[str, str]) -> None:
        """Publish to the recorder which records are visible.

        Args:
            appended: this tracker's `appended` before `behind` and `stopped` were read.
            behind: by id, the folded sequence of each episode with events that are not visible yet.
            stopped: by id, why an episode is refused or parked.
        """
        visible_to, stopped = 0, {**self.state.refused, **stopped}
        while self._invisible and self._invisible[0][0] <= appended:
            position, lasts = self._invisible[0]
            if any(behind.get(episode, last) < last for episode, last in lasts.items()):
                break
            self._stopped |= {episode: stopped[episode] for episode in lasts if episode in stopped}
            self._invisible.popleft()
            visible_to = position
        if visible_to:
            self.source.mark_visible(visible_to, self._stopped)
            self._updated.set()

    # --- as a source ------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self.source.name

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
        batch = await self.source.get_batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
        if batch:
            lasts = {each.episode: each.sequence for each in batch if each.episode is not None}
            self._track(batch[-1].position, {episode_text(episode): last for episode, last in lasts.items()})
        return batch

    async def acknowledge(self, position: int) -> None:
        await self.source.acknowledge(position)

    def dead_letter(self, records: Sequence[Record]) -> bool:
        return self.source.dead_letter(records)

    def fail(self, reason: str) -> None:
        self.source.fail(reason)

    def _track(self, position: int, lasts: dict[str, int]) -> None:
        if len(self._invisible) >= _BATCHES_MAX:
            _, before = self._invisible.pop()
            lasts = before | lasts
        self._invisible.append((position, lasts))
