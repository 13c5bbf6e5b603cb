"""Draw nodes as bars over events or over time, as SVG."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from random import Random
from typing import Literal, NamedTuple, TypeAlias, get_args

from pycrorm_async.errors import CallerError
from pycrorm_async.query.named_queries import NodeSummary
from pycrorm_async.query.notebook.markup import FAILED, Drawing, color_of, sign_of
from pycrorm_async.query.notebook.tree_view import NODES_MAX, root_failures
from pycrorm_async.query.parameter_text import duration, one_line, parameters_text

Axis: TypeAlias = Literal["events", "time"]

_WIDTH, _PAD, _LANE, _BAR, _AXIS = 900.0, 8.0, 20.0, 16.0, 18.0
_CHARACTER = 6.8
"""Width of a character of a bar's name, so that a name is cut where its bar ends."""
_TICKS = 6
"""The labels along the axis."""
_DRAWS_MAX = 4 * NODES_MAX
"""Bounds the nodes drawn by lot for a chart of a part, because those whose ancestors do not fit are left out."""


class _Bar(NamedTuple):
    node: NodeSummary
    start: float
    end: float
    lane: int


def gantt(nodes: Sequence[NodeSummary], axis: Axis = "events") -> Drawing:
    """Return a chart of the nodes over their events, or over time in s. Raises `CallerError` for another axis.

    Robots of a kinematic world jump, so that many nodes take no time; over events each is as wide as its number of
    events. A node that has not ended extends to the end of the chart. Of more nodes than 500 the chart has failures, up
    to half of it, and others by lot from the whole episode, each with its ancestors; a line below the axis counts them.
    """
    if axis not in get_args(Axis):
        raise CallerError(f"axis must be 'events' or 'time', got {axis!r}")
    drawn = _sample(nodes)
    bars = _bars(drawn, by_time=axis == "time")
    first = min((each.start for each in bars), default=0.0)
    last = max((each.end for each in bars), default=0.0)
    scale = (_WIDTH - 2 * _PAD) / ((last - first) or 1.0)
    height = (max((each.lane for each in bars), default=-1) + 1) * _LANE + _AXIS
    parts = [_drawn(each, _PAD + (each.start - first) * scale, _PAD + (each.end - first) * scale) for each in bars]
    labels: set[str] = set()
    for index in range(_TICKS):
        x = _PAD + (_WIDTH - 2 * _PAD) * index / (_TICKS - 1)
        value = first + (last - first) * index / (_TICKS - 1)
        label = duration(round(value * 1e9)) if axis == "time" else f"e{value:.0f}"
        if label in labels:  # a chart of few events
            continue
        labels.add(label)
        anchor = "start" if index == 0 else "end" if index == _TICKS - 1 else "middle"
        parts.append(f'<text x="{x:.1f}" y="{height - 4:.0f}" text-anchor="{anchor}" opacity=".7">{label}</text>')
    if note := _note(drawn, nodes):
        height += _AXIS
        parts.append(f'<text x="{_PAD:.1f}" y="{height - 4:.0f}" opacity=".7">{note}</text>')
    return Drawing(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:.0f} {height:.0f}" role="img"'
        f' aria-label="chart of {len(bars)} nodes over {axis}" font-family="system-ui,sans-serif" font-size="11"'
        f' fill="currentColor" style="width:100%;max-width:{_WIDTH:.0f}px">{"".join(parts)}</svg>'
    )


