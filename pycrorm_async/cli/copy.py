"""`pycrorm copy --from URL --to URL`: the episodes of one memory, appended to another."""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption
from pycrorm_async.cli.output import print_json, print_table, problem
from pycrorm_async.cli.pending_events import note_what_waits
from pycrorm_async.operations.copy import CopySummary, copy_episodes
from pycrorm_async.progress_bar import watched

__all__ = ["copy"]


def copy(
    target: Annotated[str, typer.Option("--to", metavar="URL", help="The memory to append to; made if need be.")],
    source: Annotated[
        str,
        typer.Option(
            "--from", envvar="PYCRORM_URL", metavar="URL", help="The memory to copy; only read.", show_envvar=True
        ),
    ] = DEFAULT_URL,
    episode: Annotated[
        list[str] | None,
        typer.Option(help="Number, id or its first digits in the memory to copy, or `last`; again for another."),
    ] = None,
    spool: SpoolOption = None,
    as_json: JsonOption = False,
) -> int:
    """Append the episodes of one memory to another: SQLite, PostgreSQL, in any order, as often as you like.

    What is there already is compared and stays. An interrupted copy is finished by the next one; of an episode that is
    still recorded the next one takes the rest. Exit code 4 if a memory is damaged or both hold different events under
    one number, 1 if an episode is stopped; the other episodes are copied.
    """
    collect_seldom()
    done = asyncio.run(_watched(source, target, episode or []))
    note_what_waits(source, spool)
    if as_json:
        print_json(done)
    else:
        print_table(
            f"From {done.source} to {done.target}",
            ("episode", "id", "were there", "copied", "last event"),
            [(each.number, each.id, each.were_there, each.copied, each.head) for each in done.episodes],
        )
    damaged = [each.damage for each in done.episodes if each.damage]
    stopped = [f"episode {each.id} is stopped: {each.stopped}" for each in done.episodes if each.stopped]
    for line in (*damaged, *stopped):
        problem(line)
    return 4 if damaged else 1 if stopped else 0


async def _watched(source: str, target: str, episodes: list[str]) -> CopySummary:
    with watched("copying") as tell:
        return await copy_episodes(source, target, episodes=episodes, watch=tell)
