"""Draw a task tree as nested lists that are opened at its failures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet

from pycrorm_async.query.named_queries import NodeSummary
from pycrorm_async.query.notebook.markup import FAILED, left_out, quiet, recorded, status
from pycrorm_async.query.parameter_text import duration, parameters_text
from pycrorm_async.query.percepts_and_places import counts_text

NODES_MAX = 500
"""Bounds the nodes of a view, so that a notebook with many of them stays small."""
_NODES_OPEN = 100
"""Opens the first two levels of a tree of up to this many nodes, and the first one of a larger tree."""
_FAILURES_OPEN = 20
"""Bounds the failures at which a tree is opened, so that a view of hundreds of them is not long."""
_PARAMETERS_MAX = 160
"""Bounds the characters of a node's parameters."""


def shown_nodes(nodes: Sequence[NodeSummary]) -> list[NodeSummary]:
    """Return the nodes that a view shows: at most half of them lead to failures, the others are nearest to the root."""
    if len(nodes) <= NODES_MAX:
        return list(nodes)
    by_id = {each.id: each for each in nodes}
    depths: dict[int, int] = {}
    for each in nodes:
        depths[each.id] = depths.get(each.parent_id, -1) + 1 if each.parent_id is not None else 0
    kept: set[int] = set()
    for each in root_failures(nodes):
        path = {each.id}
        while (parent := each.parent_id) in by_id and parent is not None:
            path.add(parent)
            each = by_id[parent]
        if len(kept | path) > NODES_MAX // 2:
            break
        kept |= path
    nearest = sorted((each.id for each in nodes if each.id not in kept), key=lambda number: depths[number])
    kept.update(nearest[: NODES_MAX - len(kept)])
    return [each for each in nodes if each.id in kept]


def root_failures(nodes: Sequence[NodeSummary]) -> list[NodeSummary]:
    """Return the failed nodes without a failed child."""
    caused = {each.parent_id for each in nodes if each.status in FAILED}
    return [each for each in nodes if each.status in FAILED and each.id not in caused]


def tree_html(nodes: Sequence[NodeSummary]) -> str:
    """Return the nodes as nested lists; `nodes` lists each parent before its children, as `TaskTree` does."""
    shown = shown_nodes(nodes)
    parents = _parents(nodes, {each.id for each in shown})
    shown_ids = {each.id for each in shown}
    hidden: dict[int | None, int] = {}
    for each in nodes:
        if each.id not in shown_ids:
            hidden[parents[each.id]] = hidden.get(parents[each.id], 0) + 1
    with_children = {parents[each.id] for each in nodes}
    from_below = {(each.parent_id, each.failure_message) for each in nodes}
    opened = _opened(shown, parents)
    parts: list[str] = []
    path: list[int] = []

    def close(parent: int | None) -> None:
        while path and path[-1] != parent:
            parts.append(f"{_more(hidden.get(path.pop(), 0))}</details>")

    for each in shown:
        close(parents[each.id])
        if each.id in with_children:
            is_open = " open" if each.id in opened else ""
            parts.append(f'<details{is_open} style="margin-left:16px"><summary>{_line(each, from_below)}</summary>')
            path.append(each.id)
        else:
            parts.append(f'<div style="margin-left:30px">{_line(each, from_below)}</div>')
    close(None)
    return f'<div style="margin-left:-16px">{"".join(parts)}{_more(hidden.get(None, 0))}</div>'


def _parents(nodes: Sequence[NodeSummary], shown: set[int]) -> dict[int, int | None]:
    """Return for each node its nearest shown ancestor; None if no ancestor is shown."""
    parents: dict[int, int | None] = {}
    for each in nodes:
        parent = each.parent_id
        parents[each.id] = parent if parent in shown else parents.get(parent) if parent is not None else None
    return parents


def _opened(shown: Sequence[NodeSummary], parents: Mapping[int, int | None]) -> set[int]:
    """Return the nodes to open: the first levels, and those with one of the first failed or running nodes below."""
    opened: set[int] = set()
    levels = 2 if len(shown) <= _NODES_OPEN else 1
    leading = root_failures(shown)[:_FAILURES_OPEN]
    ends = {each.id for each in (*leading, *(each for each in shown if each.status == "RUNNING"))}
    depths: dict[int | None, int] = {None: -1}
    for each in shown:
        depths[each.id] = depths[parents[each.id]] + 1
        if depths[each.id] < levels:
            opened.add(each.id)
        if each.id in ends:
            above = parents[each.id]
            while above is not None and above not in opened:
                opened.add(above)
                above = parents[above]
    return opened


def _line(node: NodeSummary, from_below: AbstractSet[tuple[int | None, str | None]]) -> str:
    """Return the text of a node; a failure that came from a child has its message there."""
    end = node.end_sequence if node.end_sequence is not None else ""
    name = f'<b title="events {node.sequence} to {end}">{recorded(node.dtype or node.kind)}</b>'
    parts = [status(node.status, with_name=False), name]
    if node.parameters:
        parts.append(quiet(recorded(parameters_text(node.parameters), _PARAMETERS_MAX)))
    if node.status not in ("SUCCEEDED", "FAILED"):
        parts.append(recorded(node.status))
    if node.duration_ns is not None:
        parts.append(quiet(duration(node.duration_ns)))
    if node.reason:
        has_message = node.failure_message and (node.id, node.failure_message) not in from_below
        message = f": {recorded(node.failure_message)}" if has_message else ""
        parts.append(f"<b>{recorded(node.reason)}</b>{message}")
    if node.observations:
        parts.append(quiet(f"{node.observations} observation{'s' * (node.observations > 1)}"))
    if counts := counts_text(node):
        parts.append(quiet(counts))
    if node.thoughts:
        parts.append(quiet(f"{len(node.thoughts)} simulation{'s' * (len(node.thoughts) > 1)}"))
    return " ".join(parts)


def _more(count: int) -> str:
    return f'<div style="margin-left:30px">{left_out(count)}</div>' if count else ""
