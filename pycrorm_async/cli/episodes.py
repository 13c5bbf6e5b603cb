"""`pycrorm episodes` lists the recorded episodes, one per line; simulated ones on request."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import typer

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import moment, note, print_json, print_table, stdout
from pycrorm_async.cli.reading import read_memory
from pycrorm_async.cli.since import parse_since
from pycrorm_async.cli.tree import simulated_by
from pycrorm_async.query.asking.episode_list import EpisodeChoice
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.parameter_text import duration
from pycrorm_async.store.address import DatabaseAddress

_WIDTH_WITH_ROBOTS = 100
"""Bounds the width of a terminal on which the table has the robots: on one of 80 characters the description has none
to spare."""


def episodes(
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Also list simulated episodes (SimulatedTaskTree).")
    ] = False,
    status: Annotated[
        str | None, typer.Option(metavar="STATUS", help="List only episodes of this status: RUNNING, SUCCEEDED, …")
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(
            metavar="WHEN",
            help="List only episodes that started then or later: 2026-11-23, 2026-11-23T14:30, 90min, 7d.",
        ),
    ] = None,
    tag: Annotated[
        list[str] | None, typer.Option(metavar="TAG", help="List only episodes with this tag; repeatable: with all.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(metavar="ROBOT", help="List only episodes with a robot of this name or model.")
    ] = None,
    text: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="List only episodes whose description, plan or a tag has this text."),
    ] = None,
    limit: Annotated[int | None, typer.Option(metavar="N", min=1, help="List only the newest N of them.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List the recorded episodes, the oldest first."""
    earliest = None if since is None else parse_since(since)
    choice = EpisodeChoice(status, earliest, tuple(tag or ()), robot, text, limit)
    summaries = read_memory(url, spool, lambda reading: reading.episodes(choice, simulated=simulated))
    if as_json:
        print_json(summaries)
        return
    if not summaries:
        chosen = choice != EpisodeChoice()
        note(
            "no episode matches these options; `pycrorm episodes` lists all"
            if chosen
            else "no episode yet: record one with `pycrorm run` or `pycrorm demo`"
        )
        return
    numbers = {e.id: e.number for e in summaries}
    columns: tuple[str, ...] = ("episode", "started", "took", "status", "nodes", "failed", "description")
    rows: list[tuple[object, ...]] = [
        (e.number, moment(e.started_at), duration(e.duration_ns), e.status, e.nodes, e.failed, _description(e, numbers))
        for e in summaries
    ]
    if stdout.width >= _WIDTH_WITH_ROBOTS and any(each.robots for each in summaries):
        columns = (*columns, "robots")
        names = (", ".join(robot.name for robot in each.robots) for each in summaries)
        rows = [(*row, name) for row, name in zip(rows, names, strict=True)]
    if any(each.tags for each in summaries):
        columns = (*columns, "tags")
        rows = [(*row, ", ".join(e.tags)) for row, e in zip(rows, summaries, strict=True)]
    if simulated:
        columns = (*columns, "simulated")
        rows = [(*row, simulated_by(e) if e.simulated else "") for row, e in zip(rows, summaries, strict=True)]
    print_table(f"Episodes of {DatabaseAddress.parse(url)}", columns, rows)


def _description(episode: EpisodeSummary, numbers: Mapping[str, int]) -> str:
    """Return the description; for a follow-up with the episode it continues, by number if that is in the list."""
    if episode.continues is None:
        return episode.description
    return f"{episode.description} (continues episode {numbers.get(episode.continues, episode.continues)})"
