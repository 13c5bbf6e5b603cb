"""The options every verb shares."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["UrlOption", "SpoolOption", "JsonOption", "DEFAULT_URL"]

DEFAULT_URL = "sqlite:///pycrorm.db"

UrlOption = Annotated[
    str,
    typer.Option(
        "--url",
        envvar="PYCRORM_URL",
        help="The database: sqlite:///memory.db, sqlite:////absolute/path.db.",
        show_envvar=True,
    ),
]
SpoolOption = Annotated[
    Path | None,
    typer.Option(
        "--spool", envvar="PYCRORM_SPOOL", help="The write-ahead queue's folder; default: beside the database."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Answer with one JSON document.")]
