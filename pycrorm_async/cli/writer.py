"""Drain a spool continuously: append its events and fold them into the tables.

Panel: Operate, 2.
"""

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
from pycrorm_async.cli import output
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import DamageError, SpoolDamaged
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.recovery import RecoveryReport, recover
from pycrorm_async.operations.workers import WORKERS, ChildProcess, forked
from pycrorm_async.progress_bar import stderr
from pycrorm_async.projections.custom import Projection, load_projections
from pycrorm_async.settings import Settings
from pycrorm_async.writer.daemon import STOP_S, DaemonSummary

_WATCHDOG_MARGIN_S = 5.0
"""Seconds after `STOP_S` until the watchdog ends a process whose database does not answer at all."""


def writer(
    *,
    once: Annotated[
        bool, typer.Option("--once", help="Recover, append and fold all events present now, then exit.")
    ] = False,
    place: Place,
    projection: output.ProjectionOption = None,
    file_access: output.FileAccessOption = "owner",
    recall: Annotated[
        bool, typer.Option("--recall/--no-recall", help="Make the cases that `pycrorm recall` compares.")
    ] = True,
    as_json: output.JsonOption = False,
) -> int:
    """Drain a spool continuously: append its events to the database and fold them into the tables.

    Drains the recorders of plans that run with `writer="daemon"` and of dead processes. After SIGTERM or Ctrl-C it
    stores the synced events and exits with code 0 within 15 seconds. It waits for a database that becomes unavailable.
    Exit code 3 if the database cannot be opened at the start, or if another `pycrorm writer` drains the spool.

    With --once: exit code 0, also if an episode was LOST with its process; 1 if the database refused events of an
    episode, now or earlier, or they do not fit the tables; 3 if a recorder's folder cannot be read or written; 4 if
    files are damaged. Refused events are kept in the spool, in the folder that the message names.
    """
    projections, settings = load_projections(projection or ()), Settings(file_access=file_access, recall=recall)
    collect_seldom()
    if once:
        return store_once(place, projections, settings, as_json=as_json)
    with forked(WORKERS, place.url) as processes:
        summary = asyncio.run(_serve_until_signal(place, projections, settings, processes))
    if as_json:
        output.print_json(summary._asdict())
    else:
        events, recorders = output.counted(summary.records, "event"), output.counted(summary.recorders, "recorder")
        output.note(f"stopped after {events} of {recorders}")
    return 0


async def _serve_until_signal(
    place: Place,
    projections: Sequence[Projection],
    settings: Settings,
    processes: Sequence[ChildProcess],
) -> DaemonSummary:
    stop = asyncio.Event()

    def handle_signal() -> None:
        if stop.is_set():
            os._exit(130)  # the second signal; events not stored are safe in the spool
        stop.set()
        watchdog = threading.Timer(STOP_S + _WATCHDOG_MARGIN_S, os._exit, (0,))
        watchdog.daemon = True
        watchdog.start()

    for each in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(each, handle_signal)
    return await serve(
        place.url,
        spool=place.spool,
        stop=stop,
        report=output.note,
        settings=settings,
        projections=projections,
        fold_workers=WORKERS,
        forked=processes,
    )


def store_once(
    place: Place,
    projections: Sequence[Projection],
    settings: Settings,
    *,
    as_json: bool,
    extra: Mapping[str, object] = MappingProxyType({}),
) -> int:
    """Append and fold all events of a spool, print the report and return the exit code.

    The JSON document also contains the entries of `extra`.
    """
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)  # the report contains all of these errors
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)  # the report omits those of projections
    with stderr.status("recovering the events of dead processes …"):
        report = asyncio.run(recover(place.url, spool=place.spool, settings=settings, projections=projections))
    if as_json:
        output.print_json({**extra, **_document(report)})
    else:
        _print(report)
    if report.drained.pending is not None:
        output.note(f"the tables do not show what is stored: {report.drained.pending}")
    for name, error in report.failed.items():
        remedy = ""
        if isinstance(error, SpoolDamaged):
            remedy = f"; repair it with: pycrorm spool repair {error.path.parent.parent}"
        output.problem(f"{name}: {error}{remedy}")
    for episode, reason in report.drained.stopped.items():
        output.problem(f"episode {episode} is stopped: {reason}{_dead_letters_text(report.dead_letters.get(episode))}")
    for episode, folder in report.dead_letters.items():
        if episode not in report.drained.stopped:
            output.problem(f"episode {episode} was refused{_dead_letters_text(folder)}")
    if any(isinstance(error, DamageError) for error in report.failed.values()):
        return 4
    if report.failed:
        return 3
    return 1 if report.drained.stopped or report.dead_letters else 0


def _dead_letters_text(folder: Path | None) -> str:
    return "" if folder is None else f"; its events are kept in {folder}"


def _print(report: RecoveryReport) -> None:
    drained = report.drained.drained
    events = sum(each.records for each in drained)
    dead = len(drained) - report.living
    living = f"{report.living} living, " if report.living else ""
    recorders, lost = output.counted(dead, "dead recorder"), output.counted(len(report.lost), "episode")
    output.stdout.print(f"{recorders}, {living}{events} events stored, {report.drained.folded} folded, {lost} LOST")
    for episode in report.lost:
        output.stdout.print(f"  LOST {episode}")


def _document(report: RecoveryReport) -> dict[str, object]:
    return {
        "recorders": [each.source for each in report.drained.drained],
        "events_stored": sum(each.records for each in report.drained.drained),
        "events_folded": report.drained.folded,
        "tables_pending": report.drained.pending,
        "lost": report.lost,
        "failed": {name: str(error) for name, error in report.failed.items()},
        "stopped": dict(report.drained.stopped),
        "dead_letters": {episode: str(folder) for episode, folder in report.dead_letters.items()},
    }
