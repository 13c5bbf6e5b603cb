"""Describe pick-ups whose arm, grasp and base position are sampled from a policy or recalled (thesis 5.2).

>>> await Retry(MoveAndPickUp(milk, policy=learned), max_tries=20).perform()
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import chain, compress, islice

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, func, select

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning.features import NEAR_SURFACE_M, Edge, PickUpContext, edges_around
from pycrorm_async.learning.polar_policy import PolarPolicy
from pycrorm_async.learning.policy import (
    ARMS,
    GRASPS,
    Evidence,
    Floats,
    PickUpChoice,
    Policy,
    Rectangle,
    Region,
    default_policy,
)
from pycrorm_async.learning.policy_file import AnyPolicy, name_of
from pycrorm_async.learning.recorded_policy import keep_policy
from pycrorm_async.learning.success_model import Draws, SuccessModel
from pycrorm_async.orm import PickUpWithContextView
from pycrorm_async.plan import objects
from pycrorm_async.plan.actions import MoveAndPickUpPerformable, MoveTorsoActionPerformable
from pycrorm_async.plan.failures import ObjectUnreachable, Resource
from pycrorm_async.plan.geometry import lifting_arms
from pycrorm_async.plan.language import ActionDescription
from pycrorm_async.plan.locations import BaseClearance, base_clearance, base_height_m, face
from pycrorm_async.plan.motions import collisions_count
from pycrorm_async.plan.task import Experience, PastSuccess, experience
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.bounding_boxes import box_around
from pycrorm_async.world.bullet import Object
from pycrorm_async.world.pose import Arms, Grasp, Pose, rotated
from pycrorm_async.world.queries import Costmap, OccupancyCostmap, VisibilityCostmap

# === feasible places ==========================================================================================
#
# Compute the places around an object that are free for the robot's base and from which its camera sees the object.
#
# The places are rectangles in the object's own frame.

CLEARANCE_M = 0.3
"""Minimum distance between the middle of the robot's base and any obstacle, the thesis' value."""
REACH_M = 2.0
"""Half the side of the square of places around the object: the same as the range of the default policy."""
_RESOLUTION_M = 0.05
_CELLS = round(2 * REACH_M / _RESOLUTION_M)
_VISIBLE_SHARE_MIN = 0.5
"""The least share of the object that must be visible from a place."""


def free_and_visible(robot: objects.CurrentRobot, target: Object) -> Region:
    """Return the places where the robot's base is clear of obstacles and its camera sees the object. Moves nothing.

    Where collisions count, the base is clear of the places outside with any heading; `MoveAndPickUp` checks the heading
    of each of its samples.
    """
    world, ignored = target.world, robot.with_load()
    ground = Pose((target.pose.position.x, target.pose.position.y, 0.0))
    low, high = robot.camera_heights_m()
    # The maps are not turned with the object, so the square in its frame needs up to √2 times the side: 1.5 is enough.
    size = {"size_cells": 2 * round(0.75 * _CELLS), "resolution_m": _RESOLUTION_M}
    clearance = base_clearance([robot])
    free = (
        OccupancyCostmap(world, ground, distance_to_obstacle_m=CLEARANCE_M, ignore=ignored, **size)  # type: ignore[arg-type]
        if clearance is None
        else clearance.costmap(ground, **size)  # type: ignore[arg-type]
    )
    visible = VisibilityCostmap(
        world,
        target,
        min_height_m=low,
        max_height_m=high,
        origin=ground,
        ignore=ignored,
        **size,  # type: ignore[arg-type]
    )
    middles = (np.arange(_CELLS) + 0.5) * _RESOLUTION_M - REACH_M
    places = _values(free, target.pose.yaw, middles) > 0
    places &= _values(visible, target.pose.yaw, middles) >= _VISIBLE_SHARE_MIN
    return Region(tuple(rectangles(places)))


def _values(costmap: Costmap, yaw: float, middles: NDArray[np.floating]) -> NDArray[np.float64]:
    """Sample the map at the cells of a grid that is turned by `yaw` about the map's origin."""
    x, y = np.meshgrid(middles, middles, indexing="ij")
    turned = (np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y)
    row, column = (np.floor(each / costmap.resolution_m + costmap.size_cells / 2).astype(int) for each in turned)
    return np.asarray(costmap.map[row, column])


