"""Record the files of other programs: traces, bags, logs of behaviour trees, data sets.

Panel: Record, 2.
"""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from pycrorm_async.cli import output
from pycrorm_async.cli.interruption import interrupt_on_termination
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.export.formats import format_names
from pycrorm_async.imports.intake import ImportReport
from pycrorm_async.imports.registry import BUILT_IN, GROUP, import_files
from pycrorm_async.memory import Memory
from pycrorm_async.progress_bar import ProgressCallback, progress_bar, stderr
from pycrorm_async.query.reading import Reading
from pycrorm_async.settings import Settings

_SHOWN = 50
"""Bounds the episodes of the table, as for `pycrorm episodes`; `--json` prints all."""
_SETTINGS = Settings(fold="at_end", flush_timeout_s=300)
"""No robot waits for an import, and on a busy machine one batch of a large one may fold for longer than 15 s."""
_COUNTS = ("nodes", "objects", "changes", "samples", "observations")


def import_(
    *,
    file_format: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT",
            help=f"The format of the files: {', '.join(BUILT_IN)}.",
            autocompletion=lambda: format_names(GROUP, BUILT_IN),
        ),
    ],
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="The files or folders to import.")],
    map_file: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE.toml", help="Names and settings for this format."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only count what would be recorded.")] = False,
    place: Place,
    as_json: output.JsonOption = False,
) -> int:
    """Record files of other programs as episodes, with the times that they hold. It is safe to repeat.

    An episode that the memory holds already is not recorded again; after an interruption, run it again to record the
    rest. Exit code 4 if a file is cut in the middle: what stands before is recorded.
    """
    interrupt_on_termination()
    with progress_bar("reading", unit="") as shown:
        report_progress = shown if stderr.is_terminal else None
        if dry_run:
            stored = asyncio.run(_stored_ids(place))
            report = import_files(
                file_format, paths, None, map_file=map_file, stored=stored, report_progress=report_progress
            )
        else:
            report = _record(file_format, paths, map_file, place, report_progress)
    _print(report, as_json=as_json)
    for line in report.cut:
        output.problem(line)
    refused = [f"episode {each.id} is not whole: {each.refusal}" for each in report.episodes if each.refusal]
    for line in refused:
        output.problem(line)
    return 4 if report.cut else 1 if refused else 0


def _record(
    file_format: str, paths: list[Path], map_file: Path | None, place: Place, report_progress: ProgressCallback | None
) -> ImportReport:
    place.shared_address  # noqa: B018  refuses sqlite://, which would end with this process
    with Memory.sync(place.url, spool=place.spool, settings=_SETTINGS) as memory:
        report = import_files(file_format, paths, memory.recording, map_file=map_file, report_progress=report_progress)
        memory.flush()
        status = memory.status
    for what, total, last in (("values", *status.missing), ("reports", *status.faults)):
        if total:
            report.left_out[what, f"they are not recorded, or not as they are; the last: {last}"] += total
    return report


async def _stored_ids(place: Place) -> set[str]:
    """Return the ids of the episodes whose end the memory holds; none of a memory that does not exist yet."""
    try:
        async with Reading.open(place.url) as reading:
            log = await reading.log()
            return {each.id for each in await log.episodes() if each.ended_wall_ns is not None}
    except DatabaseUnavailable:
        return set()


def _print(report: ImportReport, *, as_json: bool) -> None:
    left_out = [{"what": what, "why": why, "count": count} for (what, why), count in report.left_out.most_common()]
    if as_json:
        episodes: list[dict[str, Any]] = [asdict(each) | {"statuses": each.statuses} for each in report.episodes]
        output.print_json({"format": report.format, "episodes": episodes, "left_out": left_out, "cut": report.cut})
        return
    rows = [
        (each.id, each.description, each.state, *(getattr(each, name) for name in _COUNTS)) for each in report.episodes
    ]
    output.print_table(f"From {report.format}", ("episode", "description", "state", *_COUNTS), rows[:_SHOWN])
    if rows[_SHOWN:]:
        output.note(f"and {output.counted(len(rows) - _SHOWN, 'further episode')}: --json lists them")
    if left_out:
        columns = "what", "count", "why"
        output.print_table("Left out", columns, [tuple(each[name] for name in columns) for each in left_out])
