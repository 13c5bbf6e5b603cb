"""Remember a tree of py_trees, and read its nodes and observations from the tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pycrorm_async import Memory, Settings
from pycrorm_async.integrations.py_trees import RememberedTree
from tests.databases import ask
from tests.integrations.py_trees.behaviours import tree
from tests.recording.recorded_memory import assert_verified, url_of

PATIENT_S = 60.0
"""The time of an instant tick: a busy machine must not turn a check into work."""


def remembered(folder: Path, root: Any, run: Callable[[Any], None], **arguments: Any) -> Any:
    """Remember what `run` does with a tree of this root; return the status of the memory."""
    ticked = tree(root)
    with Memory.sync(url_of(folder), settings=Settings(fold="at_end")) as memory:
        with RememberedTree(ticked, memory.recording, **{"instant_s": PATIENT_S, **arguments}):
            run(ticked)
        status = memory.status
    assert ticked.visitors == []
    assert_verified(folder)
    return status


def nodes(folder: Path) -> list[tuple[str, str | None, str, int, str | None]]:
    """Return (name, name of the parent, status, ticks, failure message) of each node of a behaviour, in order."""
    rows = ask(
        folder / "memory.db",
        "SELECT node.parameters, parent.parameters, node.status, node.result, node.failure_message"
        " FROM designator AS node LEFT JOIN designator AS parent ON parent.id = node.parent_id ORDER BY node.id",
    )
    return [
        (
            json.loads(parameters)["name"],
            json.loads(above)["name"] if above is not None else None,
            status,
            json.loads(result)["ticks"] if result is not None else 0,
            message,
        )
        for parameters, above, status, result, message in rows
    ]


def observations(folder: Path) -> list[tuple[str, str | None, str | None, float | str | None]]:
    """Return (name, name of the behaviour, key, value) of each observed value, in order."""
    rows = ask(
        folder / "memory.db",
        "SELECT observation.name, designator.parameters, key, coalesce(number, text) FROM observation"
        " LEFT JOIN observation_value USING (id) LEFT JOIN designator ON designator.id = observation.node_id"
        " ORDER BY observation.id, position",
    )
    return [
        (name, json.loads(parameters)["name"] if parameters is not None else None, key, value)
        for name, parameters, key, value in rows
    ]


def repeated(folder: Path) -> dict[str | None, float | str | None]:
    return {behaviour: value for name, behaviour, _key, value in observations(folder) if name == "repeated"}
