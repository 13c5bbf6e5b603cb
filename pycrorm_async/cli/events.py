"""Print the events of an episode in their order, one JSON object per line.

Panel: Look at episodes, 6.
"""

from __future__ import annotations

import asyncio
import sys
from datetime import UTC, datetime
from typing import Annotated

import msgspec
import typer

from pycrorm_async.cli.output import EpisodeArgument, JsonOption
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError, LogDamaged
from pycrorm_async.events.types import EVENT_TYPES
from pycrorm_async.store.log import episode_named
from pycrorm_async.store.stored import StoredEvent
from pycrorm_async.visible_text import escaped_json


def events(
    *,
    episode: EpisodeArgument,
    after: Annotated[int, typer.Option(min=0, metavar="SEQUENCE", help="Print only events after this one.")] = 0,
    event_types: Annotated[
        list[str] | None, typer.Option("--type", help="Print only events of this type; repeatable.")
    ] = None,
    place: ReadingPlace,
    as_json: JsonOption = False,  # noqa: ARG001  the output is always JSON
) -> None:
    """Print the events of an episode in their order, one JSON object per line."""
    unknown = sorted(set(event_types or ()) - EVENT_TYPES.keys())
    if unknown:
        raise CallerError(f"unknown event type {unknown[0]!r}; known types: {', '.join(sorted(EVENT_TYPES))}")
    asyncio.run(_print(place, episode, after, frozenset(event_types or ())))
    sys.stdout.flush()
    place.place.note_pending_events()


async def _print(place: ReadingPlace, episode: str, after: int, event_types: frozenset[str]) -> None:
    """Print the events of these types; without one print all, also those of a type that this version does not know."""
    async with await place.open_log() as log:
        row = await episode_named(log, episode)
        async for page in log.pages(row, after=after):
            for each in page:
                if not event_types or each.type in event_types:
                    sys.stdout.buffer.write(_line(row.id, each))


def _line(episode: str, event: StoredEvent) -> bytes:
    try:
        msgspec.json.decode(event.payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LogDamaged(episode, event.sequence, f"its payload cannot be read: {error}") from None
    seconds, nanoseconds = divmod(event.wall_ns, 10**9)
    line = {
        "sequence": event.sequence,
        "type": event.type,
        "version": event.version,
        "time": f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{nanoseconds:09}Z",
        "wall_ns": event.wall_ns,
        "monotonic_ns": event.monotonic_ns,
        "payload": msgspec.Raw(event.payload),
    }
    return escaped_json(msgspec.json.encode(line).decode()).encode() + b"\n"
