"""List the recorded episodes, the oldest first.

Panel: Look at episodes, 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import typer

from pycrorm_async.cli import output
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.cli.show import simulated_by
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.question import absence_of_episodes
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import duration

_LISTED = 50
"""The episodes that are listed without --limit or --all: about as many as a terminal has lines."""
_WIDTH_WITH_ROBOTS = 100
"""Bounds the width of a terminal on which the table has the robots: on one of 80 characters the description has none
to spare."""


def episodes(
    *,
    place: ReadingPlace,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Also list simulated episodes (SimulatedTaskTree).")
    ] = False,
    chosen: output.Chosen,
    every: Annotated[bool, typer.Option("--all", help=f"All of them, instead of the newest {_LISTED}.")] = False,
    form: output.Form,
) -> None:
    """List the newest 50 of the recorded episodes, the oldest of them first, and say how many there are."""
    choice = chosen.choice(None if every else _LISTED)

    async def read(reading: Reading) -> tuple[list[EpisodeSummary], int, str]:
        if removed := len(await (await reading.log()).all_removed()):
            output.note(f"{output.counted(removed, 'episode')} archived or erased: `pycrorm erase` lists them")
        listed = await reading.episodes(choice, simulated=simulated)
        if len(listed) != choice.limit:
            return listed, len(listed), "" if listed else await absence_of_episodes(reading, choice)
        [(total,)] = await reading.rows(choice.counted(), simulated=simulated)
        return listed, total, ""

    summaries, total, absence = place.read(read)
    if form.as_json:
        output.print_json(summaries)
    if total > len(summaries):
        output.note(f"the newest {len(summaries)} of {total:,} episodes; --all lists all, --limit N the newest N")
    if form.as_json:
        return
    if not summaries:
        output.note(absence)
        if form.is_table:
            return
    numbers = {e.id: e.number for e in summaries}
    columns: tuple[str, ...] = ("episode", "started", "took", "status", "nodes", "failed", "description")
    rows: list[tuple[object, ...]] = [
        (e.number, output.moment(e.started_at), _took(e, form), e.status_text, e.nodes, e.failed, text)
        for e, text in ((each, _description(each, numbers)) for each in summaries)
    ]
    if output.stdout.width >= _WIDTH_WITH_ROBOTS and any(each.robots for each in summaries):
        columns = (*columns, "robots")
        names = (", ".join(robot.name for robot in each.robots) for each in summaries)
        rows = [(*row, name) for row, name in zip(rows, names, strict=True)]
    if any(each.tags for each in summaries):
        columns = (*columns, "tags")
        rows = [(*row, ", ".join(e.tags)) for row, e in zip(rows, summaries, strict=True)]
    if simulated:
        columns = (*columns, "simulated")
        rows = [(*row, simulated_by(e) if e.simulated else "") for row, e in zip(rows, summaries, strict=True)]
    output.print_table(f"Episodes of {place.place.address}", columns, rows, as_csv=form.as_csv)


def _took(episode: EpisodeSummary, form: output.Form) -> object:
    """Return the duration: of CSV in s, for programs."""
    if form.is_table or episode.duration_ns is None:
        return duration(episode.duration_ns)
    return episode.duration_ns / 1e9


def _description(episode: EpisodeSummary, numbers: Mapping[str, int]) -> str:
    """Return the description; for a follow-up with the episode it continues, by number if that is in the list."""
    if episode.continues is None:
        return episode.description
    return f"{episode.description} (continues episode {numbers.get(episode.continues, episode.continues)})"
