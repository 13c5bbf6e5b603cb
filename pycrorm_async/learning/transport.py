"""Transport objects in ways that experience prefers: where to stand, which arm and grasp, how high the torso.

>>> ways = TransportPolicy(model)
>>> await Retry(TransportAction(milk, [Arms.LEFT, Arms.RIGHT], [place], policy=ways), max_tries=5).perform()

Placing is picking up in reverse: the arm brings the hand to the same pose in the object's frame. So one policy or
model, learned from pick-ups, ranks both. The way to pick up is chosen with its end in mind: a way counts as much less
as the best way to place with its arm and grasp is less likely.

What experience prefers is checked before it is tried, as `CostmapLocation` checks its places: a way whose goals the arm
does not reach, or where collisions count reaches only in collision, is left out. What the check cannot foresee, such as
errors of base and perception, only experience does.

The ways are all combinations of arm, grasp, a place of the base on a grid within reach, and a few heights of the torso.
Drawn at random, as many ways miss most of the tasks that have few solutions, such as those at high tables.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, AsyncIterator, Iterator, Sequence
from contextlib import aclosing, suppress
from dataclasses import dataclass
from functools import cache
from itertools import compress, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import ImpossibleCondition
from pycrorm_async.learning import move_and_pick_up
from pycrorm_async.learning.features import PickUpContext, features_of
from pycrorm_async.learning.policy import Evidence, Floats, PickUpChoice, Policy, Region
from pycrorm_async.learning.policy_file import AnyPolicy
from pycrorm_async.learning.success_model import SuccessModel
from pycrorm_async.plan import failures, geometry, locations, objects
from pycrorm_async.plan.actions import MoveAndPickUpPerformable
from pycrorm_async.plan.execution import Refusal
from pycrorm_async.plan.motions import chosen_limits, collisions_count
from pycrorm_async.world.bullet import Object
from pycrorm_async.world.kinematics import chain_of, within_reach
from pycrorm_async.world.pose import Arms, Grasp, Pose, dot
from pycrorm_async.world.queries import OccupancyCostmap
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS

CELL_M = 0.06
"""The distance in m of two places that are searched; each search shifts its places at random."""
TORSOS = 5
"""The heights of the torso that are searched, its limits included: the highest tables need the highest torso."""
RATED_AT_ONCE = 256
"""The ways that a model rates before other tasks run again: 300 trees take about 15 ms."""
FETCHING_SEARCHES, PLACING_SEARCHES = 2, 4
"""The searches that follow one another until a way is possible."""
_TURN_RAD = math.pi / 2
"""The greatest angle between the goal and the robot's heading in all searches for placing but the first."""


