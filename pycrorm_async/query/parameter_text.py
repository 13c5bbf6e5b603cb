"""Format recorded parameters and durations on one line, for the terminal, notebooks and the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from pycrorm_async.events.blobs import BLOB_KEY

_TEXT_MAX = 60
"""Bounds the characters of a text parameter, so that a node fits on one line."""


def parameters_text(parameters: Mapping[str, Any], *, full: bool = False, exact: bool = False) -> str:
    """Format parameters on one line.

    With `full` nothing is cut; with `exact` no number is rounded, and poses have their orientation.

    >>> parameters_text({"arm": "LEFT", "target": {"position": [0.6, 0.4, 0.0], "orientation": [0, 0, 0, 1]}})
    'arm=LEFT target=(0.60, 0.40, 0.00)'
    """
    return " ".join(f"{name}={_value_text(value, full=full, exact=exact)}" for name, value in parameters.items())


def _value_text(value: Any, *, full: bool, exact: bool) -> str:
    if isinstance(value, dict) and "position" in value:
        if exact:
            return _pose_text(value)
        return "(" + ", ".join(f"{round(each, 2) + 0.0:.2f}" for each in value["position"]) + ")"
    if isinstance(value, dict) and BLOB_KEY in value:
        content = f", sha256 {value[BLOB_KEY]}" if full else ""
        return f"{value.get('media_type')} of {value.get('size')} bytes{content}"
    if isinstance(value, dict) and value.get("name"):
        return str(value["name"])
    if isinstance(value, dict) and "missing" in value:
        return f"? ({one_line(value['missing'], None)})" if full else "?"
    if isinstance(value, float):
        return repr(value) if exact else f"{value:g}"
    if isinstance(value, dict | list):
        count = "1 entry" if len(value) == 1 else f"{len(value)} entries"
        return msgspec.json.encode(value).decode() if full else count
    return one_line(value, None if full else _TEXT_MAX)


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
