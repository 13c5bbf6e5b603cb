"""Measure how much CPU time of its thread a plan of PyCRAM takes with and without this memory.

    .venv-pycram/bin/python -m bench.pycram                              25 pairs for each writer, three minutes
    .venv-pycram/bin/python -m bench.pycram --quick                      two pairs
    .venv-pycram/bin/python -m bench.pycram --writer daemon --pairs 100  a narrow interval for one writer

`python -m tests.integrations.pycram.environment` makes that environment. A plan of 19 nodes (park, raise the torso,
pick up, drive, place) is performed twice inside `remember` and twice without, in pairs of alternating order. The first
plan also declares the types of its nodes, which happens once; opening and closing the memory is not measured. The
measurement is `time.thread_time` of the plan's thread: wall times would be useless, because other programs run.
OpenBLAS gets one thread, because the plan's thread otherwise spins until another one has had its turn, which took up
to twice the plan's own time on a busy machine. The garbage of the plans is collected before each of them, so that both
kinds pay for their own; what was there before the first is left out, because its collection would take longer than a
plan. `daemon`: no daemon drains the spool, which a process of its own would do; `daemon-50ms`: synced every 50 ms, as
other memories, instead of every 250. `thread`: the tables are made when the block ends, which is the default of
`remember`; `idle`: whenever the plan is idle, synced every 50 ms.

The script prints one JSON line: CPU of a plan in ms, the median ratio of a pair, its 95 % interval (of order
statistics, which assumes no distribution) and quartiles, the median difference, and the ratio of the least times, which
a busy machine disturbs least. `seams_ms` is the CPU that the observer's own calls take of a plan, the median and the
least of further blocks that are in no ratio. It varies less, and leaves out what they cost beside their calls: the
memory of PyCRAM that they drive out of the caches, and the turns of the memory's threads.
"""

from __future__ import annotations

import gc
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from pathlib import Path
from typing import Any

from bench.material.runs import options

_PAIRS = 25
_TIMED_BLOCKS = 10
"""The blocks whose seams are timed, after the pairs."""


