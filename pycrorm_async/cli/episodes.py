"""`pycrorm episodes`: what the memory holds, an episode a line; what was only thought through if asked for."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Annotated

import typer

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import duration, moment, print_json, print_table
from pycrorm_async.cli.pending_events import note_what_waits
from pycrorm_async.cli.tree import thinker_text
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress

__all__ = ["episodes"]


def episodes(
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Also those that were only thought through (SimulatedTaskTree).")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List the remembered episodes."""

    async def asked() -> list[EpisodeSummary]:
        async with Reading.open(url) as reading:
            return await reading.episodes(simulated=simulated)

    found = asyncio.run(asked())
    note_what_waits(url, spool)
    if as_json:
        print_json(found)
        return
    numbers = {e.id: e.number for e in found}
    columns: tuple[str, ...] = ("episode", "started", "took", "status", "nodes", "failed", "description")
    rows: list[tuple[object, ...]] = [
        (e.number, moment(e.started_at), duration(e.duration_ns), e.status, e.nodes, e.failed, _description(e, numbers))
        for e in found
    ]
    if simulated:
        columns = (*columns, "thought through")
        rows = [(*row, thinker_text(e) if e.simulated else "") for row, e in zip(rows, found, strict=True)]
    print_table(f"Episodes of {DatabaseAddress.parse(url)}", columns, rows)


def _description(episode: EpisodeSummary, numbers: Mapping[str, int]) -> str:
    """The description, and the episode of which this one is the rest, by its number where the list has it."""
    if episode.continues is None:
        return episode.description
    return f"{episode.description} (continues episode {numbers.get(episode.continues, episode.continues)})"
