"""`pycrorm show EPISODE`: one episode: what it was, and its task tree; with `--at`, as it was then, and the world."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import duration, moment, print_facts, print_json
from pycrorm_async.cli.pending_events import note_what_waits
from pycrorm_async.cli.snapshot_view import asked_moment, print_moment
from pycrorm_async.cli.tree import print_tree, thinker_text
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import Moment

__all__ = ["show"]


def show(
    episode: Annotated[str, typer.Argument(help="Its number, its id, or the first digits of its id; `last`.")],
    at: Annotated[
        str | None,
        typer.Option(help="Show it as it was then: seconds since its start, or an event as '#300'.", metavar="WHEN"),
    ] = None,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show an episode's task tree, with statuses and durations; or tree and world at any moment of it."""
    if at is None:
        _show(episode, url, spool, as_json=as_json)
    else:
        _show_moment(episode, at, url, spool, as_json=as_json)


def _show(episode: str, url: str, spool: Path | None, *, as_json: bool) -> None:
    async def asked() -> tuple[EpisodeSummary, list[NodeSummary]]:
        async with Reading.open(url) as reading:
            found = await reading.episode(episode)
            return found, await reading.tree(found.number)

    found, tree = asyncio.run(asked())
    note_what_waits(url, spool)
    if as_json:
        print_json({"episode": found, "tree": tree})
        return
    print_facts(
        f"Episode {found.number}: {found.description}",
        {
            "id": found.id,
            "started": f"{moment(found.started_at)} UTC",
            "by": found.created_by,
            "took": duration(found.duration_ns),
            "status": found.status,
            "continues": f"episode {found.continues}" if found.continues else None,
            "goes on": f"in episode {found.continued_in}" if found.continued_in else None,
            "simulated": f"thought through {thinker_text(found)}; nothing of it happened" if found.simulated else None,
        },
    )
    print_tree(tree)


def _show_moment(episode: str, at: str, url: str, spool: Path | None, *, as_json: bool) -> None:
    time, sequence = asked_moment(at)

    async def asked() -> Moment:
        async with Reading.open(url) as reading:
            return await reading.as_of(episode, time=time, sequence=sequence)

    then = asyncio.run(asked())
    note_what_waits(url, spool)
    if as_json:
        print_json(then)
    else:
        print_moment(then, at if sequence is not None else f"{time:g} s")