class TransportPolicy:
    """The ways to fetch and to place objects that experience prefers, for `TransportAction(…, policy=)`.

    Args:
        policy: a success model or a learned policy; None prefers nothing: the first possible way, in random order.
        recall: fetch first in the ways that succeeded before, by the open memory (`RecalledPickUp`).
        checked: leave out ways that kinematics, or where collisions count a collision, forbids. Without it the
            experience alone decides.
        rng: random generator of the order and the shift of the places; None means a new one with an unpredictable seed.
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

        After a failure, ways like the failed one count less. Once the object has moved, the ways start from its new
        pose.
        """
        obj, tried, has_moved = objects.in_world(target), list[PickUpChoice](), True
        while has_moved:
            has_moved, pose = False, obj.pose
            async with aclosing(self._fetching_from_here(target, arms, goal, tried)) as ways:
                async for way in ways:
                    yield way
                    if has_moved := obj.pose != pose:
                        break

    async def _fetching_from_here(
        self, target: objects.ObjectLike, arms: Sequence[Arms], goal: Pose, tried: list[PickUpChoice]
    ) -> AsyncGenerator[MoveAndPickUpPerformable, None]:
        """Yield the ways for the object's present pose, and add them to those that were tried."""
        places = self.places(target, goal)

        @cache
        def takes(arm: Arms, grasp: Grasp) -> bool:
            return self.takes(target, arm, grasp)

        if self._recalls:
            async for recalled in move_and_pick_up.RecalledPickUp(target, arms).recalled():
                hold = recalled.arm, recalled.grasp
                if takes(*hold) and self.reaches(recalled) and await places.chance(*hold):
                    yield recalled
        action = move_and_pick_up.MoveAndPickUp(target, arms, policy=self.policy, rng=self._rng)
        action.keep_policy()
        obj = objects.in_world(target)
        robot = objects.require_robot()
        region, context = move_and_pick_up.free_and_visible(robot, obj), action.context_for(self.policy)
        holds = [hold for hold in product(arms, Grasp) if takes(*hold)]
        known = 0 if robot.description.approaches_along_fingers else 1  # of others the first depends on the base
        goals = [geometry.pick_up_poses(robot.description, obj.pose, grasp, Pose())[known:] for _, grasp in holds]
        weights: dict[int, float] = {}
        for _ in range(FETCHING_SEARCHES if holds else 0):
            stands = self.stands(obj.pose, region=region)
            await asyncio.sleep(0)
            ways = self.ways(stands, holds, goals, context)
            choices, hold_of = ways.choices, ways.holds
            await asyncio.sleep(0)
            likeness, rated = move_and_pick_up.Likeness(choices), [np.zeros(0)]
            await asyncio.sleep(0)
            for part in self.chances(choices, context):
                rated.append(part)
                await asyncio.sleep(0)
            chances = np.concatenate(rated)
            chances *= np.array([weights.get(each, 1.0) for each in hold_of.tolist()])
            for each in tried:
                chances *= 1 - likeness.to(each) / 2
            while chances.any():
                await asyncio.sleep(0)  # a search may take seconds
                best = int(chances.argmax())
                choice, number = choices[best], int(hold_of[best])
                if not self.reaches(action.chosen(choice), choice.torso):
                    chances[best] = 0.0
                elif number not in weights:  # until then its chance is too high, so that no better one is missed
                    weights[number] = await places.chance(*holds[number])
                    chances[hold_of == number] *= weights[number]
                else:
                    chances[best] = 0.0
                    tried.append(choice)
                    yield action.way(choice)
                    chances *= 1 - likeness.to(choice) / 2

    def reaches(self, way: MoveAndPickUpPerformable, torso: float | None = None) -> bool:
        """Return whether the arm, parked before, reaches all goals of the pick-up with the torso at this height, m."""
        if not self.is_checked:
            return True
        robot, target = objects.require_robot(), objects.in_world(way.object_designator)
        base = locations.face(way.standing_position, target.pose, height_m=way.standing_position.position.z)
        described = robot.one_arm(way.arm)
        tool_link = robot.body.link_pose_at(described.tool_frame, described.park)
        tool = base @ objects.in_link(tool_link, described.tool_in_link).relative_to(robot.body.pose)
        goals = geometry.pick_up_poses(robot.description, target.pose, way.grasp, tool)
        reach = locations.reaching_arms(robot, way.arm, base, lambda _: goals, torso_height=torso, grasps=True)
        return reach.refusal is None

    def takes(self, target: objects.ObjectLike, arm: Arms, grasp: Grasp) -> bool:
        """Return whether the gripper can take the object in this grasp."""
        if not self.is_checked:
            return True
        robot, obj = objects.require_robot(), objects.in_world(target)
        try:
            geometry.check_takable(robot, arm, obj)
            if collisions_count():
                geometry.check_fits(robot, arm, obj, geometry.grasping_pose(obj.pose, grasp))
        except failures.PlanFailure:
            return False
        return True

    # --- placing ----------------------------------------------------------------------------------------------

    def placing(self, held: objects.ObjectLike, arm: Arms, goal: Pose) -> locations.LocationDesignator:
        """Return the places, with heights of the torso, from which the arm places the held object, likeliest first."""
        return PlacingLocation(goal, objects.designator_of(held), arm, self)

    def places(self, target: objects.ObjectLike, goal: Pose) -> Places:
        """Return the places from which the object can be placed at the goal, to be asked for several grasps."""
        return Places(self, objects.in_world(target), goal)

    # --- searching --------------------------------------------------------------------------------------------

    def stands(self, at: Pose, *, turned: bool = False, region: Region | None = None) -> list[Stand]:
        """Return the places within reach of a pose, in random order, at which the base is clear of obstacles.

        The base faces the pose, or is turned from that by a random angle. Without collisions, places may be occupied.
        `region` bounds the places, in the upright frame of the pose.
        """
        robot, clearance, height_m = objects.require_robot(), locations.base_clearance(), locations.base_height_m()
        steps = math.ceil((reach_m := _reach_m(robot)) / CELL_M)
        axis = np.arange(-steps, steps + 1) * CELL_M
        places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + self._rng.uniform(0, CELL_M, 2)
        places = self._rng.permutation(places[np.hypot(*places.T) <= reach_m])
        if region is not None:
            places = places[region.contains(*places.T)]
        turns = self._rng.uniform(-_TURN_RAD, _TURN_RAD, len(places)) * turned
        cos, sin, (x, y, _) = math.cos(at.yaw), math.sin(at.yaw), at.position
        stands = []
        for (ahead, aside), turn in zip(places.tolist(), turns.tolist(), strict=True):
            place = Pose((x + cos * ahead - sin * aside, y + sin * ahead + cos * aside, 0.0))
            stands.append(Stand(ahead, aside, locations.face(place, at, height_m=height_m, turned=turn)))
        return stands if clearance is None else [*compress(stands, clearance.clear([each.base for each in stands]))]

    def ways(
        self,
        stands: Sequence[Stand],
        holds: Sequence[tuple[Arms, Grasp]],
        goals: Sequence[Sequence[Pose]],
        context: PickUpContext,
    ) -> Ways:
        """Return each combination whose arm is neither too far from its goals nor too near; `goals` are by hold.

        The arm and the grasp change first, then the height of the torso.
        """
        robot = objects.require_robot()
        torsos: list[float | None] = [None]
        if context.torso_limits is not None and not isinstance(self.policy, Policy):
            torsos = np.linspace(*context.torso_limits, TORSOS).tolist()
        possible = np.ones((len(stands), len(torsos), len(holds)), dtype=bool)
        for number, ((arm, _), targets) in enumerate(zip(holds, goals, strict=True)):
            if self.is_checked and arm in robot.description.arms:
                bases = [each.base for each in stands]
                possible[..., number] = within_reach(
                    robot.body, arm, targets, bases=bases, torso_heights=torsos, limits=chosen_limits()
                )
        at, torso_of, hold_of = np.nonzero(possible)
        choices = [
            PickUpChoice(*holds[hold], *stands[stand][:2], torso=torsos[torso])
            for stand, torso, hold in zip(at.tolist(), torso_of.tolist(), hold_of.tolist(), strict=True)
        ]
        return Ways(choices, at, hold_of)

    def chances(self, choices: Sequence[PickUpChoice], context: PickUpContext) -> Iterator[Floats]:
        """Yield the chance of each choice: a model's probability, of a policy its density relative to the highest.

        The chances that a model gives come in parts of `RATED_AT_ONCE`. Where there is no preference they are 1, less
        too little to matter but for their order, which is random.
        """
        if isinstance(self.policy, SuccessModel) and self.policy.trees:
            yield from self.policy.parts_of(features_of(choices, context), RATED_AT_ONCE)
            return
        rated = np.asarray(1 - 1e-9 * self._rng.random(len(choices)))
        if choices and not isinstance(self.policy, SuccessModel):
            with suppress(ImpossibleCondition):
                if isinstance(self.policy, Policy):
                    height = context.height - context.torso
                    tolerance = move_and_pick_up.HEIGHT_TOLERANCE_M
                    near = Evidence(height=(height - tolerance, height + tolerance))
                    density = self.policy.condition(near).likelihood(choices)
                else:
                    density = self.policy.likelihood(choices, context)
                if density.any():
                    rated = density / density.max()
        yield rated


