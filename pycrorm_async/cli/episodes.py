"""`pycrorm episodes`: what the memory holds, an episode a line."""

from __future__ import annotations

import asyncio

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import duration, moment, print_json, print_table
from pycrorm_async.cli.waiting import note_what_waits
from pycrorm_async.query.questions import EpisodeSummary
from pycrorm_async.query.reading import Reading

__all__ = ["episodes"]


def episodes(url: UrlOption = DEFAULT_URL, spool: SpoolOption = None, as_json: JsonOption = False) -> None:
    """List the remembered episodes."""

    async def asked() -> list[EpisodeSummary]:
        async with Reading.open(url) as reading:
            return await reading.episodes()

    found = asyncio.run(asked())
    note_what_waits(url, spool)
    if as_json:
        print_json(found)
        return
    print_table(
        f"Episodes of {url}",
        ("episode", "started", "took", "status", "nodes", "failed", "description"),
        [
            (e.number, moment(e.started_at), duration(e.duration_ns), e.status, e.nodes, e.failed, e.description)
            for e in found
        ],
    )