def measure(folder: Path, pairs: int, only: str | None = None) -> dict[str, Any]:
    """Measure all writers, or only one of them, in one process and world."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported
    from tests.integrations.pycram.headless import leave_out_mesh_checks, start_pycram

    worlds = start_pycram(folder / "home")
    from pycram.process_module import simulated_robot

    from pycrorm_async.integrations.pycram import remember
    from pycrorm_async.settings import Settings
    from pycrorm_async.writer import plan_writer as delegated_writer

    delegated_writer._UNDRAINED_S = 0.0  # noqa: SLF001  each block would wait 2 s for a daemon
    leave_out_mesh_checks()
    make_world(worlds)
    gc.freeze()
    kinds: dict[str, dict[str, Any]] = {
        "daemon": {"writer": "daemon"},
        "daemon-50ms": {"writer": "daemon", "settings": Settings(fold="at_end")},
        "thread": {"writer": "thread"},
        "idle": {"writer": "thread", "settings": Settings()},
    }
    result: dict[str, Any] = {"pairs": pairs}
    with simulated_robot:
        for name, arguments in kinds.items():
            if only not in (None, name):
                continue
            url = f"sqlite:///{folder / name}.db"

            def remembered(url: str = url, arguments: dict[str, Any] = arguments) -> AbstractContextManager[Any]:
                return remember(url, description="bench", **arguments)

            result[name] = compare(remembered, pairs)
            for place, taken_ms in zip(
                ("first", "second"), seams_ms(remembered, min(pairs, _TIMED_BLOCKS)), strict=True
            ):
                result[name][place]["seams_ms"] = round(statistics.median(taken_ms), 2)
                result[name][place]["seams_ms_least"] = round(min(taken_ms), 2)
    return result


def compare(remembered: Callable[[], AbstractContextManager[Any]], pairs: int) -> dict[str, Any]:
    """Return the CPU time of the first and of the second plan of a block, with and without a memory."""
    measured: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for number in range(pairs):
        for inside in (True, False) if number % 2 else (False, True):
            with remembered() if inside else nullcontext():
                measured[inside].append((perform(), perform()))
    figures = {}
    for place, name in enumerate(("first", "second")):
        with_ms, without_ms = ([each[place] for each in measured[inside]] for inside in (True, False))
        ratios = [one / other for one, other in zip(with_ms, without_ms, strict=True)]
        more_ms = [one - other for one, other in zip(with_ms, without_ms, strict=True)]
        figures[name] = {
            "without_ms": round(statistics.median(without_ms), 1),
            "ratio": round(statistics.median(ratios), 3),
            "ratio_interval": [round(each, 3) for each in median_interval(ratios)],
            "ratio_quartiles": [round(each, 3) for each in statistics.quantiles(ratios, n=4)[::2]],
            "more_ms": round(statistics.median(more_ms), 2),
            "ratio_of_least": round(min(with_ms) / min(without_ms), 3),
        }
    return figures


def seams_ms(remembered: Callable[[], AbstractContextManager[Any]], blocks: int) -> tuple[list[float], list[float]]:
    """Return the CPU time that the observer's calls take in the first and in the second plan of each block, ms."""
    from pycrorm_async.integrations import pycram
    from pycrorm_async.integrations import pycram as pycram_world

    taken_ns: list[int] = []
    depth = 0

    def timed(method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def call(*arguments: Any, **named: Any) -> Any:
            nonlocal depth
            depth += 1
            before = time.thread_time_ns()
            try:
                return method(*arguments, **named)
            finally:
                depth -= 1
                if not depth:
                    taken_ns.append(time.thread_time_ns() - before)

        return call

    guarded = [
        (owner, name, method)
        for owner in (pycram._PyCRAMPlans, pycram_world.PyCRAMWorld)  # noqa: SLF001
        for name, method in vars(owner).items()
        if hasattr(method, "__wrapped__")
    ]
    for owner, name, method in guarded:
        setattr(owner, name, timed(method))
    totals: tuple[list[float], list[float]] = ([], [])
    try:
        for _ in range(blocks):
            with remembered():
                for each in totals:
                    taken_ns.clear()
                    perform()
                    each.append(sum(taken_ns) / 1e6)
    finally:
        for owner, name, method in guarded:
            setattr(owner, name, method)
    return totals


def median_interval(values: list[float]) -> tuple[float, float]:
    """Return two of the values between which their population's median is with a probability of 95 %."""
    ordered = sorted(values)
    rank = max(0, int(len(ordered) / 2 - 0.98 * len(ordered) ** 0.5) - 1)
    return ordered[rank], ordered[-1 - rank]


def make_world(worlds: Any) -> None:
    from pycram.datastructures.pose import PoseStamped
    from pycram.world_concepts.world_object import Object
    from pycrap.ontologies import Milk, Robot

    worlds.BulletWorld()
    Object("pr2", Robot, "pr2.urdf")
    Object("milk", Milk, "milk.urdf", pose=PoseStamped.from_list([0.8, 0, 0.9]))


def perform() -> float:
    """Perform the plan from the same state; return the CPU time of this thread, ms."""
    from pycram.datastructures.enums import Arms, Grasp, TorsoState
    from pycram.datastructures.pose import GraspDescription, PoseStamped
    from pycram.datastructures.world import World
    from pycram.designator import ActionDescription
    from pycram.designators import action_designator as actions
    from pycram.language import SequentialPlan

    for action in (ActionDescription, *ActionDescription.__subclasses__()):
        vars(action).get("_pre_perform_callbacks", []).clear()  # they grow with every action, and each action calls all
    milk, robot = World.current_world.get_object_by_name("milk"), World.robot
    robot.set_pose(PoseStamped.from_list([0, 0, 0]))
    milk.set_pose(PoseStamped.from_list([0.8, 0, 0.9]))
    plan = SequentialPlan(
        actions.ParkArmsActionDescription(Arms.BOTH),
        actions.MoveTorsoActionDescription(TorsoState.HIGH),
        actions.PickUpActionDescription(milk, Arms.LEFT, GraspDescription(Grasp.FRONT, None, False)),
        actions.NavigateActionDescription(PoseStamped.from_list([0.1, 0.2, 0]), True),
        actions.PlaceActionDescription(milk, PoseStamped.from_list([0.9, 0.2, 0.85]), Arms.LEFT),
    )
    gc.collect()  # otherwise the plan would pay for what opening a memory leaves
    before = time.thread_time()
    plan.perform()
    return (time.thread_time() - before) * 1_000


def main() -> None:
    parser = options(__doc__, quick="few and small, to check that it works")
    parser.add_argument("--pairs", type=int, default=_PAIRS)
    parser.add_argument("--writer", choices=("daemon", "daemon-50ms", "thread", "idle"))
    given = parser.parse_args()
    pairs = 2 if given.quick else max(2, given.pairs)
    code = 1
    try:
        with tempfile.TemporaryDirectory(prefix="pycram_bench_") as folder:
            line = measure(Path(folder), pairs, given.writer)
        print(json.dumps({"command": " ".join(["python -m bench.pycram", *sys.argv[1:]]), **line}))
        code = 0
    finally:  # PyCRAM's threads do not end
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    main()