def rectangles(cells: NDArray[np.bool_]) -> Iterator[Rectangle]:
    """Cover the true cells with disjoint rectangles; equal runs along y in consecutive rows become one rectangle."""
    open_runs: dict[tuple[int, int], int] = {}
    for row in range(len(cells) + 1):
        runs = set(_runs(cells[row])) if row < len(cells) else set()
        for run in [each for each in open_runs if each not in runs]:
            edges = (open_runs.pop(run), row, *run)
            yield Rectangle(*(each * _RESOLUTION_M - REACH_M for each in edges))
        for run in runs:
            open_runs.setdefault(run, row)


def _runs(cells: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the start and the end (exclusive) of each run of true cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]])))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


# === context ==================================================================================================
#
# Read the circumstances of a pick-up from the world: heights, the object's box, and the surface below it.


def context_of(target: Object, *, at: Pose | None = None) -> PickUpContext:
    """Return the circumstances of picking this object up with the acting robot, here or `at` a pose. Moves nothing.

    The edges are those of the box around the link that the object stands on, as seen from above. Raises `NoRobotHere`.
    """
    robot, pose = objects.require_robot(), target.pose if at is None else at
    joint = robot.description.torso_joint
    frames = [(target.link_pose(link).relative_to(target.pose), target.body.solids[link]) for link in target.links]
    box = box_around([((frame.position, frame.orientation), solids) for frame, solids in frames])
    return PickUpContext(
        height=pose.position.z - robot.body.pose.position.z,
        torso=0.0 if joint is None else robot.body.joint_position(joint),
        torso_limits=None if joint is None else robot.body.joint_limits(joint),
        size=None if box is None else (box.size.x, box.size.y, box.size.z),
        origin_height=math.nan if box is None else -box.min.z,
        edges=() if box is None else tuple(_edges_below(robot, target, pose, -box.min.z)),
    )


def _edges_below(robot: objects.CurrentRobot, target: Object, pose: Pose, origin_height: float) -> Iterator[Edge]:
    """Yield the edges of the surface that the object stands on at this pose, in its frame; none in the air."""
    x, y, z = pose.position
    below = (x, y, z - origin_height - NEAR_SURFACE_M)
    [support] = target.world.ray_test([(x, y, z)], [below], ignore=[target, *robot.with_load()])
    if support is None:
        return
    point, tops = Pose(below), []
    for link in support.links:
        box = support.box_in_link(link)
        if box is None:
            continue
        frame = support.link_pose(link)
        at = point.relative_to(frame).position
        if all(low <= here <= high for low, here, high in zip(box.min[:2], at[:2], box.max[:2], strict=True)):
            top = frame.position.z + box.max.z - below[2]
            if 0 <= top <= 2 * NEAR_SURFACE_M:
                tops.append((top, frame, at, box))
    if tops:
        _, frame, at, box = max(tops, key=lambda each: each[0])
        yield from edges_around(*at[:2], box.min, box.max, frame.yaw - pose.yaw)


# === move and pick up =========================================================================================
#
# Describe move-and-pick-up actions whose arm, grasp and base position are sampled from a policy (thesis 5.2).

HEIGHT_TOLERANCE_M = 0.05
"""Experience with objects up to this much higher or lower, measured from the torso, applies to the present object."""
_DRAWS_MAX = 10
"""Bounds the draws as a multiple of the samples, because in a scene without free places all samples collide."""
_UPRIGHT_MIN = 0.1
"""Minimum vertical component of the object's own z axis (a cosine); below it the object lies on its side and its x-y
plane no longer maps to the floor."""


PROPOSALS = 2_000
"""Random ways to pick up that a success model ranks."""
NEIGHBOURS, NEIGHBOUR_M = 1_000, (0.05, 0.025)
"""A success model also ranks this many ways around the likeliest, which are a twentieth as many, and then as many
around the likeliest by then: at these standard deviations from them in x, y and the height of the torso, m. At a high
table one way in thousands succeeds, and random ways miss most of those."""
ALIKE_M = 0.1
"""The distance in m, of the base and of the torso, at which two ways with the same arm and grasp are half alike."""
DRAWN_FROM = 100
"""Ways to pick up of which one is drawn in a rollout: more would give nothing but a slower rollout."""


