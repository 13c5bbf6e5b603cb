"""Moving somewhere and picking up from there, as a policy would have it (thesis 5.2)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from sqlalchemy import Select, select

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning.policies.default_policy import default_policy
from pycrorm_async.learning.policies.evidence import Evidence
from pycrorm_async.learning.policies.policy import PickUpChoice, Policy
from pycrorm_async.learning.policies.policy_file import name_of
from pycrorm_async.learning.rollouts.feasible_places import free_and_visible
from pycrorm_async.orm import PickUpWithContextView
from pycrorm_async.plan.actions.basic import MoveAndPickUpPerformable
from pycrorm_async.plan.actions.descriptions import ActionDescription
from pycrorm_async.plan.current_robot import robot_here
from pycrorm_async.plan.failures import ObjectUnreachable
from pycrorm_async.plan.object_designators import ObjectDesignatorDescription, ObjectLike, designator_of, in_world
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp
from pycrorm_async.world.pose import Pose, rotated

__all__ = ["MoveAndPickUp", "HEIGHT_TOLERANCE_M"]

HEIGHT_TOLERANCE_M = 0.05
"""Experience with an object that was so much higher or lower, measured from the torso, is experience with this one."""
_UPRIGHT_MIN = 0.1


class MoveAndPickUp(ActionDescription[MoveAndPickUpPerformable]):
    """Alternatives for moving somewhere and picking an object up, as often as its policy has them.

    Iterating draws samples that fit the scene, and gives the likeliest first:

    >>> await Retry(MoveAndPickUp(milk, policy=learned), max_tries=20).perform()

    Args:
        target: the object, or a description of it.
        arms, grasps: only these; left out, any.
        policy: where to stand and how to grasp; left out, the default policy of the thesis.
        samples: how many alternatives there are.
        rng: where chance comes from; left out, a new one that nobody can repeat.

    Raises `ImpossibleCondition` if the policy never does it with such an arm or grasp, `CallerError` for no samples.
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
            raise CallerError(f"there is at least one sample, not {samples}")
        self.target = target.resolve() if isinstance(target, ObjectDesignatorDescription) else designator_of(target)
        wanted = Evidence(
            arms=frozenset(arms) if arms is not None else None,
            grasps=frozenset(grasps) if grasps is not None else None,
        )
        policy = default_policy() if policy is None else policy
        self.policy: Policy = policy if wanted == Evidence() else policy.condition(wanted)
        self.samples = samples
        self._rng = np.random.default_rng() if rng is None else rng

    def __repr__(self) -> str:
        return f"MoveAndPickUp({self.target.name!r}, policy={name_of(self.policy)})"

    @staticmethod
    def query_for_database() -> Select[Arms, Grasp, float, float, float | None]:
        """What a policy is learned from: how objects were picked up when it went well, in all episodes.

        A frame of it has the columns that `learn` takes: arm, grasp, object_x, object_y (where the robot stood, m, in
        the object's own frame) and height (of the object over the lifted torso, m). Add a `where` for a part of the
        episodes.
        """
        view = PickUpWithContextView
        return select(
            view.arm,
            view.grasp,
            view.object_x,
            view.object_y,
            view.height_over_torso.label("height"),
        ).where(view.status == TaskStatus.SUCCEEDED)

    # --- what is known here -----------------------------------------------------------------------------------

    @property
    def height(self) -> float:
        """How much higher than the lifted torso the object is now, m. Raises `NoWorld`, `NoRobotHere`."""
        robot = robot_here()
        torso = robot.body.joint_position(robot.description.torso_joint)
        return self.target.pose.position.z - robot.body.pose.position.z - torso

    def policy_here(self) -> Policy:
        """The policy for an object as high as this one. Raises `ObjectUnreachable` where it knows none."""
        return self._given(Evidence(height=_around(self.height)), "this high")

    def grounded(self) -> Policy:
        """The policy for where the robot can stand and see the object here. Raises `ObjectUnreachable`."""
        region = free_and_visible(robot_here(), in_world(self.target))
        return self._given(Evidence(region=region, height=_around(self.height)), "here")

    def _given(self, evidence: Evidence, where: str) -> Policy:
        try:
            return self.policy.condition(evidence)
        except ImpossibleCondition as impossible:
            message = f"the policy has no way to pick up {self.target.name} {where}: {impossible}"
            raise ObjectUnreachable(message, self.target.name) from impossible

    # --- alternatives -----------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[MoveAndPickUpPerformable]:
        """Samples that fit the scene, the likeliest first. Raises `ObjectUnreachable` if none can."""
        yield from self._likeliest_first(self.grounded())

    def from_mode(self) -> Iterator[MoveAndPickUpPerformable]:
        """The same from around the likeliest way of doing it here alone. Raises `ObjectUnreachable`."""
        yield from self._likeliest_first(self.grounded().mode())

    def plain(self) -> Iterator[MoveAndPickUpPerformable]:
        """Samples of the policy in the order they are drawn, whatever is around."""
        for choice in self.policy_here().sample(self._rng, self.samples):
            yield self.chosen(choice)

    def _likeliest_first(self, policy: Policy) -> Iterator[MoveAndPickUpPerformable]:
        choices = policy.sample(self._rng, self.samples)
        for number in np.argsort(-policy.likelihood(choices), kind="stable"):
            yield self.chosen(choices[number])

    def chosen(self, choice: PickUpChoice) -> MoveAndPickUpPerformable:
        """This very choice, for the object where it is now. Raises `ObjectUnreachable` for one that lies on its side.

        The base stands on the floor where the object's own frame has these x and y.
        """
        there = self.target.pose
        up = rotated(there.orientation, (0.0, 0.0, 1.0))
        if abs(up.z) < _UPRIGHT_MIN:
            raise ObjectUnreachable(f"{self.target.name} lies on its side: no place is beside it", self.target.name)
        x, y, z = (there @ Pose((choice.relative_x, choice.relative_y, 0.0))).position
        stand = Pose((x - z * up.x / up.z, y - z * up.y / up.z, 0.0))
        return MoveAndPickUpPerformable(stand, self.target, choice.arm, choice.grasp)


def _around(height: float) -> tuple[float, float]:
    return height - HEIGHT_TOLERANCE_M, height + HEIGHT_TOLERANCE_M
