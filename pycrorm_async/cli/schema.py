"""Describe the views of a memory and their columns.

Panel: Ask, 6.
"""

from __future__ import annotations

import sys
from typing import Annotated, Literal

import typer

from pycrorm_async.cli.output import JsonOption, print_json
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.memory_schema import CORE_VIEWS, as_mermaid, as_text, read_schema
from pycrorm_async.visible_text import visible


def schema(
    *,
    views: Annotated[
        list[str] | None, typer.Argument(metavar="VIEW...", help="Only these views; by default all of them.")
    ] = None,
    form: Annotated[
        Literal["text", "mermaid"],
        typer.Option("--format", help="mermaid: a diagram, by default of the views that most queries read."),
    ] = "text",
    place: ReadingPlace,
    as_json: JsonOption = False,
) -> None:
    """Describe the views of a memory: the meaning of a row, and each column with its type, unit and reference."""
    if as_json and form == "mermaid":
        raise CallerError("--json and --format mermaid exclude each other")
    names = tuple(views or (CORE_VIEWS if form == "mermaid" else ()))
    described = place.read(lambda reading: read_schema(reading, names))
    if as_json:
        print_json(described)
    else:
        sys.stdout.write(visible((as_mermaid if form == "mermaid" else as_text)(described)) + "\n")
