"""Find the past actions most like those of an episode, each with its equal and its different features, for the page."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from pycrorm_async.errors import DamageError, DatabaseUnavailable, TablesOutdated
from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.answer import Answer, Compared, RecalledCase, answer
from pycrorm_async.recall.blocks import Group
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.library import CaseLibrary
from pycrorm_async.recall.reading.case_reader import CaseReader
from pycrorm_async.recall.reading.cue_arguments import cue_like
from pycrorm_async.recall.reading.database_source import DatabaseSource

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
_CHARACTERS_MAX: Final = 2_000_000
"""Bounds the characters of all listed features of a page, of which most are shared by many cases."""
_FAILED = ("FAILED", "ERROR")


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
        self._pages = frozenset(pages)

    async def document(self, episode: int, starts: Collection[int]) -> dict[str, Any] | None:
        """Return the cases most like the actions of an episode that started with these events.

        They started earlier, in the same episode or in another one. None for a memory without cases, and for one whose
        cases are of another version; with a `fault` if the stored cases are damaged.
        """
        try:
            library = await self._reader.library()
        except (DatabaseUnavailable, TablesOutdated):
            return None
        except DamageError as fault:
            return {"fault": str(fault)}
        cases = _cases_of(library, episode, starts)
        nodes: dict[str, dict[str, Any]] = {}
        texts = _Texts()
        for group, row in cases[: self._actions_max(len(library))]:
            if texts.characters > _CHARACTERS_MAX:
                break
            case = group.case(row)
            nodes[str(case.sequence)] = _entry(_earlier(case, library), texts)
        mentioned = {each[0] for entry in nodes.values() for each in entry["cases"]}
        pages = {str(each): page_name(each) for each in sorted(mentioned & self._pages - {episode})}
        return {"actions": len(cases), "pages": pages, "texts": [*texts.numbers], "nodes": nodes}

    def _actions_max(self, cases: int) -> int:
        """Return the number of actions of a page to compare, in a memory with this many cases."""
        bound = _COMPARED_MAX // max(cases, 1) // max(len(self._pages), 1)
        return min(ACTIONS_MAX, max(ACTIONS_MIN, bound))


class _Texts:
    """Texts by number, each once."""

    def __init__(self) -> None:
        self.numbers: dict[str, int] = {}
        self.characters = 0

    def all(self, texts: Sequence[str]) -> list[int]:
        for each in texts:
            if each not in self.numbers:
                self.numbers[each] = len(self.numbers)
                self.characters += len(each)
        return [self.numbers[each] for each in texts]


def _cases_of(library: CaseLibrary, episode: int, starts: Collection[int]) -> list[tuple[Group, int]]:
    """Return group and row of the cases of these nodes: the failed ones first, then by their start."""
    wanted = np.array([row_id(episode, each, SLOT_NODE) for each in starts], np.int64)
    entries: list[tuple[bool, int, Group, int]] = []
    for group in library.groups():
        rows = np.flatnonzero(group.episodes == episode)
        rows = rows[np.isin(group.nodes[rows], wanted)] if rows.size else rows
        status = group.texts["status"].value
        entries += [(status(row) not in _FAILED, int(group.nodes[row]), group, row) for row in rows.tolist()]
    return [(group, row) for _, _, group, row in sorted(entries, key=lambda each: each[:2])]


def _earlier(case: Case, library: CaseLibrary) -> Answer:
    """Return the cases most like this one that started before it."""
    return answer(replace(cue_like(case, library), before_us=case.started_us, k=COUNTED), library)


def _entry(similar: Answer, texts: _Texts) -> dict[str, Any]:
    reasons = ", ".join(f"{name} {count}" for name, count in similar.reasons)
    success = similar.success
    return {
        "success": "" if success is None else str(success),
        "reasons": reasons,
        "cases": [_case(each, texts) for each in similar[:SHOWN]],
    }


def _case(recalled: RecalledCase, texts: _Texts) -> list[Any]:
    """Return a case as `web/panels.js` reads it."""
    case = recalled.case
    return [
        case.episode,
        case.sequence,
        round(recalled.score, 3),
        case.status,
        case.reason or "",
        f"{case.started_at:%Y-%m-%d %H:%M:%S}",
        texts.all(_listed(recalled.matched, _alike)),
        texts.all(_listed(recalled.missed, _differs)),
    ]


def _listed(compared: Sequence[Compared], text: Callable[[Compared], str]) -> list[str]:
    """Return the features that weigh most as texts, and how many others there are."""
    heaviest = sorted(compared, key=lambda each: -each.weight * max(each.similarity, 0.01))
    left = len(compared) - _LISTED_MAX
    return [*map(text, heaviest[:_LISTED_MAX]), *([f"{left} more"] if left > 0 else [])]


def _alike(compared: Compared) -> str:
    """Return a feature that is alike, as `arm LEFT` or `height 0.9 (0.03 off)`."""
    off = f" ({compared.difference:.2g} off)" if compared.difference and compared.similarity < 1 else ""
    return f"{compared.feature} {_value(compared.wanted if off == '' else compared.found)}{off}"


def _differs(compared: Compared) -> str:
    """Return a feature that differs, as `arm RIGHT, here LEFT`."""
    actual = "not known" if compared.found is None else _value(compared.found)
    return f"{compared.feature} {actual}, here {_value(compared.wanted)}"


def _value(value: str | tuple[str, ...] | float | None) -> str:
    match value:
        case float():
            return f"{value:.4g}"
        case tuple():
            return ", ".join(value)
    return str(value)
