"""`pycrorm datasette-metadata` prints the metadata with which Datasette shows a memory well."""

from __future__ import annotations

import asyncio
from typing import Any

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import print_json
from pycrorm_async.cli.pending_events import note_pending_events
from pycrorm_async.export.datasette import datasette_metadata as describe
from pycrorm_async.query.reading import Reading

__all__ = ["datasette_metadata"]


def datasette_metadata(
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,  # noqa: ARG001  it always prints JSON
) -> None:
    """Print Datasette's metadata of a SQLite memory: hidden tables, descriptions, facets, named questions."""

    async def read() -> dict[str, Any]:
        async with Reading.open(url) as reading:
            return await describe(reading)

    metadata = asyncio.run(read())
    note_pending_events(url, spool)
    print_json(metadata)
