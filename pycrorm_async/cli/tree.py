"""Draw a recorded task tree with types, statuses, durations and failures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.markup import escape
from rich.text import Text
from rich.tree import Tree

from pycrorm_async.cli.output import stdout
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.parameter_text import duration, one_line, parameters_text
from pycrorm_async.query.percepts_and_places import counts_text

_MESSAGE_MAX = 100
"""Bounds the characters of a failure's message, so that a failed node takes few lines."""
_SIMULATIONS_MAX = 10
"""Bounds the episode numbers listed at a node, because a node may run hundreds of simulations."""

_STYLES = {"SUCCEEDED": "green", "RUNNING": "cyan", "LOST": "yellow", "CANCELLED": "yellow", "INTERRUPTED": "yellow"}


def print_tree(nodes: Sequence[NodeSummary], *, events: bool = False, full: bool = False) -> None:
    """Print the nodes of one episode as a tree; `nodes` lists each parent before its children.

    With `events` each line has the events of the node's start and end. Long texts are cut and end in an ellipsis,
    unless `full` is True.
    """
    root = tree_of(nodes, events=events, full=full)
    if root is not None:
        stdout.print(root)


def tree_of(
    nodes: Iterable[NodeSummary], *, events: bool = False, full: bool = False, no_wrap: bool = False
) -> Tree | None:
    """Return the tree that `print_tree` prints; None without nodes. With `no_wrap` each node takes one line."""
    drawn: dict[int, Tree] = {}
    root: Tree | None = None
    for node in nodes:
        line = _line(node, events=events, full=full)
        if no_wrap:
            line.no_wrap, line.overflow = True, "ellipsis"
        parent = drawn.get(node.parent_id) if node.parent_id is not None else None
        if parent is not None:
            drawn[node.id] = parent.add(line)
        else:
            drawn[node.id] = root = Tree(line)
    return root


def _line(node: NodeSummary, *, events: bool, full: bool) -> Text:
    line = Text.from_markup(escape(node.dtype or node.kind))
    if node.parameters:
        line.append(f"  {parameters_text(node.parameters, full=full, exact=full)}", style="dim")
    line.append(f"  {node.status}", style=_STYLES.get(node.status, "red"))
    line.append(f"  {duration(node.duration_ns)}", style="dim")
    if events:
        end = f"e{node.end_sequence}" if node.end_sequence is not None else ""
        line.append(f"  e{node.sequence}-{end}", style="dim")
    if node.observations:
        line.append(f"  {node.observations} observation{'s' * (node.observations > 1)}", style="dim")
    if counts := counts_text(node):
        line.append(f"  {counts}", style="dim")
    if node.reason:
        message = one_line(node.failure_message or "", None if full else _MESSAGE_MAX)
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
