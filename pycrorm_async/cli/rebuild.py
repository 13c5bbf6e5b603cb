"""`pycrorm rebuild`: makes the tables anew from the log."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Annotated

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, ProjectionOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import duration, note, print_json, stdout
from pycrorm_async.cli.pending_events import note_pending_events
from pycrorm_async.errors import CallerError
from pycrorm_async.operations.rebuild import RebuildSummary, projections_of, rebuild_memory, rebuild_projection
from pycrorm_async.progress_bar import watched
from pycrorm_async.projections.custom.discovery import installed_besides, named
from pycrorm_async.projections.custom.projection import Projection

__all__ = ["rebuild"]

_TABLES = "tables"


def rebuild(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="`tables`, or a projection; default: all.")
    ] = None,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=1,
            max=64,
            help="Processes that fold the tables at once. Default: two for more than half a million events where two"
            " cores have nothing to do.",
            show_default=False,
        ),
    ] = None,
    projection: ProjectionOption = None,
    as_json: JsonOption = False,
) -> int:
    """Make all tables and views anew from the log, or those of the named projections, while all goes on.

    The new tables are made beside those that people see and take their place in one moment, when they show at least as
    much. A rebuild that was interrupted is taken up by the next one. It needs no code of a plan, only that of the
    projections: one whose code is not here is left as it is.
    """
    named_here = named(projection or ())
    known = {each.name: each for each in (*named_here, *installed_besides(named_here))}
    collect_seldom()
    chosen = asyncio.run(_chosen(url, names or [], known))
    done = {name: asyncio.run(_rebuild(url, workers, known.get(name))) for name in chosen}
    if as_json:
        tables = done["tables"]._asdict() if "tables" in done else {}
        others = {name: each._asdict() for name, each in done.items() if name in known}
        print_json({**tables, "projections": others} if others else tables)
    for name, each in done.items():
        if not as_json:
            rate = each.events / max(each.seconds, 1e-9)
            stdout.print(
                f"{f'{name}, ' if name in known else ''}generation {each.generation}: {each.events} events of"
                f" {each.episodes} episodes in {duration(int(each.seconds * 1e9))}, {rate:,.0f} events/s"
            )
        if each.left:
            note(
                f"{len(each.left)} tables that are not shown any more are used still, by a long transaction or a view:"
                f" {each.left[0]}, … (the next rebuild drops them)"
            )
        for episode, reason in each.parked.items():
            note(f"episode {episode} is parked{f' in {name}' if name in known else ''}: {reason}")
    note_pending_events(url, spool)
    return 1 if any(each.parked for each in done.values()) else 0


async def _chosen(url: str, names: list[str], known: Mapping[str, Projection]) -> list[str]:
    """What to rebuild, the tables first. Raises `CallerError`."""
    there = await projections_of(url)
    for name in names:
        if name in there and name not in known:
            raise CallerError(f"the code of the projection {name} is not here: give it with --projection module:Class")
        if name != _TABLES and name not in known:
            raise CallerError(f"there is no projection {name!r}: there are {', '.join([_TABLES, *sorted(known)])}")
    for name in there:
        if not names and name not in known:
            note(f"the code of the projection {name} is not here: it is left as it is")
    return [each for each in (_TABLES, *known) if not names or each in names]


async def _rebuild(url: str, workers: int | None, projection: Projection | None) -> RebuildSummary:
    with watched("rebuilding") as watch:

        def tell(what: str, done: int, total: int) -> None:
            watch(done, total, what)

        if projection is not None:
            return await rebuild_projection(url, projection, report_progress=tell)
        return await rebuild_memory(url, workers=workers, report_progress=tell)
