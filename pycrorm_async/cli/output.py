"""Print tables, facts or one JSON document on stdout, and problems as single lines on stderr."""

from __future__ import annotations

import csv
import logging
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import msgspec
import typer
from rich.cells import cell_len
from rich.markup import escape
from rich.table import Table

from pycrorm_async.errors import CallerError
from pycrorm_async.progress_bar import VisibleConsole, stderr
from pycrorm_async.settings import FileAccess, Writer
from pycrorm_async.visible_text import escaped_json, visible, without_formula

if TYPE_CHECKING:
    from pycrorm_async.query.named_queries import EpisodeChoice

_WIDTH_PIPED = 10_000
"""Width in characters if stdout is not a terminal, so that `grep` finds whole lines; more would make huge tables."""

_WORD_MAX = 24
"""Bounds the longest word of a column for which a table needs room: ids and paths may be broken."""
_READABLE = 0.75
"""The least part of the width its words need at which a table is printed; with less, it would break most words."""

stdout = VisibleConsole(highlight=False, width=None if sys.stdout and sys.stdout.isatty() else _WIDTH_PIPED)


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
    sys.stdout.write(escaped_json(msgspec.json.format(encoded, indent=2).decode()) + "\n")


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, as_csv: bool | None = None
) -> None:
    """Print a table; columns of numbers alone are right-aligned. In a narrow terminal print a block for each row.

    `as_csv` is the value of `CsvOption`.
    """
    if as_csv is not None:
        lines = ([csv_cell(each, no_formulas=not as_csv) for each in row] for row in (columns, *rows))
        csv.writer(sys.stdout).writerows(lines)
        return
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


def csv_cell(value: object, *, no_formulas: bool) -> object:
    """Return a value as CSV has it: a pipe or file gets each text unchanged, a terminal visible control characters."""
    if not isinstance(value, str):
        return value.isoformat() if isinstance(value, datetime) else value
    text = without_formula(value) if no_formulas else value
    return visible(text) if stdout.is_terminal else text


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


# === options ==================================================================================================
#
# Define the command-line options that several verbs share.

WriterOption = Annotated[
    Writer,
    typer.Option(
        "--writer",
        envvar="PYCRORM_WRITER",
        help="The writer that moves events to the database: a thread of this process, a process of its own, or the"
        " daemon `pycrorm writer`.",
        show_envvar=True,
    ),
]
FileAccessOption = Annotated[
    FileAccess,
    typer.Option(
        "--file-access",
        envvar="PYCRORM_FILE_ACCESS",
        help="Permissions of a new spool and a new SQLite file: owner only (0700, 0600), or also the folder's group.",
        show_envvar=True,
    ),
]
ProjectionOption = Annotated[
    list[str] | None,
    typer.Option(
        "--projection",
        metavar="MODULE:CLASS",
        help="Custom projection to use, in addition to those of installed packages; repeatable.",
    ),
]
EpisodeArgument = Annotated[
    str, typer.Argument(help="The episode's number, its id or first digits of the id, or `last`.")
]
StatusOption = Annotated[
    str | None, typer.Option("--status", metavar="STATUS", help="Only episodes of this status: RUNNING, SUCCEEDED, …")
]
TagOption = Annotated[
    list[str] | None, typer.Option("--tag", metavar="TAG", help="Only episodes with this tag; repeatable: with all.")
]
LakeOption = Annotated[
    str | None,
    typer.Option(
        "--lake",
        "--to",
        "--from",
        envvar="PYCRORM_LAKE",
        metavar="LAKE",
        help="The lake: ducklake:FOLDER, or with its catalog on a server ducklake:postgresql://user@host/database#FOLDER.",
        show_envvar=True,
    ),
]
CsvOption = Annotated[
    bool | None,
    typer.Option(
        "--csv/--csv-no-formulas",
        help="Print CSV; without formulas: with an apostrophe before each text that a spreadsheet would run.",
        show_default=False,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]


class Chosen(NamedTuple):
    """The options that choose among episodes."""

    status: StatusOption = None
    since: Annotated[
        str | None,
        typer.Option(
            metavar="WHEN",
            help="Only episodes that started then or later: 2026-11-23, 2026-11-23T14:30, 90min, 7d.",
        ),
    ] = None
    tag: TagOption = None
    robot: Annotated[
        str | None, typer.Option(metavar="ROBOT", help="Only episodes with a robot of this name or model.")
    ] = None
    text: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Only episodes whose description, plan or a tag has this text.")
    ] = None
    limit: Annotated[int | None, typer.Option(metavar="N", min=1, help="Only the newest N of these episodes.")] = None

    def choice(self, limit: int | None = None) -> EpisodeChoice:
        """Return the choice, by default of at most this many."""
        from pycrorm_async.query.named_queries import EpisodeChoice  # loads the mapped classes

        since = None if self.since is None else parse_since(self.since)
        return EpisodeChoice(self.status, since, tuple(self.tag or ()), self.robot, self.text, self.limit or limit)


class Form(NamedTuple):
    """The form in which a verb prints its rows: a table, one JSON document, or CSV, also without formulas."""

    as_json: JsonOption = False
    as_csv: CsvOption = None

    @property
    def is_table(self) -> bool:
        """True if it is for a person to read."""
        return not self.as_json and self.as_csv is None


def print_rows(form: Form, document: Any, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print rows in their form: the document as JSON, or a table with a title, or CSV."""
    if form.as_json:
        print_json(document)
    else:
        print_table(title, columns, rows, as_csv=form.as_csv)


# === values ===================================================================================================
#
# Parse the values of options: the earliest start of an episode, as a date, a time, or an age; and sizes of pictures.

_AGE = re.compile(r"(\d{1,6})\s*(min|h|d|w|y)")
_UNITS = {
    "min": timedelta(minutes=1),
    "h": timedelta(hours=1),
    "d": timedelta(days=1),
    "w": timedelta(weeks=1),
    "y": timedelta(days=365),
}


def parse_age(text: str) -> timedelta | None:
    """Return the age, such as 90d; None if the text is none. Raises `OverflowError` for one that is too great."""
    age = _AGE.fullmatch(text.strip())
    return int(age[1]) * _UNITS[age[2]] if age else None


def parse_since(text: str, now: datetime | None = None) -> datetime:
    """Return the time.

    A time without a zone is in UTC, as the verbs print times; an age counts back from `now`.

    >>> parse_since("2026-11-23 14:30").isoformat()
    '2026-11-23T14:30:00+00:00'

    Raises `CallerError` for another text.
    """
    try:
        if (age := parse_age(text)) is not None:
            return (now or datetime.now(UTC)) - age
        moment = datetime.fromisoformat(text.strip())
    except (ValueError, OverflowError):
        raise CallerError(
            f"{text!r} is not a time: write 2026-11-23, '2026-11-23 14:30' (UTC), 2026-11-23T14:30+01:00,"
            " or an age such as 90min, 12h, 7d, 2w"
        ) from None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


def parse_size(option: str, text: str) -> tuple[int, int]:
    """Return width and height, in pixels, of a text such as 640x480. Raises `CallerError`."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise CallerError(f"{option} takes width and height in pixels, such as 640x480, got {text!r}")
    return int(width), int(height)