@dataclass
class PredictedPickUpPerformable(MoveAndPickUpPerformable):
    """Set the torso, drive to a place, face the object from there, and pick it up, in a way that a model ranked.

    The attributes are recorded with the way, so that a model can be fitted to the nodes alone, and its predictions be
    compared with what happened. None stands for what is not known.

    Attributes:
        probability: of success, 0 to 1, as the model predicted it; None for a way that no model rates.
        torso: height of the lifted torso, m; it is set first. None leaves it as it is.
        relative_x, relative_y: of the place in the object's own frame, m.
        height: of the object over the lifted torso, m.
        width, depth, origin_height, edge_distance, edge_angle: see `features.CIRCUMSTANCES`.
    """

    probability: float | None = field(default=None, kw_only=True)
    torso: float | None = field(default=None, kw_only=True)
    relative_x: float = field(kw_only=True)
    relative_y: float = field(kw_only=True)
    height: float = field(kw_only=True)
    width: float | None = field(default=None, kw_only=True)
    depth: float | None = field(default=None, kw_only=True)
    origin_height: float | None = field(default=None, kw_only=True)
    edge_distance: float | None = field(default=None, kw_only=True)
    edge_angle: float | None = field(default=None, kw_only=True)

    def resources(self) -> frozenset[Resource]:
        own = super().resources()
        return own if self.torso is None else own | {Resource.TORSO}

    async def perform(self) -> None:
        robot = objects.require_robot()
        if self.torso is not None and robot.body.joint_position(robot.torso_joint()) != self.torso:
            await MoveTorsoActionPerformable(self.torso).perform()
        await super().perform()


