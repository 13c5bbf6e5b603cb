"""Write the elements that all views of a notebook share: recorded text, statuses, facts, tables, drawings."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from pycrorm_async.query.parameter_text import one_line

FAILED = frozenset({"FAILED", "ERROR", "LOST"})
"""The statuses of nodes that count as failed in `EpisodeSummary.failed`."""

_GOOD, _BAD, _RUNNING, _OTHER = "#2f8f46", "#dd4238", "#2f7fd1", "#a8740c"
COLORS: Mapping[str, str] = {"SUCCEEDED": _GOOD, "FAILED": _BAD, "ERROR": _BAD, "RUNNING": _RUNNING}
"""Each has a contrast of about 4 with a white page and with a dark one."""
_SIGNS = {"SUCCEEDED": "✓", "FAILED": "✗", "ERROR": "✗", "RUNNING": "▶", "LOST": "?"}
_SIGNS |= {"CANCELLED": "⊘", "INTERRUPTED": "⊘"}
_TEXT_MAX = 200
"""Bounds the characters of a recorded text in a view."""
_CELL = "padding:2px 10px 2px 0;text-align:left;vertical-align:top"


@dataclass(frozen=True)
class Drawing:
    """A drawing that a notebook shows; `svg` is its text, for a file.

    >>> Path("chart.svg").write_text((await memory.tree("last")).gantt().svg)
    """

    svg: str

    def _repr_html_(self) -> str:
        return self.svg

    def __repr__(self) -> str:
        return f"<SVG of {len(self.svg):,} characters>"


def color_of(status: str) -> str:
    """Return the colour of a status."""
    return COLORS.get(status, _OTHER)


def sign_of(status: str) -> str:
    """Return the sign of a status, so that it is readable without colour."""
    return _SIGNS.get(status, "•")


def recorded(text: object, characters_max: int = _TEXT_MAX) -> str:
    """Return recorded text for HTML: on one line, cut, escaped, and in its own direction."""
    return f"<bdi>{html.escape(one_line(text, characters_max))}</bdi>"


def quiet(content: str) -> str:
    """Return content that is less important."""
    return f'<span style="opacity:.7">{content}</span>'


def status(name: str, *, with_name: bool = True) -> str:
    """Return the sign of a status, in its colour, and its name."""
    sign = f'<span style="color:{color_of(name)};font-weight:bold">{sign_of(name)}</span>'
    return f"{sign} {html.escape(name)}" if with_name else sign


def moment(when: datetime) -> str:
    """Format a moment in UTC to the second."""
    return f"{when:%Y-%m-%d %H:%M:%S}"


def left_out(count: int, noun: str = "") -> str:
    """Return the line with the number of items that a view leaves out."""
    return quiet(f"… {count:,} more{' ' if noun else ''}{noun}")


def facts(pairs: Mapping[str, str]) -> str:
    """Return names and values, as HTML, in two columns; empty values are left out."""
    return _table("", ((quiet(name), value) for name, value in pairs.items() if value))


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of cells that are HTML."""
    head = "".join(f'<th scope="col" style="{_CELL}">{each}</th>' for each in columns)
    return _table(f"<thead><tr>{head}</tr></thead>", rows)


def _table(head: str, rows: Iterable[Sequence[str]]) -> str:
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    style = "border:0;border-collapse:collapse;margin:4px 0;font-size:inherit"
    return f'<div style="overflow-x:auto"><table style="{style}">{head}<tbody>{body}</tbody></table></div>'


def _cell(content: str) -> str:
    wrap = "" if "<bdi>" in content else ";white-space:nowrap"
    return f'<td style="{_CELL}{wrap}">{content}</td>'


def view(title: str, *parts: str) -> str:
    """Return a view: its title, as HTML, and its parts below each other."""
    font = "font-family:system-ui,sans-serif;font-size:13px;line-height:1.5"
    return f'<div style="{font}"><div>{title}</div>{"".join(parts)}</div>'
