"""The options every verb shares."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.config import Writer

__all__ = ["UrlOption", "SpoolOption", "JsonOption", "WriterOption", "ProjectionOption", "DEFAULT_URL"]

DEFAULT_URL = "sqlite:///pycrorm.db"

UrlOption = Annotated[
    str,
    typer.Option(
        "--url",
        envvar="PYCRORM_URL",
        help="The database: sqlite:///memory.db, sqlite:////absolute/path.db, postgresql://user@host/database.",
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
ProjectionOption = Annotated[
    list[str] | None,
    typer.Option(
        "--projection",
        metavar="MODULE:CLASS",
        help="A projection of your own, besides those that installed packages offer; may be given again.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Answer with one JSON document.")]
