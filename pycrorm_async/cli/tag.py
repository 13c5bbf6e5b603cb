"""Add tags to an episode that has ended, and remove others.

Panel: Record, 3.
"""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer

from pycrorm_async.cli.output import EpisodeArgument, JsonOption, note, print_json, print_line
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.operations.copy import tag_episode


def tag(
    *,
    episode: EpisodeArgument,
    tags: Annotated[list[str] | None, typer.Argument(metavar="TAG...", help="Tags to add.")] = None,
    remove: Annotated[list[str] | None, typer.Option(metavar="TAG", help="Tag to remove; repeatable.")] = None,
    place: Place,
    as_json: JsonOption = False,
) -> None:
    """Add tags to an episode that has ended, and remove others; `pycrorm episodes --tag TAG` finds it.

    The change is an event of its own behind the episode's last one. The plan that records an episode tags it with
    `memory.tag`.
    """
    added, removed = checked_tags(tags or ()), checked_tags(remove or ())
    if not added and not removed:
        raise CallerError("name a tag to add, or one to remove with --remove")
    with place.shared_address.located() as address:
        done = asyncio.run(tag_episode(address, episode, added, removed))
    place.note_pending_events()
    if not done.visible:
        note("the tags are stored; the tables show them after the next fold (`pycrorm writer --once`)")
    if as_json:
        print_json(done)
    else:
        print_line(f"episode {done.number}: {', '.join(done.tags) or 'no tags'}")
