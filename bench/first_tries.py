"""Measure how often a pick-up succeeds at the first try: recalled, with a learned policy, with the default policy.

    python -m bench.first_tries            new heights, then the kitchen, then varied scenes from nothing
    python -m bench.first_tries --only kitchen
    python -m bench.first_tries --quick    one seed, a few scenes

*Heights.* A memory in SQLite has 200, 500 or 2,000 tries of the default policy with the milk in the air at 0.6, 0.9 and
1.2 m, turned at random. Then the milk is at heights between these, 150 scenes a seed, and only the first try counts;
what is tried there is not recorded. With *off* the base lands off its place, by a normal error of 4 cm in x and y. The
learned policy is that of `learn` with 10 samples a leaf, and its likeliest sample of 20 that fit the scene.

*Kitchen.* The milk stands at random places on the three worktops, turned at random; the torso is at 0.3 m, and
collisions of the base and the arm with the furniture count, in the tries that are remembered as in those that are
counted. All choose free places from which the object is seen, the default policy the likeliest of 20. *from the air*
remembers the tries at three heights, without furniture and collisions, and has its first tries in the kitchen.

*Varied.* A memory that is empty at first, in which every try is recorded at once and is not flushed. Each scene has the
milk at 0.5 to 1.4 m, the torso at 0 to 0.3 m, one given arm, and a robot with free places in only a third of the circle
around the object. One try a scene; the first-try success of each 200 scenes, and the number of different ways (arm,
grasp, place to 1 cm) that served in the last 200, because where one way serves everywhere nothing is generalised.

The script prints one JSON line; the tables are on stderr. The robot is kinematic, and collisions count in the
kitchen only.
"""

from __future__ import annotations

import asyncio
import json
import math
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.progress import track
from rich.table import Table

from bench.material.runs import options
from bench.reporting.figures import console
from pycrorm_async import Memory, Reading
from pycrorm_async.errors import NotEnoughExperience
from pycrorm_async.learning import MoveAndPickUp, Policy, RecalledPickUp, Scene, Tally, learn
from pycrorm_async.learning.experiment import KITCHEN
from pycrorm_async.learning.scenes import Stage
from pycrorm_async.plan.actions import MoveAndPickUpPerformable
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.plan.locations import surface_poses
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.world import Arms, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion

TRIED_M = (0.6, 0.9, 1.2)
OFF_M = 0.04
PART = 200
"""The scenes of one point of the curve."""
Chooser = Callable[[Stage, np.random.Generator], Any]


def prepared(stage: Stage, rng: np.random.Generator, height: float, torso: float = 0.0) -> None:
    """Put the milk at this height, turned at random, and the robot back."""
    stage.reset()
    stage.target.set_pose(Pose((1.3, 1.0, height), yaw_quaternion(rng.uniform(-math.pi, math.pi))))
    stage.robot.set_joint_position("torso_lift_joint", torso)


async def succeeds(action: MoveAndPickUpPerformable, rng: np.random.Generator, off_m: float) -> bool:
    """Perform the action with a base that lands off its place."""
    x, y, z = action.standing_position.position
    x, y = x + rng.normal(0, off_m) if off_m else x, y + rng.normal(0, off_m) if off_m else y
    try:
        await replace(action, standing_position=Pose((x, y, z), action.standing_position.orientation)).perform()
    except PlanFailure:
        return False
    return True


# --- remembered tries, then first tries elsewhere -------------------------------------------------------------------


@dataclass(frozen=True)
class Setting:
    """A scene for tries, and the function that prepares it for the try of a number."""

    scene: Scene
    prepare: Callable[[Stage, np.random.Generator, int], None]
    is_free: bool = False
    """The default policy only stands at free places, from which the object is seen."""


def _tried_height(stage: Stage, rng: np.random.Generator, number: int) -> None:
    prepared(stage, rng, TRIED_M[number % len(TRIED_M)])


def _new_height(stage: Stage, rng: np.random.Generator, number: int) -> None:  # noqa: ARG001  as the others
    prepared(stage, rng, rng.uniform(TRIED_M[0], TRIED_M[-1]))


@cache
def in_kitchen() -> Setting:
    """Return the setting with the milk at a random place on a worktop."""
    with KITCHEN.entered() as stage:
        kitchen = stage.world.object("kitchen")
        places = [each for link in WORKTOPS for each in surface_poses(link, kitchen, stage.target)]
    free = [each.position for each in places if isinstance(each, Pose)]

    def prepare(stage: Stage, rng: np.random.Generator, number: int) -> None:  # noqa: ARG001  as the others
        stage.reset()
        position = free[rng.integers(len(free))]
        stage.target.set_pose(Pose(position, yaw_quaternion(rng.uniform(-math.pi, math.pi))))

    return Setting(KITCHEN, prepare, is_free=True)


