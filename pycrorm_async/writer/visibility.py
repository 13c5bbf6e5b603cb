"""Drain one recorder for a daemon, and track which of its records are visible in the tables."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.writer.drain import Append, Drain
from pycrorm_async.writer.ports import ClaimedSource

_BATCHES_MAX = 256
"""Bounds the batches tracked separately, so that memory stays flat while the tables lag; later ones are merged."""


class VisibilityTracker:
    """Drains a claimed source and notes the batches, so that it can publish their visibility.

    Visibility comes from the log, per episode, so it does not matter which process folded.
    """

    def __init__(
        self,
        source: ClaimedSource,
        append: Append,
        *,
        settings: Settings,
        on_append: Callable[[], None],
        report: Callable[[str], None],
    ) -> None:
        self.source = source
        self.drain = Drain(source, append, settings=settings, on_append=self._track, report=report)
        self._on_append = on_append
        self._stored_before = source.stored if source.invisible else 0
        # Of each batch its last position, and each episode's last sequence up to it; first those stored before.
        self._invisible: deque[tuple[int, dict[str, int]]] = deque()
        if source.invisible:
            self._invisible.append((source.stored, _by_text(source.invisible)))
        self._stopped: dict[str, str] = {}
        self._updated = asyncio.Event()

    async def run(self) -> None:
        """Run until the folder is drained and all its records are visible. Raises as `Drain.run` does."""
        await self.drain.run()
        while self._invisible:
            self._updated.clear()
            await self._updated.wait()

    @property
    def appended(self) -> int:
        """Position of the last appended record, by this process or an earlier one."""
        return max(self.drain.state.appended, self._stored_before)

    def note(self, appended: int, behind: Mapping[str, int], stopped: Mapping[str, str]) -> None:
        """Publish to the recorder which records are visible.

        Args:
            appended: this tracker's `appended` before `behind` and `stopped` were read.
            behind: by id, the folded sequence of each episode with events that are not visible yet.
            stopped: by id, the reason why an episode is refused or parked.
        """
        visible_to, stopped = 0, {**self.drain.state.refused, **stopped}
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

    def _track(self, batch: Sequence[Record]) -> None:
        lasts = _by_text({each.episode: each.sequence for each in batch if each.episode is not None})
        if len(self._invisible) >= _BATCHES_MAX:
            _, before = self._invisible.pop()
            lasts = before | lasts
        self._invisible.append((batch[-1].position, lasts))
        self._on_append()


def _by_text(lasts: Mapping[EpisodeId, int]) -> dict[str, int]:
    return {episode_text(episode): last for episode, last in lasts.items()}
