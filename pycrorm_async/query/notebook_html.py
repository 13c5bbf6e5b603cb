"""Draw episodes, task trees, charts, moments and answers for notebooks: tables, lines of text, and charts as SVG.

The views are without scripts, styles of their own or requests. Text takes the colour of the notebook, signs and bars
have colours that contrast with light and dark pages, and every status has a sign. Everything recorded is escaped and
isolated from the direction of the text around it.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from random import Random
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias, get_args

import msgspec

from pycrorm_async.errors import CallerError
from pycrorm_async.query import text as texts
from pycrorm_async.query.episode_diff import EpisodeDiff
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary, counts_text
from pycrorm_async.query.snapshot import Moment, ObjectThen, WorldThen
from pycrorm_async.query.sql import SqlResult
from pycrorm_async.query.text import facts, status

if TYPE_CHECKING:
    from pycrorm_async.query.observed_images import ObservedPicture

EPISODES_MAX = 100
"""Bounds the rows of a table of episodes."""
_COLUMNS = ("episode", "started, UTC", "took", "status", "nodes", "failed", "description", "robots", "tags")


def episodes_html(episodes: Sequence[EpisodeSummary], total: int | None = None, *, folding: int = 0) -> str:
    """Return a table of the newest episodes, the oldest of them first.

    `total` is the number of all in the memory, `folding` that of those that the tables do not show as they are yet.
    """
    lagging = f"<div>{texts.quiet(texts.folding_text(folding))}</div>" if folding else ""
    if not episodes:
        return texts.view("No episodes", lagging)
    count, shown = len(episodes) if total is None else total, episodes[-EPISODES_MAX:]
    more = f"<div>{texts.left_out(count - len(shown), 'before these')}</div>" if len(shown) < count else ""
    return texts.view(
        f"<b>{count:,} episode{'s' * (count > 1)}</b>", more, texts.table(_COLUMNS, map(_row, shown)), lagging
    )


def _row(each: EpisodeSummary) -> tuple[str, ...]:
    return (
        str(each.number),
        texts.moment(each.started_at),
        texts.duration(each.duration_ns),
        f"{status(each.status)}{_failed_actions(each)}",
        f"{each.nodes:,}",
        f"{each.failed:,}" if each.failed else "",
        texts.recorded(each.description, 100),
        texts.recorded(", ".join(map(str, each.robots)), 60),
        texts.recorded(", ".join(each.tags), 60),
    )


def episode_html(each: EpisodeSummary) -> str:
    """Return the facts of an episode."""
    commit = f"{each.git_commit}{' and changes' if each.git_dirty else ''}" if each.git_commit else ""
    return texts.view(
        _title(each),
        facts(
            {
                "started": f"{texts.moment(each.started_at)} UTC by {texts.recorded(each.created_by)}",
                "took": texts.duration(each.duration_ns),
                "nodes": f"{each.nodes:,}, {each.failed:,} failed",
                "robots": texts.recorded(", ".join(map(str, each.robots))) if each.robots else "",
                "tags": texts.recorded(", ".join(each.tags)) if each.tags else "",
                "metadata": texts.recorded(each.metadata) if each.metadata else "",
                "plan": texts.recorded(each.plan) if each.plan else "",
                "commit": texts.recorded(commit) if commit else "",
                "world": texts.recorded(each.world) if each.world else "",
                "simulated by": f"a node of episode {each.thought_by.episode}" if each.thought_by else "",
                "id": each.id,
            }
        ),
    )


def _title(each: EpisodeSummary) -> str:
    more = f"{_failed_actions(each)} {texts.quiet('simulated')}" if each.simulated else _failed_actions(each)
    return f"<b>Episode {each.number} · {texts.recorded(each.description)}</b> · {status(each.status)}{more}"


def _failed_actions(each: EpisodeSummary) -> str:
    return texts.quiet(each.status_text.removeprefix(each.status))


def task_tree_html(
    nodes: Sequence[NodeSummary], episode: EpisodeSummary | None, pictures: Sequence[ObservedPicture] = ()
) -> str:
    """Return the title of the episode, a chart of its nodes over events, and the nodes as nested lists."""
    count = f"{len(nodes):,} node{'s' * (len(nodes) != 1)}"
    if episode is None:
        title = f"<b>{count}</b>"
    else:
        took = f" {texts.duration(episode.duration_ns)}" if episode.duration_ns is not None else ""
        title = f"{_title(episode)}{took} · {count}"
    if not nodes:
        return texts.view(title)
    chart = f'<div style="max-height:340px;overflow:auto;margin:6px 0">{gantt(nodes).svg}</div>'
    return texts.view(title, chart, tree_html(nodes, pictures))


# === tree view ================================================================================================
#
# Draw a task tree as lines of text.

NODES_MAX = 500
"""Bounds the nodes of a view, so that a notebook with many of them stays small."""


def shown_nodes(nodes: Sequence[NodeSummary]) -> list[NodeSummary]:
    """Return the nodes that a view shows: at most half of them lead to failures, the others are nearest to the root."""
    return _part(nodes, root_failures(nodes), sorted(nodes, key=lambda each: each.depth))


def _part(
    nodes: Sequence[NodeSummary], failures: Sequence[NodeSummary], others: Sequence[NodeSummary]
) -> list[NodeSummary]:
    """Return all nodes, or of many those that a view has room for: failures up to half of it, then others."""
    if len(nodes) <= NODES_MAX:
        return list(nodes)
    by_id = {each.id: each for each in nodes}
    kept: set[int] = set()
    _keep(kept, failures, by_id, NODES_MAX // 2)
    _keep(kept, others, by_id, NODES_MAX)
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


def root_failures(nodes: Sequence[NodeSummary]) -> list[NodeSummary]:
    """Return the failed nodes without a failed child."""
    caused = {each.parent_id for each in nodes if each.status in texts.FAILED}
    return [each for each in nodes if each.status in texts.FAILED and each.id not in caused]


def tree_html(nodes: Sequence[NodeSummary], pictures: Sequence[ObservedPicture] = ()) -> str:
    """Return the nodes as indented lines; `nodes` lists each parent before its children, as `TaskTree` does.

    What a node observed is below its line.
    """
    shown = shown_nodes(nodes)
    seen: dict[int | None, list[ObservedPicture]] = {}
    for each in pictures:
        seen.setdefault(each.node, []).append(each)
    rows = [(each.depth, row) for each in shown for row in (_line(each), *pictures_row(seen.get(each.id, ())))]
    lines = "\n".join(f"{'  ' * depth}{row}" for depth, row in rows)
    more = f"<div>{texts.left_out(len(nodes) - len(shown), 'nodes')}</div>" if len(nodes) > len(shown) else ""
    return f'<div style="font-family:monospace;white-space:pre;overflow-x:auto">{lines}</div>{more}'


def pictures_row(pictures: Sequence[ObservedPicture]) -> list[str]:
    """Return one row with these pictures, or none without any."""
    return ["".join(f"  {_picture(each)}" for each in pictures)] if pictures else []


def _picture(picture: ObservedPicture) -> str:
    caption = f"{texts.recorded(picture.name, 20)} {texts.quiet(f'e{picture.sequence}')}"
    if not picture.address:
        return f"{caption}: {texts.recorded(picture.text)}"
    hint = html.escape(texts.one_line(f"{picture.name} at event {picture.sequence} {picture.text}", 200))
    image = f'<img src="{picture.address}" alt="{hint}" title="{hint}" style="height:90px;max-width:100%">'
    return f'<span style="display:inline-block;vertical-align:top">{image}<br>{caption}</span>'


def _line(node: NodeSummary) -> str:
    made = (node.observations, "observations"), (len(node.thoughts), "simulations")
    counts = counts_text(node), *(f"{number} {noun}" for number, noun in made if number)
    words = " ".join(filter(None, (texts.node_text(node), *counts)))
    return f"{status(node.status, with_name=False)} {texts.recorded(words)}"


# === gantt ====================================================================================================
#
# Draw nodes as bars over events or over time, as SVG.

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


def gantt(nodes: Sequence[NodeSummary], axis: Axis = "events") -> texts.Drawing:
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
        label = texts.duration(round(value * 1e9)) if axis == "time" else f"e{value:.0f}"
        if label in labels:  # a chart of few events
            continue
        labels.add(label)
        anchor = "start" if index == 0 else "end" if index == _TICKS - 1 else "middle"
        parts.append(f'<text x="{x:.1f}" y="{height - 4:.0f}" text-anchor="{anchor}" opacity=".7">{label}</text>')
    if note := _note(drawn, nodes):
        height += _AXIS
        parts.append(f'<text x="{_PAD:.1f}" y="{height - 4:.0f}" opacity=".7">{note}</text>')
    return texts.Drawing(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:.0f} {height:.0f}" role="img"'
        f' aria-label="chart of {len(bars)} nodes over {axis}" font-family="system-ui,sans-serif" font-size="11"'
        f' fill="currentColor" style="width:100%;max-width:{_WIDTH:.0f}px">{"".join(parts)}</svg>'
    )


def _sample(nodes: Sequence[NodeSummary]) -> list[NodeSummary]:
    """Return all nodes, or of many some that are spread over the whole episode, always the same ones."""
    lot = Random(0)  # noqa: S311  no secret: a seed draws the same chart again
    failures = root_failures(nodes)
    drawn = (lot.sample(each, min(len(each), _DRAWS_MAX)) for each in (failures, nodes))
    return _part(nodes, *drawn)


def _note(drawn: Sequence[NodeSummary], nodes: Sequence[NodeSummary]) -> str:
    """Return the line that counts what a chart of a part of the nodes draws; empty for a chart of all."""
    if len(drawn) == len(nodes):
        return ""
    failed, all_failed = (sum(each.status in texts.FAILED for each in some) for some in (drawn, nodes))
    failures = f"all {failed:,}" if failed == all_failed else f"{failed:,} of {all_failed:,}"
    others = f"{len(drawn) - failed:,} of {len(nodes) - all_failed:,}"
    return (
        f"{failures} failed nodes and {others} others, chosen at random from the whole episode; gaps are not idle time"
    )


def _bars(nodes: Sequence[NodeSummary], *, by_time: bool) -> list[_Bar]:
    """Give each node the first free lane below its parent's, so that concurrent branches do not cover each other."""
    ordered = sorted(nodes, key=lambda each: each.sequence)
    begin_ns = min((each.start_ns for each in nodes), default=0)
    spans: list[tuple[float, float | None]] = []
    for each in ordered:
        if by_time:
            start = (each.start_ns - begin_ns) / 1e9
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
    width, color = max(right - left - 1, 1.5), texts.color_of(node.status)
    dash = ' stroke-dasharray="4 2"' if node.end_sequence is None else ""
    shape = (
        f'<rect x="{left:.1f}" y="{top:.0f}" width="{width:.1f}" height="{_BAR:.0f}" rx="2" fill="{color}"'
        f' fill-opacity=".25" stroke="{color}"{dash}/>'
    )
    if node.status in texts.FAILED:
        shape += f'<path d="{_hatch(left, top, width)}" stroke="{color}" stroke-opacity=".7"/>'
    name = node.dtype or node.kind
    label = name if node.status == "SUCCEEDED" else f"{texts.sign_of(node.status)} {name}"
    room = int((width - 6) / _CHARACTER)
    if room >= 3:
        shown = label if len(label) <= room else f"{label[: room - 1]}…"
        shape += f'<text x="{left + 4:.1f}" y="{top + 12:.0f}">{html.escape(shown)}</text>'
    hint = texts.one_line(
        f"{label} {node.status} {texts.duration(node.duration_ns)} {texts.parameters_text(node.parameters)}", 200
    )
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


