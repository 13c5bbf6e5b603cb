"""Keep the records that the database refuses, so that their recorder's segments can be deleted all the same.

Each episode has one folder beside the recorder's, `<recorder>.<episode>.refused`, with segments in the same format.
While the recorder's own folder exists, only its drainer adds records and no process drains them. Afterwards the folder
is recovered like any dead folder: every start offers its records to the database, until the database takes all of them.

After a crash between adding records here and acknowledging them there, the drainer adds the same records again;
`DeadLetters` recognises them by their sequence.
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
from pycrorm_async.queue.files.recorder_folder import parse_folder_name, wrap_os_errors, write_durably
from pycrorm_async.queue.files.scan import seal, survey, sync_segments
from pycrorm_async.queue.files.segment import (
    EPISODE_ENDED,
    LastRecord,
    SegmentHeader,
    encode_header,
    salt_of,
    segment_path,
    sync_folder,
)

_SEGMENT_BYTES: Final = 2**22
"""Size in bytes at which the next records begin another file."""


class DeadLetters:
    """The dead letters of one recorder, written by its drainer. Creates no folder before the first record."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._episodes: dict[EpisodeId, _EpisodeFolder] = {}

    def put(self, records: Sequence[Record]) -> None:
        """Add records; durable on return. Ignores records added before. Each episode's records must have no gap.

        Raises `FilesError` or `SpoolDamaged`: then keep the records in the recorder's folder and add no more.
        """
        runs: dict[EpisodeId, list[Record]] = {}
        for record in records:
            assert record.episode is not None, "only episodes are refused"
            runs.setdefault(record.episode, []).append(record)
        for episode, run in runs.items():
            if episode not in self._episodes:
                self._episodes[episode] = _EpisodeFolder(self._folder, episode)
            self._episodes[episode].put(run)
            if run[-1].type == EPISODE_ENDED:
                self._episodes.pop(episode).release()

    def release(self) -> None:
        """Unlock the folders for other processes. Idempotent."""
        while self._episodes:
            self._episodes.popitem()[1].release()


class _EpisodeFolder:
    """One episode's folder, locked. Seals the files of earlier processes and continues in a new file."""

    def __init__(self, recorder_folder: Path, episode: EpisodeId) -> None:
        self._recorder = parse_folder_name(recorder_folder.name).recorder
        self._episode = episode
        self.folder = recorder_folder.with_name(f"{recorder_folder.name}.{episode_text(episode)}{REFUSED}")
        self._last: LastRecord | None = None
        self._uncommitted: tuple[int, ...] = ()
        with wrap_os_errors(self.folder):
            with suppress(FileExistsError):
                create_folder(self.folder)
            alive = FileLock.take(self.folder / ALIVE)
            if alive is None:
                raise SpoolUnavailable(self.folder, "is used by another process")
            self._alive = alive
            try:
                self._resume()
            except BaseException:
                alive.release()
                raise

    def put(self, run: Sequence[Record]) -> None:
        head = run[0].sequence - 1 if self._last is None else self._last.sequence
        fresh = [record for record in run if record.sequence > head]
        if not fresh:
            return
        if fresh[0].sequence != head + 1:
            raise SpoolUnavailable(
                self.folder, f"holds events up to {head}, and event {fresh[0].sequence} leaves a gap"
            )
        with wrap_os_errors(self.folder):
            if self._bytes < _SEGMENT_BYTES:
                self._append(fresh)
            else:
                self._begin(fresh)
        self._position += len(fresh)
        self._last, self._uncommitted = _last_of(fresh[-1]), ()

    def release(self) -> None:
        self._alive.release()

    def _resume(self) -> None:
        """Find the last record; truncate a torn tail and sync the rest."""

        def note_last(_: int, frame: Frame) -> None:
            if frame.kind == EVENT:
                self._last = _last_of(frame)

        prefix, damage, self._uncommitted = survey(self.folder, self._recorder, on_frame=note_last)
        if damage is not None:
            raise damage
        seal(self.folder, prefix)
        sync_segments(self.folder, prefix.bases)
        sync_folder(self.folder.parent)
        self._number, self._position = prefix.cut.number, prefix.cut.position
        self._bytes = _SEGMENT_BYTES  # a sealed file is not extended: begin another

    def _begin(self, fresh: Sequence[Record]) -> None:
        first = fresh[0]
        before = self._last or LastRecord(first.sequence - 1, first.wall_ns, first.monotonic_ns)
        opened = {self._episode: before} if first.sequence > 1 else {}
        self._number += 1
        header = SegmentHeader(self._recorder, self._number, self._position + 1, opened)
        content = b"".join((encode_header(header), *self._span(fresh)))
        write_durably(segment_path(self.folder, self._number), content)
        self._bytes = len(content)

    def _append(self, fresh: Sequence[Record]) -> None:
        with segment_path(self.folder, self._number).open("ab") as file:
            for part in self._span(fresh):  # records, sync, commit frame, sync: in this order (queue/__init__.py)
                self._bytes += file.write(part)
                file.flush()
                os.fdatasync(file.fileno())

    def _span(self, fresh: Sequence[Record]) -> tuple[bytes, bytes]:
        frames = [
            Frame(EVENT, version, 0, sequence, wall_ns, monotonic_ns, self._episode, kind.encode(), payload)
            for _, _, sequence, kind, version, wall_ns, monotonic_ns, payload in fresh
        ]
        salt = salt_of(self._recorder, self._number)
        return encode_span(frames, after=self._position, salt=salt, uncommitted=self._uncommitted)


def _last_of(record: Record | Frame) -> LastRecord:
    return LastRecord(record.sequence, record.wall_ns, record.monotonic_ns)
