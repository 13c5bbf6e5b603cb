"""`pycrorm datasette-metadata` prints Datasette's metadata of a memory: hidden tables, descriptions, questions."""

from __future__ import annotations

from pycrorm_async.cli.output import DEFAULT_URL, JsonOption, SpoolOption, UrlOption, print_json
from pycrorm_async.cli.reading import read_memory
from pycrorm_async.export.export import datasette_metadata as describe


def datasette_metadata(
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,  # noqa: ARG001  it always prints JSON
) -> None:
    """Print Datasette's metadata of a SQLite memory: hidden tables, descriptions, facets, named questions."""
    print_json(read_memory(url, spool, describe))
