"""Where a robot can stand to reach or see something: the best cells of a costmap, each tried by inverse kinematics.

What is tried is what the actions will do (`plan.grasping`), from where the robot would stand, with its torso
and arms as they are now, within the limits of the chosen robot. Nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial

from pycrorm_async.plan.current_robot import CurrentRobot, check_in_map, require_world
from pycrorm_async.plan.errors import NoRobotHere
from pycrorm_async.plan.geometry.grasp_poses import pick_up_poses, place_pose, retract
from pycrorm_async.plan.motions.process_modules import chosen_limits
from pycrorm_async.plan.object_designators import ObjectLike, in_world, pose_of
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.pose import Pose, yaw_quaternion
from pycrorm_async.world.queries.costmaps import Costmap, GaussianCostmap, OccupancyCostmap, VisibilityCostmap
from pycrorm_async.world.robots.kinematics import Unreachable, solve

__all__ = ["face", "reaching_arms", "resolve_robot", "base_poses"]

CELLS_MAX = 600
VISIBLE_SHARE_MIN = 0.5


def base_poses(
    target: Pose | ObjectLike,
    *,
    reachable_for: ObjectLike | None,
    visible_for: ObjectLike | None,
    reachable_arm: Arms | None,
) -> Iterator[tuple[Pose, tuple[Arms, ...] | None]]:
    """Poses of the base that face the target, best first, each with the arms that reach; None if it will not do."""
    reacher = resolve_robot(reachable_for) if reachable_for is not None else None
    seer = resolve_robot(visible_for) if visible_for is not None else None
    goal = target if isinstance(target, Pose) else pose_of(target)
    check_in_map(goal)
    costmap = _costmap(target, goal, [each for each in (reacher, seer) if each is not None], seer)
    for cell in costmap.best(CELLS_MAX):
        stand = face(cell, goal)
        if seer is not None and not _sees(seer, stand, target, goal):
            yield stand, None
        elif reacher is not None:
            yield stand, reaching_arms(reacher, reachable_arm, stand, partial(_goals, reacher, stand, target, goal))
        else:
            yield stand, ()


def resolve_robot(meant: ObjectLike) -> CurrentRobot:
    """The robot that is meant. Raises `NoRobotHere` if it is none, or of a kind that is not known here."""
    body = in_world(meant)
    if body.robot_description is None:
        raise NoRobotHere(f"{body.name!r} is not a robot of a kind that is known here")
    return CurrentRobot(body, body.robot_description)


def face(place: Pose, goal: Pose, *, turned: float = 0.0) -> Pose:
    """On the floor at the place, looking towards the goal, or `turned` (rad) from that to the left."""
    x, y, _ = place.position
    heading = math.atan2(goal.position.y - y, goal.position.x - x) + turned
    return Pose((x, y, 0.0), yaw_quaternion(heading))


def reaching_arms(
    robot: CurrentRobot,
    wanted: Arms | None,
    stand: Pose,
    goals: Callable[[Arms], Iterable[Pose]],
    *,
    torso_height: float | None = None,
) -> tuple[Arms, ...] | None:
    """The arms that reach all their goals when the base is there; None if those that are wanted do not.

    Args:
        wanted: one arm, or BOTH: each of the two; None: any.
        torso_height: m; as it is now, if left out.

    Raises `CapabilityAbsenceFailure` for an arm that the robot lacks.
    """
    limits = chosen_limits()
    arms = tuple(robot.description.arms if wanted is None else robot.each_arm(wanted))
    reaching = []
    for arm in arms:
        try:
            for each in goals(arm):
                solve(robot.body, arm, each, base=stand, torso_height=torso_height, limits=limits)
        except Unreachable:
            continue
        reaching.append(arm)
    enough = reaching == list(arms) if wanted is Arms.BOTH else bool(reaching)
    return tuple(reaching) if enough else None


def _costmap(target: Pose | ObjectLike, goal: Pose, robots: list[CurrentRobot], seer: CurrentRobot | None) -> Costmap:
    world = require_world()
    origin = Pose((goal.position.x, goal.position.y, 0.0))
    ignored = {part for robot in robots for part in robot.with_load()}
    costmap = OccupancyCostmap(world, origin, ignore=ignored) * GaussianCostmap(origin)
    if seer is None:
        return costmap
    low, high = seer.description.camera_height_m
    seen = goal if isinstance(target, Pose) else in_world(target)
    return costmap * VisibilityCostmap(world, seen, min_height_m=low, max_height_m=high, origin=origin, ignore=ignored)


def _goals(robot: CurrentRobot, stand: Pose, target: Pose | ObjectLike, goal: Pose, arm: Arms) -> tuple[Pose, ...]:
    body, description = robot
    tool_frame = description.arms[arm].tool_frame
    tool = body.link_pose(tool_frame)
    if not isinstance(target, Pose):
        return pick_up_poses(goal, Grasp.FRONT, stand @ tool.relative_to(body.pose))
    held = next((each for each, link in body.attachments.items() if link == tool_frame), None)
    there = place_pose(goal, held.pose, tool) if held is not None else goal
    return there, retract(there)


def _sees(robot: CurrentRobot, stand: Pose, target: Pose | ObjectLike, goal: Pose) -> bool:
    """Whether the camera would have the target in plain view from there."""
    body, description = robot
    eye = (stand @ body.link_pose(description.camera_link).relative_to(body.pose)).position
    if isinstance(target, Pose):
        return require_world().ray_test([eye], [goal.position], ignore=robot.with_load()) == [None]
    return require_world().visible(in_world(target), eye, ignore=robot.with_load()) >= VISIBLE_SHARE_MIN
