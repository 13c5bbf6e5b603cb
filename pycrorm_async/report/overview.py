"""Write the overview of many episodes: how often they succeed and why they fail, and a table that leads to their pages.

>>> await overview(reading, "kitchen.html", choice=EpisodeChoice(tags=("kitchen",)))
Overview(path=PosixPath('kitchen.html'), episodes=12, pages=12, left_out=0, unreadable={})
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import quote

from sqlalchemy import func, select

from pycrorm_async import errors
from pycrorm_async.orm import RootFailure, TaskTreeNode
from pycrorm_async.query.frames import TRIED, times_with
from pycrorm_async.query.named_queries import EpisodeChoice, EpisodeSummary
from pycrorm_async.query.question import absence_of_episodes
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.success import PICK_UPS, Axis, success_samples, success_table
from pycrorm_async.report.output_files import refuse_existing, write_file
from pycrorm_async.report.write import SimilarCases, asset, html_page, page_name, program, report, stream_of
from pycrorm_async.task_status import TaskStatus

_PAGES_MAX = 200
"""Bounds the pages behind an overview: one has about 0.7 MB."""


class Overview(NamedTuple):
    """A written overview: its file, and the numbers of episodes that it counts, has pages for, and leaves out.

    `unreadable` has the reason, by number, for each episode without a page: it is damaged, or of a newer version.
    """

    path: Path
    episodes: int
    pages: int
    left_out: int
    unreadable: Mapping[int, str]


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
        raise errors.CallerError(f"{folder} exists: add --force to write pages into it, or give another name")
    choice = choice or EpisodeChoice()
    episodes, total = await newest_episodes(reading, choice)
    if not episodes:
        raise errors.CallerError(await absence_of_episodes(reading, choice))
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
        await asyncio.to_thread(lambda: write_file(overview_page_of(document).encode(), file, force=force))
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
            await report(reading, each, folder / page_name(each.number), force=force, similar=similar)
        except (errors.LogDamaged, errors.DatabaseForeign) as error:
            unreadable[each.number] = str(error)
        except (errors.PycrormError, OSError):
            raise
        except Exception as error:  # noqa: BLE001  whatever an episode holds, the others get their pages
            unreadable[each.number] = f"its page cannot be made: {type(error).__name__}: {error}"
    return unreadable


MODULES = "dom episode success overview".split()
"""The modules of the page's program, every one behind those that it imports."""


def overview_page_of(document: Mapping[str, Any]) -> str:
    """Return the page of a document from `overview_document`."""
    scripts = (program(*MODULES, *stream_of(document)),)
    return html_page(document, document["title"], "", asset("web/overview_body.html"), scripts)


# === overview data ============================================================================================
#
# Collect the episodes of a memory into the document of an overview: outcomes, durations, failures by reason.

_EPISODES_MAX = 20_000
"""Bounds the episodes of an overview: it then has about 5 MB."""
_DESCRIPTION_MAX = 200
"""Bounds the characters of a description in the table."""
NO_REASON: Final = "no reason"
"""The name under which failures without a reason are counted."""
_REASON_MAX = 500
"""Bounds the characters of the reason for which an episode cannot be read."""


async def newest_episodes(reading: Reading, choice: EpisodeChoice | None = None) -> tuple[list[EpisodeSummary], int]:
    """Return the newest of all episodes, or of a choice, the oldest first, and the number of all of them."""
    choice = choice or EpisodeChoice()
    limit = min(choice.limit or _EPISODES_MAX, _EPISODES_MAX)
    summaries = await reading.episodes(replace(choice, limit=limit))
    if len(summaries) < limit or limit == choice.limit:
        return summaries, len(summaries)
    [(total,)] = await reading.rows(choice.counted())
    return summaries, total if choice.limit is None else min(total, choice.limit)


