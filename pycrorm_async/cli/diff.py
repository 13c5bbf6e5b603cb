"""Compare two episodes: facts, task trees, last places of objects.

Panel: Ask, 3.
"""

from __future__ import annotations

from typing import Annotated

import typer

from pycrorm_async.cli.output import Form, counted, note, print_json, print_line, print_table, stdout
from pycrorm_async.cli.reading import Place
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.text import duration

_HELP = "The episode's number, its id or first digits of the id, or `last`."


def diff(
    first: Annotated[str, typer.Argument(metavar="A", help=_HELP)],
    second: Annotated[str, typer.Argument(metavar="B", help=_HELP)],
    place: Place,
    form: Form,
    sql: Annotated[bool, typer.Option("--sql", help="Print the SQL of the rows that are compared.")] = False,
) -> None:
    """Compare two episodes: their circumstances, their task trees, and the last places of their objects.

    Nodes correspond by the types from the root down. A node that only one episode has is listed without its children.
    SQL reads the rows (`--sql`); the comparison is made in Python.
    """
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


def _line(episode: EpisodeSummary) -> str:
    took = duration(episode.duration_ns) or "not ended"
    nodes = counted(episode.nodes, "node")
    return f"episode {episode.number}, {episode.description}: {episode.status_text}, {took}, {nodes}"
