"""Mends a dead recorder's damaged folder, so that all that is whole in it can be drained, and tells what is given up.

The folder is put aside as it was, `<recorder>.damaged`, and a new one takes its name: the segments before the damage,
then new ones with the whole records from behind it. An episode's records are kept as long as none of its own is
missing: the log takes no episode with a gap. Records get new positions, for positions have no gaps either.

The new folder is made beside the old one, read again and safe on the disk before either is renamed. Killed anywhere,
the next repair goes on: what is unfinished is made anew, what is finished gets its name.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async.errors import InternalError, SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue.files.file_access import create_folder, open_file
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import ALIVE, DRAIN, MENDED
from pycrorm_async.queue.files.recorder_folder import available, held_by
from pycrorm_async.queue.files.scan import Survey, scan, survey
from pycrorm_async.queue.files.segment import sync_folder
from pycrorm_async.queue.maintenance.inspection import SET_ASIDE, Damage
from pycrorm_async.queue.maintenance.salvage import Range, Rescue, ranges

__all__ = ["RepairReport", "GivenUp", "repair_folder", "finish_repairs"]


@dataclass(frozen=True)
class GivenUp:
    """Whole records of one episode that stand behind a gap in it: the log could not take them.

    Attributes:
        episode: its id.
        kept_to: sequence of its last record that is kept; 0 if there is none.
        sequences: of the records given up.
        positions: where they stand in the folder that was put aside.
    """

    episode: str
    kept_to: int
    sequences: tuple[Range, ...]
    positions: tuple[Range, ...]


@dataclass(frozen=True)
class RepairReport:
    """What was done to one folder.

    Attributes:
        name: the recorder.
        set_aside: the folder as it was; files named in `damage` are in it.
        damage: where it began.
        kept: records before the damage.
        saved: records from behind it.
        unreadable: positions of records that cannot be read any more.
        given_up: by episode, whole records that are not kept.
        headless: the oldest file's header was unreadable: an episode that was open in it and has no record behind the
            damage does not get its end.
    """

    name: str
    set_aside: str
    damage: Damage
    kept: int
    saved: int
    unreadable: tuple[Range, ...]
    given_up: tuple[GivenUp, ...]
    headless: bool

    @property
    def complete(self) -> bool:
        """Whether nothing at all was given up."""
        return not (self.unreadable or self.given_up or self.headless)


def repair_folder(folder: Path) -> RepairReport | None:
    """Mends the folder if it is damaged; None if it is whole.

    Raises `SpoolUnavailable` if its recorder lives, somebody drains it, or it cannot be written; `SpoolForeign` for a
    newer format or another recorder's file. Then nothing is changed.
    """
    with available(folder):
        locks = _locked(folder)
        try:
            found = survey(folder, held_by(folder.name).recorder)
            if found.damage is None:
                return None
            return _replace(folder, found)
        finally:
            for lock in locks:
                lock.release()


def finish_repairs(spool: Path) -> list[Path]:
    """Gives finished folders their names when a repair was killed between its last two steps; these folders."""
    done = []
    with available(spool):
        for mended in sorted(spool.glob(f"*{MENDED}")):
            folder = mended.with_name(mended.name.removesuffix(MENDED))
            if not folder.exists():  # the old one is put aside only when the new one is whole and safe
                mended.rename(folder)
                sync_folder(spool)
                done.append(folder)
    return done


def _locked(folder: Path) -> list[FileLock]:
    alive = FileLock.take(folder / ALIVE, create=False)
    if alive is None:
        raise SpoolUnavailable(folder, "its recorder is alive, or somebody drains it: stop that first")
    try:
        drain = FileLock.take(folder / DRAIN)
    except BaseException:
        alive.release()
        raise
    if drain is None:
        alive.release()
        raise SpoolUnavailable(folder, "is being drained: stop that first")
    return [drain, alive]


def _replace(folder: Path, found: Survey) -> RepairReport:
    """The folder is put aside, and a mended one has its name."""
    damage = found.damage
    assert damage is not None
    mended = folder.with_name(f"{folder.name}{MENDED}")
    if mended.exists():  # of a repair that was killed
        shutil.rmtree(mended)
    create_folder(mended)
    try:
        rescue = _filled(mended, folder, found)
        aside = _free_name(folder)
        folder.rename(aside)
    except BaseException:
        shutil.rmtree(mended, ignore_errors=True)
        raise
    mended.rename(folder)
    sync_folder(folder.parent)
    return RepairReport(
        name=folder.name,
        set_aside=str(aside),
        damage=Damage(str(aside / damage.path.name), damage.offset, damage.reason),
        kept=found.kept.cut.position - found.kept.start.position,
        saved=rescue.saved,
        unreadable=tuple(rescue.unreadable),
        given_up=tuple(
            GivenUp(
                episode_text(episode),
                rescue.kept_to(episode),
                ranges(frame.sequence for frame in frames),
                ranges(frame.position for frame in frames),
            )
            for episode, frames in sorted(rescue.given_up.items())
        ),
        headless=rescue.headless,
    )


def _filled(mended: Path, folder: Path, found: Survey) -> Rescue:
    """What was written into the new folder, read again and safe on the disk."""
    os.close(open_file(mended / ALIVE, os.O_WRONLY))
    rescue = Rescue(folder, mended, found)
    rescue.run()
    written = scan(mended, held_by(folder.name).recorder).cut.position
    if written != rescue.position:
        raise InternalError(f"{mended} holds records up to {written} and not up to {rescue.position}")
    sync_folder(mended)
    return rescue


def _free_name(folder: Path) -> Path:
    aside = folder.with_name(f"{folder.name}{SET_ASIDE}")
    number = 1
    while aside.exists():
        number += 1
        aside = folder.with_name(f"{folder.name}{SET_ASIDE}.{number}")
    return aside
