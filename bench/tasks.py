"""Measure whole tasks: fetch an object from a table and place it on another one, with and without experience.

    python -m bench.tasks                     60 tasks, all rows, without and with errors of the robot
    python -m bench.tasks --tasks 200 --kept tasks.jsonl      continues after an interruption
    python -m bench.tasks --only "model, checked" --errors none
    python -m bench.tasks --only "model, checked" --errors all --object-noise 0.01      objects 1 cm off
    python -m bench.tasks --robots pr2 tiago_pro      the same tasks for each, with a model of its own

Each task is drawn from (seed, number): two tables of 0.7 m by 1.4 m, 0.5 to 1.1 m high and turned at random, 3.2 m
apart; milk, cereal or pringles 8 to 25 cm behind the edge of one, turned at random; its goal as far behind the
edge of the other, with another heading. The arms are parked, the torso is at 0.2 m, collisions of base,
arm and held object count, and the gripper opens 8.6 cm, that of a TIAGo Pro 7.9 cm. `Retry` has five tries.

| row | how to pick up and where to place |
|---|---|
| TransportAction | as without experience: `CostmapLocation`, from the front, the torso as it is |
| random | random ways, the first free ones |
| random, checked | random ways, the first that kinematics and collisions allow |
| recall, checked | the recalled ways that kinematics and collisions allow, then random ones |
| model | the likeliest ways of a success model, nothing checked |
| model, checked | the likeliest ways of a success model that kinematics and collisions allow |

The model learns from pick-ups alone, in 16 rounds of 375 at single tables (`Scene`), with the errors of all rows;
what is recalled are 1,000 random pick-ups in the same scene. Errors: the base misses its place by 2 cm and 2°, the
object is 0.5 cm and 3° beside its believed pose (standard deviations), 1 % slip. Of another `--object-noise` the model
learned nothing.

A try counts as failed if it was made and did not pick up; *all tries* also counts, of a task in which no try picked up,
the tries that were left. Intervals are of 95 %. The seconds are of processor time for each task.

A task can be *solved* if an arm and a grasp that fit the object pick it up from any place of a grid and place it from
any, without errors: places 6 cm apart, five heights of the torso, and for placing nine headings, or if a row did it.

The script prints one JSON line; progress and the table are on stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import AsyncExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import compress, product
from multiprocessing import get_context
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from bench.material.runs import options
from pycrorm_async import Memory, Reading
from pycrorm_async.errors import NotEnoughExperience
from pycrorm_async.learning import Disturbance, MoveAndPickUp, Scene, load_policy, save_policy
from pycrorm_async.learning.move_and_pick_up import context_of
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
from pycrorm_async.plan.actions import MoveAndPickUpPerformable
from pycrorm_async.plan.geometry import pick_up_poses, retract
from pycrorm_async.plan.locations import base_clearance, base_height_m, face, reaching_arms
from pycrorm_async.plan.motions import ChosenRobot, SimulatedModules
from pycrorm_async.plan.objects import designator_of, require_robot
from pycrorm_async.plan.task import collected_tree, experience
from pycrorm_async.query.success import interval_95
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.kinematics import within_reach
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS, PR2, Limits

TRIES = 5
BATCH = 5
"""Tasks of one job: the results of finished ones are kept."""
CELL_M, TORSOS = 0.06, 5
PLACES_M = (0.3, 1.15)
"""Limits of the distance of the base from the object in the grid of places."""
TURNS = tuple(side * turn for turn in (0.4, 0.8, 1.2, 1.8) for side in (1, -1))
"""Headings of the base in the grid, rad from that which faces the goal; these are tried last."""
OBJECTS = (ObjectType.MILK, ObjectType.BREAKFAST_CEREAL, ObjectType.PRINGLES)
ERRORS = Disturbance(base_m=0.02, base_rad=math.radians(2), object_m=0.005, object_rad=math.radians(3), slip=0.01)
TORSO_M = 0.2
LEARNING = Scene(
    heights=(0.6, 1.25), turned=True, others=OBJECTS[1:], table=True, parked=True, collisions=True, torso_height=TORSO_M
)
ROUNDS, ROLLOUTS = 16, 375
REMEMBERED = 1_000
"""The pick-ups that are recalled."""
ROWS = ("TransportAction", "random", "random, checked", "recall, checked", "model", "model, checked")


# --- learning -------------------------------------------------------------------------------------------------------


async def learned(scene: Scene, seed: int, *, rounds: int = ROUNDS, rollouts: int = ROLLOUTS) -> SuccessModel:
    """Return a model of pick-ups in this scene; each round tries where the model so far is unsure.

    Where the robot errs, no way is sure: a search would try the likeliest alone, and learn too little of the others.
    """
    rows: list[dict[str, Any]] = []
    draws = Draws.SEARCHED if scene.disturbance == Disturbance() else Draws.UNCERTAIN
    model = SuccessModel.untrained()
    with scene.entered() as stage:
        for number in range(rounds):
            for index in range(rollouts):
                stage.reset()
                action = MoveAndPickUp(stage.prepare(seed + number, index), policy=model)
                with suppress(PlanFailure):  # no place is free
                    rows.append(await tried(action.drawn(randomness(seed + number, index))))
            with suppress(NotEnoughExperience):  # a further round may succeed more often
                model = SuccessModel.fit(pd.DataFrame(rows)).drawing(draws)
    return model.drawing(Draws.CONFIDENT)


async def remember(url: str, scene: Scene, seed: int, count: int) -> None:
    """Record random pick-ups in this scene."""
    async with Memory.open(url) as memory:
        with scene.entered() as stage:
            async with memory.episode(description="pick-ups at a table"):
                for index in range(count):
                    stage.reset()
                    action = MoveAndPickUp(stage.prepare(seed, index), policy=SuccessModel.untrained())
                    with suppress(PlanFailure):
                        await action.drawn(randomness(seed, index)).perform()
        await memory.flush()


async def tried(way: Any) -> dict[str, Any]:
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
        description = self.robot.robot_description
        assert description is not None
        for each in description.arms.values():
            self.robot.set_joint_positions(dict(each.park))
        if description.torso_joint is not None:
            self.robot.set_joint_position(description.torso_joint, TORSO_M)
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
def kitchen(errors: Disturbance, robot_name: str = PR2.name) -> Iterator[Kitchen]:
    modules = SimulatedModules(Limits.SOFT, collisions=True)
    if errors != Disturbance():
        modules = DisturbedModules(Limits.SOFT, errors, collisions=True)
    with BulletWorld(), ChosenRobot("tasks", modules, collisions=True):
        robot = Object(robot_name, ObjectType.ROBOT)
        urdf = box_urdf("table", x=(-0.35, 0.35), y=(-0.7, 0.7), z=(-2.0, 0.0))
        one, other = (Object(f"table_{number}", ObjectType.ENVIRONMENT, urdf) for number in range(2))
        away = [Pose((50.0 + number, 50.0, 0.0)) for number in range(len(OBJECTS))]
        things = tuple(Object(each.name.lower(), each, pose=at) for each, at in zip(OBJECTS, away, strict=True))
        yield Kitchen(robot, (one, other), things, modules)


@dataclass(frozen=True)
class Ended:
    """How a task ended: the tries that were made and did not pick up, whether the first one did, what was achieved.

    Attributes:
        placed: the object is at its goal, also if the arm failed after it had left it there.
        reasons: the class of the failure of each failed action, the innermost one of a try.
        cpu_s: processor time.
    """

    failed: int
    first: bool
    picked: bool
    placed: bool
    reasons: list[str] = field(default_factory=list)
    cpu_s: float = field(default=0.0, compare=False)

    @property
    def all_failed(self) -> int:
        """The failed tries, and of a task in which no try picked up those that were left."""
        return self.failed if self.picked else TRIES


def transport(row: str, model: AnyPolicy | None, thing: Object, goal: Pose, rng: np.random.Generator) -> Any:
    arms = [*require_robot().description.arms]
    if row == "TransportAction":
        return TransportAction(thing, (arms * TRIES)[:TRIES], [goal])
    checked, recall = row.endswith("checked"), row.startswith("recall")
    ways = TransportPolicy(model if row.startswith("model") else None, recall=recall, checked=checked, rng=rng)
    return TransportAction(thing, arms, [goal], policy=ways)


async def performed(row: str, model: AnyPolicy | None, here: Kitchen, seed: int, number: int) -> Ended:
    thing, goal = here.prepare(seed, number)
    began = process_time()
    plan = transport(row, model, thing, goal, np.random.default_rng((seed, number, 3)))
    placed = True
    with collected_tree() as tree:
        try:
            await Retry(plan, max_tries=TRIES).perform()
        except PlanFailure:
            placed = thing not in here.robot.attachments and math.dist(thing.pose.position, goal.position) < 0.01
    reasons = [
        type(each.failure).__name__
        for each in tree
        if isinstance(each.designator, TransportActionPerformable) and each.failure is not None
    ]
    made = 0
    for node in tree:
        if isinstance(node.designator, TransportActionPerformable):
            made += 1
        elif isinstance(node.designator, PickUpActionPerformable) and node.status is TaskStatus.SUCCEEDED:
            return Ended(made - 1, made == 1, True, placed, reasons, process_time() - began)
    return Ended(made, False, False, placed, reasons, process_time() - began)


def grid(at: Pose, turn: float) -> list[Pose]:
    """Return the poses of the base around a point that are clear of obstacles, the usual distances first."""
    steps = math.ceil(PLACES_M[1] / CELL_M)
    cells = [(CELL_M * x, CELL_M * y) for x in range(-steps, steps + 1) for y in range(-steps, steps + 1)]
    cells = [each for each in cells if PLACES_M[0] < math.hypot(*each) < PLACES_M[1]]
    cells.sort(key=lambda each: abs(math.hypot(*each) - 0.65))
    x, y, _ = at.position
    poses = [face(Pose((x + dx, y + dy, 0.0)), at, height_m=base_height_m(), turned=turn) for dx, dy in cells]
    clearance = base_clearance()
    assert clearance is not None
    return [*compress(poses, clearance.clear(poses))]


def holds(thing: Object) -> Iterator[tuple[Arms, Grasp]]:
    """Yield each arm and grasp with which the object can be picked up from a place of the grid."""
    ways, around, heights = TransportPolicy(), grid(thing.pose, 0.0), torsos(thing)
    description = require_robot().description
    for arm, grasp in product(description.arms, Grasp):
        goals = pick_up_poses(description, thing.pose, grasp, Pose())[1:]  # the first depends on the base
        if ways.takes(thing, arm, grasp) and any(
            ways.reaches(MoveAndPickUpPerformable(base, designator_of(thing), arm, grasp), torso)
            for base, torso in reachable(arm, goals, around, heights)
        ):
            yield arm, grasp


def reachable(
    arm: Arms, goals: Sequence[Pose], bases: Sequence[Pose], heights: Sequence[float | None]
) -> Iterator[tuple[Pose, float | None]]:
    """Yield each place and height of the torso from which no goal is too far from the arm, or too near."""
    reached = within_reach(require_robot().body, arm, goals, bases=bases, torso_heights=heights)
    return compress(product(bases, heights), reached.ravel())


def torsos(thing: Object) -> list[float | None]:
    limits = context_of(thing).torso_limits
    return [None] if limits is None else np.linspace(*limits, TORSOS).tolist()


def solvable(here: Kitchen, seed: int, number: int) -> bool:
    """Return whether any arm and grasp pick the object up from a place of the grid, and place it from another."""
    thing, goal = here.prepare(seed, number)
    robot, heights = require_robot(), torsos(thing)

    def places(hold: tuple[Arms, Grasp], turn: float) -> bool:
        at = goal @ Pose(orientation=GRASP_ORIENTATIONS[hold[1]])
        goals = at, retract(at)
        return any(
            reaching_arms(robot, hold[0], base, lambda _: goals, torso_height=torso, grasps=False).refusal is None
            for base, torso in reachable(hold[0], goals, around[turn], heights)
        )

    able: list[tuple[Arms, Grasp]] = []
    around = {0.0: grid(goal, 0.0)}
    for hold in holds(thing):
        able.append(hold)
        if places(hold, 0.0):
            return True
    around = {turn: grid(goal, turn) for turn in TURNS} if able else {}
    return any(places(hold, turn) for turn in around for hold in able)


def job(
    row: str,
    experience_file: str | None,
    errors: Disturbance,
    seed: int,
    numbers: Sequence[int],
    robot_name: str = PR2.name,
) -> list[Any]:
    """Return how these tasks ended, of the row "ceiling" whether they can be solved; run in a process of its own.

    `experience_file` is that of the model, or the memory of the recalled ways.
    """

    async def ended() -> list[Any]:
        model = load_policy(experience_file) if experience_file is not None and row.startswith("model") else None
        async with AsyncExitStack() as stack:
            if row.startswith("recall"):  # without recording, so that the order of the tasks does not matter
                reading = await stack.enter_async_context(Reading.open(f"sqlite:///{experience_file}"))
                experience.set(PickUpExperience.of(reading))
            here = stack.enter_context(kitchen(errors, robot_name))
            if row == "ceiling":
                return [solvable(here, seed, number) for number in numbers]
            return [await performed(row, model, here, seed, number) for number in numbers]

    return asyncio.run(ended())


class Kept:
    """The ends of tasks that were measured before, by robot, row, errors, seed and number, in a file of JSON lines."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self._ends: dict[tuple[Any, ...], Any] = {}
        if file is not None and file.exists():
            for line in file.read_text().splitlines():
                with suppress(ValueError):  # the last line of a run that was killed
                    *key, end = json.loads(line)
                    self._ends[tuple(key if len(key) > 5 else (PR2.name, *key))] = end  # of one robot, formerly

    def of(self, key: tuple[Any, ...], number: int) -> Any:
        end = self._ends.get((*key, number))
        return Ended(**end) if isinstance(end, dict) else end

    def solved(self, robot_name: str, seed: int) -> set[int]:
        """Return the tasks in which a row without errors placed the object."""
        return {
            number
            for (robot, _, errors, _, own_seed, number), end in self._ends.items()
            if isinstance(end, dict) and end["placed"] and not errors and (robot, own_seed) == (robot_name, seed)
        }

    def add(self, key: tuple[Any, ...], numbers: Sequence[int], ends: Sequence[Any]) -> None:
        for number, end in zip(numbers, ends, strict=True):
            self._ends[(*key, number)] = plain = asdict(end) if isinstance(end, Ended) else end
            if self._file is not None:
                with self._file.open("a") as file:
                    file.write(json.dumps([*key, number, plain]) + "\n")


