"""Compare episodes: facts, task trees, last places of objects of two; of more, the nodes at which they part.

Panel: Ask, 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli.output import Form, counted, note, print_json, print_line, print_table, stdout
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.episode_diff import Parting, align_runs
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.text import duration

_HELP = "The episode's number, its id or first digits of the id, or `last`."


def diff(
    first: Annotated[str, typer.Argument(metavar="A", help=_HELP)],
    second: Annotated[str, typer.Argument(metavar="B", help=_HELP)],
    place: ReadingPlace,
    form: Form,
    others: Annotated[
        list[str] | None, typer.Argument(metavar="[C]...", help="More episodes: list the nodes at which all part.")
    ] = None,
    sql: Annotated[bool, typer.Option("--sql", help="Print the SQL of the rows that are compared.")] = False,
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write a page: aligned trees, of two also scenes.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file of --html if it exists.")] = False,
) -> None:
    """Compare two episodes: their circumstances, their task trees, and the last places of their objects.

    Nodes correspond by the types from the root down. A node that only one episode has is listed without its children.
    Of more than two episodes, such as ten runs of one plan, it lists the nodes that ended in several ways and names the
    first one, which follows from no other. As a page they have the pages of the episodes in a folder beside it.
    SQL reads the rows (`--sql`); the comparison is made in Python.
    """
    if others and sql:
        raise CallerError("--sql compares two episodes: name two")
    episodes = [first, second, *(others or [])]
    if html is not None:
        from pycrorm_async.report.comparison import write_comparison  # here, because it loads numpy and recall

        file = place.read(lambda reading: write_comparison(reading, episodes, html, force=force))
        print_json({"file": file, "bytes": file.stat().st_size}) if form.as_json else print_line(file)
        return
    if others:
        _print_partings(place.read(lambda reading: align_runs(reading, episodes)).partings, form)
        return
    compared = place.read(lambda reading: reading.diff(first, second))
    if sql:
        print_line(compared.sql)
        return
    if form.as_json:
        print_json(compared)
        return
    for letter, episode in (("A", compared.first), ("B", compared.second)) if form.is_table else ():
        stdout.print(f"{letter}: {_line(episode)}", markup=False)
    rows = [
        (
            each.of,
            each.where,
            f"{each.what}, with {each.below} below" if each.below else each.what,
            each.first,
            each.second,
        )
        for each in compared.differences
    ]
    if rows or not form.is_table:
        print_table("Differences", ("of", "where", "what", "A", "B"), rows, as_csv=form.as_csv)
    note(f"{counted(len(rows), 'difference')}; nodes that are the same: {compared.same_nodes:,}")


def _print_partings(parted: Sequence[Parting], form: Form) -> None:
    if form.as_json:
        print_json(parted)
        return
    rows = [(each.where, f"{each.otherwise} of {each.runs}", each.text) for each in parted]
    if rows or not form.is_table:
        print_table("Where the episodes part", ("where", "otherwise", "ended"), rows, as_csv=form.as_csv)
    first = "".join(f"; first {each.where}" for each in parted if each.first)
    note(f"{counted(len(rows), 'node')} that ended in several ways{first}")


def _line(episode: EpisodeSummary) -> str:
    took = duration(episode.duration_ns) or "not ended"
    nodes = counted(episode.nodes, "node")
    return f"episode {episode.number}, {episode.description}: {episode.status_text}, {took}, {nodes}"
