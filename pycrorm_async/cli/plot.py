"""Draw how often actions succeeded over two columns of a view.

Panel: Ask, 4.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Any

import typer

from pycrorm_async.cli.output import JsonOption, note, print_json, print_line
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.success import Kind, SuccessTable, success_figure, success_samples, success_table
from pycrorm_async.report.output_files import refuse_existing, write_file

_SUFFIXES = (".png", ".svg", ".pdf")


def plot(
    *,
    x: Annotated[str, typer.Argument(help="The column along the bottom: numbers, times, texts or enums.")],
    y: Annotated[str, typer.Argument(help="The column along the side.")],
    of: Annotated[
        str, typer.Option(metavar="VIEW", help="The view, mapped class or designator type that has both and a status.")
    ] = "PickUpWithContextView",
    kind: Annotated[
        Kind,
        typer.Option(help="Shares of successes in cells, or each row as a point; auto: points for up to 500 rows."),
    ] = "auto",
    bins: Annotated[
        int | None,
        typer.Option(
            min=1, max=200, help="Divide a numeric column into at most N ranges; default: more for more rows."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file to write: .png, .svg or .pdf.")] = Path(
        "success.png"
    ),
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
    place: ReadingPlace,
    as_json: JsonOption = False,
) -> None:
    """Draw how often actions succeeded over two columns of a view: where, with which arm, how long.

    Needs the extra 'pictures'. With --json the counts of all cells are printed too.
    """
    if out.suffix not in _SUFFIXES:
        raise CallerError(f"--out {out} must end in one of {', '.join(_SUFFIXES)}")
    refuse_existing(out, force=force)
    samples = place.read(lambda reading: success_samples(reading, x, y, of))
    buffer = io.BytesIO()
    success_figure(samples, kind=kind, bins=bins).savefig(buffer, format=out.suffix[1:], dpi=120)
    write_file(buffer.getvalue(), out, force=force)
    table = success_table(samples, bins=bins)
    if as_json:
        print_json({"file": out, **_document(table)})
        return
    print_line(out)
    note(f"{table.succeeded:,} of {table.rows:,} rows succeeded.")


def _document(table: SuccessTable) -> dict[str, Any]:
    cells = [
        {
            table.x.name: table.x.cell_text(each.x),
            table.y.name: table.y.cell_text(each.y),
            "succeeded": each.succeeded,
            "rows": each.rows,
            "interval": [round(limit, 3) for limit in each.interval],
        }
        for each in table.cells
    ]
    counts = {"succeeded": table.succeeded, "rows": table.rows, "missing": table.missing, "running": table.running}
    return {"view": table.source, **counts, "cells": cells}
