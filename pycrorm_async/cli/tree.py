"""Draws a remembered task tree: names, statuses, durations, reasons."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape
from rich.text import Text
from rich.tree import Tree

from pycrorm_async.cli.output import duration, stdout
from pycrorm_async.query.questions import NodeSummary

__all__ = ["print_tree"]

_STYLES = {"SUCCEEDED": "green", "RUNNING": "cyan", "LOST": "yellow", "CANCELLED": "yellow", "INTERRUPTED": "yellow"}


def print_tree(nodes: Sequence[NodeSummary]) -> None:
    """The nodes of one episode, a parent before its children."""
    drawn: dict[int, Tree] = {}
    root: Tree | None = None
    for node in nodes:
        line = _line(node)
        parent = drawn.get(node.parent_id) if node.parent_id is not None else None
        if parent is not None:
            drawn[node.id] = parent.add(line)
        else:
            drawn[node.id] = root = Tree(line)
    if root is not None:
        stdout.print(root)


def _line(node: NodeSummary) -> Text:
    line = Text.from_markup(escape(node.dtype or "root"))
    line.append(f"  {node.status}", style=_STYLES.get(node.status, "red"))
    line.append(f"  {duration(node.duration_ns)}", style="dim")
    if node.reason:
        message = " ".join((node.failure_message or "").split())
        line.append(f"  {node.reason}{': ' if message else ''}{message[:100]}", style="red")
    return line
