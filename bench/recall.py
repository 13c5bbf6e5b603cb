"""Measure how long it takes to recall the cases most like a cue, beside the episodic memory of Soar.

    python -m bench.recall                         100,000 and 1,000,000 actions; some minutes, most of them for Soar
    python -m bench.recall --actions 100000        one size
    python -m bench.recall --no-soar --actions 10000000
    python -m bench.recall --quick                 2,000 actions, few cues

Each action has a type, 12 texts and 6 numbers. The cues of a kind take turns with those of the other kinds, and each is
asked once. `recall` measures the answer with the best 10 cases, and reads the best one. Soar returns one episode; its
own timer measures the query, and it is asked at most 60 cues of a kind. An episode of Soar has ten of the elements. It
compares numbers for equality only, so they are stored in decimetres, and a cue asks for those features that the
episodes have. The script prints one JSON line: by number of actions and kind of cue the ms (median, p99, p99.9,
maximum); the bytes and the µs of storing an action, and the ms of decoding all blocks. Soar is missing if `soar-sml` is
not installed.
"""

from __future__ import annotations

import gc
import importlib
import json
import re
import tempfile
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.material.actions import BLOCK_CASES, CUES, Actions
from bench.material.runs import options
from bench.reporting.figures import MISSING, console, percentiles, spread
from pycrorm_async.recall.answer import Sequences, answer
from pycrorm_async.recall.blocks import CaseBlock, CaseLibrary, decode, encode, merge
from pycrorm_async.recall.search import Cue, forgotten

# === soar memory ==============================================================================================
#
# Store actions in the episodic memory of Soar, and query it, with its own timers. Requires `soar-sml`.

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


# === recall ===================================================================================================

_SEED = 69
_SOAR_CUES = 60
"""Bounds the cues of a kind that Soar is asked: it needs 0.2 s for one of some kinds in a million episodes."""
_LOADS = 5
"""The number of times that all blocks are loaded."""
_FLUSHED = 64
"""The cases of a block that a flush writes."""


def main() -> None:
    parser = options(__doc__, quick="few and small, to check that it works")
    parser.add_argument("--actions", type=int, nargs="+")
    parser.add_argument("--no-soar", action="store_true")
    parser.add_argument("--cues", type=int, help="of each kind; 200 by default")
    arguments = parser.parse_args()
    sizes = arguments.actions or ([2_000] if arguments.quick else [100_000, 1_000_000])
    cues = arguments.cues or (5 if arguments.quick else 200)
    line = {
        "bench": "recall",
        "cues": cues,
        **{f"{size:,}": measure(size, cues, soar=not arguments.no_soar) for size in sizes},
    }
    print(json.dumps(line))


def measure(size: int, cues: int, *, soar: bool) -> dict[str, Any]:
    """Measure one memory of this many actions."""
    console().print(f"{size:,} actions")
    actions = Actions(size, seed=_SEED)
    rows = [encode(block) for block in actions.blocks()]
    count_bytes = sum(map(len, rows))
    loads_ms = []
    for _ in range(_LOADS):
        began_s = time.perf_counter()
        library = CaseLibrary([decode(each) for each in rows])
        loads_ms.append(1_000 * (time.perf_counter() - began_s))
    asked = [(kind, make(actions)) for _ in range(cues) for kind, make in CUES.items()]
    took_ms: dict[str, list[float]] = {kind: [] for kind in CUES}
    cpu_ms: dict[str, list[float]] = {kind: [] for kind in CUES}
    for _, cue in asked[: len(CUES)]:
        answer(cue, library)  # the first answer of a kind counts words, and is not measured
    gc.collect()
    gc.freeze()
    for kind, cue in asked:
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        found = answer(cue, library)
        assert not found or found[0].case.type == cue.type
        cpu_ms[kind].append(1_000 * (time.process_time() - began_cpu_s))
        took_ms[kind].append(1_000 * (time.perf_counter() - began_s))
    return {
        "bytes_an_action": round(count_bytes / size, 1),
        "load_ms": spread(loads_ms),
        "store_us_an_action": _stored(library),
        "recall_ms": {kind: percentiles(each) for kind, each in took_ms.items()},
        "recall_cpu_ms": {kind: percentiles(each) for kind, each in cpu_ms.items()},
        "sequences_ms": _sequences(library),
        "soar": _soar(actions, cues) if soar else "left out",
    }


def _stored(library: CaseLibrary) -> dict[str, float]:
    """Return the CPU time of making small blocks of cases, and of merging 16 of them into one."""
    cases = list(library.blocks[0].cases())[: 16 * _FLUSHED]
    began_s = time.process_time()
    blocks = [CaseBlock.of(cases[first : first + _FLUSHED]) for first in range(0, len(cases), _FLUSHED)]
    encoded = [encode(block) for block in blocks]
    flushed_s = time.process_time()
    encode(merge([decode(each) for each in encoded]))
    merged_s = time.process_time()
    return {
        f"blocks of {_FLUSHED}": round(1e6 * (flushed_s - began_s) / len(cases), 2),
        "merge of 16": round(1e6 * (merged_s - flushed_s) / len(cases), 2),
    }


def _sequences(library: CaseLibrary) -> dict[str, float]:
    """Return the time of sorting all cases by parent, of counting followers, and of the activation of all ways."""
    marks = [time.perf_counter()]
    sequences = Sequences(library)
    marks.append(time.perf_counter())
    for name in library.types:
        sequences.follows(name, status="FAILED")
    marks.append(time.perf_counter())
    forgotten(library, threshold=-2.0, now_us=2 * BLOCK_CASES * 10**6 * len(library.blocks))
    marks.append(time.perf_counter())
    sorted_ms, followed_ms, activation_ms = (1_000 * (after - before) for before, after in pairwise(marks))
    return {
        "sorted once": round(sorted_ms, 1),
        "what follows a type": round(followed_ms / len(library.types), 3),
        "activation of all": round(activation_ms, 1),
    }


def _soar(actions: Actions, cues: int) -> dict[str, Any] | str:
    try:
        sml: ModuleType = importlib.import_module("soar_sml")
    except ImportError:
        return MISSING
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "soar.db"
        memory = SoarMemory(sml, path)
        took_s = memory.store(actions)
        took_ms = {
            kind: [memory.query(memory.askable(make(actions))) for _ in range(min(cues, _SOAR_CUES))]
            for kind, make in CUES.items()
        }
        memory.close()  # which writes the rest of the file
        return {
            "bytes_an_action": round(path.stat().st_size / len(actions), 1),
            "store_us_an_action": round(1e6 * took_s / len(actions), 1),
            "recall_ms": {kind: percentiles(each) for kind, each in took_ms.items()},
        }


if __name__ == "__main__":
    main()
