"""This module draws a recorded task tree with types, statuses, durations and failures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from rich.markup import escape
from rich.text import Text
from rich.tree import Tree

from pycrorm_async.cli.output import duration, stdout
from pycrorm_async.events.blobs import BLOB_KEY
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary

__all__ = ["print_tree", "parameters_text", "simulated_by"]

_TEXT_MAX = 60
"""Bounds the characters of a text parameter, so that a node fits on one line."""
_MESSAGE_MAX = 100
"""Bounds the characters of a failure's message, so that a failed node takes few lines."""
_SIMULATIONS_MAX = 10
"""Bounds the episode numbers listed at a node, because a node may run hundreds of simulations."""

_STYLES = {"SUCCEEDED": "green", "RUNNING": "cyan", "LOST": "yellow", "CANCELLED": "yellow", "INTERRUPTED": "yellow"}


def print_tree(nodes: Sequence[NodeSummary], *, events: bool = False, full: bool = False) -> None:
    """Print the nodes of one episode as a tree; `nodes` lists each parent before its children.

    With `events` each line has the events of the node's start and end. An ellipsis marks each text that is cut; with
    `full` none is.
    """
    drawn: dict[int, Tree] = {}
    root: Tree | None = None
    for node in nodes:
        line = _line(node, events=events, full=full)
        parent = drawn.get(node.parent_id) if node.parent_id is not None else None
        if parent is not None:
            drawn[node.id] = parent.add(line)
        else:
            drawn[node.id] = root = Tree(line)
    if root is not None:
        stdout.print(root)


def _line(node: NodeSummary, *, events: bool, full: bool) -> Text:
    line = Text.from_markup(escape(node.dtype or node.kind))
    if node.parameters:
        line.append(f"  {parameters_text(node.parameters, full=full)}", style="dim")
    line.append(f"  {node.status}", style=_STYLES.get(node.status, "red"))
    line.append(f"  {duration(node.duration_ns)}", style="dim")
    if events:
        end = f"e{node.end_sequence}" if node.end_sequence is not None else ""
        line.append(f"  e{node.sequence}-{end}", style="dim")
    if node.observations:
        line.append(f"  {node.observations} observation{'s' * (node.observations > 1)}", style="dim")
    if node.reason:
        message = _text(node.failure_message or "", None if full else _MESSAGE_MAX)
        line.append(f"  {node.reason}{': ' if message else ''}{message}", style="red")
    if node.thoughts:
        listed = node.thoughts if full else node.thoughts[:_SIMULATIONS_MAX]
        numbers = ", ".join(map(str, listed))
        more = f" and {len(node.thoughts) - len(listed)} more" if len(node.thoughts) > len(listed) else ""
        line.append(f"  simulated in episode{'s' * (len(node.thoughts) > 1)} {numbers}{more}", style="magenta")
    return line


def simulated_by(episode: EpisodeSummary) -> str:
    """Describe the node that ran a simulated episode, for example `by PickUpAction of episode 3`."""
    by = episode.thought_by
    if by is None:
        return "outside any episode"
    return f"by {by.dtype or 'the plan'} of episode {by.episode if by.episode is not None else by.id}"


def parameters_text(parameters: Mapping[str, Any], *, full: bool = False) -> str:
    """Format parameters on one line; with `full`, long texts, lists, dicts and reasons of missing values too.

    >>> parameters_text({"arm": "LEFT", "target": {"position": [0.6, 0.4, 0.0], "orientation": [0, 0, 0, 1]}})
    'arm=LEFT target=(0.60, 0.40, 0.00)'
    """
    return " ".join(f"{name}={_value_text(value, full=full)}" for name, value in parameters.items())


def _value_text(value: Any, *, full: bool) -> str:
    if isinstance(value, dict) and "position" in value:
        return "(" + ", ".join(f"{each:.2f}" for each in value["position"]) + ")"
    if isinstance(value, dict) and BLOB_KEY in value:
        return f"{value.get('media_type')} of {value.get('size')} bytes"
    if isinstance(value, dict) and value.get("name"):
        return str(value["name"])
    if isinstance(value, dict) and "missing" in value:
        return f"? ({_text(value['missing'], None)})" if full else "?"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, dict | list):
        return msgspec.json.encode(value).decode() if full else f"{len(value)} entries"
    return _text(value, None if full else _TEXT_MAX)


def _text(value: object, characters_max: int | None) -> str:
    """Format a text on one line; an ellipsis marks the cut."""
    text = " ".join(str(value).split())
    return text if characters_max is None or len(text) <= characters_max else f"{text[:characters_max]}…"
