"""`pycrorm writer`: the daemon that brings a spool into its database; with `--once` it does that once."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from socket import socket
from typing import Annotated

import typer

from pycrorm_async.adoption import RecoveryReport, recover
from pycrorm_async.apart import folding_process
from pycrorm_async.bulk import collect_seldom
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, ProjectionOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import note, print_json, problem, stderr, stdout
from pycrorm_async.daemon import serve
from pycrorm_async.errors import DamageError, SpoolDamaged
from pycrorm_async.projections.own import Projection
from pycrorm_async.projections.own_found import named
from pycrorm_async.writer.daemon import LEAVE_S, Moved

__all__ = ["writer"]

_HANGING_S = 5.0
"""How much longer than `LEAVE_S` a database that does not answer at all may keep the process."""


def writer(
    once: Annotated[
        bool, typer.Option("--once", help="Recover, append and fold all there is at this moment, then exit.")
    ] = False,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    projection: ProjectionOption = None,
    as_json: JsonOption = False,
) -> int:
    """Bring what is recorded below a spool into the database and its tables, as it comes.

    Drains plans that run with `writer="daemon"` and what dead processes left, until SIGTERM or Ctrl-C: then stores what
    is synced and exits 0 within 15 seconds. A database that goes away is waited for; one that cannot be opened at the
    start, or a spool that another `pycrorm writer` drains, is exit code 3.

    With --once: exit code 0 also when an episode was lost with its process; 4 if files are damaged, 1 if an episode is
    stopped.
    """
    projections = named(projection or ())
    collect_seldom()
    if once:
        return _once(url, spool, projections, as_json=as_json)
    with folding_process(url, spool=spool, projections=projections) as folding:
        moved = asyncio.run(_until_told_to_leave(url, spool, projections, folding))
    if as_json:
        print_json(moved._asdict())
    else:
        note(f"left after {moved.records} events of {moved.recorders} recorders")
    return 0


async def _until_told_to_leave(
    url: str, spool: Path | None, projections: Sequence[Projection], folding: socket
) -> Moved:
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
    return await serve(url, spool=spool, leave=leave, say=note, projections=projections, folding=folding)


def _once(url: str, spool: Path | None, projections: Sequence[Projection], *, as_json: bool) -> int:
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)  # the report tells all of it, once
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)  # but of these nothing
    with stderr.status("recovering what dead processes left …"):
        report = asyncio.run(recover(url, spool=spool, projections=projections))
    if as_json:
        print_json(_document(report))
    else:
        _print(report)
    for name, error in report.failed.items():
        mend = ""
        if isinstance(error, SpoolDamaged):
            mend = f"; mend it with: pycrorm spool repair {error.path.parent.parent}"
        problem(f"{name}: {error}{mend}")
    for episode, reason in report.drained.stopped.items():
        problem(f"episode {episode} is stopped: {reason}")
    if any(isinstance(error, DamageError) for error in report.failed.values()):
        return 4
    if report.failed:
        return 3
    return 1 if report.drained.stopped else 0


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
    }
