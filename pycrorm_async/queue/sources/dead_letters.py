"""Where records are kept that the database refuses, so that their recorder's own files can be forgotten all the same.

One folder an episode beside the recorder's, `<recorder>.<episode>.refused`, with segments in the same format. As long
as the recorder's own folder is there, only who drains that puts into it and nobody takes from it. Afterwards it is
recovered as any folder of the dead: every start offers it to the database again, until that takes all of it.

A crash may come between putting here and forgetting there. Then the same records are put again, and known by their
sequence.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.file_access import create_folder
from pycrorm_async.queue.files.frame import EVENT, Frame, encode_span
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import ALIVE, REFUSED
from pycrorm_async.queue.files.recorder_folder import available, held_by, write_safely
from pycrorm_async.queue.files.scan import make_safe, seal, survey
from pycrorm_async.queue.files.segment import (
    CLOSES,
    Last,
    SegmentHeader,
    encode_header,
    salt_of,
    segment_path,
    sync_folder,
)

__all__ = ["RefusedRecords"]

_SEGMENT_BYTES: Final = 2**22
"""A file that has grown so large is followed by another."""


class RefusedRecords:
    """Those of one recorder, for whoever drains its folder. Makes nothing before the first record."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._episodes: dict[EpisodeId, _RefusedEpisode] = {}

    def put(self, records: Sequence[Record]) -> None:
        """Durable when it returns; what is kept already is kept once. Each episode's records come without a gap.

        Raises `FilesError` or `SpoolDamaged`: then they are to be kept where they are, and no more is to be put.
        """
        runs: dict[EpisodeId, list[Record]] = {}
        for record in records:
            assert record.episode is not None, "only episodes are refused"
            runs.setdefault(record.episode, []).append(record)
        for episode, run in runs.items():
            if episode not in self._episodes:
                self._episodes[episode] = _RefusedEpisode(self._folder, episode)
            self._episodes[episode].put(run)
            if run[-1].type == CLOSES:
                self._episodes.pop(episode).release()

    def release(self) -> None:
        """Others may put into it, or take it. Twice is once."""
        while self._episodes:
            self._episodes.popitem()[1].release()


class _RefusedEpisode:
    """One episode's folder, locked. What a process before left in it is sealed; a new file goes on behind it."""

    def __init__(self, recorder_folder: Path, episode: EpisodeId) -> None:
        self._recorder = held_by(recorder_folder.name).recorder
        self._episode = episode
        self.folder = recorder_folder.with_name(f"{recorder_folder.name}.{episode_text(episode)}{REFUSED}")
        self._last: Last | None = None
        self._unsaid: tuple[int, ...] = ()
        with available(self.folder):
            with suppress(FileExistsError):
                create_folder(self.folder)
            alive = FileLock.take(self.folder / ALIVE)
            if alive is None:
                raise SpoolUnavailable(self.folder, "is used by another process")
            self._alive = alive
            try:
                self._look()
            except BaseException:
                alive.release()
                raise

    def put(self, run: Sequence[Record]) -> None:
        known = run[0].sequence - 1 if self._last is None else self._last.sequence
        fresh = [record for record in run if record.sequence > known]
        if not fresh:
            return
        if fresh[0].sequence != known + 1:
            raise SpoolUnavailable(self.folder, f"holds events up to {known}, and {fresh[0].sequence} does not follow")
        with available(self.folder):
            if self._bytes < _SEGMENT_BYTES:
                self._append(fresh)
            else:
                self._begin(fresh)
        self._position += len(fresh)
        self._last, self._unsaid = _last_of(fresh[-1]), ()

    def release(self) -> None:
        self._alive.release()

    def _look(self) -> None:
        """Finds the end, and has the disk keep what is before it."""

        def seen(_: int, frame: Frame) -> None:
            if frame.kind == EVENT:
                self._last = _last_of(frame)

        kept, damage, self._unsaid = survey(self.folder, self._recorder, seen=seen)
        if damage is not None:
            raise damage
        seal(self.folder, kept)
        make_safe(self.folder, kept.bases)
        sync_folder(self.folder.parent)
        self._number, self._position = kept.cut.number, kept.cut.position
        self._bytes = _SEGMENT_BYTES  # what is sealed is not continued

    def _begin(self, fresh: Sequence[Record]) -> None:
        first = fresh[0]
        before = self._last or Last(first.sequence - 1, first.wall_ns, first.monotonic_ns)
        opened = {self._episode: before} if first.sequence > 1 else {}
        self._number += 1
        header = SegmentHeader(self._recorder, self._number, self._position + 1, opened)
        content = b"".join((encode_header(header), *self._span(fresh)))
        write_safely(segment_path(self.folder, self._number), content)
        self._bytes = len(content)

    def _append(self, fresh: Sequence[Record]) -> None:
        with segment_path(self.folder, self._number).open("ab") as file:
            for part in self._span(fresh):  # the records first: on the disk the commit frame never comes before them
                self._bytes += file.write(part)
                file.flush()
                os.fdatasync(file.fileno())

    def _span(self, fresh: Sequence[Record]) -> tuple[bytes, bytes]:
        frames = [
            Frame(EVENT, version, 0, sequence, wall_ns, monotonic_ns, self._episode, kind.encode(), payload, 0, 0)
            for _, _, sequence, kind, version, wall_ns, monotonic_ns, payload in fresh
        ]
        salt = salt_of(self._recorder, self._number)
        return encode_span(frames, after=self._position, salt=salt, unsaid=self._unsaid)


def _last_of(record: Record | Frame) -> Last:
    return Last(record.sequence, record.wall_ns, record.monotonic_ns)
