"""Transport objects in ways that experience prefers: where to stand, which arm and grasp, how high the torso.

>>> ways = TransportPolicy(model)
>>> await Retry(TransportAction(milk, [Arms.LEFT, Arms.RIGHT], [place], policy=ways), max_tries=5).perform()

Placing is picking up in reverse: the arm brings the hand to the same pose in the object's frame. So one policy or
model, learned from pick-ups, ranks both. The way to pick up is chosen with its end in mind: a way counts as much less
as the best way to place with its arm and grasp is less likely.

What experience prefers is checked before it is tried, as `CostmapLocation` checks its places: a way whose goals the arm
does not reach, or where collisions count reaches only in collision, is left out. What the check cannot foresee, such as
errors of base and perception, only experience does.
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import islice

import numpy as np

from pycrorm_async.errors import ImpossibleCondition
from pycrorm_async.learning.features import PickUpContext
from pycrorm_async.learning.move_and_pick_up import PROPOSALS, MoveAndPickUp, RecalledPickUp, context_of
from pycrorm_async.learning.policy import Evidence, Floats, PickUpChoice, Policy, default_policy
from pycrorm_async.learning.policy_file import AnyPolicy
from pycrorm_async.learning.success_model import SuccessModel
from pycrorm_async.plan import failures, geometry, locations, objects
from pycrorm_async.plan.actions import MoveAndPickUpPerformable
from pycrorm_async.plan.execution import Refusal
from pycrorm_async.plan.motions import collisions_count
from pycrorm_async.world.pose import Arms, Grasp, Pose, dot
from pycrorm_async.world.queries import OccupancyCostmap
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS

CHECKED_MAX = 200
"""Bounds the places that are checked to find out whether an arm and a grasp can place an object at all."""
_ALIKE_M = 0.1
"""The distance in m, of the base and of the torso, at which two ways with the same arm and grasp are half alike."""


class TransportPolicy:
    """The ways to fetch and to place objects that experience prefers, for `TransportAction(…, policy=)`.

    Args:
        policy: a success model or a learned policy; None prefers nothing: random places and heights of the torso.
        recall: fetch first in the ways that succeeded before, by the open memory, then in those of the policy
            (`RecalledPickUp`).
        checked: leave out ways that kinematics, or where collisions count a collision, forbids. Without it the
            experience alone decides.
        rng: random generator of the proposals; None means a new one with an unpredictable seed.
    """

    def __init__(
        self,
        policy: AnyPolicy | None = None,
        *,
        recall: bool = False,
        checked: bool = True,
        rng: np.random.Generator | None = None,
    ) -> None:
        self.policy = SuccessModel.untrained() if policy is None else policy
        self.is_checked = checked
        self._recalls = recall
        self._rng = np.random.default_rng() if rng is None else rng

    # --- fetching ---------------------------------------------------------------------------------------------

    async def fetching(
        self, target: objects.ObjectLike, arms: Sequence[Arms], goal: Pose
    ) -> AsyncIterator[MoveAndPickUpPerformable]:
        """Iterate over ways to pick up the object so that it can be placed at the goal, the likeliest first.

        After a failure, ways like the failed one count less. Raises `ObjectUnreachable` if there is no free place.
        """

        @cache
        def placeable(arm: Arms, grasp: Grasp) -> float:
            return self.placing_chance(target, arm, grasp, goal)

        if self._recalls:
            otherwise = self.policy if self.policy != SuccessModel.untrained() else None
            async for way in RecalledPickUp(target, arms, policy=otherwise, samples=PROPOSALS, rng=self._rng):
                if placeable(way.arm, way.grasp) and self.reaches(way):
                    yield way
            return
        action = MoveAndPickUp(target, arms, policy=self.policy, rng=self._rng)
        action.keep_policy()
        choices, chances = action.rated(PROPOSALS)
        clearance = locations.base_clearance()
        weighed: set[tuple[Arms, Grasp]] = set()
        while chances.any():
            best = int(chances.argmax())
            choice = choices[best]
            hold = choice.arm, choice.grasp
            if hold not in weighed:  # until then its chance is too high, so that no better one is missed
                weighed.add(hold)
                chances = chances * np.where([each[:2] == hold for each in choices], placeable(*hold), 1.0)
                continue
            chances[best] = 0.0
            if clearance is not None and not action.is_clear(choice, clearance):
                continue
            if self.reaches(way := action.way(choice)):
                yield way
                chances *= 1 - _alike(choice, choices) / 2

    def reaches(self, way: MoveAndPickUpPerformable) -> bool:
        """Return whether the arm, parked before, reaches all goals of the pick-up."""
        if not self.is_checked:
            return True
        robot, target = objects.require_robot(), objects.in_world(way.object_designator)
        base = locations.face(way.standing_position, target.pose, height_m=way.standing_position.position.z)
        described = robot.one_arm(way.arm)
        tool_link = robot.body.link_pose_at(described.tool_frame, described.park)
        tool = base @ objects.in_link(tool_link, described.tool_in_link).relative_to(robot.body.pose)
        goals = geometry.pick_up_poses(target.pose, way.grasp, tool)
        try:
            geometry.check_takable(robot, way.arm, target)
            if collisions_count():
                geometry.check_fits(robot, way.arm, target, goals.at.orientation)
        except failures.PlanFailure:
            return False
        torso = getattr(way, "torso", None)
        reach = locations.reaching_arms(robot, way.arm, base, lambda _: goals, torso_height=torso, grasps=True)
        return reach.refusal is None

    # --- placing ----------------------------------------------------------------------------------------------

    def placing(self, held: objects.ObjectLike, arm: Arms, goal: Pose) -> locations.LocationDesignator:
        """Return the places, with heights of the torso, from which the arm places the held object, likeliest first."""
        return PlacingLocation(goal, objects.designator_of(held), arm, self)

    def placing_chance(self, target: objects.ObjectLike, arm: Arms, grasp: Grasp, goal: Pose) -> float:
        """Return the chance to place the object at the goal with this arm and grasp; 0 if no place is found."""
        for place, chance in islice(self.placing_places(target, arm, grasp, goal), CHECKED_MAX):
            if isinstance(place, locations.Location):
                return chance
        return 0.0

    def placing_places(
        self, target: objects.ObjectLike, arm: Arms, grasp: Grasp, goal: Pose
    ) -> Iterator[tuple[locations.Location | Refusal, float]]:
        """Yield places around the goal that are free, the likeliest first, each with its chance or its refusal."""
        robot, obj = objects.require_robot(), objects.in_world(target)
        context, tool = context_of(obj, at=goal), Pose(orientation=GRASP_ORIENTATIONS[grasp])
        if robot.body.attachments.get(obj) == robot.one_arm(arm).tool_frame:
            tool = robot.tool_pose(arm).relative_to(obj.pose)
        goals = goal @ tool, geometry.retract(goal @ tool)
        choices = self._proposals(robot, arm, grasp, goal, context)
        chances = self._chances(choices, context)
        clearance, height_m = locations.base_clearance(), locations.base_height_m()
        for number in np.argsort(-chances, kind="stable").tolist():
            choice, chance = choices[number], float(chances[number])
            base = locations.face(_place(goal, choice), goal, height_m=height_m)
            refusal = clearance.refusal(base) if clearance is not None else None
            if refusal is None and self.is_checked:
                refusal = locations.reaching_arms(
                    robot, arm, base, lambda _: goals, torso_height=choice.torso, grasps=False
                ).refusal
            if refusal is not None:
                yield Refusal(base, refusal), chance
            else:
                yield locations.Location(base, (arm,), grasp, choice.torso), chance

    def _proposals(
        self, robot: objects.CurrentRobot, arm: Arms, grasp: Grasp, goal: Pose, context: PickUpContext
    ) -> Sequence[PickUpChoice]:
        """Return choices of the default policy around the goal, at free places, each with a height of the torso."""
        ground = Pose((goal.position.x, goal.position.y, 0.0))
        clearance = locations.base_clearance()
        free = (
            clearance.costmap(ground)
            if clearance is not None
            else OccupancyCostmap(objects.require_world(), ground, ignore=robot.with_load())
        )
        evidence = Evidence(frozenset({arm}), frozenset({grasp}))
        drawn = default_policy().condition(evidence).sample(self._rng, 2 * PROPOSALS)
        choices = [each for each in drawn if free.value_at(*_place(goal, each).position[:2]) > 0][:PROPOSALS]
        return MoveAndPickUp.lifted(choices, self._rng, context)

    def _chances(self, choices: Sequence[PickUpChoice], context: PickUpContext) -> Floats:
        """Return the chance of each choice: a model's probability, of a policy its density relative to the highest."""
        rated = np.ones(len(choices))
        if isinstance(self.policy, SuccessModel):
            return self.policy.probability(choices, context)
        if choices:
            with suppress(ImpossibleCondition):
                density = (
                    self.policy.likelihood(choices) if isinstance(self.policy, Policy)
                    else self.policy.likelihood(choices, context)
                )  # fmt: skip
                if density.any():
                    rated = density / density.max()
        return rated