# === answer view ==============================================================================================
#
# Draw results: rows of SQL, a question that is not awaited yet, differences of two episodes, recalled cases.

_ROWS_MAX = 100
"""Bounds the rows that a notebook shows."""
_SQL_MAX = 5_000
"""Bounds the characters of SQL that a notebook shows."""


def sql_result_html(result: SqlResult) -> str:
    """Return the first rows as a table; a missing value is an empty cell."""
    cells = [["" if value is None else texts.recorded(value) for value in row] for row in result.rows[:_ROWS_MAX]]
    count = f"<b>{len(result.rows):,} row{'s' * (len(result.rows) != 1)}</b>"
    limited = f" {texts.quiet('and more, which a limit left out')}" if result.more else ""
    return texts.view(
        count + limited,
        texts.table([texts.recorded(each) for each in result.columns], cells),
        _omitted(len(result.rows)),
    )


def question_html(name: str, sql: str, request: str) -> str:
    """Return the name of a question, the code that awaits it, and its SQL."""
    shown = html.escape(sql if len(sql) <= _SQL_MAX else f"{sql[:_SQL_MAX]}…")
    text = f'<div style="font-family:monospace;white-space:pre-wrap;margin:4px 0">{shown}</div>'
    return texts.view(f"<b>Question {html.escape(name)}</b> {texts.quiet(html.escape(request))}", text)