async def overview_document(
    reading: Reading,
    title: str,
    episodes: Collection[EpisodeSummary],
    total: int,
    pages: Mapping[int, str],
    unreadable: Mapping[int, str],
) -> dict[str, Any]:
    """Return the document of an overview of these episodes.

    `pages` are the addresses of their pages, `unreadable` the reasons why others have none, both by number.
    """
    first = min((each.number for each in episodes), default=0)
    failures, actions = await failures_by_reason(reading, first=first), await _actions(reading, first)
    return {
        "title": title,
        "total": total,
        "episodes": [
            {
                "number": each.number,
                "started": f"{each.started_at:%Y-%m-%d %H:%M:%S}",
                "description": each.description[:_DESCRIPTION_MAX],
                "status": each.status,
                "robots": [robot.name for robot in each.robots],
                "seconds": None if each.duration_ns is None else round(each.duration_ns / 1e9, 6),
                "nodes": each.nodes,
                "failed": each.failed,
                "failed_actions": each.failed_actions,
                "actions": actions.get(each.number, {}),
                "reasons": {name: sum(each.values()) for name, each in failures.get(each.number, {}).items()},
                "outcomes": failures.get(each.number, {}),
                "page": pages.get(each.number),
                "unreadable": unreadable.get(each.number, "")[:_REASON_MAX],
            }
            for each in episodes
        ],
    }


async def failures_by_reason(
    reading: Reading, numbers: Collection[int] | None = None, *, first: int = 0
) -> dict[int, dict[str, dict[str, int]]]:
    """Count root failures by episode, reason and outcome: of episodes with these numbers, or from `first` on."""
    columns = RootFailure.process_metadata_id, RootFailure.reason, RootFailure.outcome
    query = select(*columns, func.count()).where(columns[0] >= first).group_by(*columns)
    if numbers is not None:
        query = query.where(RootFailure.process_metadata_id.in_(numbers))
    counts: dict[int, dict[str, dict[str, int]]] = {}
    for number, reason, outcome, count in await reading.rows(query):
        counts.setdefault(number, {}).setdefault(reason or NO_REASON, {})[outcome] = count
    return counts


async def _actions(reading: Reading, first: int) -> dict[int, dict[str, list[int]]]:
    """Count successes and tries of the actions of each episode from the number `first` on, by type."""
    node = TaskTreeNode
    counted = times_with(node.status == TaskStatus.SUCCEEDED), times_with(node.status.in_(TRIED))
    name = func.coalesce(node.dtype, node.kind)  # another executive may report an action without a type
    query = select(node.process_metadata_id, name, *counted).where(
        node.kind == "action", node.process_metadata_id >= first
    )
    actions: dict[int, dict[str, list[int]]] = {}
    for number, dtype, *counts in await reading.rows(query.group_by(node.process_metadata_id, name)):
        actions.setdefault(number, {})[dtype] = counts
    return actions


# === success data =============================================================================================
#
# Count successes of episodes over two columns, pick-ups by default, for the heat maps of an overview.


class Plot(NamedTuple):
    """Two columns of a view over which successes are counted; the names are those of `pycrorm plot`."""

    x: str
    y: str
    of: str = PICK_UPS


_PICK_UPS = (Plot("relative_x", "relative_y"), Plot("arm", "grasp"))


async def success_documents(
    reading: Reading, numbers: Collection[int], plots: Collection[Plot] = ()
) -> list[dict[str, Any]]:
    """Return a table of successes of these episodes for each plot.

    Raises `CallerError` as `success_samples` does. Without plots the tables are those of pick-ups, if any has ended.
    """
    if plots:
        return [await _document(reading, numbers, each) for each in plots]
    try:
        return [await _document(reading, numbers, each) for each in _PICK_UPS]
    except errors.CallerError:  # no pick-up, or more than are counted
        return []


async def _document(reading: Reading, numbers: Collection[int], plot: Plot) -> dict[str, Any]:
    table = success_table(await success_samples(reading, plot.x, plot.y, plot.of, episodes=numbers))
    return {
        "of": table.source,
        "x": _axis(table.x),
        "y": _axis(table.y),
        "cells": [list(each) for each in table.cells],
        "succeeded": table.succeeded,
        "rows": table.rows,
    }


def _axis(axis: Axis) -> dict[str, Any]:
    """Return the name, the labels of the cells or the texts of the edges between them, and the number of cells."""
    return {
        "name": axis.name,
        "unit": axis.unit,
        "labels": axis.labels,
        "edges": [axis.text(each) for each in axis.edges],
        "cells": axis.cells,
    }
