"""Compare the engines of a world side by side: loading, moving, collisions, rays, copies, pictures and rollouts.

    python -m bench.world              nine rounds
    python -m bench.world --quick      two short rounds

Each round asks every installed engine every question, in turn and in one process. The script prints one JSON line: for
each question the least CPU time of the thread over all rounds, in µs by engine, and MuJoCo's as a multiple of Bullet's.
The scene is the PR2 in its kitchen with ten objects; the rollouts are the thesis', in the air and in the kitchen.
"""

import asyncio
import itertools
import json
import os
import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.rollouts import batch_rollout
from pycrorm_async.learning.scenes import Scene
from pycrorm_async.world import PR2, Arms, BulletWorld, Object, ObjectType, Pose, copied
from pycrorm_async.world.engines import ENGINES, VARIABLE, engine_class
from pycrorm_async.world.pose import EngineMissing
from pycrorm_async.world.queries import Camera, collisions_at, photograph

QUICK = "--quick" in sys.argv
ROUNDS = 2 if QUICK else 9
SHARE = 0.1 if QUICK else 1.0
TOOL = PR2.arms[Arms.LEFT].tool_frame
SCENES = {"rollout, in the air": Scene(), "rollout, in the kitchen": Scene(kitchen=True, collisions=True)}

Questions = Iterator[tuple[str, int, Callable[[], object]]]
"""The name of a question, how often it is asked in a round, and the question."""


def questions(world: BulletWorld) -> Questions:
    """Yield the questions to a world, the ones after the others, because some move the robot."""
    rng = random.Random(1)
    robot, milk = world.object("pr2"), world.object("milk 3")
    arm = PR2.arms[Arms.LEFT].joints
    postures = itertools.cycle([{joint: rng.uniform(-0.3, 0.0) for joint in arm} for _ in range(50)])
    links = [link for link in robot.links if link.startswith("l_")]
    eye, points = (0.0, 0.0, 1.2), [(2.0, rng.uniform(-1, 1), rng.uniform(0, 1.5)) for _ in range(1_000)]
    eyes = [(rng.uniform(-0.5, 0.5), 0.0, 1.0) for _ in points]
    camera = Camera(milk.pose.position, 3.0, 200)

    def turned() -> None:
        robot.set_joint_positions(next(postures))
        robot.link_pose(TOOL)

    def added() -> None:
        bowl = Object("bowl", ObjectType.BOWL)
        robot.link_pose(TOOL)
        world.remove(bowl)

    def copy() -> None:
        with copied(world) as other:
            other.object("pr2").link_pose(TOOL)

    yield "7 joints and a link's pose", 300, turned
    yield "an arm against everything", 50, lambda: collisions_at(robot, next(postures), links=links)
    yield "1,000 rays from one eye", 3, lambda: world.ray_test([eye] * len(points), points)
    yield "1,000 rays from many", 3, lambda: world.ray_test(eyes, points)
    yield "how much of an object is visible", 30, lambda: world.visible(milk, eye)
    yield "an object added, a pose, removed", 3, added
    yield "copy and a pose", 1, copy
    yield "picture, 80 x 60", 3, lambda: photograph(world, camera, 80, 60, smooth=False)


def fill(world: BulletWorld) -> None:
    Object("pr2", ObjectType.ROBOT, pose=Pose([0.6, 0.5, 0]))
    Object("kitchen", ObjectType.ENVIRONMENT)
    for n in range(10):
        Object(f"milk {n}", ObjectType.MILK, pose=Pose([1.3, 0.1 * n, 0.9]))
    world.object("pr2").link_pose(TOOL)


def opened(engine: str) -> None:
    with BulletWorld(engine=engine, set_up=fill):
        pass


def seconds(question: Callable[[], object], times: int) -> float:
    began = time.thread_time()
    for _ in range(times):
        question()
    return (time.thread_time() - began) / times


async def rollouts(scene: Scene, count: int) -> float:
    with scene.entered() as stage:
        action = MoveAndPickUp(stage.target)
        await batch_rollout(action, 5, seed=1, reset=stage.reset, report_progress=lambda _: None)
        began = time.thread_time()
        await batch_rollout(action, count, seed=69, reset=stage.reset, report_progress=lambda _: None)
        return (time.thread_time() - began) / count


def main() -> None:
    engines = {}
    for name in ENGINES:
        with suppress(EngineMissing):
            engines[name] = engine_class(name).title()
    least: dict[str, dict[str, float]] = {}

    def note(question: str, engine: str, duration: float) -> None:
        of_question = least.setdefault(question, {})
        of_question[engine] = min(duration, of_question.get(engine, duration))

    for _ in range(ROUNDS):
        for engine in engines:
            note("open and load", engine, seconds(lambda engine=engine: opened(engine), 1))  # type: ignore[misc]
            with BulletWorld(engine=engine, set_up=fill) as world:
                for question, times, ask in questions(world):
                    note(question, engine, seconds(ask, max(1, round(times * SHARE))))
            os.environ[VARIABLE] = engine
            for question, scene in SCENES.items():
                note(question, engine, asyncio.run(rollouts(scene, round(50 * SHARE))))
    figures = {
        question: {engine: round(duration * 1e6, 1) for engine, duration in each.items()}
        | ({"mujoco / bullet": round(each["mujoco"] / each["bullet"], 2)} if len(each) == len(ENGINES) else {})
        for question, each in least.items()
    }
    print(json.dumps({"bench": "world", "engines": engines, "us": figures}))


if __name__ == "__main__":
    main()
