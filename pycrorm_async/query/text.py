"""Format recorded values as one line of text or as HTML, and find the nearest names."""

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from difflib import get_close_matches
from functools import singledispatch
from typing import Any

import msgspec

from pycrorm_async.events.types import BLOB_KEY, is_missing

_TEXT_MAX = 60
"""Bounds the characters of a text parameter, so that a node fits on one line."""


def parameters_text(parameters: Mapping[str, Any], *, full: bool = False, exact: bool = False) -> str:
    """Format parameters on one line.

    With `full` nothing is cut; with `exact` no number is rounded, and poses have their orientation.

    >>> parameters_text({"arm": "LEFT", "target": {"position": [0.6, 0.4, 0.0], "orientation": [0, 0, 0, 1]}})
    'arm=LEFT target=(0.60, 0.40, 0.00)'
    """
    return " ".join(f"{name}={value_text(value, full=full, exact=exact)}" for name, value in parameters.items())


def value_text(value: Any, *, full: bool = False, exact: bool = False) -> str:
    """Format a value on one line, as `parameters_text` does."""
    if isinstance(value, dict) and _is_position(value.get("position")):
        if exact:
            return _pose_text(value)
        return "(" + ", ".join(f"{round(each, 2) + 0.0:.2f}" for each in value["position"]) + ")"
    if isinstance(value, dict) and BLOB_KEY in value:
        content = f", sha256 {value[BLOB_KEY]}" if full else ""
        return f"{value.get('media_type')} of {value.get('size')} bytes{content}"
    if isinstance(value, dict) and value.get("name") and ("object" in value or "dtype" in value):
        return str(value["name"])
    if is_missing(value):
        return f"? ({one_line(value['missing'], None)})" if full else "?"
    if isinstance(value, float):
        return repr(value) if exact else f"{value:g}"
    if isinstance(value, dict | list):
        count = "1 entry" if len(value) == 1 else f"{len(value)} entries"
        return msgspec.json.encode(value).decode() if full else count
    return one_line(value, None if full else _TEXT_MAX)


def _is_position(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(each, int | float) for each in value)


def _pose_text(pose: Mapping[str, Any]) -> str:
    """Format a pose with all digits, its orientation as x, y, z, w."""
    position, orientation = (f"({', '.join(map(str, pose.get(part) or ()))})" for part in ("position", "orientation"))
    frame = f" in {pose['frame']}" if pose.get("frame", "map") != "map" else ""
    return f"{position} turned {orientation}{frame}"


def with_object_names(
    parameters: Mapping[str, Any], name_of: Callable[[Mapping[str, int]], str | None]
) -> dict[str, Any]:
    """Add to each reference to an object the object's name, where it is known; keep the other parameters.

    `name_of` gets a reference: `object`, the sequence of its ObjectAdded, and `row`, that of its latest state.

    >>> with_object_names({"object_designator": {"object": 3, "row": 9}, "arm": "LEFT"}, lambda _: "milk")
    {'object_designator': {'object': 3, 'row': 9, 'name': 'milk'}, 'arm': 'LEFT'}
    """
    named = dict(parameters)
    for key, value in parameters.items():
        match value:
            case {"object": int(), "row": int()} if len(value) == 2 and (name := name_of(value)) is not None:
                named[key] = {**value, "name": name}
    return named


def node_text(node: Any) -> str:
    """Format a `NodeSummary` on one line: type, parameters, status, duration and failure."""
    failure = f"{node.reason}: {node.failure_message}" if node.reason else ""
    parts = node.dtype or node.kind, parameters_text(node.parameters), node.status, duration(node.duration_ns), failure
    return " ".join(parts)


def distinct(names: Sequence[str]) -> list[str]:
    """Return the names of columns, each of them once: a number follows a name that came before.

    >>> distinct(["x", "x", "x_1"])
    ['x', 'x_2', 'x_1']
    """
    distinct_names: dict[str, None] = {}
    for name in names:
        number, unique = 0, name
        while unique in distinct_names or (number and unique in names):
            number += 1
            unique = f"{name}_{number}"
        distinct_names[unique] = None
    return list(distinct_names)


