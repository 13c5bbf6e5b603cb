"""The cost of one hook: an action with object, arm and grasp starts and ends, robot state read from a Bullet world.

Prints one JSON line: microseconds of `node_started` and `node_ended`, with the queue's sync thread and the writer's
thread at work. Run it with `python -m bench.hook`.
"""

import asyncio
import json
import platform
import statistics
import tempfile
import time

from pycrorm_async import Memory
from pycrorm_async.clock import monotonic_ns
from pycrorm_async.plan import PickUpActionPerformable
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.plan.ports import recorder
from pycrorm_async.plan.task_tree import TaskStatus, TaskTreeNode
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose

ROUNDS = 100_000


def spread(nanoseconds: list[int]) -> dict[str, float]:
    """Median and tails in µs."""
    ordered = sorted(nanoseconds)
    at = {"p99": 0.99, "p99.9": 0.999}
    return {
        "median": statistics.median(ordered) / 1e3,
        **{name: ordered[int(share * len(ordered))] / 1e3 for name, share in at.items()},
        "max": ordered[-1] / 1e3,
    }


async def measured(url: str) -> dict[str, object]:
    starts, ends = [], []
    async with Memory.open(url) as memory, memory.episode(description="bench"):
        with BulletWorld():
            Object("pr2", ObjectType.ROBOT)
            milk = designator_of(Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9])))
            action = PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT)
            told = recorder.get()
            assert told is not None
            began = time.perf_counter()
            for _ in range(ROUNDS):
                node = TaskTreeNode(action, "action", None, monotonic_ns())
                one = time.perf_counter_ns()
                told.node_started(node)
                two = time.perf_counter_ns()
                node.status = TaskStatus.SUCCEEDED
                three = time.perf_counter_ns()
                told.node_ended(node)
                ends.append(time.perf_counter_ns() - three)
                starts.append(two - one)
            took = time.perf_counter() - began
        stored = memory.status.stored
    both = [(start + end) // 2 for start, end in zip(starts, ends, strict=True)]
    return {
        "bench": "hook",
        "rounds": ROUNDS,
        "start_us": spread(starts),
        "end_us": spread(ends),
        "mean_of_both_us": spread(both),
        "events_per_s": round(2 * ROUNDS / took),
        "stored_meanwhile": stored,
        "python": platform.python_version(),
    }


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(asyncio.run(measured(f"sqlite:///{folder}/bench.db"))))


if __name__ == "__main__":
    main()