def _sample(nodes: Sequence[NodeSummary]) -> list[NodeSummary]:
    """Return all nodes, or of many some that are spread over the whole episode, always the same ones."""
    if len(nodes) <= NODES_MAX:
        return list(nodes)
    lot = Random(0)  # noqa: S311  no secret: a seed draws the same chart again
    by_id = {each.id: each for each in nodes}
    kept: set[int] = set()
    failures = root_failures(nodes)
    _keep(kept, lot.sample(failures, min(len(failures), _DRAWS_MAX)), by_id, NODES_MAX // 2)
    _keep(kept, lot.sample(nodes, min(len(nodes), _DRAWS_MAX)), by_id, NODES_MAX)
    return [each for each in nodes if each.id in kept]


def _keep(kept: set[int], chosen: Sequence[NodeSummary], by_id: Mapping[int, NodeSummary], nodes_max: int) -> None:
    """Add the chosen nodes, each with its ancestors, as far as they fit."""
    for each in chosen:
        path: set[int] = set()
        node: NodeSummary | None = each
        while node is not None and node.id not in kept and len(kept) + len(path) <= nodes_max:
            path.add(node.id)
            node = by_id.get(node.parent_id) if node.parent_id is not None else None
        if len(kept) + len(path) <= nodes_max:
            kept |= path


def _note(drawn: Sequence[NodeSummary], nodes: Sequence[NodeSummary]) -> str:
    """Return the line that counts what a chart of a part of the nodes draws; empty for a chart of all."""
    if len(drawn) == len(nodes):
        return ""
    failed, all_failed = (sum(each.status in FAILED for each in some) for some in (drawn, nodes))
    failures = f"all {failed:,}" if failed == all_failed else f"{failed:,} of {all_failed:,}"
    others = f"{len(drawn) - failed:,} of {len(nodes) - all_failed:,}"
    return (
        f"{failures} failed nodes and {others} others, chosen at random from the whole episode; gaps are not idle time"
    )


def _bars(nodes: Sequence[NodeSummary], *, by_time: bool) -> list[_Bar]:
    """Give each node the first free lane below its parent's, so that concurrent branches do not cover each other."""
    ordered = sorted(nodes, key=lambda each: each.sequence)
    begin = min((each.started_at for each in nodes), default=None)
    spans: list[tuple[float, float | None]] = []
    for each in ordered:
        if by_time and begin is not None:
            start = (each.started_at - begin).total_seconds()
            spans.append((start, None if each.duration_ns is None else start + each.duration_ns / 1e9))
        else:
            spans.append((each.sequence, each.end_sequence))
    last = max((start if end is None else end for start, end in spans), default=0.0)
    lanes: dict[int | None, int] = {}
    busy_until: list[int] = []
    bars = []
    for node, (start, end) in zip(ordered, spans, strict=True):
        lane = lanes.get(node.parent_id, -1) + 1
        while lane < len(busy_until) and busy_until[lane] > node.sequence:
            lane += 1
        busy_until += [0] * (lane + 1 - len(busy_until))
        busy_until[lane] = node.end_sequence or ordered[-1].sequence + 1
        lanes[node.id] = lane
        bars.append(_Bar(node, start, max(last if end is None else end, start), lane))
    return bars


def _drawn(bar: _Bar, left: float, right: float) -> str:
    node, top = bar.node, bar.lane * _LANE + 1
    width, color = max(right - left - 1, 1.5), color_of(node.status)
    dash = ' stroke-dasharray="4 2"' if node.end_sequence is None else ""
    shape = (
        f'<rect x="{left:.1f}" y="{top:.0f}" width="{width:.1f}" height="{_BAR:.0f}" rx="2" fill="{color}"'
        f' fill-opacity=".25" stroke="{color}"{dash}/>'
    )
    if node.status in FAILED:
        shape += f'<path d="{_hatch(left, top, width)}" stroke="{color}" stroke-opacity=".7"/>'
    name = node.dtype or node.kind
    label = name if node.status == "SUCCEEDED" else f"{sign_of(node.status)} {name}"
    room = int((width - 6) / _CHARACTER)
    if room >= 3:
        shown = label if len(label) <= room else f"{label[: room - 1]}…"
        shape += f'<text x="{left + 4:.1f}" y="{top + 12:.0f}">{html.escape(shown)}</text>'
    hint = one_line(f"{label} {node.status} {duration(node.duration_ns)} {parameters_text(node.parameters)}", 200)
    return f"<g><title>{html.escape(hint)}</title>{shape}</g>"


def _hatch(left: float, top: float, width: float) -> str:
    """Return diagonal lines across a bar, so that a failure is visible without colour."""
    lines = []
    foot = left - _BAR + 4
    while foot < left + width:
        begin, end = max(foot, left), min(foot + _BAR, left + width)
        lines.append(f"M{begin:.1f} {top + _BAR - (begin - foot):.1f}L{end:.1f} {top + _BAR - (end - foot):.1f}")
        foot += 6
    return "".join(lines)