class Stand(NamedTuple):
    """A place of the base: x and y in the upright frame of the pose to be reached, m, and the base's pose."""

    x: float
    y: float
    base: Pose


class Ways(NamedTuple):
    """Ways to reach a pose: each choice, the number of its stand and that of its arm and grasp, shape (choices,)."""

    choices: list[PickUpChoice]
    stands: NDArray[np.intp]
    holds: NDArray[np.intp]


class Places:
    """The free places around a goal, searched once for all arms and grasps with which an object may be placed there."""

    def __init__(self, ways: TransportPolicy, target: Object, goal: Pose) -> None:
        self._ways, self._target, self._goal = ways, target, goal
        self._context = move_and_pick_up.context_of(target, at=goal)
        self._searches: list[list[Stand]] = []
        self._chances: dict[tuple[Arms, Grasp], float] = {}

    async def chance(self, arm: Arms, grasp: Grasp) -> float:
        """Return the chance to place the object with this arm and grasp; 0 if no place is found.

        A hold is searched once, which may take seconds; other tasks run meanwhile.
        """
        if (hold := (arm, grasp)) not in self._chances:
            for place, chance in self.of(arm, grasp):
                await asyncio.sleep(0)
                if isinstance(place, locations.Location):
                    self._chances[hold] = chance
                    break
        return self._chances.setdefault(hold, 0.0)

    def of(self, arm: Arms, grasp: Grasp) -> Iterator[tuple[locations.Location | Refusal | None, float]]:
        """Yield the places for this arm and grasp, the likeliest of a search first, each with its chance or refusal.

        Yields None after each part of the places that is rated.
        """
        robot = objects.require_robot()
        tool = Pose(orientation=GRASP_ORIENTATIONS[grasp])
        if robot.body.attachments.get(self._target) == robot.one_arm(arm).tool_frame:
            tool = robot.tool_pose(arm).relative_to(self._target.pose)
        goals = self._goal @ tool, geometry.retract(self._goal @ tool)
        for number in range(PLACING_SEARCHES):
            stands = self._search(number)
            choices, stand_of, _ = self._ways.ways(stands, [(arm, grasp)], [goals], self._context)
            rated = [np.zeros(0)]
            for part in self._ways.chances(choices, self._context):
                rated.append(part)
                yield None, 0.0
            chances = np.concatenate(rated)
            for at in np.argsort(-chances, kind="stable").tolist():
                base, torso, chance = stands[stand_of[at]].base, choices[at].torso, chances[at]
                reach = locations.PlaceReach((arm,))
                if self._ways.is_checked:
                    reach = locations.reaching_arms(robot, arm, base, lambda _: goals, torso_height=torso, grasps=False)
                if reach.refusal is not None:
                    yield Refusal(base, reach.refusal), float(chance)
                else:
                    yield locations.Location(base, (arm,), grasp, torso), float(chance)

    def _search(self, number: int) -> list[Stand]:
        """Return the places of this search; where collisions do not count, those 0.32 m clear of obstacles."""
        if len(self._searches) == number:
            stands = self._ways.stands(self._goal, turned=number > 0)
            if not collisions_count():
                ground = Pose((self._goal.position.x, self._goal.position.y, 0.0))
                ignored = objects.require_robot().with_load()
                free = OccupancyCostmap(objects.require_world(), ground, ignore=ignored)
                stands = [each for each in stands if free.value_at(*each.base.position[:2]) > 0]
            self._searches.append(stands)
        return self._searches[number]


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
        for place, _ in self.policy.places(self.held, self.goal).of(self.arm, grasp):
            if place is not None:
                yield place

    def _no_place_failure(self) -> failures.PlanFailure:
        message = f"there is no place to stand and place {self.held.name} at {self.goal}"
        return failures.ReachabilityFailure(message, self.goal)


def held_grasp(robot: objects.CurrentRobot, arm: Arms, held: objects.ObjectLike) -> Grasp:
    """Return the grasp whose orientation is nearest to that of the hand in the held object's axes."""
    hand = robot.tool_pose(arm).relative_to(objects.in_world(held).pose).orientation
    return max(Grasp, key=lambda grasp: abs(dot(hand, GRASP_ORIENTATIONS[grasp])))


def _reach_m(robot: objects.CurrentRobot) -> float:
    """Return the greatest distance along the floor from the base to a point that an arm reaches."""
    reaches = []
    for arm, described in robot.description.arms.items():
        shoulder = robot.body.link_pose(robot.body.model.joints[described.joints[0]].child)
        reaches.append(
            chain_of(robot.body, arm).reach_m + math.hypot(*shoulder.relative_to(robot.body.pose).position[:2])
        )
    return max(reaches)
