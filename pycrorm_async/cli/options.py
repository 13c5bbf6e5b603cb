"""Define the command-line options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.settings import FileAccess, Writer

DEFAULT_URL = "sqlite:///pycrorm.db"

UrlOption = Annotated[
    str,
    typer.Option(
        "--url",
        envvar="PYCRORM_URL",
        help="The database: sqlite:///memory.db, sqlite:////absolute/path.db, postgresql://user@host/database."
        " The list of processes shows a password in this option; put it into the environment variable or ~/.pgpass.",
        show_envvar=True,
    ),
]
SpoolOption = Annotated[
    Path | None,
    typer.Option(
        "--spool", envvar="PYCRORM_SPOOL", help="Folder of the write-ahead queue; default: beside the database."
    ),
]
WriterOption = Annotated[
    Writer,
    typer.Option(
        "--writer",
        envvar="PYCRORM_WRITER",
        help="The writer that moves events to the database: a thread of this process, or the daemon `pycrorm writer`.",
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
SinceOption = Annotated[
    str | None,
    typer.Option(
        "--since",
        metavar="WHEN",
        help="Only episodes that started then or later: 2026-11-23, 2026-11-23T14:30, 90min, 7d.",
    ),
]
TagOption = Annotated[
    list[str] | None, typer.Option("--tag", metavar="TAG", help="Only episodes with this tag; repeatable: with all.")
]
RobotOption = Annotated[
    str | None, typer.Option("--robot", metavar="ROBOT", help="Only episodes with a robot of this name or model.")
]
TextOption = Annotated[
    str | None,
    typer.Option("--text", metavar="TEXT", help="Only episodes whose description, plan or a tag has this text."),
]
LimitOption = Annotated[
    int | None, typer.Option("--limit", metavar="N", min=1, help="Only the newest N of these episodes.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]
