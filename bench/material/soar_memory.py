"""Store actions in the episodic memory of Soar, and query it, with its own timers. Requires `soar-sml`."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.material.actions import Actions
from pycrorm_async.recall.search import Cue

__all__ = ["SoarMemory"]

_STORED_TEXTS = ("object_type", "arm", "grasp", "robot", "surface", "plan")
_STORED_NUMBERS = ("height", "torso", "stand_x")
"""The features of an episode: with the type, ten elements of working memory. A number is stored in decimetres, because
Soar compares numbers for equality only.
"""
_SETTINGS = (
    "watch 0",
    "soar wait-snc on",  # no impasse in every decision, because the agent has no operators
    "epmem --set database file",
    "epmem --set trigger dc",
    "epmem --set learning on",
    "epmem --set timers two",
)


class SoarMemory:
    """One agent, whose every decision stores its input link as an episode in a file."""

    def __init__(self, sml: Any, path: Path) -> None:
        self._kernel = sml.Kernel.CreateKernelInCurrentThread()
        self._agent = self._kernel.CreateAgent("bench")
        for each in (*_SETTINGS, f"epmem --set path {path}", "epmem --init"):
            self._agent.ExecuteCommandLine(each)
        self._elements: dict[str, tuple[str, Any]] = {}

    def store(self, actions: Actions) -> float:
        """Store all actions; return the duration of the agent's decisions in s, without the changes of its input."""
        link, took_s = self._agent.GetInputLink(), 0.0
        for index in range(len(actions)):
            for name, value in _elements(actions, index).items():
                old, element = self._elements.get(name, ("", None))
                if old != value:
                    if element is not None:
                        element.DestroyWME()
                    self._elements[name] = value, link.CreateStringWME(name, value)
            began_s = time.perf_counter()
            self._agent.RunSelf(1)
            took_s += time.perf_counter() - began_s
        self._agent.ExecuteCommandLine("epmem --set trigger none")
        return took_s

    def query(self, cue: Cue) -> float:
        """Query the episode most like a cue; return the duration in ms by Soar's own timer."""
        wanted = {"type": str(cue.type), **dict(cue.has)} | {each.feature: _decimetres(each.value) for each in cue.near}
        conditions = " ".join(f"^{name} |{value}|" for name, value in wanted.items())
        self._agent.ExecuteCommandLine(
            "sp {ask (state <s> ^superstate nil ^epmem.command <c>) --> (<c> ^query <q>) (<q> ^io <io>)"
            f" (<io> ^input-link <link>) (<link> {conditions})}}"
        )
        before_s = self._timer_s()
        self._agent.RunSelf(2)  # a query is answered in the next decision
        took_s = self._timer_s() - before_s
        self._agent.ExecuteCommandLine("excise ask")
        self._agent.RunSelf(1)
        return 1_000 * took_s

    def askable(self, cue: Cue) -> Cue:
        """Return the cue with the features that its episodes have."""
        near = tuple(each for each in cue.near if each.feature in _STORED_NUMBERS)
        return replace(cue, has=tuple(each for each in cue.has if each[0] in _STORED_TEXTS), near=near)

    def close(self) -> None:
        """Close the agent and its file."""
        self._kernel.Shutdown()

    def _timer_s(self) -> float:
        printed = self._agent.ExecuteCommandLine("epmem --timers")
        match = re.search(r"epmem_query:\s+(\S+)", printed)
        assert match is not None, printed
        return float(match.group(1))


def _elements(actions: Actions, index: int) -> dict[str, str]:
    texts = {name: actions.word(index, name) for name in _STORED_TEXTS}
    numbers = {name: _decimetres(float(actions.numbers[name][index])) for name in _STORED_NUMBERS}
    return {"type": actions.type_name(index), **texts, **numbers}


def _decimetres(value: float) -> str:
    return f"d{round(10 * value)}"