@dataclass(frozen=True)
class PlacingLocation(locations.LocationDesignator):
    """Places from which an arm places the object that it holds at the goal, in the order of a `TransportPolicy`.

    Resolving raises `ReachabilityFailure` if there is none.
    """

    goal: Pose
    held: objects.ObjectDesignator
    arm: Arms
    policy: TransportPolicy

    def _candidates(self) -> Iterator[locations.Location | Refusal]:
        grasp = held_grasp(objects.require_robot(), self.arm, self.held)
        for place, _ in self.policy.placing_places(self.held, self.arm, grasp, self.goal):
            yield place

    def _no_place_failure(self) -> failures.PlanFailure:
        message = f"there is no place to stand and place {self.held.name} at {self.goal}"
        return failures.ReachabilityFailure(message, self.goal)


def held_grasp(robot: objects.CurrentRobot, arm: Arms, held: objects.ObjectLike) -> Grasp:
    """Return the grasp whose orientation is nearest to that of the hand in the held object's axes."""
    hand = robot.tool_pose(arm).relative_to(objects.in_world(held).pose).orientation
    return max(Grasp, key=lambda grasp: abs(dot(hand, GRASP_ORIENTATIONS[grasp])))


def _place(goal: Pose, choice: PickUpChoice) -> Pose:
    """Return the point of the floor that has these x and y in an upright frame with the goal's heading."""
    x, y = choice.relative_x, choice.relative_y
    cos, sin = math.cos(goal.yaw), math.sin(goal.yaw)
    return Pose((goal.position.x + cos * x - sin * y, goal.position.y + sin * x + cos * y, 0.0))


def _alike(one: PickUpChoice, choices: Sequence[PickUpChoice]) -> Floats:
    """Return how alike each choice is to one: 1 to 0, a half at a distance of `_ALIKE_M`; 0 for another grasp."""
    same = np.array([each[:2] == one[:2] for each in choices])
    at = np.array([(*each[2:4], each.torso or 0.0) for each in choices])
    return np.asarray(same * 0.5 ** (((at - at[choices.index(one)]) ** 2).sum(axis=1) / _ALIKE_M**2))
