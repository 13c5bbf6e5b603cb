"""`pycrorm rebuild`: makes the tables anew from the log."""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, UrlOption
from pycrorm_async.cli.output import duration, note, print_json, stderr, stdout
from pycrorm_async.rebuilding import Rebuilt, rebuild_memory

__all__ = ["rebuild"]


def rebuild(
    url: UrlOption = DEFAULT_URL,
    workers: Annotated[int, typer.Option("--workers", min=1, max=64, help="Processes that fold at once.")] = 1,
    as_json: JsonOption = False,
) -> int:
    """Make all tables and views anew from the log, while recording and reading go on.

    The new tables are made beside those that people see and take their place in one moment, when they show at least as
    much. A rebuild that was interrupted is taken up by the next one. It needs no code of a plan.
    """
    done = asyncio.run(_rebuild(url, workers))
    if as_json:
        print_json(done._asdict())
    else:
        rate = done.events / max(done.seconds, 1e-9)
        stdout.print(
            f"generation {done.generation}: {done.events} events of {done.episodes} episodes in"
            f" {duration(int(done.seconds * 1e9))}, {rate:,.0f} events/s"
        )
    if done.left:
        note(
            f"{len(done.left)} tables that are not shown any more are used still, by a long transaction or a view:"
            f" {done.left[0]}, … (the next rebuild drops them)"
        )
    for episode, reason in done.parked.items():
        note(f"episode {episode} is parked: {reason}")
    return 1 if done.parked else 0


async def _rebuild(url: str, workers: int) -> Rebuilt:
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        console=stderr,
        disable=not stderr.is_terminal,
        transient=True,
    )
    with bar:
        task = bar.add_task("rebuilding", total=None, rate="")

        def tell(what: str, done: int, total: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, description=what, completed=done, total=total, rate=f"{speed:,.0f}/s" if speed else "")

        return await rebuild_memory(url, workers=workers, tell=tell)
