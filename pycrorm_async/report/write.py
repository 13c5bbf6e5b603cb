"""Write the report of an episode: read, make the page, and give the file its name when it is complete.

>>> await report(reading, "last", "breakfast.html")
Report(path=PosixPath('breakfast.html'), first=1, last=188, events=188)
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import html
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from sqlalchemy import select

from pycrorm_async import errors
from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.orm import RootFailure
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.question import AskedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.answer import Answer, Compared, RecalledCase, answer, value_text
from pycrorm_async.recall.blocks import CaseLibrary, Group
from pycrorm_async.recall.recall import CaseReader, DatabaseSource, cue_like
from pycrorm_async.report.document import episode_document
from pycrorm_async.report.output_files import refuse_existing, write_file
from pycrorm_async.report.pictures import Images
from pycrorm_async.visible_text import visible


class Report(NamedTuple):
    """A written page: its file, the first and the last event that it shows, and the number of events in the log."""

    path: Path
    first: int
    last: int
    events: int

    def _repr_html_(self) -> str:
        """Return the page in a frame, for a notebook: its scripts cannot reach the notebook."""
        page = html.escape(self.path.read_text(encoding="utf-8"))
        return f'<iframe sandbox="allow-scripts" style="width:100%;height:640px;border:0" srcdoc="{page}"></iframe>'


async def report(
    reading: Reading,
    episode: AskedEpisode,
    path: str | PathLike[str] | None = None,
    *,
    force: bool = False,
    first: int | None = None,
    last: int | None = None,
    similar: SimilarCases | None = None,
    back: str = "",
    images: Images = "thumbs",
) -> Report:
    """Write an episode as one HTML file that opens offline, and return the file and the events that it shows.

    Args:
        episode: its number, its id or the first digits of it, `last`, or the object from `memory.episode` or
            `episodes`. It may be running: the page shows the events up to the last one in the log.
        path: of the file; `episode-NUMBER.html` in the working directory by default.
        force: replace the file if it exists.
        first, last: sequences of the first and the last event to show; all by default, up to 100,000 nodes
            or 200,000 moves.
        similar: the cases of the memory, which an overview reads once for all its pages.
        back: address of the overview, to which the page links.
        images: what the page has of observed images, depth maps and point clouds: `none`; thumbnails of at most 200,
            `thumbs`; or `full`, the whole contents, up to 24 MB, and thumbnails of the others.

    Raises `UnknownEpisode`; `CallerError` if the file exists or cannot have this name, or if no event is in the window;
    `LogDamaged` or `DatabaseForeign` for an event that cannot be read; `OSError` if the disk is full.
    """
    if path is not None:
        refuse_existing(Path(path), force=force)
    name = str(episode.number if isinstance(episode, EpisodeSummary) else episode)
    document = await episode_document(reading, name, first=first, last=last, images=images)
    document["outcomes"] = await outcomes_of(reading, document["episode"]["number"])
    similar = similar or SimilarCases(reading)
    document["similar"] = await similar.document(document["episode"]["number"], document["nodes"][0])
    if back:
        document["episode"]["overview"] = back
    file = Path(path) if path is not None else Path(page_name(document["episode"]["number"]))
    await asyncio.to_thread(lambda: write_file(page_of(document).encode(), file, force=force))
    shown = document["episode"]
    return Report(file, shown["first"], shown["last"], shown["head"])


# === html page ================================================================================================
#
# Write the document of an episode into one HTML file that opens offline and makes no request.
#
# The Content-Security-Policy allows the page's own style and scripts by their hashes, and nothing else. Recorded text
# is in the page only as JSON in which `<` is escaped, and in its title; the scripts set it as text.
#
# A document with a `live` entry becomes a live page, which has one more module, `stream.js`, and may connect to its own
# server for the parts of the document that follow.

_EPISODE = (
    "dom episode find bodies extent path_lines scene_camera seen_view scene_view map_view tree_view gantt_bars"
    " gantt_view curves_view similar panels playback main"
).split()
"""The modules of the page's program, every one behind those that it imports."""
_STREAM = ("stream",)
_SELF = "'self'"
_TITLE_MAX = 200
"""Bounds the characters of the description in title and heading."""
_ESCAPES = {
    b"<": rb"\u003c",
    b">": rb"\u003e",
    b"&": rb"\u0026",
    b"\xe2\x80\xa8": rb"\u2028",
    b"\xe2\x80\xa9": rb"\u2029",
}
_UNREAD = re.compile(
    r"^import \{[^}]*\} from \"\./\w+\.js\";\n|^ *//[^\n]*\n|^ */\*\*.*?\*/\n|^ +", re.MULTILINE | re.DOTALL
)
_EXPORT = re.compile(r"^export (?=(const|class|function) )", re.MULTILINE)