def diff_html(compared: EpisodeDiff) -> str:
    """Return the first differences as a table; A and B are the episodes."""
    title = " and ".join(
        f"<b>{letter}: episode {each.number} · {texts.recorded(each.description)}</b>"
        for letter, each in (("A", compared.first), ("B", compared.second))
    )
    rows = [
        [
            texts.recorded(each.of),
            texts.recorded(each.where),
            texts.recorded(f"{each.what}, with {each.below} below" if each.below else each.what),
            *("" if value is None else texts.recorded(value) for value in (each.first, each.second)),
        ]
        for each in compared.differences[:_ROWS_MAX]
    ]
    count = len(compared.differences)
    same = texts.quiet(f"{count:,} difference{'s' * (count != 1)}; {compared.same_nodes:,} nodes are the same")
    return texts.view(
        title, same, texts.table(("of", "where", "what", "A", "B"), rows) if rows else "", _omitted(count)
    )


def cases_html(summary: Sequence[str], columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return the lines of a summary, and the first cases as a table; the column `status` has signs."""
    title, *lines = (texts.recorded(each) for each in summary)
    cells = [
        [
            status(str(value))
            if name == "status"
            else f"{value:.3f}"
            if isinstance(value, float)
            else texts.recorded(value)
            for name, value in zip(columns, ("" if each is None else each for each in row), strict=True)
        ]
        for row in rows[:_ROWS_MAX]
    ]
    facts = [f"<div>{each}</div>" for each in lines]
    return texts.view(f"<b>{title}</b>", *facts, texts.table(columns, cells) if cells else "", _omitted(len(rows)))


def _omitted(count: int) -> str:
    return f"<div>{texts.left_out(count - _ROWS_MAX)}</div>" if count > _ROWS_MAX else ""


# === moment view ==============================================================================================
#
# Draw the state of an episode at a moment: running nodes, objects, observations and the tree.


def moment_html(then: Moment) -> str:
    """Return the views of a moment below each other."""
    simulated = f" {texts.quiet('simulated')}" if then.simulated else ""
    title = (
        f"<b>Episode {then.number} · {texts.recorded(then.description)}</b>"
        f" at {then.time_s:.3f} s, event {then.sequence}"
        f" {texts.quiet(f'({texts.moment(then.at)} UTC)')} · {status(then.status)}{simulated}"
    )
    running = " → ".join(f"<b>{texts.recorded(each.dtype or each.kind)}</b>" for each in then.running)
    seen = list(then.observations.items())
    rows = [
        (texts.recorded(name, 40), texts.recorded(msgspec.json.encode(each.values).decode()), f"e{each.sequence}")
        for name, each in seen[:_ROWS_MAX]
    ]
    observed = [texts.table(("observation", "values", "event"), rows), _omitted(len(seen))] if seen else []
    doing = f"<div>{running or texts.quiet('nothing was running')}</div>"
    return texts.view(title, doing, _objects(then.world), *observed, *pictures_row(then.pictures), tree_html(then.tree))


def world_html(world: WorldThen) -> str:
    """Return the table of the objects of a world."""
    return texts.view(f"<b>{len(world.objects):,} object{'s' * (len(world.objects) != 1)}</b>", _objects(world))


def _objects(world: WorldThen) -> str:
    if not world.objects:
        return f"<div>{texts.quiet('the world was empty at this moment')}</div>"
    columns = ("object", "type", "x, m", "y, m", "z, m", "heading", "attached to")
    return texts.table(columns, map(_object_row, world.objects[:_ROWS_MAX])) + _omitted(len(world.objects))


def _object_row(each: ObjectThen) -> Sequence[str]:
    attached = texts.recorded(", ".join(filter(None, each.attached_to))) if each.attached_to is not None else ""
    position = (f"{value:.3f}" for value in each.pose.position)
    heading = f"{round(math.degrees(each.pose.yaw)) + 0}°"
    return texts.recorded(each.name, 40), texts.recorded(each.object_type), *position, heading, attached
