"""Perform the plans of `plans` in the environment of PyCRAM, and read what their databases hold."""

from __future__ import annotations

import json
import os
import sqlite3
import textwrap
from pathlib import Path
from typing import Any

from tests.integrations.pycram.environment import ROOT

PLANS = ("-m", "tests.integrations.pycram.plans")
RUN_S_MAX = 300
"""Bounds all plans; they take 15 s."""


def environment(folder: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "HOME": str(folder)}


class Run:
    """One run of all plans: their databases, and what PyCRAM itself keeps about them."""

    def __init__(self, folder: Path, output: str) -> None:
        self.folder = folder
        self.output = output
        self.facts: dict[str, Any] = json.loads((folder / "facts.json").read_text())

    def rows(self, plan: str, statement: str) -> list[tuple[Any, ...]]:
        assert "raised" not in self.facts.get(plan, {}), self.facts[plan]["raised"]
        return rows(self.folder / f"{plan}.db", statement)

    def tree(self, plan: str, episode: int = 1) -> str:
        """Return an episode's nodes, one a line, indented below their parents."""
        return tree_of(self.rows(plan, f"SELECT id, parent_id, dtype, status FROM task_tree_node {OF} {episode}"))


OF = "WHERE process_metadata_id ="


def rows(database: Path, statement: str) -> list[tuple[Any, ...]]:
    connection = sqlite3.connect(database)
    try:
        return connection.execute(statement).fetchall()
    finally:
        connection.close()


def tree_of(nodes: list[tuple[Any, ...]]) -> str:
    def below(parent: int | None, depth: int) -> list[str]:
        lines = []
        for node, of, dtype, status in sorted(nodes):
            if of == parent:
                lines += [f"{'  ' * depth}{dtype or 'root'} {status}", *below(node, depth + 1)]
        return lines

    return "\n".join(below(None, 0))


def text(lines: str) -> str:
    return textwrap.dedent(lines).strip()
