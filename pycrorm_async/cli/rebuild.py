"""Rebuild all tables and views from the log, while recording continues.

Panel: Operate, 3.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Annotated

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.output import JsonOption, ProjectionOption, counted, note, print_json, problem, stdout
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import CallerError
from pycrorm_async.operations.rebuild import RebuildSummary, projections_of, rebuild_memory, rebuild_projection
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.projections.custom import PackedProjection, Projection, installed_projections, load_projections
from pycrorm_async.query.text import duration

_TABLES = "tables"


def rebuild(
    *,
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="`tables`, or the name of a projection; default: all."),
    ] = None,
    place: Place,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=1,
            max=64,
            help="The most processes that fold in parallel, each 125,000 events or more. Default: 2 for more than half"
            " a million events if two cores are idle, else 1.",
            show_default=False,
        ),
    ] = None,
    projection: ProjectionOption = None,
    as_json: JsonOption = False,
) -> int:
    """Rebuild all tables and views from the log, or those of the named projections, while recording continues.

    The new tables are built as a new generation beside the current one and replace it in one transaction, once they
    contain at least as many events. Run it again to continue an interrupted rebuild. It needs the code of the
    projections, but of no plan; a projection whose code is not available is skipped.
    Exit code 1 if an episode is parked, 4 if the id of one is damaged; all others are shown.
    """
    given_projections = load_projections(projection or ())
    projections = {each.name: each for each in (*given_projections, *installed_projections(given_projections))}
    collect_seldom()
    chosen = asyncio.run(_choose(place.url, names or [], projections))
    summaries = {name: asyncio.run(_rebuild(place.url, workers, projections.get(name))) for name in chosen}
    # Projections of this package are rebuilt with the tables, so they are listed only if the user names them.
    built_in = {name for name, each in projections.items() if isinstance(each, PackedProjection)}
    shown = [name for name in summaries if name not in built_in or name in (names or ())]
    if as_json:
        tables = summaries["tables"]._asdict() if "tables" in summaries else {}
        others = {name: summaries[name]._asdict() for name in shown if name in projections}
        print_json({**tables, "projections": others} if others else tables)
    for name, each in summaries.items():
        if not as_json and name in shown:
            rate = each.events / max(each.seconds, 1e-9)
            folded = f"{counted(each.events, 'event')} of {counted(each.episodes, 'episode')}"
            stdout.print(
                f"{f'{name}, ' if name in projections else ''}generation {each.generation}: {folded}"
                f" in {duration(int(each.seconds * 1e9))}, {rate:,.0f} events/s"
            )
        if each.left:
            note(
                f"{len(each.left)} tables of a former generation are still used by a long transaction or a view:"
                f" {each.left[0]}, … (the next rebuild drops them)"
            )
        for episode, reason in each.parked.items():
            note(f"episode {episode} is parked{f' in {name}' if name in projections else ''}: {reason}")
    damaged = {number: each for summary in summaries.values() for number, each in summary.damaged.items()}
    for number, identity in damaged.items():
        problem(f"episode {number}: its id {identity!r:.100} was changed after it was stored: it is not a UUID")
    place.note_pending_events()
    return 4 if damaged else 1 if any(each.parked for each in summaries.values()) else 0


async def _choose(url: str, names: list[str], projections: Mapping[str, Projection]) -> list[str]:
    """Return the names of the projections to rebuild, the tables first. Raises `CallerError` for an unknown name."""
    stored_names = await projections_of(url)
    for name in names:
        if name in stored_names and name not in projections:
            raise CallerError(f"the code of the projection {name} is not available: add --projection module:Class")
        if name != _TABLES and name not in projections:
            choices = ", ".join([_TABLES, *sorted(projections)])
            raise CallerError(f"unknown projection {name!r}; known: {choices}")
    for name in stored_names:
        if not names and name not in projections:
            note(f"the projection {name} is not rebuilt, because its code is not available")
    return [each for each in (_TABLES, *projections) if not names or each in names]


async def _rebuild(url: str, workers: int | None, projection: Projection | None) -> RebuildSummary:
    with progress_bar("rebuilding") as report_progress:
        if projection is not None:
            return await rebuild_projection(url, projection, report_progress=report_progress)
        return await rebuild_memory(url, workers=workers, report_progress=report_progress)
