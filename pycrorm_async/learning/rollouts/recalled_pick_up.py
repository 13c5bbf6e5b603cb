"""Describe a pick-up whose alternatives are the ways that succeeded before, at about this height."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pycrorm_async.errors import CallerError
from pycrorm_async.learning.policies.evidence import Region
from pycrorm_async.learning.policies.policy import ARMS, GRASPS, PickUpChoice, Policy
from pycrorm_async.learning.policies.policy_file import name_of
from pycrorm_async.learning.rollouts.feasible_places import free_and_visible
from pycrorm_async.learning.rollouts.move_and_pick_up import MoveAndPickUp
from pycrorm_async.plan.actions.action_description import ActionDescription
from pycrorm_async.plan.actions.basic import MoveAndPickUpPerformable
from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.experience import Experience, PastSuccess, experience
from pycrorm_async.plan.failures import ObjectUnreachable
from pycrorm_async.plan.geometry.gripper_checks import lifting_arms
from pycrorm_async.plan.locations.base_clearance import BaseClearance, base_clearance
from pycrorm_async.plan.object_designators import ObjectDesignatorDescription, ObjectLike, in_world
from pycrorm_async.world.enums import Arms, Grasp

_EVIDENCE_MIN = 0.5
"""The least evidence for an alternative: that of one success at a height 12 cm away."""


@dataclass
class RecalledPickUpPerformable(MoveAndPickUpPerformable):
    """Drive to a place, face the object from there, and pick it up; the node records why this way was chosen.

    Attributes:
        chosen_by: `recall`, `default policy`, or the name of a learned policy.
        expected_success: the share of successes that recall expects, 0 to 1; None if a policy chose it.
    """

    chosen_by: str = "recall"
    expected_success: float | None = None


class RecalledPickUp(ActionDescription[RecalledPickUpPerformable]):
    """A description whose alternatives for moving to an object and picking it up are those of earlier tries.

    Each alternative is the way with the highest expected success at the object's height over the lifted torso. The
    tries of this process count as soon as they have ended, so that a failure also makes similar ways less likely.
    Leaves out ways that are expected to succeed less often than an average try, and ways without a similar try; after
    the last one the samples of the policy follow, as in `MoveAndPickUp`, and then those of the default policy.

    >>> await Retry(RecalledPickUp(milk, policy=learned), max_tries=20).perform()

    Args:
        target: the object, or a description of it.
        arms, grasps: the allowed ones; None allows all.
        policy: the policy that follows; None means the thesis' default policy alone.
        experience: the source of earlier tries; None means the open memory, or none if no memory is open.
        samples: number of each policy's samples.
        rng: random generator of the policies; None means a new one with an unpredictable seed.

    Raises what `MoveAndPickUp` raises. The robot drives only to free places from which the object is visible.
    """

    def __init__(
        self,
        target: ObjectLike | ObjectDesignatorDescription,
        arms: Iterable[Arms] | None = None,
        grasps: Iterable[Grasp] | None = None,
        policy: Policy | None = None,
        *,
        experience: Experience | None = None,
        samples: int = 20,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(RecalledPickUpPerformable)
        self._arms = ARMS if arms is None else tuple(arms)
        self._grasps = GRASPS if grasps is None else tuple(grasps)
        rng = np.random.default_rng() if rng is None else rng
        self._default = MoveAndPickUp(target, self._arms, self._grasps, samples=samples, rng=rng)
        self._otherwise = [(self._default, "default policy")]
        if policy is not None:
            learned = MoveAndPickUp(self._default.target, self._arms, self._grasps, policy, samples=samples, rng=rng)
            self._otherwise.insert(0, (learned, name_of(policy)))
        self._experience = experience
        self.target = self._default.target

    def __repr__(self) -> str:
        return f"RecalledPickUp({self.target.name!r}, otherwise={self._otherwise[0][1]})"

    async def resolve(self) -> RecalledPickUpPerformable:  # type: ignore[override]  # a memory is asked
        """Return the first alternative. Raises `ObjectUnreachable` if there is none."""
        async for each in self:
            return each
        raise ObjectUnreachable(f"there is no way to pick up {self.target.name} here", self.target.name)

    def __iter__(self) -> Iterator[RecalledPickUpPerformable]:
        """Raise `CallerError`, because the memory is queried between two alternatives."""
        raise CallerError("a recalled pick-up asks the memory: iterate with `async for`, or `await …resolve()`")

    async def __aiter__(self) -> AsyncIterator[RecalledPickUpPerformable]:
        """Yield the way with the highest expected success that was not yielded yet, then the policy's samples."""
        source = self._experience if self._experience is not None else experience.get()
        if source is not None:
            region, clearance = free_and_visible(require_robot(), in_world(self.target)), base_clearance()
            tried: set[PickUpChoice] = set()
            while (best := await self._best(source, region, clearance, tried)) is not None:
                choice, way = best
                tried.add(choice)
                yield self._performable_of(choice, "recall", expected=way.score)
        for description, chosen_by in self._otherwise:
            try:
                choices = [*description.choices()]
            except ObjectUnreachable:
                if description is self._default:
                    raise
                continue  # a learned policy may know no way at this height
            for each in choices:
                yield self._performable_of(each, chosen_by, policy=description.policy_name)

    async def _best(
        self, source: Experience, region: Region, clearance: BaseClearance | None, tried: set[PickUpChoice]
    ) -> tuple[PickUpChoice, PastSuccess] | None:
        """Return the best way that is left and possible here."""
        robot = require_robot()
        torso = robot.body.joint_position(robot.torso_joint()) if robot.description.torso_joint is not None else None
        over_base = self.target.pose.position.z - robot.body.pose.position.z
        arms = lifting_arms(robot, self._arms, self.target)
        arm = arms[0] if len(arms) == 1 else None
        ways = await source.successes(self.target.object_type, arm=arm, height=over_base, torso=torso)
        places = np.array([each.stand.position[:2] for each in ways]).reshape(-1, 2)
        for way, is_free in zip(ways, region.contains(*places.T), strict=True):
            choice = PickUpChoice(way.arm, way.grasp, *way.stand.position[:2])
            if (
                is_free
                and choice not in tried
                and way.arm in arms
                and way.grasp in self._grasps
                and way.score >= way.prior
                and way.evidence >= _EVIDENCE_MIN
                and (clearance is None or self._default.is_clear(choice, clearance))
            ):
                return choice, way
        return None

    def _performable_of(
        self, choice: PickUpChoice, chosen_by: str, *, expected: float | None = None, policy: str | None = None
    ) -> RecalledPickUpPerformable:
        move = self._default.chosen(choice)
        return RecalledPickUpPerformable(
            move.standing_position, move.object_designator, move.arm, move.grasp, chosen_by, expected, policy=policy
        )
