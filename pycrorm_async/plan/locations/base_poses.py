"""Search base poses from which a robot reaches or sees a target: the best cells of a costmap, checked by kinematics.

Each check uses the goals that the actions will use (`geometry.grasp_poses`), with the robot's torso and arms as they
are now, within the limits of the chosen robot. Nothing is moved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np

from pycrorm_async.plan.current_robot import CurrentRobot, check_in_map, require_world
from pycrorm_async.plan.errors import NoRobotHere
from pycrorm_async.plan.execution.observer import Cells
from pycrorm_async.plan.geometry.grasp_poses import pick_up_poses, place_pose, retract
from pycrorm_async.plan.geometry.gripper_checks import lifting_arms
from pycrorm_async.plan.locations.base_clearance import BaseClearance, base_clearance
from pycrorm_async.plan.motions.robot_choice import chosen_limits
from pycrorm_async.plan.object_designators import ObjectLike, in_world, pose_of
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.pose import Pose, yaw_quaternion
from pycrorm_async.world.queries.costmaps import Costmap, GaussianCostmap, OccupancyCostmap, VisibilityCostmap
from pycrorm_async.world.robots.acting_robot import acting_robot
from pycrorm_async.world.robots.kinematics import Unreachable, solve
from pycrorm_async.world.robots.robot_description import Drive, PR2Description

CELLS_MAX = 600
"""Bounds the cells per search at which kinematics is checked, so that a search without a solution ends."""
VISIBLE_SHARE_MIN = 0.5
"""Minimum visible share of an object that counts as seen from a place."""


class Reach(NamedTuple):
    """The arms that reach the target from a place; or, for an unsuitable place, none and the reason."""

    arms: tuple[Arms, ...] = ()
    refusal: str | None = None


def base_poses(
    target: Pose | ObjectLike,
    *,
    reachable_for: ObjectLike | None,
    visible_for: ObjectLike | None,
    reachable_arm: Arms | None,
) -> Iterator[tuple[Pose, Reach] | Cells]:
    """Yield the cells of the costmaps, then base poses that face the target, best first, suitable or not.

    For a fixed base yield only its own pose.
    """
    reacher = resolve_robot(reachable_for) if reachable_for is not None else None
    viewer = resolve_robot(visible_for) if visible_for is not None else None
    goal = target if isinstance(target, Pose) else pose_of(target)
    check_in_map(goal)
    arms = _arms(reacher, reachable_arm, target) if reacher is not None else reachable_arm
    if reacher is not None and reacher.description.drive is Drive.FIXED:
        yield _checked(reacher.body.pose, target, goal, reacher, viewer, arms)
        return
    robots = [each for each in (reacher, viewer) if each is not None]
    clearance = base_clearance(robots)
    costmap, cells = _costmap(target, goal, robots, viewer, clearance)
    yield cells
    clear, height_m = 0, base_height_m(reacher or viewer)
    for cell in _cells(costmap, robots, every=clearance is not None):
        base_pose = face(cell, goal, height_m=height_m)
        if clearance is not None and (collision := clearance.refusal(base_pose)) is not None:
            yield base_pose, Reach(refusal=collision)
            continue
        if (clear := clear + 1) > CELLS_MAX:
            return
        yield _checked(base_pose, target, goal, reacher, viewer, arms)


def _arms(robot: CurrentRobot, arm: Arms | None, target: Pose | ObjectLike) -> Arms | tuple[Arms, ...]:
    """Return the required arm; without one those that lift the target, or reach it if it is a pose."""
    if arm is not None:
        return arm
    candidates = tuple(robot.description.arms)
    return candidates if isinstance(target, Pose) else lifting_arms(robot, candidates, target)


def _cells(costmap: Costmap, robots: list[CurrentRobot], *, every: bool) -> Iterator[Pose]:
    """Yield the middles of the cells to search: the best ones, or with `every` all of them.

    The best cells are as near to the target as is usual for a PR2. For other robots, whose arms reach from other
    distances, the cells are spread over the whole map, best first.
    """
    if all(isinstance(robot.description, PR2Description) for robot in robots):
        return islice(costmap.ranked(), None if every else CELLS_MAX)
    return costmap.ranked(every=max(1, int(np.count_nonzero(costmap.map)) // CELLS_MAX))


def _checked(
    base_pose: Pose,
    target: Pose | ObjectLike,
    goal: Pose,
    reacher: CurrentRobot | None,
    viewer: CurrentRobot | None,
    arms: Arms | tuple[Arms, ...] | None,
) -> tuple[Pose, Reach]:
    """Return the base pose with the arms that reach the target from there, or with the reason why none does."""
    if viewer is not None and not _sees(viewer, base_pose, target, goal):
        return base_pose, Reach(refusal="the target is not visible from here")
    if reacher is None:
        return base_pose, Reach()
    return base_pose, reaching_arms(reacher, arms, base_pose, partial(_goals, reacher, base_pose, target, goal))


def resolve_robot(meant: ObjectLike) -> CurrentRobot:
    """Return the robot that the argument refers to. Raises `NoRobotHere` if it has no robot description."""
    body = in_world(meant)
    if body.robot_description is None:
        raise NoRobotHere(f"{body.name!r} is not a robot with a robot description")
    return CurrentRobot(body, body.robot_description)


def base_height_m(robot: CurrentRobot | None = None) -> float:
    """Return the height of a robot's base link, which driving keeps: of this robot, else of the acting one, else 0."""
    if robot is not None:
        return robot.body.pose.position.z
    world = current_world.get()
    acting = acting_robot(world) if world is not None else None
    return acting.pose.position.z if acting is not None else 0.0


