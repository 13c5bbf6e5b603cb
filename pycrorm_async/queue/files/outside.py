"""What a recorder sees of the process that drains its folder: how far it is, no further than can be true."""

from __future__ import annotations

import os
from pathlib import Path

from pycrorm_async.queue.files.drain_status import DrainStatus, Progress, RecorderStatus
from pycrorm_async.queue.files.file_access import open_file
from pycrorm_async.queue.files.recorder_folder import DRAIN

__all__ = ["DrainStatusReader"]


class DrainStatusReader:
    """The recorder's side of `progress`. Making one offers the folder to whoever drains this spool."""

    def __init__(self, folder: Path, *, before: int = 0) -> None:
        """Nothing up to position `before` is in this folder. Raises `OSError`."""
        # Made here, so that whoever wants to drain need not make it: a folder that is being deleted stays deleted.
        os.close(open_file(folder / DRAIN, os.O_WRONLY))
        self._progress = Progress.make(folder, DrainStatus(before, before))
        self._told = RecorderStatus()

    def tell(self, *, synced: int, closed: bool) -> bool:
        """Says it if it is news; False if the disk did not take it, and then it is to be said again."""
        news = RecorderStatus(synced, closed)
        if news != self._told:
            try:
                self._progress.tell_recorded(news)
            except OSError:  # no reason to refuse the plan's events: the next look says it again
                return False
            self._told = news
        return True

    def believed(self, *, synced: int) -> DrainStatus:
        """What the drainer says. Nothing that is not synced left the folder, so it cannot be stored."""
        said = self._progress.drained()
        if max(said.stored, said.folded) > synced:
            return DrainStatus()
        return said

    def close(self) -> None:
        """Gives up the file; what was heard last stands."""
        self._progress.close()
