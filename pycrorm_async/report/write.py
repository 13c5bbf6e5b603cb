"""Write the report of an episode: read its events, make the page, and give the file its name when it is complete.

>>> await report(reading, "last", "breakfast.html")
Report(path=PosixPath('breakfast.html'), first=1, last=188, events=188)
"""

from __future__ import annotations

import asyncio
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.episode_data import episode_document
from pycrorm_async.report.html_page import page_of, refuse_existing, write_page

__all__ = ["Report", "report"]


class Report(NamedTuple):
    """A written page: its file, the first and the last event that it shows, and the number of events in the log."""

    path: Path
    first: int
    last: int
    events: int


async def report(
    reading: Reading,
    episode: AnyEpisode,
    path: str | PathLike[str] | None = None,
    *,
    force: bool = False,
    first: int | None = None,
    last: int | None = None,
) -> Report:
    """Write an episode as one HTML file that opens offline, and return the file and the events that it shows.

    Args:
        episode: its number, its id or the first digits of it, `last`, or the object from `memory.episode` or
            `episodes`. It may be running: the page shows the events up to the last one in the log.
        path: of the file; `episode-NUMBER.html` in the working directory by default.
        force: replace the file if it exists.
        first, last: sequences of the first and the last event to show; all by default, up to 100,000 nodes.

    Raises `UnknownEpisode`; `CallerError` if the file exists or cannot have this name, or if no event is in the window;
    `LogDamaged` or `DatabaseForeign` for an event that cannot be read; `OSError` if the disk is full.
    """
    if path is not None:
        refuse_existing(Path(path), force=force)
    name = str(episode.number if isinstance(episode, EpisodeSummary) else episode)
    document = await episode_document(reading, name, first=first, last=last)
    file = Path(path) if path is not None else Path(f"episode-{document['episode']['number']}.html")
    await asyncio.to_thread(lambda: write_page(page_of(document), file, force=force))
    shown = document["episode"]
    return Report(file, shown["first"], shown["last"], shown["head"])
