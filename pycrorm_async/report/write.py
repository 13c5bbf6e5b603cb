"""Write the report of an episode, or of many: read, make the page, and give the file its name when it is complete.

>>> await report(reading, "last", "breakfast.html")
Report(path=PosixPath('breakfast.html'), first=1, last=188, events=188)
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.asking.episode_list import EpisodeChoice
from pycrorm_async.query.asking.unknown_names import absence_of_episodes
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.episode_data import episode_document
from pycrorm_async.report.html_page import overview_page_of, page_of, write_page
from pycrorm_async.report.output_files import refuse_existing
from pycrorm_async.report.overview_data import newest_episodes, overview_document
from pycrorm_async.report.similar_cases import SimilarCases, page_name
from pycrorm_async.report.success_data import Plot, success_documents

_PAGES_MAX = 200
"""Bounds the pages behind an overview: one has about 0.7 MB."""


class Report(NamedTuple):
    """A written page: its file, the first and the last event that it shows, and the number of events in the log."""

    path: Path
    first: int
    last: int
    events: int


class Overview(NamedTuple):
    """A written overview: its file, and the numbers of episodes that it counts, has pages for, and leaves out.

    `unreadable` has the reason, by number, for each episode without a page: it is damaged, or of a newer version.
    """

    path: Path
    episodes: int
    pages: int
    left_out: int
    unreadable: Mapping[int, str]


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
        first, last: sequences of the first and the last event to show; all by default, up to 100,000 nodes
            or 200,000 moves.

    Raises `UnknownEpisode`; `CallerError` if the file exists or cannot have this name, or if no event is in the window;
    `LogDamaged` or `DatabaseForeign` for an event that cannot be read; `OSError` if the disk is full.
    """
    return await _report(SimilarCases(reading), reading, episode, path, force=force, first=first, last=last)


async def _report(
    similar: SimilarCases,
    reading: Reading,
    episode: AnyEpisode,
    path: str | PathLike[str] | None,
    *,
    force: bool,
    first: int | None = None,
    last: int | None = None,
) -> Report:
    if path is not None:
        refuse_existing(Path(path), force=force)
    name = str(episode.number if isinstance(episode, EpisodeSummary) else episode)
    document = await episode_document(reading, name, first=first, last=last)
    document["similar"] = await similar.document(document["episode"]["number"], document["nodes"][0])
    file = Path(path) if path is not None else Path(page_name(document["episode"]["number"]))
    await asyncio.to_thread(lambda: write_page(page_of(document), file, force=force))
    shown = document["episode"]
    return Report(file, shown["first"], shown["last"], shown["head"])


async def overview(
    reading: Reading,
    path: str | PathLike[str],
    *,
    choice: EpisodeChoice | None = None,
    plots: Collection[Plot] = (),
    force: bool = False,
) -> Overview:
    """Write a table of all episodes, or of a choice, and pages of the newest 200 of them behind it.

    `plots` replace the heat maps of pick-ups; a wrong column or view raises before anything is written.
    The pages are in the folder `NAME.pages` beside the file `NAME.html`. An episode whose events cannot be read has the
    reason in its row and no page. Raises `CallerError` if one of the files exists, without `force`, or if there is no
    such episode.
    """
    file = Path(path)
    folder = file.with_name(f"{file.stem}.pages")
    refuse_existing(file, force=force)
    if folder.exists() and not (force and folder.is_dir()):
        raise CallerError(f"{folder} exists: add --force to write pages into it, or give another name")
    choice = choice or EpisodeChoice()
    episodes, total = await newest_episodes(reading, choice)
    if not episodes:
        raise CallerError(await absence_of_episodes(reading, choice))
    title = f"Episodes: {choice}" if str(choice) else "Episodes"
    successes = await success_documents(reading, [each.number for each in episodes], plots)
    with _folder_of_pages(folder):
        shown = episodes[-_PAGES_MAX:]
        unreadable = await _write_pages(reading, shown, folder, force=force)
        shown = [each for each in shown if each.number not in unreadable]
        if unreadable:  # again, because some pages may link to those that are missing
            await _write_pages(reading, shown, folder, force=True)
        pages = {each.number: f"{quote(folder.name)}/{page_name(each.number)}" for each in shown}
        document = await overview_document(reading, title, episodes, total, pages, unreadable)
        document["successes"] = successes
        await asyncio.to_thread(lambda: write_page(overview_page_of(document), file, force=force))
    return Overview(file, len(episodes), len(pages), total - len(episodes), unreadable)


@contextmanager
def _folder_of_pages(folder: Path) -> Iterator[None]:
    """Make the folder if it does not exist; delete it again, with its pages, if an error leaves the block."""
    is_new = not folder.exists()
    folder.mkdir(exist_ok=True)
    try:
        yield
    except BaseException:
        if is_new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


async def _write_pages(
    reading: Reading, episodes: Collection[EpisodeSummary], folder: Path, *, force: bool
) -> dict[int, str]:
    """Write a page of each episode, with links to each other; return the reasons why some have none, by number."""
    unreadable: dict[int, str] = {}
    similar = SimilarCases(reading, [each.number for each in episodes])
    for each in episodes:
        try:
            await _report(similar, reading, each, folder / page_name(each.number), force=force)
        except (LogDamaged, DatabaseForeign) as error:
            unreadable[each.number] = str(error)
    return unreadable