def page_of(document: Mapping[str, Any]) -> str:
    """Return the page of a document from `episode_document`."""
    episode = document["episode"]
    heading = episode["description"] or f"Episode {episode['number']}"
    scripts = (asset("assets/three.bundle.js"), program(*_EPISODE, *stream_of(document)))
    return html_page(document, heading, f" · episode {episode['number']}", asset("web/episode_body.html"), scripts)


def stream_of(document: Mapping[str, Any]) -> tuple[str, ...]:
    return _STREAM if "live" in document else ()


def html_page(document: Mapping[str, Any], heading: str, suffix: str, body: str, scripts: Sequence[str]) -> str:
    heading, style = heading[:_TITLE_MAX], asset("web/page.css")
    policy = (
        f"default-src 'none'; script-src {' '.join(map(_hash, scripts))}; style-src {_hash(style)};"
        f" img-src data:; base-uri 'none'; form-action 'none'{'; connect-src ' + _SELF if 'live' in document else ''}"
    )
    parts = {
        "policy": policy,
        "title": html.escape(visible(heading, kept="") + suffix),
        "style": style,
        "body": body.replace("{heading}", html.escape(visible(heading, kept=""))),
        "document": _safe_json(document),
        "scripts": "\n".join(f"<script>{each}</script>" for each in scripts),
    }
    return re.sub(r"\{(\w+)\}", lambda match: parts[match[1]], asset("web/page.html"))


def _safe_json(document: Mapping[str, Any]) -> str:
    """Encode as JSON that ends no <script> element, whatever the document holds."""
    encoded = msgspec.json.encode(document)
    for each, escaped in _ESCAPES.items():
        encoded = encoded.replace(each, escaped)
    return encoded.decode()


@cache
def program(*modules: str) -> str:
    """Return modules of the page as one, without imports among them, comments on lines of their own, and indents."""
    text = "\n".join(_EXPORT.sub("", _UNREAD.sub("", asset(f"web/{name}.js"))) for name in modules)
    return f'"use strict";\n{{\n{text}}}\n'


@cache
def asset(name: str) -> str:
    return resources.files("pycrorm_async.report").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


async def outcomes_of(reading: Reading, number: int) -> dict[str, str]:
    """Return the outcomes of an episode's root failures by the event of the node's start, as far as it is folded."""
    query = select(RootFailure.sequence, RootFailure.outcome).where(RootFailure.process_metadata_id == number)
    try:
        rows = await reading.rows(query, simulated=True)
    except (errors.DatabaseUnavailable, errors.TablesPending):  # the page shows the events alone
        return {}
    return {str(row.sequence): row.outcome for row in rows}


# === similar cases ============================================================================================
#
# Find the past actions most like those of an episode, each with its equal and its different features, for the page.

ACTIONS_MAX: Final = 200
"""Bounds the actions of a page that are compared, failures first."""
ACTIONS_MIN: Final = 5
"""The actions of a page that are compared in any memory."""
_COMPARED_MAX: Final = 50_000_000
"""Bounds actions times cases of a report, because each pair takes 50 to 100 ns: 2 to 5 s."""
SHOWN: Final = 5
"""The cases that the page shows for an action."""
COUNTED: Final = 20
"""The cases among which successes and reasons are counted."""
_LISTED_MAX: Final = 12
"""Bounds the features of a case that are listed as alike, and as different; those that weigh most are taken."""
_FAILED_STATUSES = ("FAILED", "ERROR")


def page_name(episode: int) -> str:
    """Return the name of an episode's page, to which other pages in its folder link."""
    return f"episode-{episode}.html"


