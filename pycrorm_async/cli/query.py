"""Run one read-only query in SQL.

Panel: Ask, 5.
"""

from __future__ import annotations

import csv
import math
import sys
from typing import Annotated, Any, Literal

import typer

from pycrorm_async.cli.output import Form, counted, csv_cell, note, print_rows
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.sql import SqlLimits, SqlResult, json_rows

_ROWS = 1_000
"""Bounds the printed rows by default; `--limit 0` prints all."""
_MEGABYTE = 1_000_000


def query(
    *,
    sql: Annotated[str, typer.Argument(metavar="SQL", help="One SELECT; `-` reads it from stdin.")],
    layout: Annotated[
        Literal["table", "csv", "json"], typer.Option("--format", help="csv prints the rows while the query runs.")
    ] = "table",
    limit: Annotated[
        int, typer.Option(metavar="ROWS", min=0, help="Return at most this many rows; 0: any number.")
    ] = _ROWS,
    megabytes: Annotated[float, typer.Option(metavar="MB", help="Return at most this size of rows.")] = 16.0,
    seconds: Annotated[float, typer.Option(metavar="S", help="Time that the database may take.")] = 10.0,
    place: ReadingPlace,
    form: Form,
) -> None:
    """Run one read-only query in SQL: no statement can change the memory or the machine.

    On PostgreSQL it runs as the role pycrorm_reader, which `pycrorm roles --create` makes. Times are integers, µs
    since 1970-01-01 UTC; columns that end in _ns are ns of the robot's monotonic clock. Bytes are hexadecimal
    digits; JSON has "NaN", "Infinity" and "-Infinity" as texts.
    """
    text = sys.stdin.read() if sql == "-" else sql
    if not 0 < megabytes < math.inf:
        raise CallerError(f"--megabytes must be > 0 and finite, got {megabytes}")
    limits = SqlLimits(rows=limit or None, bytes=max(int(megabytes * _MEGABYTE), 1), seconds=seconds)
    if form.as_json and layout == "csv":
        raise CallerError("--json and --format csv exclude each other")
    if layout == "csv" or form.as_csv is not None:
        more = place.read(lambda reading: _write_csv(reading, text, limits, no_formulas=form.as_csv is False))
    else:
        result = place.read(lambda reading: reading.query(text, limits))
        more = result.more
        form = Form(form.as_json or layout == "json")
        rows = ([*map(_cell, row)] for row in result.rows)
        print_rows(form, _document(result), counted(len(result.rows), "row"), result.columns, rows)
    if more:
        note(
            f"the query has more rows: these are the first, up to {limit or 'any number of'} rows and {megabytes:g} MB;"
            " --limit and --megabytes raise the limits."
        )


async def _write_csv(reading: Reading, sql: str, limits: SqlLimits, *, no_formulas: bool) -> bool:
    async with reading.stream(sql, limits) as rows:
        lines = csv.writer(sys.stdout)
        lines.writerow(rows.columns)
        async for row in rows:
            lines.writerow(
                csv_cell(each, no_formulas=no_formulas) if isinstance(each, str) else _cell(each) for each in row
            )
        sys.stdout.flush()
        return rows.more


def _document(result: SqlResult) -> dict[str, Any]:
    rows = [dict(zip(result.names, row, strict=True)) for row in json_rows(result.rows)]
    return {"columns": result.names, "rows": rows, "more": result.more}


def _cell(value: Any) -> Any:
    """Return a value of the table: numbers with all their digits, bytes in hexadecimal digits."""
    return (
        repr(value)
        if isinstance(value, float)
        else ""
        if value is None
        else value.hex()
        if isinstance(value, bytes | memoryview)
        else value
    )