AIR, BETWEEN = Setting(Scene(), _tried_height), Setting(Scene(), _new_height)
WORKTOPS = ("kitchen_counter_surface", "sink_area_surface", "kitchen_island_surface")


async def fill(memory: Memory, at: Setting, tries: int, rng: np.random.Generator, off_m: float) -> None:
    with at.scene.entered() as stage:
        async with memory.episode(description="tries under the default policy"):
            for number in range(tries):
                at.prepare(stage, rng, number)
                with suppress(PlanFailure):  # no place to stand
                    if at.is_free:
                        action = next(iter(MoveAndPickUp(stage.target, rng=rng)))
                    else:
                        (action,) = MoveAndPickUp(stage.target, samples=1, rng=rng).plain()
                    await succeeds(action, rng, off_m)
    await memory.flush()


async def first_tries(at: Setting, choose: Chooser, scenes: int, rng: np.random.Generator, off_m: float) -> Tally:
    tally = Tally()
    with at.scene.entered() as stage:
        for number in range(scenes):
            at.prepare(stage, rng, number)
            done = False
            with suppress(PlanFailure):  # a policy may know no way at this height
                action = await anext(aiter(choose(stage, rng)))
                done = await succeeds(action, rng, off_m)
            tally.successes += done
            tally.failures["failed"] += not done
    return tally


async def likeliest(stage: Stage, rng: np.random.Generator, policy: Policy | None) -> Any:
    for action in MoveAndPickUp(stage.target, policy=policy, rng=rng):
        yield action


async def compared(
    url: str, before: Setting, then: Setting, tries: int, seed: int, scenes: int, off_m: float
) -> dict[str, Tally]:
    """Remember tries in one setting; return how often each chooser succeeds first in another one."""
    rng = np.random.default_rng((seed, tries))
    async with Memory.open(url) as memory:
        await fill(memory, before, tries, rng, off_m)
        policy = None
        with suppress(NotEnoughExperience):  # then the default policy is all that is learned
            policy = learn(await memory.dataframe(MoveAndPickUp.query_for_database()), min_samples_leaf=10)
    choosers: dict[str, Chooser] = {
        "default policy": lambda stage, rng: likeliest(stage, rng, None),
        "learned policy": lambda stage, rng: likeliest(stage, rng, policy),
    }
    figures = {name: await first_tries(then, each, scenes, rng, off_m) for name, each in choosers.items()}
    async with Reading.open(url) as reading:  # in which nothing is recorded
        known = PickUpExperience.of(reading)

        def recalled(stage: Stage, rng: np.random.Generator) -> RecalledPickUp:
            return RecalledPickUp(stage.target, policy=policy, experience=known, rng=rng)

        figures["recalled"] = await first_tries(then, recalled, scenes, rng, off_m)
    return figures


# --- from nothing, in varied scenes ---------------------------------------------------------------------------------


def fan() -> str:
    """Return the URDF of low obstacles that leave a free sector of a third of the circle around the origin."""
    parts: list[str] = []
    for angle in np.linspace(math.radians(80), math.radians(280), 9).tolist():
        for radius, length in ((0.5, 0.4), (1.1, 0.7), (2.0, 1.0)):
            name, place = f"box_{len(parts)}", f"{radius * math.cos(angle):.3f} {radius * math.sin(angle):.3f} 0.025"
            shape = f'<geometry><box size="{length} {radius / 5} 0.05"/></geometry>'
            parts.append(
                f'<link name="{name}"><visual>{shape}</visual><collision>{shape}</collision></link>'
                f'<joint name="at_{name}" type="fixed"><parent link="fan"/><child link="{name}"/>'
                f'<origin xyz="{place}" rpy="0 0 {angle:.3f}"/></joint>'
            )
    return f'<robot name="fan"><link name="fan"/>{"".join(parts)}</robot>'


async def pick_up(stage: Stage, arm: Arms, rng: np.random.Generator, *, recall: bool) -> Any:
    if recall:
        async for recalled in RecalledPickUp(stage.target, [arm], rng=rng):
            yield recalled
    for sampled in MoveAndPickUp(stage.target, [arm], rng=rng):
        yield sampled


