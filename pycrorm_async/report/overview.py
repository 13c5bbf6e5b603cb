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
from pycrorm_async.events.ids import row_key
from pycrorm_async.orm import Object, RootFailure, TaskTreeNode
from pycrorm_async.query.frames import TRIED, times_with
from pycrorm_async.query.named_queries import EpisodeChoice, EpisodeSummary
from pycrorm_async.query.question import absence_of_episodes
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.success import PICK_UPS, Axis, success_samples, success_table
from pycrorm_async.report.output_files import refuse_existing, write_file
from pycrorm_async.report.pictures import Images
from pycrorm_async.report.write import SimilarCases, asset, html_page, page_name, program, report, stream_of
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import ObjectType

PAGES_MAX = 200
"""Bounds the pages behind an overview, or a comparison of runs: one has about 0.7 MB."""


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
    images: Images = "thumbs",
) -> Overview:
    """Write a table of all episodes, or of a choice, and pages of the newest 200 of them behind it.

    `plots` replace the heat maps of pick-ups; a wrong column or view raises before anything is written.
    The pages of `NAME.html` are in the folder `NAME.pages` beside it; any other name is that of a folder, which gets
    `index.html` and the pages. An episode whose events cannot be read has the reason in its row and no page. Raises
    `CallerError` if one of the files exists, without `force`, or if there is no such episode.
    """
    file = Path(path)
    is_page = file.suffix.lower() in (".html", ".htm")
    folder = file.with_name(f"{file.stem}.pages") if is_page else file
    refuse_existing(file, force=force, folder=not is_page)
    file = file if is_page else folder / "index.html"
    choice = choice or EpisodeChoice()
    episodes, total = await newest_episodes(reading, choice)
    if not episodes:
        raise errors.CallerError(await absence_of_episodes(reading, choice))
    title = f"Episodes: {choice}" if str(choice) else "Episodes"
    successes = await success_documents(reading, [each.number for each in episodes], plots)
    with folder_of_pages(folder, force=force):
        shown = episodes[-PAGES_MAX:]
        back = f"../{quote(file.name)}" if is_page else file.name
        unreadable = await write_pages(reading, shown, folder, back, force=force, images=images)
        shown = [each for each in shown if each.number not in unreadable]
        below = f"{quote(folder.name)}/" if is_page else ""
        pages = {each.number: f"{below}{page_name(each.number)}" for each in shown}
        document = await overview_document(reading, title, episodes, total, pages, unreadable)
        document["successes"] = successes
        await asyncio.to_thread(lambda: write_file(overview_page_of(document).encode(), file, force=force))
    return Overview(file, len(episodes), len(pages), total - len(episodes), unreadable)


@contextmanager
def folder_of_pages(folder: Path, *, force: bool) -> Iterator[None]:
    """Make the folder if it does not exist; delete it again, with its pages, if an error leaves the block.

    Raises `CallerError` if it exists, without `force`.
    """
    is_new = not folder.exists()
    if not is_new and not (force and folder.is_dir()):
        raise errors.CallerError(f"{folder} exists: add --force to write pages into it, or give another name")
    folder.mkdir(exist_ok=True)
    try:
        yield
    except BaseException:
        if is_new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


async def write_pages(
    reading: Reading,
    episodes: Collection[EpisodeSummary],
    folder: Path,
    back: str,
    *,
    force: bool,
    images: Images = "thumbs",
) -> dict[int, str]:
    """Write a page of each episode, with links to each other and `back`; return why some have none, by number."""
    unreadable: dict[int, str] = {}
    similar = SimilarCases(reading, [each.number for each in episodes])
    for each in episodes:
        try:
            page = folder / page_name(each.number)
            await report(reading, each, page, force=force, similar=similar, back=back, images=images)
        except (errors.LogDamaged, errors.DatabaseForeign) as error:
            unreadable[each.number] = str(error)
        except (errors.PycrormError, OSError):
            raise
        except Exception as error:  # noqa: BLE001  whatever an episode holds, the others get their pages
            unreadable[each.number] = f"its page cannot be made: {type(error).__name__}: {error}"
    if unreadable:  # again, because some pages may link to those that are missing
        readable = [each for each in episodes if each.number not in unreadable]
        await write_pages(reading, readable, folder, back, force=True, images=images)
    return unreadable


MODULES = "dom episode success counts filters groups overview".split()
"""The modules of the page's program, every one behind those that it imports."""


def overview_page_of(document: Mapping[str, Any]) -> str:
    """Return the page of a document from `overview_document`."""
    document = {**document, "episodes": _columns(document["episodes"])}
    scripts = (program(*MODULES, *stream_of(document)),)
    return html_page(document, document["title"], "", asset("web/overview_body.html"), scripts)


# === overview data ============================================================================================
#
# Collect the episodes of a memory into the document of an overview: what filters choose by, outcomes, times, causes.