class SimilarCases:
    """The cases of one memory, for the pages of one report.

    Args:
        pages: numbers of the episodes that have a page in the same folder.
    """

    def __init__(self, reading: Reading, pages: Collection[int] = ()) -> None:
        self._reader = CaseReader(DatabaseSource(reading))
        self._library: CaseLibrary | None = None
        self._pages = frozenset(pages)

    async def document(self, episode: int, starts: Collection[int]) -> dict[str, Any] | None:
        """Return the cases most like the actions of an episode that started with these events.

        They started earlier, in the same episode or in another one. None for a memory without cases, and for one whose
        cases are of another version; with a `fault` if the stored cases are damaged.
        """
        try:
            if self._library is None:  # once for all pages, which shows them the same cases
                self._library = await self._reader.library()
        except (errors.DatabaseUnavailable, errors.TablesPending):
            return None
        except errors.DamageError as fault:
            return {"fault": str(fault)}
        library = self._library
        cases = _cases_of(library, episode, starts)
        nodes: dict[str, dict[str, Any]] = {}
        texts: dict[str, int] = {}
        for group, row in cases[: self._actions_max(len(library))]:
            case = group.case(row)
            earlier = replace(cue_like(case, library), before_us=case.started_us, k=COUNTED)
            nodes[str(case.sequence)] = _entry(answer(earlier, library), texts)
        mentioned = {each[0] for entry in nodes.values() for each in entry["cases"]}
        pages = {str(each): page_name(each) for each in sorted(mentioned & self._pages - {episode})}
        return {"actions": len(cases), "pages": pages, "texts": [*texts], "nodes": nodes}

    def _actions_max(self, cases: int) -> int:
        """Return the number of actions of a page to compare, in a memory with this many cases."""
        bound = _COMPARED_MAX // max(cases, 1) // max(len(self._pages), 1)
        return min(ACTIONS_MAX, max(ACTIONS_MIN, bound))


def _cases_of(library: CaseLibrary, episode: int, starts: Collection[int]) -> list[tuple[Group, int]]:
    """Return group and row of the cases of these nodes: the failed ones first, then by their start."""
    wanted = np.array([row_id(episode, each, SLOT_NODE) for each in starts], np.int64)
    entries: list[tuple[bool, int, Group, int]] = []
    for group in library.groups():
        rows = np.flatnonzero(group.episodes == episode)
        rows = rows[np.isin(group.nodes[rows], wanted)] if rows.size else rows
        status = group.texts["status"].value
        entries += [(status(row) not in _FAILED_STATUSES, int(group.nodes[row]), group, row) for row in rows.tolist()]
    return [(group, row) for _, _, group, row in sorted(entries, key=lambda each: each[:2])]


def _entry(similar: Answer, texts: dict[str, int]) -> dict[str, Any]:
    reasons = ", ".join(f"{name} {count}" for name, count in similar.reasons)
    success = similar.success
    return {
        "success": "" if success is None else str(success),
        "reasons": reasons,
        "cases": [_case(each, texts) for each in similar[:SHOWN]],
    }


def _case(recalled: RecalledCase, texts: dict[str, int]) -> list[Any]:
    """Return a case as `web/panels.js` reads it, with its features as numbers of `texts`."""
    case = recalled.case
    return [
        case.episode,
        case.sequence,
        round(recalled.score, 3),
        case.status,
        case.reason or "",
        f"{case.started_at:%Y-%m-%d %H:%M:%S}",
        [texts.setdefault(each, len(texts)) for each in _listed(recalled.matched, _alike)],
        [texts.setdefault(each, len(texts)) for each in _listed(recalled.missed, _differs)],
    ]


def _listed(compared: Sequence[Compared], text: Callable[[Compared], str]) -> list[str]:
    """Return the features that weigh most as texts, and how many others there are."""
    heaviest = sorted(compared, key=lambda each: -each.weight * max(each.similarity, 0.01))
    left = len(compared) - _LISTED_MAX
    return [*map(text, heaviest[:_LISTED_MAX]), *([f"{left} more"] if left > 0 else [])]


def _alike(compared: Compared) -> str:
    """Return a feature that is alike, as `arm LEFT` or `height 0.9 (0.03 off)`."""
    off = f" ({compared.difference:.2g} off)" if compared.difference and compared.similarity < 1 else ""
    return f"{compared.feature} {value_text(compared.wanted if off == '' else compared.found)}{off}"


def _differs(compared: Compared) -> str:
    """Return a feature that differs, as `arm RIGHT, here LEFT`."""
    return f"{compared.feature} {value_text(compared.found)}, here {value_text(compared.wanted)}"