def measure(
    kept: Kept,
    row: str,
    experience_file: str | None,
    errors: Disturbance,
    seed: int,
    numbers: Sequence[int],
    workers: int,
    robot_name: str,
) -> list[Any]:
    """Return how each of these tasks ended; the same for any number of workers."""
    key = robot_name, row, str(errors), Path(experience_file).name if experience_file is not None else "", seed
    missing = [number for number in numbers if kept.of(key, number) is None]
    with ProcessPoolExecutor(workers, mp_context=get_context("forkserver")) as pool:
        running = {
            pool.submit(job, row, experience_file, errors, seed, some, robot_name): some
            for some in (missing[first : first + BATCH] for first in range(0, len(missing), BATCH))
        }
        left = len(missing)
        for each in as_completed(running):
            kept.add(key, running[each], each.result())
            left -= len(running[each])
            done = f"{len(numbers) - left} of {len(numbers)} tasks"
            print(f"{robot_name}, {row}, {str(errors) or 'no errors'}: {done}", file=sys.stderr, flush=True)
    return [kept.of(key, number) for number in numbers]


def share(flags: Sequence[bool]) -> list[float]:
    """Return the share of true flags and its interval of 95 %."""
    count = sum(flags)
    return [round(each, 3) for each in (count / len(flags), *interval_95(count, len(flags)))]


