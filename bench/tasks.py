"""Measure whole tasks: fetch an object from a table and place it on another one, with and without experience.

    python -m bench.tasks                 200 tasks, all policies, without and with errors of the robot
    python -m bench.tasks --tasks 30      fewer
    python -m bench.tasks --only model    one row

Each task is drawn from (seed, number): two tables of 0.7 m by 1.4 m, 0.5 to 1.1 m high and turned at random, 3.2 m
apart; milk, cereal or pringles 8 to 25 cm behind the edge of one, turned at random; its goal as far behind the
edge of the other, with another heading. The arms are parked, the torso is at 0.2 m, collisions of base,
arm and held object count, and the gripper opens 8.6 cm. `Retry` has five tries.

| row | how to pick up and where to place |
|---|---|
| TransportAction | as without experience: `CostmapLocation`, from the front, the torso as it is |
| random | random ways, the first free ones |
| random, checked | random ways, the first that kinematics and collisions allow |
| model | the likeliest ways of a success model, nothing checked |
| model, checked | the likeliest ways of a success model that kinematics and collisions allow |

The model learns from pick-ups alone, in four rounds of 2,500 at single tables (`Scene`), with the errors of the row.
Errors: the base misses its place by 2 cm and 2°, the object is 0.5 cm and 3° beside its believed pose (standard
deviations), 1 % slip. A try counts as failed if it was made and did not pick up; in the last column a task that is
given up also counts the tries that are left. The ceiling is the share of tasks in which any of 4,000 ways to pick up,
and a place for placing it, works without errors. Intervals are of 95 %.

The script prints one JSON line; the table is on stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from pycrorm_async.errors import NotEnoughExperience
from pycrorm_async.learning import Disturbance, MoveAndPickUp, Scene, load_policy, save_policy
from pycrorm_async.learning.policy_file import AnyPolicy
from pycrorm_async.learning.rollouts import randomness
from pycrorm_async.learning.scenes import DisturbedModules
from pycrorm_async.learning.success_model import Draws, SuccessModel
from pycrorm_async.learning.transport import TransportPolicy
from pycrorm_async.plan import (
    PickUpActionPerformable,
    PlanFailure,
    Retry,
    TransportAction,
    TransportActionPerformable,
)
from pycrorm_async.plan.locations import base_clearance
from pycrorm_async.plan.motions import ChosenRobot, SimulatedModules
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.query.success import interval_95
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.urdf import Limits

TRIES = 5
CANDIDATES, TURNS = 4_000, 10
OBJECTS = (ObjectType.MILK, ObjectType.BREAKFAST_CEREAL, ObjectType.PRINGLES)
ERRORS = Disturbance(base_m=0.02, base_rad=math.radians(2), object_m=0.005, object_rad=math.radians(3), slip=0.01)
TORSO_M = 0.2
LEARNING = Scene(
    heights=(0.6, 1.25), turned=True, others=OBJECTS[1:], table=True, parked=True, collisions=True, torso_height=TORSO_M
)
ROUNDS, ROLLOUTS = 4, 2_500
ROWS = ("TransportAction", "random", "random, checked", "model", "model, checked")


# --- learning -------------------------------------------------------------------------------------------------------


async def learned(scene: Scene, seed: int, *, rounds: int = ROUNDS, rollouts: int = ROLLOUTS) -> SuccessModel:
    """Return a model of pick-ups in this scene; each round tries where the model so far is unsure."""
    rows: list[dict[str, Any]] = []
    model = SuccessModel.untrained()
    with scene.entered() as stage:
        for number in range(rounds):
            for index in range(rollouts):
                stage.reset()
                action = MoveAndPickUp(stage.prepare(seed + number, index), policy=model)
                with suppress(PlanFailure):  # no place is free
                    rows.append(await _tried(action.drawn(randomness(seed + number, index))))
            with suppress(NotEnoughExperience):  # a further round may succeed more often
                model = SuccessModel.fit(pd.DataFrame(rows)).drawing(Draws.UNCERTAIN)
    return model.drawing(Draws.CONFIDENT)


async def _tried(way: Any) -> dict[str, Any]:
    status = TaskStatus.SUCCEEDED
    try:
        await way.perform()
    except PlanFailure:
        status = TaskStatus.FAILED
    row = {name: getattr(way, name) for name in ("width", "depth", "origin_height", "edge_distance", "edge_angle")}
    return row | {
        "arm": way.arm.name, "grasp": way.grasp.name, "robot_in_object_x": way.relative_x,
        "robot_in_object_y": way.relative_y, "height": way.height, "torso_height": way.torso, "status": status.value,
    }  # fmt: skip


# --- tasks ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kitchen:
    """The world of the tasks: the robot, two tables, and the objects, of which a task uses one."""

    robot: Object
    tables: tuple[Object, Object]
    things: tuple[Object, ...]
    modules: SimulatedModules

    def prepare(self, seed: int, number: int) -> tuple[Object, Pose]:
        """Draw a task; return the object and its goal."""
        self.robot.world.reset()
        rng = np.random.default_rng((seed, number, 1))
        if isinstance(self.modules, DisturbedModules):
            self.modules.rng = np.random.default_rng((seed, number, 2))
        assert self.robot.robot_description is not None
        for each in self.robot.robot_description.arms.values():
            self.robot.set_joint_positions(dict(each.park))
        self.robot.set_joint_position("torso_lift_joint", TORSO_M)
        thing = self.things[rng.integers(len(self.things))]
        underside = thing.bounding_box().min.z - thing.pose.position.z
        places = []
        for table, x in zip(self.tables, (1.6, -1.6), strict=True):
            table.set_pose(Pose((x, 0.0, rng.uniform(0.5, 1.1)), yaw_quaternion(rng.uniform(-math.pi, math.pi))))
            on_top = Pose((rng.uniform(-0.27, -0.1), rng.uniform(-0.4, 0.4), -underside))
            heading = yaw_quaternion(rng.uniform(-math.pi, math.pi))
            places.append(Pose((table.pose @ on_top).position, heading))
        thing.set_pose(places[0])
        return thing, places[1]


@contextmanager
def kitchen(errors: Disturbance) -> Iterator[Kitchen]:
    modules = SimulatedModules(Limits.SOFT, collisions=True)
    if errors != Disturbance():
        modules = DisturbedModules(Limits.SOFT, errors, collisions=True)
    with BulletWorld(), ChosenRobot("tasks", modules, collisions=True):
        robot = Object("pr2", ObjectType.ROBOT)
        urdf = box_urdf("table", x=(-0.35, 0.35), y=(-0.7, 0.7), z=(-2.0, 0.0))
        one, other = (Object(f"table_{number}", ObjectType.ENVIRONMENT, urdf) for number in range(2))
        away = [Pose((50.0 + number, 50.0, 0.0)) for number in range(len(OBJECTS))]
        things = tuple(Object(each.name.lower(), each, pose=at) for each, at in zip(OBJECTS, away, strict=True))
        yield Kitchen(robot, (one, other), things, modules)


@dataclass(frozen=True)
class Ended:
    """How a task ended: the tries that were made and did not pick up, whether the first one did, what was achieved."""

    failed: int
    first: bool
    picked: bool
    placed: bool


def transport(row: str, model: AnyPolicy | None, thing: Object, goal: Pose, rng: np.random.Generator) -> Any:
    arms = [Arms.LEFT, Arms.RIGHT]
    if row == "TransportAction":
        return TransportAction(thing, (arms * TRIES)[:TRIES], [goal])
    ways = TransportPolicy(model if row.startswith("model") else None, checked=row.endswith("checked"), rng=rng)
    return TransportAction(thing, arms, [goal], policy=ways)


async def performed(row: str, model: AnyPolicy | None, here: Kitchen, seed: int, number: int) -> Ended:
    thing, goal = here.prepare(seed, number)
    plan = transport(row, model, thing, goal, np.random.default_rng((seed, number, 3)))
    placed = True
    with collected_tree() as tree:
        try:
            await Retry(plan, max_tries=TRIES).perform()
        except PlanFailure:
            placed = False
    made = 0
    for node in tree:
        if isinstance(node.designator, TransportActionPerformable):
            made += 1
        elif isinstance(node.designator, PickUpActionPerformable) and node.status is TaskStatus.SUCCEEDED:
            return Ended(made - 1, made == 1, True, placed)
    return Ended(made, False, False, placed)


async def ceiling(here: Kitchen, seed: int, number: int) -> tuple[bool, bool]:
    """Return whether any of many ways picks the object up, and whether any does with which it can be placed."""
    thing, goal = here.prepare(seed, number)
    rng = np.random.default_rng((seed, number, 4))
    ways = TransportPolicy(rng=rng)
    picking = False
    placing: dict[Any, bool] = {}
    with suppress(PlanFailure):  # no place is free
        action = MoveAndPickUp(thing, policy=SuccessModel.untrained(), rng=rng)
        clearance = base_clearance()
        assert clearance is not None
        for choice in action.rated(CANDIDATES)[0]:
            if action.is_clear(choice, clearance) and ways.reaches(action.way(choice)):
                picking, key = True, choice[:2]
                if key not in placing:
                    placing[key] = any(ways.placing_chance(thing, *key, goal) for _ in range(TURNS))
                if placing[key]:
                    return True, True
    return picking, False


async def part(row: str, model_file: str | None, errors: Disturbance, seed: int, numbers: Sequence[int]) -> list[Any]:
    model = load_policy(model_file) if model_file is not None else None
    with kitchen(errors) as here:
        if row == "ceiling":
            return [await ceiling(here, seed, number) for number in numbers]
        return [await performed(row, model, here, seed, number) for number in numbers]


def in_process(*arguments: Any) -> list[Any]:
    return asyncio.run(part(*arguments))


def measure(row: str, model_file: str | None, errors: Disturbance, seed: int, tasks: int, workers: int) -> list[Any]:
    """Return how each task ended; the same for any number of workers."""
    parts = [range(first, tasks, workers) for first in range(workers)]
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
        results = list(
            pool.map(in_process, *zip(*((row, model_file, errors, seed, each) for each in parts), strict=True))
        )
    ended: list[Any] = [None] * tasks
    for numbers, some in zip(parts, results, strict=True):
        for number, each in zip(numbers, some, strict=True):
            ended[number] = each
    return ended


def figures_of(ended: Sequence[Ended]) -> dict[str, Any]:
    shares = {
        name: (sum(flags), [round(each, 3) for each in interval_95(sum(flags), len(flags))])
        for name, flags in (
            ("first_try", [each.first for each in ended]),
            ("picked", [each.picked for each in ended]),
            ("placed", [each.placed for each in ended]),
        )
    }
    figures: dict[str, Any] = {name: [round(done / len(ended), 3), *limits] for name, (done, limits) in shares.items()}
    failed = sum(each.failed for each in ended)
    left = sum(TRIES - each.failed for each in ended if not each.picked)
    return figures | {
        "failed_per_100": round(100 * failed / len(ended), 1),
        "with_tries_left": round(100 * (failed + left) / len(ended), 1),
    }


def show(figures: dict[str, Any]) -> None:
    table = Table("errors", "row", "first try", "picked in 5", "placed", "failed tries per 100", "tries left counted")
    for each in figures["rows"]:
        shares = ("{:.1%} ({:.0%}-{:.0%})".format(*each[name]) for name in ("first_try", "picked", "placed"))
        counts = (str(each[name]) for name in ("failed_per_100", "with_tries_left"))
        table.add_row(each["errors"], each["row"], *shares, *counts)
    for each in figures["ceilings"]:
        shares = ("{:.1%} ({:.0%}-{:.0%})".format(*each[name]) for name in ("picked", "placed"))
        table.add_row("none", "ceiling", "", *shares, "", "")
    Console(stderr=True, width=140).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few tasks, and a model of a few rollouts")
    parser.add_argument("--tasks", type=int, default=200)
    parser.add_argument("--seed", type=int, default=69)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", choices=(*ROWS, "ceiling"))
    parser.add_argument("--errors", choices=("none", "all"), help="without or with errors of the robot; default both")
    parser.add_argument("--models", type=Path, help="folder in which models are kept, to be used again")
    arguments = parser.parse_args()
    tasks, rollouts = (6, 200) if arguments.quick else (arguments.tasks, ROLLOUTS)
    rows = [row for row in ROWS if arguments.only in (None, row)]
    figures: dict[str, Any] = {"bench": "tasks", "tasks": tasks, "seed": arguments.seed, "rows": [], "ceilings": []}
    with tempfile.TemporaryDirectory(prefix="tasks_") as temporary:
        folder = arguments.models or Path(temporary)
        if arguments.only in (None, "ceiling"):
            reached = measure("ceiling", None, Disturbance(), arguments.seed, tasks, arguments.workers)
            figures["ceilings"].append(
                {
                    name: [round(sum(flags) / tasks, 3), *interval_95(sum(flags), tasks)]
                    for name, flags in zip(("picked", "placed"), zip(*reached, strict=True), strict=True)
                }
            )
        for name, errors in (("none", Disturbance()), ("all", ERRORS)):
            if arguments.errors not in (None, name):
                continue
            file = folder / f"tasks_{name}_{rollouts}.json"
            if any(row.startswith("model") for row in rows) and not file.exists():
                model = asyncio.run(learned(replace(LEARNING, disturbance=errors), 1_000, rollouts=rollouts))
                save_policy(model, file)
            for row in rows:
                used = str(file) if row.startswith("model") else None
                began = time.monotonic()
                ended = measure(row, used, errors, arguments.seed, tasks, arguments.workers)
                seconds = round((time.monotonic() - began) / tasks, 3)
                figures["rows"].append({"errors": name, "row": row, **figures_of(ended), "seconds_per_task": seconds})
                show({**figures, "rows": figures["rows"][-1:], "ceilings": []})
    show(figures)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