async def online(folder: Path, seed: int, scenes: int, *, recall: bool) -> tuple[list[float], int]:
    """Return the share of first tries that succeeded in each part, and the number of ways in the last one."""
    rng = np.random.default_rng(seed)
    served: list[bool] = []
    ways: list[tuple[int, tuple[Any, ...]]] = []
    with Scene().entered() as stage:
        obstacle = Object("fan", ObjectType.GENERIC_OBJECT, fan())
        async with Memory.open(f"sqlite:///{folder}/online_{seed}_{recall}.db") as memory:
            for _ in range(scenes):
                prepared(stage, rng, rng.uniform(0.5, 1.4), rng.uniform(0, 0.3))
                obstacle.set_pose(Pose((1.3, 1.0, 0.0), yaw_quaternion(rng.uniform(-math.pi, math.pi))))
                arm = [Arms.LEFT, Arms.RIGHT][rng.integers(2)]
                done = False
                with suppress(PlanFailure):  # some scenes have no place to stand
                    action = await anext(aiter(pick_up(stage, arm, rng, recall=recall)))
                    x, y, _ = action.standing_position.relative_to(stage.target.pose).position
                    async with memory.episode(description="one scene"):
                        done = await succeeds(action, rng, 0.0)
                    if done:
                        ways.append((len(served), (action.arm, action.grasp, round(x, 2), round(y, 2))))
                served.append(done)
    parts = [sum(served[first : first + PART]) / PART for first in range(0, scenes, PART)]
    return parts, len({way for number, way in ways if number >= scenes - PART})


class Case(NamedTuple):
    """One row of the first table: tries of a setting are remembered, and first tries of another one counted."""

    table: str
    before: Setting
    then: Setting
    tries: int
    off_m: float = 0.0


def cases_of(tries: Sequence[int], only: str | None) -> list[Case]:
    heights = [Case("heights", AIR, BETWEEN, number) for number in tries]
    heights.append(Case("heights", AIR, BETWEEN, max(tries), OFF_M))
    kitchen = [Case("kitchen", in_kitchen(), in_kitchen(), number) for number in tries[:2]]
    kitchen += [Case("kitchen, from the air", AIR, in_kitchen(), number) for number in tries[:2]]
    return [each for each in heights + kitchen if only is None or each.table.startswith(only)]


async def measure(
    seeds: int, scenes: int, tries: Sequence[int], online_scenes: int, folder: Path, only: str | None
) -> dict[str, Any]:
    figures: dict[str, Any] = {"heights": [], "kitchen": [], "kitchen, from the air": [], "varied": []}
    for case in cases_of(tries, only):
        total: dict[str, Tally] = {}
        each_seed: dict[str, list[float]] = {}
        title = f"{case.table}: {case.tries} tries, {case.off_m * 100:g} cm off"
        for seed in track(range(seeds), title, console=console()):
            url = f"sqlite:///{folder}/{case.table.replace(', ', '_')}_{case.tries}_{seed}_{case.off_m}.db"
            for name, tally in (await compared(url, *case[1:4], seed, scenes, case.off_m)).items():
                total[name] = total.get(name, Tally()) + tally
                each_seed.setdefault(name, []).append(round(tally.success_rate, 3))
        for name, tally in total.items():
            interval = [round(each, 3) for each in tally.interval]
            line = {"by": name, "tries": case.tries, "off_m": case.off_m, "first_try": round(tally.success_rate, 3)}
            figures[case.table].append({**line, "interval": interval, "seeds": each_seed[name]})
    for recall in (False, True) if only in (None, "varied") else ():
        for seed in track(range(seeds), "varied scenes", console=console()):
            parts, ways = await online(folder, seed, online_scenes, recall=recall)
            by = "recalled" if recall else "default policy"
            figures["varied"].append({"by": by, "seed": seed, "first_try": parts, "ways": ways})
    return figures


def show(figures: dict[str, Any]) -> None:
    for name in ("heights", "kitchen", "kitchen, from the air"):
        table = Table("tries", "base off", "chosen by", "first try", "95 %", "seeds", title=name)
        for each in figures[name]:
            low, high = each["interval"]
            spread = " ".join(f"{share:.0%}" for share in each["seeds"])
            off = f"{each['off_m'] * 100:g} cm"
            table.add_row(
                str(each["tries"]), off, each["by"], f"{each['first_try']:.1%}", f"{low:.0%}-{high:.0%}", spread
            )
        console().print(table)
    curve = Table("chosen by", "seed", f"first try, each {PART} scenes", "ways at the end", title="varied scenes")
    for each in figures["varied"]:
        shares = " ".join(f"{share:.0%}" for share in each["first_try"])
        curve.add_row(each["by"], str(each["seed"]), shares, str(each["ways"]))
    console().print(curve)


def main() -> None:
    parser = options(__doc__, quick="one seed, a few scenes")
    parser.add_argument("--only", choices=("heights", "kitchen", "varied"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="first_tries_") as folder:
        seeds, scenes, varied = (1, 20, PART) if arguments.quick else (3, 150, 5 * PART)
        tries = (200,) if arguments.quick else (200, 500, 2_000)
        figures = asyncio.run(measure(seeds, scenes, tries, varied, Path(folder), arguments.only))
    show(figures)
    print(json.dumps({"bench": "first_tries", **figures}))


if __name__ == "__main__":
    main()
