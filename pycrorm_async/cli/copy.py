"""Append the episodes of one memory to another.

Panel: Hand over, 2.
"""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.output import Form, print_rows, problem
from pycrorm_async.cli.reading import DEFAULT_URL, Place, SpoolOption
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.workers import WORKERS, forked
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.store.lake import PREFIX


def copy(
    *,
    target: Annotated[str, typer.Option("--to", metavar="URL", help="Memory to append to; created if missing.")],
    source: Annotated[
        str,
        typer.Option(
            "--from", envvar="PYCRORM_URL", metavar="URL", help="Memory, or lake, to copy; only read.", show_envvar=True
        ),
    ] = DEFAULT_URL,
    episode: Annotated[
        list[str] | None,
        typer.Option(
            help="Episode to copy: its number, its id or first digits of the id, or `last`; repeatable. Default: all."
        ),
    ] = None,
    spool: SpoolOption = None,
    form: Form,
) -> int:
    """Append the episodes of one memory to another, in SQLite or PostgreSQL. It is safe to repeat.

    Events that the target already holds are compared and kept. After an interruption, or for an episode that is still
    being recorded, run it again to copy the remaining events. Exit code 4 if a memory is damaged or both hold different
    events under one number, 1 if an episode is stopped; all other episodes are copied.
    """
    collect_seldom()
    with forked(WORKERS, target) as processes, progress_bar("copying") as report:
        summary = asyncio.run(
            copy_episodes(source, target, episodes=episode or [], report_progress=report, forked=processes)
        )
    if not source.startswith(PREFIX):
        Place(source, spool).note_pending_events()
    print_rows(
        form,
        summary,
        f"From {summary.source} to {summary.target}",
        ("episode", "id", "already present", "copied", "last event"),
        [(each.number, each.id, each.were_there, each.copied, each.head) for each in summary.episodes],
    )
    damaged = [each.damage for each in summary.episodes if each.damage]
    stopped = [f"episode {each.id} is stopped: {each.stopped}" for each in summary.episodes if each.stopped]
    for line in (*damaged, *stopped):
        problem(line)
    return 4 if damaged else 1 if stopped else 0