def face(place: Pose, goal: Pose, *, height_m: float, turned: float = 0.0) -> Pose:
    """Return the upright pose at the place that faces the goal, rotated by `turned` (rad) to the left."""
    x, y, _ = place.position
    heading = math.atan2(goal.position.y - y, goal.position.x - x) + turned
    return Pose((x, y, height_m), yaw_quaternion(heading))


def reaching_arms(
    robot: CurrentRobot,
    arm: Arms | tuple[Arms, ...] | None,
    base_pose: Pose,
    goals: Callable[[Arms], Iterable[Pose]],
    *,
    torso_height: float | None = None,
) -> Reach:
    """Return the arms that reach all their goals from this base pose, or a refusal if the required ones do not.

    Args:
        arm: the required arm; BOTH requires both, several any of these, None any.
        torso_height: m; None means the current height.

    Raises `CapabilityAbsenceFailure` for an arm that the robot lacks.
    """
    limits = chosen_limits()
    if isinstance(arm, tuple):
        candidates = arm
    else:
        candidates = tuple(robot.description.arms if arm is None else robot.each_arm(arm))
    reaching: list[Arms] = []
    refusals: list[str] = []
    for candidate in candidates:
        try:
            for each in goals(candidate):
                solve(robot.body, candidate, each, base=base_pose, torso_height=torso_height, limits=limits)
        except Unreachable as unreachable:
            refusals.append(f"{candidate.name}: {unreachable.reason}")
        else:
            reaching.append(candidate)
    enough = not refusals if arm is Arms.BOTH else bool(reaching)
    return Reach(tuple(reaching)) if enough else Reach(refusal="; ".join(refusals))


def _costmap(
    target: Pose | ObjectLike,
    goal: Pose,
    robots: list[CurrentRobot],
    viewer: CurrentRobot | None,
    clearance: BaseClearance | None,
) -> tuple[Costmap, Cells]:
    """Return the costmap of the search, and how many cells the maps in it exclude."""
    world = require_world()
    origin = Pose((goal.position.x, goal.position.y, 0.0))
    ignored = {part for robot in robots for part in robot.with_load()}
    free = OccupancyCostmap(world, origin, ignore=ignored) if clearance is None else clearance.costmap(origin)
    costmap = free * GaussianCostmap(origin)
    if viewer is None:
        return costmap, cells_of(free)
    low, high = viewer.camera_heights_m()
    viewed = goal if isinstance(target, Pose) else in_world(target)
    visible = VisibilityCostmap(world, viewed, min_height_m=low, max_height_m=high, origin=origin, ignore=ignored)
    return costmap * visible, cells_of(free, free * visible)


def cells_of(free: Costmap, seeing: Costmap | None = None) -> Cells:
    """Count the cells of a map of free places; `seeing` leaves those from which the target is visible."""
    clear = int(np.count_nonzero(free.map))
    left = clear if seeing is None else int(np.count_nonzero(seeing.map))
    return Cells(free.map.size - clear, clear - left, left)


def _goals(robot: CurrentRobot, base_pose: Pose, target: Pose | ObjectLike, goal: Pose, arm: Arms) -> tuple[Pose, ...]:
    body, description = robot
    tool_frame = description.arms[arm].tool_frame
    tool = robot.tool_pose(arm)
    if not isinstance(target, Pose):
        return pick_up_poses(goal, Grasp.FRONT, base_pose @ tool.relative_to(body.pose))
    held = next((each for each, link in body.attachments.items() if link == tool_frame), None)
    tool_goal = place_pose(goal, held.pose, tool) if held is not None else goal
    return tool_goal, retract(tool_goal)


def _sees(robot: CurrentRobot, base_pose: Pose, target: Pose | ObjectLike, goal: Pose) -> bool:
    """Return whether the target is visible from the camera's position at this base pose."""
    eye = (base_pose @ robot.camera_pose().relative_to(robot.body.pose)).position
    if isinstance(target, Pose):
        return require_world().ray_test([eye], [goal.position], ignore=robot.with_load()) == [None]
    return require_world().visible(in_world(target), eye, ignore=robot.with_load()) >= VISIBLE_SHARE_MIN
