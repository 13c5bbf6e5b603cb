"""The options every verb shares."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.settings import FileAccess, Writer

__all__ = [
    "UrlOption",
    "SpoolOption",
    "JsonOption",
    "WriterOption",
    "FileAccessOption",
    "ProjectionOption",
    "DEFAULT_URL",
]

DEFAULT_URL = "sqlite:///pycrorm.db"

UrlOption = Annotated[
    str,
    typer.Option(
        "--url",
        envvar="PYCRORM_URL",
        help="The database: sqlite:///memory.db, sqlite:////absolute/path.db, postgresql://user@host/database."
        " A password given here is visible in the list of processes: put it into the environment variable, or into"
        " ~/.pgpass.",
        show_envvar=True,
    ),
]
SpoolOption = Annotated[
    Path | None,
    typer.Option(
        "--spool", envvar="PYCRORM_SPOOL", help="The write-ahead queue's folder; default: beside the database."
    ),
]
WriterOption = Annotated[
    Writer,
    typer.Option(
        "--writer",
        envvar="PYCRORM_WRITER",
        help="Who moves events to the database: a thread of this process, or the daemon `pycrorm writer`.",
        show_envvar=True,
    ),
]
FileAccessOption = Annotated[
    FileAccess,
    typer.Option(
        "--file-access",
        envvar="PYCRORM_FILE_ACCESS",
        help="A new spool and a new SQLite file are for their owner alone (0700, 0600), or for their folder's group.",
        show_envvar=True,
    ),
]
ProjectionOption = Annotated[
    list[str] | None,
    typer.Option(
        "--projection",
        metavar="MODULE:CLASS",
        help="A projection of your own, besides those that installed packages offer; may be given again.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Answer with one JSON document.")]
