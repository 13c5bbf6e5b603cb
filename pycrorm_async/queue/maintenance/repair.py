"""Repair a dead recorder's damaged folder, so that its whole records can be drained, and report the records dropped.

The damaged folder is renamed unchanged to `<recorder>.damaged`, and a new folder takes its name. The new folder holds
the segments before the damage and new segments with the whole records behind it, as far as `salvage.py` can keep them.

The new folder is built beside the old one, scanned and synced before either is renamed. After a kill at any point the
next repair continues: it builds an unfinished folder again, and renames a finished one.
"""

from __future__ import annotations

import os
import shutil
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async.errors import InternalError, SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue.files.file_access import create_folder, open_file
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import ALIVE, DRAIN, MENDED
from pycrorm_async.queue.files.recorder_folder import parse_folder_name, wrap_os_errors
from pycrorm_async.queue.files.scan import Survey, scan, survey
from pycrorm_async.queue.files.segment import sync_folder
from pycrorm_async.queue.maintenance.inspection import DAMAGED_SUFFIX, Damage
from pycrorm_async.queue.maintenance.salvage import Range, Salvage, ranges


@dataclass(frozen=True)
class DroppedRecords:
    """Whole records behind a gap in their episode, dropped because the log accepts no gap.

    Attributes:
        episode: the episode's id.
        kept_to: sequence of the episode's last kept record; 0 if none is kept.
        sequences: sequences of the dropped records.
        positions: their positions in the damaged folder.
    """

    episode: str
    kept_to: int
    sequences: tuple[Range, ...]
    positions: tuple[Range, ...]


@dataclass(frozen=True)
class RepairReport:
    """The result of one repair.

    Attributes:
        name: the recorder.
        set_aside: the damaged folder under its new name; it contains the files named in `damage`.
        damage: where the damage began.
        kept: number of records before the damage.
        saved: number of records salvaged behind it.
        unreadable: positions of records that cannot be read any more.
        given_up: by episode, whole records that were dropped.
        headless: the oldest file's header was unreadable: an episode that it listed as open and that has no record
            behind the damage does not get its end.
    """

    name: str
    set_aside: str
    damage: Damage
    kept: int
    saved: int
    unreadable: tuple[Range, ...]
    given_up: tuple[DroppedRecords, ...]
    headless: bool

    @property
    def complete(self) -> bool:
        """Return whether no record was lost or dropped."""
        return not (self.unreadable or self.given_up or self.headless)


def repair_folder(folder: Path) -> RepairReport | None:
    """Repair the folder if it is damaged; return None if it is whole.

    Raises `SpoolUnavailable` if the recorder lives, a process drains the folder, or it cannot be written, and
    `SpoolForeign` for a newer format or another recorder's file. Then the folder is unchanged.
    """
    with wrap_os_errors(folder), ExitStack() as locks:
        alive = FileLock.take(folder / ALIVE, create=False)
        if alive is None:
            reason = "its recorder is alive, or another process drains it: stop that process first"
            raise SpoolUnavailable(folder, reason)
        locks.callback(alive.release)
        drain = FileLock.take(folder / DRAIN)
        if drain is None:
            raise SpoolUnavailable(folder, "another process drains it: stop that process first")
        locks.callback(drain.release)
        result = survey(folder, parse_folder_name(folder.name).recorder)
        return None if result.damage is None else _replace(folder, result, result.damage)


def finish_repairs(spool: Path) -> list[Path]:
    """Name the finished folders of repairs killed between their last two steps; return these folders."""
    folders = []
    with wrap_os_errors(spool):
        for repaired in sorted(spool.glob(f"*{MENDED}")):
            folder = repaired.with_name(repaired.name.removesuffix(MENDED))
            if not folder.exists():  # the damaged folder is renamed only after the new one is whole and synced
                repaired.rename(folder)
                sync_folder(spool)
                folders.append(folder)
    return folders


def _replace(folder: Path, result: Survey, damage: SpoolDamaged) -> RepairReport:
    """Build a repaired folder, rename the damaged one, and give its name to the repaired one."""
    repaired = folder.with_name(f"{folder.name}{MENDED}")
    if repaired.exists():  # left by a killed repair
        shutil.rmtree(repaired)
    create_folder(repaired)
    try:
        salvage = _fill(repaired, folder, result)
        damaged = _free_name(folder)
        folder.rename(damaged)
    except BaseException:
        shutil.rmtree(repaired, ignore_errors=True)
        raise
    repaired.rename(folder)
    sync_folder(folder.parent)
    return RepairReport(
        name=folder.name,
        set_aside=str(damaged),
        damage=Damage(str(damaged / damage.path.name), damage.offset, damage.reason),
        kept=result.prefix.cut.position - result.prefix.start.position,
        saved=salvage.saved,
        unreadable=tuple(salvage.unreadable),
        given_up=tuple(
            DroppedRecords(
                episode_text(episode),
                salvage.kept_to(episode),
                ranges(frame.sequence for frame in frames),
                ranges(frame.position for frame in frames),
            )
            for episode, frames in sorted(salvage.dropped.items())
        ),
        headless=salvage.headless,
    )


def _fill(repaired: Path, folder: Path, result: Survey) -> Salvage:
    """Write the new folder, scan it again and sync it."""
    os.close(open_file(repaired / ALIVE, os.O_WRONLY))
    salvage = Salvage(folder, repaired, result)
    salvage.run()
    written = scan(repaired, parse_folder_name(folder.name).recorder).cut.position
    if written != salvage.position:
        raise InternalError(
            f"{repaired} holds records up to position {written} instead of {salvage.position};"
            " the damaged folder is unchanged"
        )
    sync_folder(repaired)
    return salvage


def _free_name(folder: Path) -> Path:
    name = folder.with_name(f"{folder.name}{DAMAGED_SUFFIX}")
    number = 1
    while name.exists():
        number += 1
        name = folder.with_name(f"{folder.name}{DAMAGED_SUFFIX}.{number}")
    return name
