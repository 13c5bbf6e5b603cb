"""Write two episodes side by side as one HTML file: their trees aligned, what differs, and their scenes on one clock.

>>> await write_comparison(reading, 1, "last", "diff.html")
PosixPath('diff.html')
"""

from __future__ import annotations

import asyncio
from os import PathLike
from pathlib import Path

from pycrorm_async.query.question import AskedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import duration
from pycrorm_async.report.document import episode_document
from pycrorm_async.report.output_files import refuse_existing, write_file
from pycrorm_async.report.write import asset, html_page, program

_MODULES = "dom episode bodies extent path_lines scene_camera seen_view scene_view map_view comparison".split()
"""The modules of the page's program, every one behind those that it imports."""


async def write_comparison(
    reading: Reading, first: AskedEpisode, second: AskedEpisode, path: str | PathLike[str], *, force: bool = False
) -> Path:
    """Write two episodes as one page that opens offline, and return its file.

    The page aligns the nodes as `diff` does: by the types from the root down. A node that took at least half as long
    again is marked too, which `diff` does not compare. Of a long episode it shows what `report` shows of it. Raises
    `UnknownEpisode`; `CallerError` if the file exists, without `force`; `LogDamaged` or `DatabaseForeign` for an event
    that cannot be read.
    """
    file = Path(path)
    refuse_existing(file, force=force)
    diff = await reading.diff(first, second)
    documents = [await episode_document(reading, each.number, images="none") for each in (diff.first, diff.second)]
    of_episodes = [each for each in diff.differences if each.of != "node"]  # the page compares the nodes itself
    document = {
        "episodes": documents,
        "took": [duration(each.duration_ns) for each in (diff.first, diff.second)],
        "differences": [[each.of, each.where, each.what, each.first, each.second] for each in of_episodes],
    }
    scripts = (asset("assets/three.bundle.js"), program(*_MODULES))
    heading = f"Episode {diff.first.number} beside episode {diff.second.number}"
    page = html_page(document, heading, "", asset("web/comparison_body.html"), scripts)
    await asyncio.to_thread(lambda: write_file(page.encode(), file, force=force))
    return file
