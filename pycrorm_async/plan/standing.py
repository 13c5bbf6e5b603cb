"""Where a robot can stand to reach or see something: the best cells of a costmap, each tried by inverse kinematics.

What is tried is what the actions will do (`plan.grasping`), from where the robot would stand, with its torso
and arms as they are now, within the limits of the chosen robot. Nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from pycrorm_async.plan.errors import NoRobotHere
from pycrorm_async.plan.grasping import pick_up_poses, place_pose, retracted
from pycrorm_async.plan.here import RobotHere, world_here
from pycrorm_async.plan.objects import ObjectLike, designator_of, in_world
from pycrorm_async.plan.process_modules import chosen_limits
from pycrorm_async.world.costmaps import Costmap, GaussianCostmap, OccupancyCostmap, VisibilityCostmap
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.kinematics import Unreachable, solve
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, yaw_quaternion

__all__ = ["stands"]

CELLS_MAX = 600
VISIBLE_SHARE_MIN = 0.5


def stands(
    target: Pose | ObjectLike,
    *,
    reachable_for: ObjectLike | None,
    visible_for: ObjectLike | None,
    reachable_arm: Arms | None,
) -> Iterator[tuple[Pose, tuple[Arms, ...] | None]]:
    """Poses of the base that face the target, best first, each with the arms that reach; None if it will not do."""
    reacher = _robot(reachable_for) if reachable_for is not None else None
    seer = _robot(visible_for) if visible_for is not None else None
    goal = target if isinstance(target, Pose) else designator_of(target).pose
    costmap = _costmap(target, goal, [each for each in (reacher, seer) if each is not None], seer)
    for cell in costmap.best(CELLS_MAX):
        x, y, _ = cell.position
        heading = math.atan2(goal.position.y - y, goal.position.x - x)
        stand = Pose((x, y, 0.0), yaw_quaternion(heading))
        if seer is not None and not _sees(seer, stand, target, goal):
            yield stand, None
        elif reacher is not None:
            yield stand, _reaching(reacher, stand, target, goal, reachable_arm)
        else:
            yield stand, ()


def _robot(meant: ObjectLike) -> RobotHere:
    body = in_world(meant)
    if body.robot_description is None:
        raise NoRobotHere(f"{body.name!r} is not a robot of a kind that is known here")
    return RobotHere(body, body.robot_description)


def _costmap(target: Pose | ObjectLike, goal: Pose, robots: list[RobotHere], seer: RobotHere | None) -> Costmap:
    world = world_here()
    origin = Pose((goal.position.x, goal.position.y, 0.0))
    ignored = {part for robot in robots for part in _with_load(robot.body)}
    costmap = OccupancyCostmap(world, origin, ignore=ignored) * GaussianCostmap(origin)
    if seer is None:
        return costmap
    low, high = seer.description.camera_height_m
    seen = goal if isinstance(target, Pose) else in_world(target)
    return costmap * VisibilityCostmap(world, seen, min_height_m=low, max_height_m=high, origin=origin, ignore=ignored)


def _with_load(body: Object) -> set[Object]:
    """The object and all that is attached to it, however deep."""
    return {body, *body.world.attachments.below(body)}


def _reaching(
    robot: RobotHere, stand: Pose, target: Pose | ObjectLike, goal: Pose, wanted: Arms | None
) -> tuple[Arms, ...] | None:
    """The arms that reach all goals from there; None if those that are wanted do not."""
    limits = chosen_limits()
    arms = (Arms.LEFT, Arms.RIGHT) if wanted in (None, Arms.BOTH) else (wanted,)
    reaching = []
    for arm in arms:
        goals = _goals(robot, arm, stand, target, goal)
        try:
            for each in goals:
                solve(robot.body, arm, each, base=stand, limits=limits)
        except Unreachable:
            continue
        reaching.append(arm)
    enough = len(reaching) == 2 if wanted is Arms.BOTH else bool(reaching)
    return tuple(reaching) if enough else None


def _goals(robot: RobotHere, arm: Arms, stand: Pose, target: Pose | ObjectLike, goal: Pose) -> tuple[Pose, ...]:
    body, description = robot
    tool_frame = description.arms[arm].tool_frame
    tool = body.link_pose(tool_frame)
    if not isinstance(target, Pose):
        return pick_up_poses(goal, Grasp.FRONT, stand @ tool.relative_to(body.pose))
    held = next((each for each, link in body.attachments.items() if link == tool_frame), None)
    there = place_pose(goal, held.pose, tool) if held is not None else goal
    return there, retracted(there)


def _sees(robot: RobotHere, stand: Pose, target: Pose | ObjectLike, goal: Pose) -> bool:
    """Whether the camera would have the target in plain view from there."""
    body, description = robot
    eye = (stand @ body.link_pose(description.camera_link).relative_to(body.pose)).position
    if isinstance(target, Pose):
        return world_here().ray_test([eye], [goal.position], ignore=_with_load(body)) == [None]
    return world_here().visible(in_world(target), eye, ignore=_with_load(body)) >= VISIBLE_SHARE_MIN