def figures_of(ended: Sequence[Ended], solvable: Sequence[bool]) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "first_try": share([each.first for each in ended]),
        "picked": share([each.picked for each in ended]),
        "placed": share([each.placed for each in ended]),
        "failed_per_100": round(100 * sum(each.failed for each in ended) / len(ended), 1),
        "all_tries_per_100": round(100 * sum(each.all_failed for each in ended) / len(ended), 1),
        "cpu_s": round(sum(each.cpu_s for each in ended) / len(ended), 2),
        "reasons": dict(Counter(reason for each in ended for reason in each.reasons).most_common()),
    }
    if any(solvable):
        able = [each for each, flag in zip(ended, solvable, strict=True) if flag]
        figures["placed_of_solvable"] = share([each.placed for each in able])
        figures["all_tries_per_100_solvable"] = round(100 * sum(each.all_failed for each in able) / len(able), 1)
    return figures


def show(figures: dict[str, Any]) -> None:
    names = "first_try", "picked", "placed", "placed_of_solvable"
    counts = "failed_per_100", "all_tries_per_100", "all_tries_per_100_solvable", "cpu_s"
    headings = "first try", "picked in 5", "placed", "of solvable"
    table = Table("robot", "errors", "row", *headings, "failed per 100", "all tries", "all, per 100 solvable", "s")
    for each in figures["rows"]:
        shares = ["{:.0%} ({:.0%}-{:.0%})".format(*each[name]) if name in each else "" for name in names]
        table.add_row(
            each["robot"], each["errors"], each["row"], *shares, *(str(each.get(name, "")) for name in counts)
        )
    lines = []
    for robot_name, each in figures["solvable"].items():
        lines.append("{:.1%} ({:.1%}-{:.1%}) of the tasks can be solved by ".format(*each["share"]) + robot_name)
        if each["not"]:
            lines[-1] += ", all but " + ", ".join(map(str, each["not"]))
    table.caption = "\n".join(lines)
    Console(stderr=True, width=160).print(table)


