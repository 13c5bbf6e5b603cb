"""Print tables, facts or one JSON document on stdout, and problems as single lines on stderr."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any

import msgspec
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pycrorm_async.progress_bar import stderr

_WIDTH_PIPED = 160
"""Width of tables in characters if stdout is not a terminal; wide enough to keep most rows on one line."""

_WORD_MAX = 24
"""Bounds the longest word of a column for which a table needs room: ids and paths may be broken."""
_READABLE = 0.75
"""The least part of the width its words need at which a table is printed; with less, it would break most words."""

stdout = Console(highlight=False, width=None if sys.stdout and sys.stdout.isatty() else _WIDTH_PIPED)


def problem(line: str) -> None:
    """Print a problem, and the command that solves it, as one line on stderr."""
    stderr.print(f"[bold red]pycrorm:[/] {escape(' '.join(line.split()))}")


def write_last(line: str) -> None:
    """Write a problem with one system call, for a signal handler that then calls `os._exit`.

    The signal may interrupt a line that `stderr` is printing. The console would buffer a second line until the first
    is complete, and `os._exit` would discard it.
    """
    cursor = "\x1b[?25h" if stderr.is_terminal else ""  # a progress bar may have hidden the cursor
    with suppress(OSError):
        os.write(2, f"{cursor}pycrorm: {line}\n".encode())


def note(line: str) -> None:
    """Print an additional line of information on stderr."""
    stderr.print(f"[dim]{escape(line)}[/]")


class LogLines(logging.Handler):
    """Prints each message of a log on stderr, above a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one message."""
        style = "bold red" if record.levelno >= logging.ERROR else "yellow"
        stderr.print(f"[{style}]{record.levelname:<8}[/] {escape(self.format(record))}")


def print_json(document: Any) -> None:
    """Print the JSON document of a `--json` call on stdout."""
    encoded = msgspec.json.Encoder(enc_hook=str, decimal_format="number").encode(document)
    sys.stdout.write(msgspec.json.format(encoded, indent=2).decode() + "\n")


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table; columns of numbers alone are right-aligned. In a narrow terminal print a block for each row."""
    rows = [tuple(row) for row in rows]
    stdout.print(f"[bold]{escape(title)}[/]")  # not the title of the table, which is wrapped to the table's width
    if stdout.width < _READABLE * _width_of_words(columns, rows):
        for row in rows:
            _print_block(columns, row)
        return
    table = Table(header_style="bold")
    for index, name in enumerate(columns):
        numeric = bool(rows) and all(isinstance(row[index], int | float) for row in rows)
        table.add_column(escape(name), justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        table.add_row(*(_cell(value) for value in row))
    stdout.print(table)


def _width_of_words(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> int:
    """Return the width of a table whose columns have room for their longest words."""
    return 1 + sum(
        3 + min(_WORD_MAX, max(cell_len(word) for value in (name, *cells) for word in _cell(value).split() or [""]))
        for name, *cells in zip(columns, *rows, strict=True)
    )


def _print_block(columns: Sequence[str], row: Sequence[object]) -> None:
    """Print a row as a line for each value that is not empty, and an empty line."""
    for name, value in zip(columns, row, strict=True):
        if value not in (None, ""):
            stdout.print(f"  [dim]{escape(name.ljust(max(map(len, columns))))}[/] {_cell(value)}", soft_wrap=True)
    stdout.print()


def print_line(text: object) -> None:
    """Print a line without wrapping, so that users can copy its paths, addresses and ids."""
    stdout.print(str(text), markup=False, soft_wrap=True)


def print_facts(title: str, facts: Mapping[str, object]) -> None:
    """Print a title, then one line for each fact that is neither None nor empty."""
    stdout.print(f"[bold]{escape(title)}[/]")
    for name, value in facts.items():
        if value not in (None, ""):
            stdout.print(f"  [dim]{name:<9}[/] {_cell(value)}")


def counted(number: int, noun: str) -> str:
    """Format a number of objects.

    >>> counted(1, "row"), counted(1_200, "row")
    ('1 row', '1,200 rows')
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def moment(when: datetime) -> str:
    """Format a moment to the second, in its own time zone; all callers pass UTC."""
    return when.strftime("%Y-%m-%d %H:%M:%S")


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.3f}"
    return escape(str(value))
