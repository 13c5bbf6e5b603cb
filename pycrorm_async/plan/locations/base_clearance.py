"""Check whether a robot's base, with its heading, is clear of obstacles at a pose."""

from __future__ import annotations

from collections.abc import Collection

from pycrorm_async.plan.current_robot import CurrentRobot, require_robot, require_world
from pycrorm_async.plan.motions.robot_choice import collisions_count
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.queries.costmaps import Costmap
from pycrorm_async.world.queries.footprints import Obstacles, footprint_of


class BaseClearance:
    """The footprints of one or more robots, and the obstacles around them as they are now."""

    def __init__(self, robots: Collection[CurrentRobot]) -> None:
        self._footprints = [footprint_of(each.body, each.base_links()) for each in robots]
        self._obstacles = Obstacles(require_world(), ignore={part for each in robots for part in each.with_load()})

    def refusal(self, base: Pose) -> str | None:
        """Return the reason why a base cannot be at this pose; None if it is clear of obstacles there."""
        for footprint in self._footprints:
            if (obstacle := self._obstacles.overlapping(footprint, base)) is not None:
                return "base in collision with {} ({})".format(*obstacle)
        return None

    def costmap(self, origin: Pose, *, size_cells: int = 200, resolution_m: float = 0.02) -> Costmap:
        """Return the places that a base may have with some heading: 1 where nothing is within its inner radius."""
        distance_m = max(each.inner_radius_m for each in self._footprints)
        return self._obstacles.costmap(origin, distance_m=distance_m, size_cells=size_cells, resolution_m=resolution_m)


def base_clearance(robots: Collection[CurrentRobot] = ()) -> BaseClearance | None:
    """Return the clearance of these robots, of the current one without any; None where collisions do not count.

    Raises `NoRobotHere` if collisions count and there is no robot.
    """
    return BaseClearance(robots or (require_robot(),)) if collisions_count() else None