def compared(
    arguments: argparse.Namespace, robot_name: str, kept: Kept, rows: Sequence[str], tasks: int, rollouts: int
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return which tasks this robot can solve, and the figures of each row."""
    ends: dict[tuple[str, str], list[Ended]] = {}
    with tempfile.TemporaryDirectory(prefix="tasks_") as temporary:
        folder = arguments.models or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        prefix = "" if robot_name == PR2.name else f"{robot_name}_"
        files = {"model": folder / f"{prefix}tasks_{rollouts}.json", "recall": folder / f"{prefix}tasks.db"}
        scene = replace(LEARNING, disturbance=ERRORS, robot=robot_name)
        if any(row.startswith("model") for row in rows) and not files["model"].exists():
            print(f"{robot_name}: learning from {ROUNDS * rollouts} pick-ups", file=sys.stderr, flush=True)
            save_policy(asyncio.run(learned(scene, 1_000, rollouts=rollouts)), files["model"])
        if any(row.startswith("recall") for row in rows) and not files["recall"].exists():
            print(f"{robot_name}: remembering {REMEMBERED} pick-ups", file=sys.stderr, flush=True)
            asyncio.run(remember(f"sqlite:///{files['recall']}", scene, 1_000, REMEMBERED))
        noisy = replace(ERRORS, object_m=arguments.object_noise)
        for name, errors in (("none", Disturbance()), ("all", noisy)):
            if arguments.errors not in (None, name):
                continue
            for row in rows:
                used = files.get(row.removesuffix(", checked"))
                file = None if used is None else str(used)
                ends[name, row] = measure(
                    kept, row, file, errors, arguments.seed, range(tasks), arguments.workers, robot_name
                )
    able = kept.solved(robot_name, arguments.seed)
    rest = [number for number in range(tasks) if number not in able]
    searched = measure(kept, "ceiling", None, Disturbance(), arguments.seed, rest, arguments.workers, robot_name)
    able |= {*compress(rest, searched)}
    flags = [number in able for number in range(tasks)]
    solvable = {"share": share(flags), "not": [number for number in rest if number not in able]}
    measured = [
        {"robot": robot_name, "errors": name, "row": row, **figures_of(ended, flags)}
        for (name, row), ended in ends.items()
    ]
    return solvable, measured


def main() -> None:
    parser = options(__doc__, quick="a few tasks, and a model of a few rollouts")
    parser.add_argument("--tasks", type=int, default=60)
    parser.add_argument("--seed", type=int, default=69)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", choices=(*ROWS, "ceiling"), help="one row")
    parser.add_argument("--errors", choices=("none", "all"), help="without or with errors of the robot; default both")
    parser.add_argument(
        "--object-noise", type=float, default=ERRORS.object_m, metavar="M",
        help=f"how far objects are off their places in x and in y where the robot errs, m; default {ERRORS.object_m}",
    )  # fmt: skip
    parser.add_argument("--robots", nargs="+", default=[PR2.name], help="names of robots; default pr2")
    parser.add_argument("--rollouts", type=int, default=ROLLOUTS, help=f"pick-ups of a round; default {ROLLOUTS}")
    parser.add_argument("--models", type=Path, help="folder in which models are kept, to be used again")
    parser.add_argument("--kept", type=Path, help="file of ended tasks: a further run with it continues; of this code")
    arguments = parser.parse_args()
    tasks, rollouts = (6, 100) if arguments.quick else (arguments.tasks, arguments.rollouts)
    if min(tasks, rollouts, arguments.workers) < 1:
        parser.error("--tasks, --rollouts and --workers must be 1 or more")
    rows = [row for row in ROWS if arguments.only in (None, row)]
    figures: dict[str, Any] = {
        "bench": "tasks", "tasks": tasks, "seed": arguments.seed, "object_noise_m": arguments.object_noise,
        "solvable": {}, "rows": [],
    }  # fmt: skip
    kept = Kept(arguments.kept)
    for robot_name in arguments.robots:
        figures["solvable"][robot_name], measured = compared(arguments, robot_name, kept, rows, tasks, rollouts)
        figures["rows"] += measured
    show(figures)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
