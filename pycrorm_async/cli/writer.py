"""`pycrorm writer`: the daemon that brings a spool into its database; with `--once` it does that once."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.options import (
    DEFAULT_URL,
    FileAccessOption,
    JsonOption,
    ProjectionOption,
    SpoolOption,
    UrlOption,
)
from pycrorm_async.cli.output import note, print_json, problem, stderr, stdout
from pycrorm_async.errors import DamageError, SpoolDamaged
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.fold_process import FoldProcess, forked
from pycrorm_async.operations.fold_workers import WORKERS
from pycrorm_async.operations.recovery import RecoveryReport, recover
from pycrorm_async.projections.custom.discovery import named
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.settings import Settings
from pycrorm_async.writer.daemon import LEAVE_S, DaemonSummary

__all__ = ["writer", "store_once"]

_HANGING_S = 5.0
"""How much longer than `LEAVE_S` a database that does not answer at all may keep the process."""


def writer(
    once: Annotated[
        bool, typer.Option("--once", help="Recover, append and fold all there is at this moment, then exit.")
    ] = False,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    projection: ProjectionOption = None,
    file_access: FileAccessOption = "owner",
    as_json: JsonOption = False,
) -> int:
    """Bring what is recorded below a spool into the database and its tables, as it comes.

    Drains plans that run with `writer="daemon"` and what dead processes left, until SIGTERM or Ctrl-C: then stores what
    is synced and exits 0 within 15 seconds. A database that goes away is waited for; one that cannot be opened at the
    start, or a spool that another `pycrorm writer` drains, is exit code 3.

    With --once: exit code 0 also when an episode was lost with its process; 1 if the database refused events of an
    episode, now or earlier, or they do not fit the tables; 3 if a recorder's folder cannot be read or written; 4 if
    files are damaged. What is refused is kept in the spool, and the line names the folder.
    """
    projections, settings = named(projection or ()), Settings(file_access=file_access)
    collect_seldom()
    if once:
        return store_once(url, spool, projections, settings, as_json=as_json)
    with forked(WORKERS) as processes:
        moved = asyncio.run(_until_told_to_leave(url, spool, projections, settings, processes))
    if as_json:
        print_json(moved._asdict())
    else:
        note(f"left after {moved.records} events of {moved.recorders} recorders")
    return 0


async def _until_told_to_leave(
    url: str,
    spool: Path | None,
    projections: Sequence[Projection],
    settings: Settings,
    processes: Sequence[FoldProcess],
) -> DaemonSummary:
    leave = asyncio.Event()

    def told() -> None:
        if leave.is_set():
            os._exit(130)  # asked twice; what is not stored is safe in the spool
        leave.set()
        watchdog = threading.Timer(LEAVE_S + _HANGING_S, os._exit, (0,))
        watchdog.daemon = True
        watchdog.start()

    for each in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(each, told)
    return await serve(
        url,
        spool=spool,
        leave=leave,
        say=note,
        settings=settings,
        projections=projections,
        fold_workers=WORKERS,
        forked=processes,
    )


def store_once(
    url: str,
    spool: Path | None,
    projections: Sequence[Projection],
    settings: Settings,
    *,
    as_json: bool,
    beside: Mapping[str, object] = MappingProxyType({}),
) -> int:
    """Append and fold all there is, and print the report (`beside` goes into the same JSON document); the exit code."""
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)  # the report tells all of it, once
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)  # but of these nothing
    with stderr.status("recovering what dead processes left …"):
        report = asyncio.run(recover(url, spool=spool, settings=settings, projections=projections))
    if as_json:
        print_json({**beside, **_document(report)})
    else:
        _print(report)
    for name, error in report.failed.items():
        mend = ""
        if isinstance(error, SpoolDamaged):
            mend = f"; mend it with: pycrorm spool repair {error.path.parent.parent}"
        problem(f"{name}: {error}{mend}")
    for episode, reason in report.drained.stopped.items():
        problem(f"episode {episode} is stopped: {reason}{_kept_in(report.dead_letters.get(episode))}")
    for episode, folder in report.dead_letters.items():
        if episode not in report.drained.stopped:
            problem(f"episode {episode} was refused{_kept_in(folder)}")
    if any(isinstance(error, DamageError) for error in report.failed.values()):
        return 4
    if report.failed:
        return 3
    return 1 if report.drained.stopped or report.dead_letters else 0


def _kept_in(folder: Path | None) -> str:
    return "" if folder is None else f"; its events are kept in {folder}"


def _print(report: RecoveryReport) -> None:
    drained = report.drained.drained
    events = sum(each.records for each in drained)
    dead = len(drained) - report.living
    living = f"{report.living} living, " if report.living else ""
    stdout.print(
        f"{dead} dead recorder{'' if dead == 1 else 's'}, {living}{events} events stored,"
        f" {report.drained.folded} folded, {len(report.lost)} episode{'' if len(report.lost) == 1 else 's'} LOST"
    )
    for episode in report.lost:
        stdout.print(f"  LOST {episode}")


def _document(report: RecoveryReport) -> dict[str, object]:
    return {
        "recorders": [each.source for each in report.drained.drained],
        "events_stored": sum(each.records for each in report.drained.drained),
        "events_folded": report.drained.folded,
        "lost": report.lost,
        "failed": {name: str(error) for name, error in report.failed.items()},
        "stopped": dict(report.drained.stopped),
        "dead_letters": {episode: str(folder) for episode, folder in report.dead_letters.items()},
    }
