"""`pycrorm report EPISODE` writes an episode as one HTML file: tree, chart, scene, failures, observations."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import note, print_json, stdout
from pycrorm_async.cli.pending_events import note_pending_events
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.write import Report
from pycrorm_async.report.write import report as write_report

__all__ = ["report"]


def report(
    episode: Annotated[str, typer.Argument(help="The episode's number, its id or first digits of the id, or `last`.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.html", help="The file to write; default: episode-NUMBER.html."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
    first: Annotated[
        int | None, typer.Option("--from", min=1, metavar="SEQUENCE", help="Show events from this one on.")
    ] = None,
    last: Annotated[
        int | None, typer.Option("--to", min=1, metavar="SEQUENCE", help="Show events up to this one.")
    ] = None,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write an episode as one HTML page that opens offline: task tree, Gantt chart, 3D scene, failures."""

    async def write() -> Report:
        async with Reading.open(url) as reading:
            return await write_report(reading, episode, out, force=force, first=first, last=last)

    written = asyncio.run(write())
    note_pending_events(url, spool)
    size = written.path.stat().st_size
    if as_json:
        shown = {"first": written.first, "last": written.last, "events": written.events}
        print_json({"file": written.path, "bytes": size, **shown})
        return
    stdout.print(str(written.path), markup=False, highlight=False, soft_wrap=True)
    note(f"The page has {size / 1e6:.1f} MB and opens in any browser, also offline.")
    if first is None and last is None and written.last < written.events:
        note(
            f"It shows the events {written.first} to {written.last} of {written.events}, because there are more nodes"
            f" than a page can hold; the next page: --from {written.last + 1}"
        )
