"""Write episodes beside each other as one HTML file: two with their scenes on one clock, more as one tree of all.

>>> await write_comparison(reading, (1, "last"), "diff.html")
PosixPath('diff.html')
"""

import asyncio
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pycrorm_async.query.episode_diff import AlignedNode, AlignedRuns, align_runs
from pycrorm_async.query.named_queries import NodeSummary
from pycrorm_async.query.question import AskedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import duration
from pycrorm_async.report.document import episode_document
from pycrorm_async.report.output_files import refuse_existing, write_file
from pycrorm_async.report.overview import PAGES_MAX, folder_of_pages, write_pages
from pycrorm_async.report.write import asset, html_page, page_name, program

_PAIR = "dom episode bodies extent path_lines scene_camera seen_view scene_view map_view playback comparison".split()
_RUNS = "dom episode runs".split()
"""The modules of the pages' programs, every one behind those that it imports."""
_CELLS_MAX = 300_000
"""Bounds nodes times runs of a page, which has about 12 bytes for each."""
_DESCRIPTION_MAX = 200
"""Bounds the characters of a description in the list of the runs."""


async def write_comparison(
    reading: Reading, episodes: Sequence[AskedEpisode], path: str | PathLike[str], *, force: bool = False
) -> Path:
    """Write episodes as one page that opens offline, and return its file.

    The page aligns the nodes as `diff` does: by the types from the root down. Of two episodes it has the scenes too,
    and marks a node that took at least half as long again, which `diff` does not compare. Of a long episode it shows
    what `report` shows of it. Of more episodes, such as ten runs of one plan, it shows at each node how many ended in
    which way, and leads to the pages of the last 200, in the folder `NAME.pages` beside `NAME.html`.

    Raises `UnknownEpisode`; `CallerError` if the file or the folder exists, without `force`; and of two episodes
    `LogDamaged` or `DatabaseForeign` for an event that cannot be read.
    """
    file = Path(path)
    refuse_existing(file, force=force)
    aligned = await align_runs(reading, episodes)
    if len(episodes) > 2:
        await _write_runs(reading, aligned, file, force=force)
    else:
        page = await _pair(reading, episodes[0], episodes[1], aligned)
        await asyncio.to_thread(lambda: write_file(page.encode(), file, force=force))
    return file


async def _pair(reading: Reading, first: AskedEpisode, second: AskedEpisode, aligned: AlignedRuns) -> str:
    diff = await reading.diff(first, second)
    numbers = diff.first.number, diff.second.number
    documents = [await episode_document(reading, str(each), images="none") for each in numbers]
    of_episodes = [each for each in diff.differences if each.of != "node"]  # the page compares the nodes itself
    document = {
        "episodes": documents,
        "nodes": [[_start(each.nodes.get(number)) for number in numbers] for each in aligned.nodes],
        "took": [duration(each.duration_ns) for each in (diff.first, diff.second)],
        "differences": [[each.of, each.where, each.what, each.first, each.second] for each in of_episodes],
    }
    scripts = (asset("assets/three.bundle.js"), program(*_PAIR))
    heading = f"Episode {numbers[0]} beside episode {numbers[1]}"
    return html_page(document, heading, "", asset("web/comparison_body.html"), scripts)


async def _write_runs(reading: Reading, aligned: AlignedRuns, file: Path, *, force: bool) -> None:
    folder = file.with_name(f"{file.stem}.pages")
    with folder_of_pages(folder, force=force):
        shown = aligned.runs[-PAGES_MAX:]
        unreadable = await write_pages(reading, shown, folder, f"../{quote(file.name)}", force=force)
        pages = {each.number: page_name(each.number) for each in shown if each.number not in unreadable}
        runs = [
            {
                "number": each.number,
                "status": each.status,
                "took": duration(each.duration_ns) or "not ended",
                "started": f"{each.started_at:%Y-%m-%d %H:%M:%S}",
                "description": each.description[:_DESCRIPTION_MAX],
                "page": f"{quote(folder.name)}/{pages[each.number]}" if each.number in pages else "",
                "unreadable": unreadable.get(each.number, ""),
            }
            for each in aligned.runs
        ]
        document = {"runs": runs, **_tree_document(aligned)}
        heading = f"{len(aligned.runs)} runs: where they part"
        page = html_page(document, heading, "", asset("web/runs_body.html"), (program(*_RUNS),))
        await asyncio.to_thread(lambda: write_file(page.encode(), file, force=force))


def _tree_document(aligned: AlignedRuns) -> dict[str, Any]:
    """Return the tree of all runs; of too many nodes those at which they part, and those around them."""
    shown = aligned.nodes
    if len(shown) * len(aligned.runs) > _CELLS_MAX:
        parted = [each.path for each in shown if len(each.outcomes) > 1]
        ways = {path[:length] for path in parted for length in range(1, len(path) + 1)}
        shown = tuple(each for each in shown if each.path in ways)[: _CELLS_MAX // len(aligned.runs)]
    index = {each.number: place for place, each in enumerate(aligned.runs)}
    by_path = {each.path: each for each in shown}
    outcomes: dict[str, int] = {}

    def ways_of(each: AlignedNode) -> list[list[int]]:
        around = by_path.get(each.path[:-1])
        ways = []
        for outcome, numbers in each.outcomes.items():
            way = [outcomes.setdefault(outcome, len(outcomes))]
            for number in numbers:
                node = each.nodes[number] or (around.nodes[number] if around is not None else None)
                way += index[number], _start(node)
            ways.append(way)
        return ways

    first = aligned.first_parting
    nodes = [[len(each.path) - 1, each.name, int(each is first), ways_of(each)] for each in shown]
    return {"outcomes": [*outcomes], "nodes": nodes, "left": len(aligned.nodes) - len(shown)}


def _start(node: NodeSummary | None) -> int:
    """Return the event with which a node began; 0 without one."""
    return node.sequence if node is not None else 0