def one_line(text: object, characters_max: int | None) -> str:
    """Format a text on one line; an ellipsis marks the cut."""
    line = " ".join(str(text).split())
    return line if characters_max is None or len(line) <= characters_max else f"{line[:characters_max]}…"


def duration(nanoseconds: int | None) -> str:
    """Format a duration as 12 µs, 3.4 ms or 1.20 s; None as an empty string.

    >>> duration(1_204_000_000), duration(3_400_000), duration(12_000), duration(None)
    ('1.20 s', '3.4 ms', '12 µs', '')
    """
    if nanoseconds is None:
        return ""
    if nanoseconds >= 10**9:
        return f"{nanoseconds / 1e9:.2f} s"
    if nanoseconds >= 10**6:
        return f"{nanoseconds / 1e6:.1f} ms"
    return f"{nanoseconds / 1e3:.0f} µs"


# === markup ===================================================================================================
#
# Write the elements that all views of a notebook share: recorded text, statuses, facts, tables, drawings.

FAILED = frozenset({"FAILED", "ERROR", "LOST"})
"""The statuses of nodes that count as failed in `EpisodeSummary.failed`."""

_GOOD, _BAD, _RUNNING, _OTHER = "#2f8f46", "#dd4238", "#2f7fd1", "#a8740c"
COLORS: Mapping[str, str] = {"SUCCEEDED": _GOOD, "FAILED": _BAD, "ERROR": _BAD, "RUNNING": _RUNNING}
"""Each has a contrast of about 4 with a white page and with a dark one."""
_SIGNS = {"SUCCEEDED": "✓", "FAILED": "✗", "ERROR": "✗", "RUNNING": "▶", "LOST": "?", "UNKNOWN": "?"}
_SIGNS |= {"CANCELLED": "⊘", "INTERRUPTED": "⊘"}
_RECORDED_TEXT_MAX = 200
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


def recorded(text: object, characters_max: int = _RECORDED_TEXT_MAX) -> str:
    """Return recorded text for HTML: on one line, cut, escaped, and in its own direction."""
    return f"<bdi>{html.escape(one_line(text, characters_max))}</bdi>"


def folding_text(count: int) -> str:
    """Return the sentence about episodes that a list does not show, or not as they are."""
    return f"{count:,} episode{'s are' if count > 1 else ' is'} being folded: `await memory.flush()` waits for that"


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


# === suggestions ==============================================================================================
#
# Suggest the nearest valid name in place of a wrong one.


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return a question for the end of a message, or an empty text where no valid name is near.

    >>> nearest("root_failure", ["root_failures", "arms"])
    '; did you mean root_failures?'
    """
    by_folded = {_folded(each): each for each in valid}
    names = get_close_matches(_folded(name), by_folded, n=3, cutoff=0.6)
    if not names:
        return ""
    first, *others = [by_folded[each] for each in names]
    return f"; did you mean {', '.join([first, *others][:-1]) + ' or ' if others else ''}{[first, *others][-1]}?"


def _folded(name: str) -> str:
    """Return the name without what makes it no nearer to another one: capital letters and the dashes of an option."""
    return name.casefold().lstrip("-")


# === value html ===============================================================================================
#
# Give values an HTML form in notebooks. They do not import the views that draw them: `notebook_html` registers these.
#
# `query.reading` imports `notebook_html`, so that every value which a memory returns has its view.


@singledispatch
def value_html(value: object) -> str:
    """Return the view that is registered for the value's class; without one, the value's text."""
    return f"<pre>{html.escape(repr(value))}</pre>"


class NotebookValue:
    """Base of the values that a notebook draws."""

    def _repr_html_(self) -> str:
        return value_html(self)
