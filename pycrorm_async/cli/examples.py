"""Copy the example notebooks, to be run and changed.

Panel: Record, 1.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli.output import JsonOption, note, print_json, print_line
from pycrorm_async.errors import CallerError


def examples(
    *,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to; it is made if it does not exist.")] = Path(
        "pycrorm-examples"
    ),
    as_json: JsonOption = False,
) -> None:
    """Copy the example notebooks into a folder. A file that exists there, and differs, is never overwritten."""
    notebooks = [each for each in files("pycrorm_async.examples").iterdir() if each.name.endswith(".ipynb")]
    copies = {folder / each.name: each.read_text() for each in sorted(notebooks, key=lambda each: each.name)}
    if changed := [str(path) for path, text in copies.items() if path.exists() and path.read_text() != text]:
        raise CallerError(f"{', '.join(changed)} would be overwritten: name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for path, text in copies.items():
        path.write_text(text)
    titles = {str(path): json.loads(text)["cells"][0]["source"][0].strip("# \n") for path, text in copies.items()}
    if as_json:
        print_json(titles)
        return
    for name, title in titles.items():
        print_line(f"{name}  {title}")
    note(f"to open them: pip install jupyterlab 'pycrorm-async[all]', jupyter lab {folder}")
