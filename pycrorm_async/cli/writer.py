"""`pycrorm writer --once`: recover, append and fold what dead processes left in a spool."""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer

from pycrorm_async.adoption import RecoveryReport, recover
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import print_json, problem, stderr, stdout
from pycrorm_async.errors import CallerError, DamageError

__all__ = ["writer"]


def writer(
    once: Annotated[bool, typer.Option("--once", help="Recover, append and fold all there is, then exit.")] = False,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,
) -> int:
    """Bring what dead processes left in the spool into the database.

    Exit code 0 also when an episode was lost with its process; 4 if files are damaged, 1 if an episode is stopped.
    """
    if not once:
        raise CallerError("`pycrorm writer` runs with --once: a live process writes its own events")
    with stderr.status("recovering what dead processes left …"):
        report = asyncio.run(recover(url, spool=spool))
    if as_json:
        print_json(_document(report))
    else:
        _print(report)
    for name, error in report.failed.items():
        problem(f"{name}: {error}")
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
    stdout.print(
        f"{len(drained)} dead recorder{'' if len(drained) == 1 else 's'}, {events} events stored,"
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