_EPISODES_MAX = 20_000
"""Bounds the episodes of an overview: it then has about 5 MB."""
_DESCRIPTION_MAX = 200
"""Bounds the characters of a description in the table."""
NO_REASON: Final = "no reason"
"""The name under which failures without a reason are counted."""
OBJECTS_MAX = 30
"""Bounds the names of objects of an episode by which it can be chosen."""
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
    causes, actions = await causes_of(reading, first=first), await _actions(reading, first)
    objects = await _objects(reading, first)
    return {
        "title": title,
        "total": total,
        "episodes": [
            {
                "number": each.number,
                "started": int(each.started_at.timestamp()),
                "description": each.description[:_DESCRIPTION_MAX],
                "status": each.status,
                "plan": each.plan or "",
                "commit": commit_text(each.git_commit, is_dirty=each.git_dirty),
                "robots": [robot.name for robot in each.robots],
                "tags": [*each.tags],
                "objects": objects.get(each.number, [])[:OBJECTS_MAX],
                "seconds": None if each.duration_ns is None else round(each.duration_ns / 1e9, 6),
                "nodes": each.nodes,
                "failed": each.failed,
                "failed_actions": each.failed_actions,
                "actions": actions.get(each.number, {}),
                "causes": causes.get(each.number, []),
                "page": pages.get(each.number),
                "unreadable": unreadable.get(each.number, "")[:_REASON_MAX],
            }
            for each in episodes
        ],
    }


def commit_text(commit: str | None, *, is_dirty: bool | None) -> str:
    """Return the first digits of a plan's commit, with `+` if the work tree differed from it."""
    return f"{commit[:10]}{'+' if is_dirty else ''}" if commit else ""


def _columns(episodes: Collection[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the entries of episodes as columns, in which texts are numbers of `texts`, for `web/counts.js`."""
    texts: dict[str, int] = {}

    def packed(value: Any) -> Any:
        match value:
            case str():
                return texts.setdefault(value, len(texts))
            case list() | tuple():
                return [*map(packed, value)]
            case dict():
                return [packed(each) for pair in value.items() for each in pair]
        return value

    names = dict.fromkeys(name for each in episodes for name in each)
    columns = {name: [packed(each.get(name)) for each in episodes] for name in names}
    return {**columns, "texts": [*texts]}


async def causes_of(
    reading: Reading, numbers: Collection[int] | None = None, *, first: int = 0
) -> dict[int, list[list[Any]]]:
    """Count root failures as `failures_by_cause` does, by episode and outcome: of these episodes, or from `first` on.

    A cause is reason, type, object, outcome, the number of failures, and the event at which the first node started.
    """
    failure = RootFailure
    columns = failure.process_metadata_id, failure.reason, failure.dtype, failure.object, failure.outcome
    query = select(*columns, func.count(), func.min(failure.id)).where(columns[0] >= first).group_by(*columns)
    if numbers is not None:
        query = query.where(failure.process_metadata_id.in_(numbers))
    causes: dict[int, list[list[Any]]] = {}
    for number, reason, dtype, object_name, outcome, count, node in await reading.rows(query):
        cause = [reason or NO_REASON, dtype or "", object_name or "", outcome, count, row_key(node).sequence]
        causes.setdefault(number, []).append(cause)
    return causes


async def _actions(reading: Reading, first: int) -> dict[int, dict[str, list[float]]]:
    """Count the actions of each episode from the number `first` on, by type: successes, tries, ended, and their s."""
    node = TaskTreeNode
    counted = times_with(node.status == TaskStatus.SUCCEEDED), times_with(node.status.in_(TRIED))
    timed = func.count(node.end_ns), func.coalesce(func.sum(node.duration), 0)
    name = func.coalesce(node.dtype, node.kind)  # another executive may report an action without a type
    query = select(node.process_metadata_id, name, *counted, *timed).where(
        node.kind == "action", node.process_metadata_id >= first
    )
    actions: dict[int, dict[str, list[float]]] = {}
    for number, dtype, good, tries, ended, seconds in await reading.rows(
        query.group_by(node.process_metadata_id, name)
    ):
        actions.setdefault(number, {})[dtype] = [good, tries, ended, float(f"{seconds:.4g}")]
    return actions


async def _objects(reading: Reading, first: int) -> dict[int, list[str]]:
    """Return the names of the objects of each episode from the number `first` on, without robots and environments."""
    was_added = Object.id == Object.identity_id, Object.process_metadata_id >= first
    query = select(Object.process_metadata_id, Object.name, Object.obj_type).where(*was_added).distinct()
    names: dict[int, list[str]] = {}
    for number, name, object_type in await reading.rows(query.order_by(Object.process_metadata_id, Object.name)):
        if object_type not in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
            names.setdefault(number, []).append(name)
    return names


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