class MoveAndPickUp(ActionDescription[MoveAndPickUpPerformable]):
    """A description whose alternatives for moving to an object and picking it up are samples of a policy.

    Iterating draws samples that fit the scene and yields the likeliest first:

    >>> await Retry(MoveAndPickUp(milk, policy=learned), max_tries=20).perform()

    Args:
        target: the object, or a description of it.
        arms, grasps: the allowed ones; None allows all.
        policy: the distribution of base positions, arms and grasps; None means the thesis' default policy. With a
            `SuccessModel` the likeliest of `PROPOSALS` ways of the default policy, each with a random height of the
            torso, and of ways around these are tried, and ways like earlier ones later; each alternative has its
            `probability`, so that a plan can refuse one below a bound.
        samples: number of alternatives.
        rng: random generator; None means a new one with an unpredictable seed.

    Each alternative names the policy as passed, before arms and grasps limit it (`policy_name`). The first alternative
    in an episode records the policy's content, once for each opened memory (`read_policy`).

    Raises `ImpossibleCondition` if the policy gives these arms or grasps no probability, `CallerError` if
    samples < 1, and when it is iterated if the model was fitted to another robot.
    """

    def __init__(
        self,
        target: objects.ObjectLike | objects.ObjectDesignatorDescription,
        arms: Iterable[Arms] | None = None,
        grasps: Iterable[Grasp] | None = None,
        policy: AnyPolicy | None = None,
        *,
        samples: int = 20,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(MoveAndPickUpPerformable)
        if samples < 1:
            raise CallerError(f"samples must be >= 1, got {samples}")
        self.target = (
            target.resolve()
            if isinstance(target, objects.ObjectDesignatorDescription)
            else objects.designator_of(target)
        )
        self.allowed = evidence = Evidence(
            arms=frozenset(arms) if arms is not None else None,
            grasps=frozenset(grasps) if grasps is not None else None,
        )
        self._passed_policy = policy = default_policy() if policy is None else policy
        self.policy_name = name_of(policy)
        self._model = None if isinstance(policy, Policy) else policy
        places = policy if isinstance(policy, Policy) else default_policy()
        self.policy: Policy = places if evidence == Evidence() else places.condition(evidence)
        self.samples = samples
        self._rng = np.random.default_rng() if rng is None else rng

    def of(self, target: objects.ObjectLike) -> MoveAndPickUp:
        """Return the same description for another object."""
        other = copy(self)
        other.target = objects.designator_of(target)
        return other

    def __repr__(self) -> str:
        return f"MoveAndPickUp({self.target.name!r}, policy={self.policy_name})"

    @staticmethod
    def query_for_database() -> Select[Arms, Grasp, float, float, float | None, str | None]:
        """Select the successful pick-ups of all episodes, the input of `learn`.

        A data frame of it has the columns arm, grasp, object_x, object_y (the robot's position in the object's own
        frame, m), height (of the object over the lifted torso, m) and robot, of which there must be one to learn. Add a
        `where` to cut it, by columns of `PickUpWithContextView` such as `robot`, `description` and `scene` (of the
        episode) or `obj_type`. The height of a robot without a torso is that over its base.
        """
        view = PickUpWithContextView
        return select(
            view.arm,
            view.grasp,
            view.robot_in_object_x.label("object_x"),
            view.robot_in_object_y.label("object_y"),
            func.coalesce(view.height_over_torso, -view.robot_in_object_z).label("height"),
            view.robot,
        ).where(view.status == TaskStatus.SUCCEEDED)

    @staticmethod
    def query_with_failures() -> Select[Arms, Grasp, float, float, float, float | None, TaskStatus, str | None]:
        """Select the pick-ups of all episodes that succeeded or failed, the input of `SuccessModel.fit`.

        A data frame of it has the columns of `query_for_database`, torso_height (m) and status. It can be cut in the
        same way.
        """
        view = PickUpWithContextView
        return select(
            view.arm,
            view.grasp,
            view.robot_in_object_x.label("object_x"),
            view.robot_in_object_y.label("object_y"),
            func.coalesce(view.height_over_torso, -view.robot_in_object_z).label("height"),
            view.torso_height,
            view.status,
            view.robot,
        ).where(view.status.in_([TaskStatus.SUCCEEDED, TaskStatus.FAILED]))

    # --- policies for the current scene -----------------------------------------------------------------------

    @property
    def height(self) -> float:
        """Height of the object over the lifted torso, if there is one, else over the base, now, m.

        Raises `NoWorld`, `NoRobotHere`.
        """
        robot = objects.require_robot()
        joint = robot.description.torso_joint
        torso = 0.0 if joint is None else robot.body.joint_position(joint)
        return self.target.pose.position.z - robot.body.pose.position.z - torso

    def policy_here(self) -> Policy:
        """Condition the policy on the object's height, and its mass if an allowed arm does not lift it.

        Raises `ObjectUnreachable` if that has probability 0.
        """
        return self._condition(Evidence(self._strong_enough(), height=_around(self.height)), "at this height")

    def grounded(self) -> Policy:
        """Condition the policy on height and mass of the object, and on the free places that see it.

        Raises `ObjectUnreachable` if that has probability 0.
        """
        region = free_and_visible(objects.require_robot(), objects.in_world(self.target))
        return self._condition(
            Evidence(self._strong_enough(), region=region, height=_around(self.height)), "in this scene"
        )

    def _strong_enough(self) -> frozenset[Arms] | None:
        """Return the allowed arms that the robot has and that lift the object; None if that does not rule one out."""
        allowed = ARMS if self.allowed.arms is None else tuple(self.allowed.arms)
        lifting = _own_arms(allowed, self.target)
        return frozenset(lifting) if len(lifting) < len(allowed) else None

    def _condition(self, evidence: Evidence, where: str) -> Policy:
        self._check_robot(self._passed_policy)
        try:
            return self.policy.condition(evidence)
        except ImpossibleCondition as impossible:
            message = f"the policy has no way to pick up {self.target.name} {where}: {impossible}"
            raise ObjectUnreachable(message, self.target.name) from impossible

    # --- alternatives -----------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples that fit the scene, the likeliest first. Raises `ObjectUnreachable` if none fits."""
        self.keep_policy()
        if self._model is None:
            yield from map(self.chosen, self._likeliest_first(self.grounded()))
            return
        choices, rates = self.rated(max(PROPOSALS, self.samples), searched=True)
        clearance = base_clearance()
        clear = _diverse_ranking(choices, rates, lambda each: clearance is None or self.is_clear(each, clearance))
        first = next(clear, None)
        if first is None:
            raise self._nowhere()
        yield from map(self.way, islice(chain([first], clear), self.samples))

    def drawn(self, rng: np.random.Generator, policy: Policy | None = None) -> MoveAndPickUpPerformable:
        """Return one sample, without regard to obstacles and visibility; `policy` saves `policy_here`.

        Of a `SuccessModel`, one of `DRAWN_FROM` proposals, by its `draws`, which may search twice as many around the
        likeliest; where collisions count, one in which the base is clear, if there is any. Raises `ObjectUnreachable`.
        """
        if self._model is None:
            return self.chosen((self.policy_here() if policy is None else policy).sample(rng)[0])
        context, clearance = self.context_for(self._model), base_clearance()

        def possible(choice: PickUpChoice) -> bool:
            return clearance is None or self.is_clear(choice, clearance)

        if isinstance(self._model, SuccessModel):
            places = self.policy_here()
            proposals = self.lifted(places.sample(rng, DRAWN_FROM), rng, context)
            neighbours = DRAWN_FROM if self._model.draws is Draws.SEARCHED else 0
            choices, rates = self._searched(self._model, proposals, neighbours, context, places, rng)
            choice = self._model.draw(rng, choices, context, possible, rates)
        else:
            [choice] = self._polar_ways(self._model, rng, 1, context, self.policy_here())
        return self._predicted(self._model, choice, context)

    def rated(self, count: int, *, searched: bool = False) -> tuple[Sequence[PickUpChoice], Floats]:
        """Draw ways to pick up at free places, and rate each: a model's probability, or a policy's density.

        With `searched`, those follow that a success model finds around the likeliest ones. Where collisions count, the
        base may collide at its heading there (`is_clear`). Raises `ObjectUnreachable`.
        """
        policy, model = self.grounded(), self._model
        if model is None:
            samples = policy.sample(self._rng, count)
            return samples, policy.likelihood(samples)
        context = self.context_for(model)
        if isinstance(model, PolarPolicy):
            proposals = self._polar_ways(model, self._rng, count, context, policy)
            return proposals, model.likelihood(proposals, context)
        choices = self.lifted(policy.sample(self._rng, count), self._rng, context)
        return self._searched(model, choices, NEIGHBOURS if searched else 0, context, policy, self._rng)

    def _searched(
        self,
        model: SuccessModel,
        choices: Sequence[PickUpChoice],
        neighbours: int,
        context: PickUpContext,
        policy: Policy,
        rng: np.random.Generator,
    ) -> tuple[Sequence[PickUpChoice], Floats]:
        """Return these choices and as many `neighbours` of the likeliest, twice, each with its probability."""
        rates = model.probability(choices, context)
        for off_m in NEIGHBOUR_M if neighbours and model.trees else ():
            near = self._neighbours(choices, rates, off_m, neighbours, context, policy, rng)
            choices, rates = [*choices, *near], np.concatenate([rates, model.probability(near, context)])
        return choices, rates

    def _neighbours(
        self,
        choices: Sequence[PickUpChoice],
        rates: Floats,
        off_m: float,
        count: int,
        context: PickUpContext,
        policy: Policy,
        rng: np.random.Generator,
    ) -> list[PickUpChoice]:
        """Return random ways around the likeliest ones, at free places."""
        clearance, region = base_clearance(), policy.evidence.region
        ordered = (choices[number] for number in np.argsort(-rates, kind="stable").tolist())
        clear = (each for each in ordered if clearance is None or self.is_clear(each, clearance))
        parents = [*islice(clear, max(count // 20, 1))]
        if not parents:
            return []
        low, high = context.torso_limits or (0.0, 0.0)
        drawn = rng.integers(len(parents), size=count).tolist()
        offsets = rng.normal(0.0, off_m, (count, 3)).tolist()
        near = [
            each._replace(
                relative_x=each.relative_x + dx,
                relative_y=each.relative_y + dy,
                torso=None if each.torso is None else min(max(each.torso + dz, low), high),
            )
            for each, (dx, dy, dz) in zip((parents[number] for number in drawn), offsets, strict=True)
        ]
        places = np.array([each[2:4] for each in near]).T
        return near if region is None else list(compress(near, region.contains(*places)))

    def way(self, choice: PickUpChoice) -> MoveAndPickUpPerformable:
        """Return the action for this choice, with the prediction of a model."""
        if self._model is None:
            return self.chosen(choice)
        return self._predicted(self._model, choice, self.context_for(self._model))

    def context_for(self, model: AnyPolicy) -> PickUpContext:
        """Return the object's context for the robot. Raises `CallerError` for a policy of another robot."""
        self._check_robot(model)
        return context_of(objects.in_world(self.target))

    def _check_robot(self, policy: AnyPolicy) -> None:
        robot = objects.require_robot()
        if policy.robot not in (None, robot.body.name, robot.description.name):
            message = f"the policy {self.policy_name} was learned from pick-ups of {policy.robot}"
            raise CallerError(f"{message}, this robot is {robot.body.name}: pass a policy of this robot")

    def _polar_ways(
        self, model: PolarPolicy, rng: np.random.Generator, count: int, context: PickUpContext, policy: Policy
    ) -> Sequence[PickUpChoice]:
        """Return samples at places of `policy`, the default policy here. Raises `ObjectUnreachable`."""

        def draw(number: int) -> list[PickUpChoice]:
            drawn = model.sample(rng, number, context, policy.evidence)
            places = np.array([each[2:4] for each in drawn]).T
            region = policy.evidence.region
            return drawn if region is None else list(compress(drawn, region.contains(*places)))

        try:
            return self._clear_choices(draw, count, every=True)
        except ImpossibleCondition as impossible:
            message = f"the policy has no way to pick up {self.target.name} here: {impossible}"
            raise ObjectUnreachable(message, self.target.name) from impossible

    @staticmethod
    def lifted(
        choices: Sequence[PickUpChoice], rng: np.random.Generator, context: PickUpContext
    ) -> Sequence[PickUpChoice]:
        """Return the choices, each with a random height of the torso, if there is one to lift."""
        if context.torso_limits is None:
            return choices
        torsos = rng.uniform(*context.torso_limits, len(choices)).tolist()
        return [each._replace(torso=torso) for each, torso in zip(choices, torsos, strict=True)]

    def _predicted(
        self, model: SuccessModel | PolarPolicy, choice: PickUpChoice, context: PickUpContext
    ) -> PredictedPickUpPerformable:
        """Return the action of this choice, with the model's prediction and its circumstances."""
        share: float | None = None
        if isinstance(model, SuccessModel) and model.trees:
            share = model.probability([choice], context).item()
        known = {name: value.item() for name, value in context.circumstances([choice]).items()}
        move = self.chosen(choice)
        return PredictedPickUpPerformable(
            move.standing_position, move.object_designator, move.arm, move.grasp, policy=self.policy_name,
            probability=share, torso=choice.torso, relative_x=choice.relative_x, relative_y=choice.relative_y,
            height=context.height - (context.torso if choice.torso is None else choice.torso),
            **{name: None if math.isnan(value) else value for name, value in known.items()},
        )  # fmt: skip

    def from_mode(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples from around the mode of the grounded policy only, as the thesis' `iter_with_mode` does.

        Raises `ObjectUnreachable`, and `CallerError` for a model, which has no mode.
        """
        if self._model is not None:
            raise CallerError(f"{self.policy_name} has no mode: iterate over its alternatives, the likeliest first")
        self.keep_policy()
        yield from map(self.chosen, self._likeliest_first(self.grounded().mode()))

    def plain(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples in the order they are drawn, without regard to obstacles and visibility."""
        self.keep_policy()
        policy = self.policy_here()
        for _ in range(self.samples):
            yield self.drawn(self._rng, policy)

    def keep_policy(self) -> None:
        """Record the policy's content in the open episode, once for each opened memory."""
        keep_policy(self.policy_name, self._passed_policy)

    def _likeliest_first(self, policy: Policy) -> Iterator[PickUpChoice]:
        choices = self._clear_choices(lambda number: policy.sample(self._rng, number), self.samples)
        for number in np.argsort(-policy.likelihood(choices), kind="stable"):
            yield choices[number]

    def _clear_choices(
        self, draw: Callable[[int], list[PickUpChoice]], count: int, *, every: bool = False
    ) -> Sequence[PickUpChoice]:
        """Draw `count` ways; where collisions count, only those where the base is clear.

        With `every`, `draw` may return fewer than it is asked for. Raises `ObjectUnreachable` if none of `_DRAWS_MAX`
        times as many is possible.
        """
        clearance = base_clearance()
        if clearance is None and not every:
            return draw(count)
        clear: list[PickUpChoice] = []
        for _ in range(_DRAWS_MAX):
            clear += [each for each in draw(count) if clearance is None or self.is_clear(each, clearance)]
            if len(clear) >= count:
                break
        if not clear:
            raise self._nowhere()
        return clear[:count]

    def _nowhere(self) -> ObjectUnreachable:
        message = f"the base would be in collision at every place to pick up {self.target.name}"
        return ObjectUnreachable(message, self.target.name)

    def is_clear(self, choice: PickUpChoice, clearance: BaseClearance) -> bool:
        """Return whether the base is clear of obstacles at its place, where it faces the object."""
        return clearance.refusal(self.chosen(choice).standing_position) is None

    def chosen(self, choice: PickUpChoice) -> MoveAndPickUpPerformable:
        """Return the action for this choice and the object's current pose.

        The base's position is above the point of the floor that has these x and y in the object's own frame. Where
        collisions count it faces the object on arrival, because turning there takes more room. Raises
        `ObjectUnreachable` for an object that lies on its side, whose x-y plane does not map to the floor.
        """
        pose = self.target.pose
        up = rotated(pose.orientation, (0.0, 0.0, 1.0))
        if abs(up.z) < _UPRIGHT_MIN:
            message = f"{self.target.name} lies on its side: its frame gives no position on the floor"
            raise ObjectUnreachable(message, self.target.name)
        x, y, z = (pose @ Pose((choice.relative_x, choice.relative_y, 0.0))).position
        standing_position = Pose((x - z * up.x / up.z, y - z * up.y / up.z, base_height_m()))
        if collisions_count():
            standing_position = face(standing_position, pose, height_m=base_height_m())
        return MoveAndPickUpPerformable(
            standing_position, self.target, choice.arm, choice.grasp, policy=self.policy_name
        )


class Likeness:
    """How alike each of these choices is to another: 1 to 0, a half at a distance of `ALIKE_M`; 0 for another grasp."""

    def __init__(self, choices: Sequence[PickUpChoice]) -> None:
        self._holds = np.array([_hold_number(each) for each in choices])
        self._places = np.array([_place(each) for each in choices]).reshape(-1, 3)

    def to(self, one: PickUpChoice) -> Floats:
        """Return the likeness of each choice to this one, shape (choices,)."""
        off = np.linalg.norm(self._places - _place(one), axis=1)
        return np.asarray((self._holds == _hold_number(one)) * 0.5 ** (off / ALIKE_M) ** 2)


def _hold_number(choice: PickUpChoice) -> int:
    return ARMS.index(choice.arm) * len(GRASPS) + GRASPS.index(choice.grasp)


def _place(choice: PickUpChoice) -> tuple[float, float, float]:
    return choice.relative_x, choice.relative_y, choice.torso or 0.0


def _diverse_ranking(
    choices: Sequence[PickUpChoice], rates: Floats, possible: Callable[[PickUpChoice], bool]
) -> Iterator[PickUpChoice]:
    """Yield the possible choices, the likeliest first; those like one that was yielded before count less.

    So the tries that follow a failure differ from it: the likeliest ways are all around the same place.
    """
    left, likeness = np.array(rates), Likeness(choices)
    while (left >= 0).any():
        best = int(left.argmax())
        left[best] = -1.0
        if possible(choices[best]):
            yield choices[best]
            left[left > 0] *= 1 - likeness.to(choices[best])[left > 0] / 2


def _own_arms(among: Iterable[Arms], target: objects.ObjectLike) -> tuple[Arms, ...]:
    """Return those of these arms that the robot has and that lift the object.

    Returns all of them if the robot has none, so that the action names the reason.
    """
    robot, among = objects.require_robot(), tuple(among)
    own = [arm for arm in among if arm in robot.description.arms]
    return lifting_arms(robot, own or among, target)


def _around(height: float) -> tuple[float, float]:
    return height - HEIGHT_TOLERANCE_M, height + HEIGHT_TOLERANCE_M


# === recalled pick up =========================================================================================
#
# Describe a pick-up whose alternatives are the ways that succeeded before, at about this height.

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


class RecalledPickUp(ActionDescription[MoveAndPickUpPerformable]):
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
        target: objects.ObjectLike | objects.ObjectDesignatorDescription,
        arms: Iterable[Arms] | None = None,
        grasps: Iterable[Grasp] | None = None,
        policy: AnyPolicy | None = None,
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

    async def resolve(self) -> MoveAndPickUpPerformable:  # type: ignore[override]  # a memory is asked
        """Return the first alternative. Raises `ObjectUnreachable` if there is none."""
        async for each in self:
            return each
        raise ObjectUnreachable(f"there is no way to pick up {self.target.name} here", self.target.name)

    def __iter__(self) -> Iterator[MoveAndPickUpPerformable]:
        """Raise `CallerError`, because the memory is queried between two alternatives."""
        raise CallerError("a recalled pick-up asks the memory: iterate with `async for`, or `await …resolve()`")

    async def __aiter__(self) -> AsyncIterator[MoveAndPickUpPerformable]:
        """Yield the ways of `recalled`, then the policy's samples."""
        async for recalled in self.recalled():
            yield recalled
        for description, chosen_by in self._otherwise:
            try:
                for move in description:
                    yield self._performable_of(move, chosen_by)
            except ObjectUnreachable:  # a learned policy may know no way at this height
                if description is self._default:
                    raise

    async def recalled(self) -> AsyncIterator[MoveAndPickUpPerformable]:
        """Yield the way with the highest expected success that was not yielded yet, while there is one."""
        source = self._experience if self._experience is not None else experience.get()
        if source is None:
            return
        region = free_and_visible(objects.require_robot(), objects.in_world(self.target))
        clearance = base_clearance()
        tried: set[PickUpChoice] = set()

        def possible(way: PastSuccess, choice: PickUpChoice, arms: Sequence[Arms]) -> bool:
            return (
                choice not in tried
                and way.arm in arms
                and way.grasp in self._grasps
                and way.score >= way.prior
                and way.evidence >= _EVIDENCE_MIN
                and (clearance is None or self._default.is_clear(choice, clearance))
            )

        while True:
            robot = objects.require_robot()
            joint = robot.description.torso_joint
            torso = None if joint is None else robot.body.joint_position(joint)
            over_base = self.target.pose.position.z - robot.body.pose.position.z
            arms = _own_arms(self._arms, self.target)
            arm = arms[0] if len(arms) == 1 else None
            ways = await source.successes(self.target.object_type, arm=arm, height=over_base, torso=torso)
            places = np.array([each.stand.position[:2] for each in ways]).reshape(-1, 2)
            choices = [PickUpChoice(each.arm, each.grasp, *each.stand.position[:2]) for each in ways]
            free = compress(zip(ways, choices, strict=True), region.contains(*places.T))
            best = next((each for each in free if possible(*each, arms)), None)
            if best is None:
                return
            way, choice = best
            tried.add(choice)
            recalled = replace(self._default.chosen(choice), policy=None)
            yield self._performable_of(recalled, "recall", expected=way.score)

    def _performable_of(
        self, move: MoveAndPickUpPerformable, chosen_by: str, *, expected: float | None = None
    ) -> MoveAndPickUpPerformable:
        if isinstance(move, PredictedPickUpPerformable):
            return move
        place, target, policy = move.standing_position, move.object_designator, move.policy
        return RecalledPickUpPerformable(place, target, move.arm, move.grasp, chosen_by, expected, policy=policy)
