"""Describe move-and-pick-up actions whose arm, grasp and base position are sampled from a policy (thesis 5.2)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from sqlalchemy import Select, select

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning.policies.default_policy import default_policy
from pycrorm_async.learning.policies.evidence import Evidence
from pycrorm_async.learning.policies.policy import ARMS, PickUpChoice, Policy
from pycrorm_async.learning.policies.policy_file import name_of
from pycrorm_async.learning.policies.recorded_policy import keep_policy
from pycrorm_async.learning.rollouts.feasible_places import free_and_visible
from pycrorm_async.orm import PickUpWithContextView
from pycrorm_async.plan.actions.action_description import ActionDescription
from pycrorm_async.plan.actions.basic import MoveAndPickUpPerformable
from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.failures import ObjectUnreachable
from pycrorm_async.plan.geometry.gripper_checks import lifting_arms
from pycrorm_async.plan.locations.base_clearance import BaseClearance, base_clearance
from pycrorm_async.plan.locations.base_poses import base_height_m, face
from pycrorm_async.plan.object_designators import ObjectDesignatorDescription, ObjectLike, designator_of, in_world
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.pose import Pose, rotated

HEIGHT_TOLERANCE_M = 0.05
"""Experience with objects up to this much higher or lower, measured from the torso, applies to the present object."""
_DRAWS_MAX = 10
"""Bounds the draws as a multiple of the samples, because in a scene without free places all samples collide."""
_UPRIGHT_MIN = 0.1
"""Minimum vertical component of the object's own z axis (a cosine); below it the object lies on its side and its x-y
plane no longer maps to the floor."""


class MoveAndPickUp(ActionDescription[MoveAndPickUpPerformable]):
    """A description whose alternatives for moving to an object and picking it up are samples of a policy.

    Iterating draws samples that fit the scene and yields the likeliest first:

    >>> await Retry(MoveAndPickUp(milk, policy=learned), max_tries=20).perform()

    Args:
        target: the object, or a description of it.
        arms, grasps: the allowed ones; None allows all.
        policy: the distribution of base positions, arms and grasps; None means the thesis' default policy.
        samples: number of alternatives.
        rng: random generator; None means a new one with an unpredictable seed.

    Each alternative names the policy as passed, before arms and grasps limit it (`policy_name`). The first alternative
    in an episode records the policy's content, once for each opened memory (`read_policy`).

    Raises `ImpossibleCondition` if the policy gives these arms or grasps no probability, `CallerError` if
    samples < 1.
    """

    def __init__(
        self,
        target: ObjectLike | ObjectDesignatorDescription,
        arms: Iterable[Arms] | None = None,
        grasps: Iterable[Grasp] | None = None,
        policy: Policy | None = None,
        *,
        samples: int = 20,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(MoveAndPickUpPerformable)
        if samples < 1:
            raise CallerError(f"samples must be >= 1, got {samples}")
        self.target = target.resolve() if isinstance(target, ObjectDesignatorDescription) else designator_of(target)
        self.allowed = evidence = Evidence(
            arms=frozenset(arms) if arms is not None else None,
            grasps=frozenset(grasps) if grasps is not None else None,
        )
        self._passed_policy = policy = default_policy() if policy is None else policy
        self.policy_name = name_of(policy)
        self.policy: Policy = policy if evidence == Evidence() else policy.condition(evidence)
        self.samples = samples
        self._rng = np.random.default_rng() if rng is None else rng

    def __repr__(self) -> str:
        return f"MoveAndPickUp({self.target.name!r}, policy={self.policy_name})"

    @staticmethod
    def query_for_database() -> Select[Arms, Grasp, float, float, float | None]:
        """Select the successful pick-ups of all episodes, the input of `learn`.

        A data frame of it has the columns arm, grasp, object_x, object_y (the robot's position in the object's own
        frame, m) and height (of the object over the lifted torso, m). Add a `where` to cut it, by columns of
        `PickUpWithContextView` such as `robot`, `description` and `scene` (of the episode) or `obj_type`.
        """
        view = PickUpWithContextView
        return select(
            view.arm,
            view.grasp,
            view.object_x,
            view.object_y,
            view.height_over_torso.label("height"),
        ).where(view.status == TaskStatus.SUCCEEDED)

    # --- policies for the current scene -----------------------------------------------------------------------

    @property
    def height(self) -> float:
        """Height of the object over the lifted torso at this moment, m. Raises `NoWorld`, `NoRobotHere`."""
        robot = require_robot()
        torso = robot.body.joint_position(robot.torso_joint())
        return self.target.pose.position.z - robot.body.pose.position.z - torso

    def policy_here(self) -> Policy:
        """Condition the policy on the object's height, and its mass if an allowed arm does not lift it.

        Raises `ObjectUnreachable` if that has probability 0.
        """
        return self._condition(Evidence(self._strong_enough(), height=_around(self.height)), "at this height")

    def grounded(self) -> Policy:
        """Condition the policy as `policy_here` does, and on the free places that see the object.

        Raises `ObjectUnreachable` if that has probability 0.
        """
        region = free_and_visible(require_robot(), in_world(self.target))
        return self._condition(
            Evidence(self._strong_enough(), region=region, height=_around(self.height)), "in this scene"
        )

    def _strong_enough(self) -> frozenset[Arms] | None:
        """Return the allowed arms that lift the object; None if that does not rule one out."""
        allowed = ARMS if self.allowed.arms is None else tuple(self.allowed.arms)
        lifting = lifting_arms(require_robot(), allowed, self.target)
        return frozenset(lifting) if len(lifting) < len(allowed) else None

    def _condition(self, evidence: Evidence, where: str) -> Policy:
        try:
            return self.policy.condition(evidence)
        except ImpossibleCondition as impossible:
            message = f"the policy has no way to pick up {self.target.name} {where}: {impossible}"
            raise ObjectUnreachable(message, self.target.name) from impossible

    # --- alternatives -----------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples that fit the scene, the likeliest first. Raises `ObjectUnreachable` if none fits."""
        yield from map(self.chosen, self.choices())

    def choices(self) -> Iterator[PickUpChoice]:
        """Yield the choices of `__iter__`."""
        self.keep_policy()
        yield from self._likeliest_first(self.grounded())

    def from_mode(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples from around the mode of the grounded policy only, as the thesis' `iter_with_mode` does.

        Raises `ObjectUnreachable`.
        """
        self.keep_policy()
        yield from map(self.chosen, self._likeliest_first(self.grounded().mode()))

    def plain(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples in the order they are drawn, without regard to obstacles and visibility."""
        self.keep_policy()
        for choice in self.policy_here().sample(self._rng, self.samples):
            yield self.chosen(choice)

    def keep_policy(self) -> None:
        """Record the policy's content in the open episode, once for each opened memory."""
        keep_policy(self.policy_name, self._passed_policy)

    def _likeliest_first(self, policy: Policy) -> Iterator[PickUpChoice]:
        choices = self._clear_choices(policy)
        for number in np.argsort(-policy.likelihood(choices), kind="stable"):
            yield choices[number]

    def _clear_choices(self, policy: Policy) -> Sequence[PickUpChoice]:
        """Draw samples; where collisions count, only those where the base is clear before and after it turns.

        Raises `ObjectUnreachable` if collisions count and none of `_DRAWS_MAX` times as many samples is clear.
        """
        clearance = base_clearance()
        if clearance is None:
            return policy.sample(self._rng, self.samples)
        clear: list[PickUpChoice] = []
        for _ in range(_DRAWS_MAX):
            clear += [each for each in policy.sample(self._rng, self.samples) if self.is_clear(each, clearance)]
            if len(clear) >= self.samples:
                break
        if not clear:
            message = f"the base would be in collision at every place to pick up {self.target.name}"
            raise ObjectUnreachable(message, self.target.name)
        return clear[: self.samples]

    def is_clear(self, choice: PickUpChoice, clearance: BaseClearance) -> bool:
        """Return whether the base is clear of obstacles at its place, before and after it turns to the object."""
        place = self.chosen(choice).standing_position
        facing = face(place, self.target.pose, height_m=place.position.z)
        return clearance.refusal(place) is None and clearance.refusal(facing) is None

    def chosen(self, choice: PickUpChoice) -> MoveAndPickUpPerformable:
        """Return the action for this choice and the object's current pose.

        The base's position is above the point of the floor that has these x and y in the object's own frame. Raises
        `ObjectUnreachable` for an object that lies on its side, whose x-y plane does not map to the floor.
        """
        pose = self.target.pose
        up = rotated(pose.orientation, (0.0, 0.0, 1.0))
        if abs(up.z) < _UPRIGHT_MIN:
            message = f"{self.target.name} lies on its side: its frame gives no position on the floor"
            raise ObjectUnreachable(message, self.target.name)
        x, y, z = (pose @ Pose((choice.relative_x, choice.relative_y, 0.0))).position
        standing_position = Pose((x - z * up.x / up.z, y - z * up.y / up.z, base_height_m()))
        return MoveAndPickUpPerformable(
            standing_position, self.target, choice.arm, choice.grasp, policy=self.policy_name
        )


def _around(height: float) -> tuple[float, float]:
    return height - HEIGHT_TOLERANCE_M, height + HEIGHT_TOLERANCE_M
