"""Success models: fitted as scikit-learn fits them, evaluated and stored without it, and used to choose pick-ups."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError, ImpossibleCondition, NotEnoughExperience, PolicyDamaged, PolicyFileRefused
from pycrorm_async.learning import (
    Draws,
    Edge,
    Evidence,
    MoveAndPickUp,
    PickUpChoice,
    PickUpContext,
    PredictedPickUpPerformable,
    Scene,
    Stage,
    SuccessModel,
    context_of,
    default_policy,
    learn_polar,
    load_policy,
    name_of,
    read_policy,
    save_policy,
)
from pycrorm_async.learning.experiment import Experiment, Learned, read_rollouts, run
from pycrorm_async.learning.features import (
    ARM_M,
    FEATURES,
    SHOULDER_M,
    WRIST_M,
    features_of,
    features_of_frame,
    place_of,
)
from pycrorm_async.learning.polar_policy import PolarLeaf, PolarPolicy
from pycrorm_async.learning.policy import Linear
from pycrorm_async.learning.policy_cards import read_card
from pycrorm_async.learning.policy_file import AnyPolicy
from pycrorm_async.learning.pool import MemoryLocation
from pycrorm_async.learning.rollouts import Tally
from pycrorm_async.learning.scenes import Disturbance
from pycrorm_async.learning.success_model import CONFIDENT, Tree
from pycrorm_async.plan import Retry, simulated_robot
from pycrorm_async.plan.failures import ObjectUnreachable
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.learning.geometric_rollouts import succeeds

TORSO_M = (0.0, 0.33)


def split(feature: str, threshold: float, below: float, above: float) -> Tree:
    column = FEATURES.index(feature)
    return Tree(
        (column, -1, -1), (threshold, 0.0, 0.0), (True, False, False), (1, 1, 2), (2, 1, 2), (0.0, below, above)
    )


NEAR_AND_LOW = SuccessModel(
    "grasp-polar", 1, 0.0, (split("distance", 0.9, 3.0, -3.0), split("height", 0.8, 1.0, -1.0)), "pr2", 100, 40
)
"""Ways nearer than 0.9 m to objects lower than 0.8 m over the torso succeed; written by hand."""


def tries(count: int, seed: int, heights: tuple[float, float] = (0.6, 1.2)) -> tuple[list[PickUpChoice], Any]:
    """Return random ways with a random torso, and the heights of their objects over the floor."""
    rng = np.random.default_rng(seed)
    torsos = rng.uniform(*TORSO_M, count).tolist()
    drawn = default_policy().sample(rng, count)
    return [each._replace(torso=torso) for each, torso in zip(drawn, torsos, strict=True)], rng.uniform(*heights, count)


def frame_of(choices: Sequence[PickUpChoice], heights: Any) -> pd.DataFrame:
    """Return them, performed, as a memory's frame of tries."""
    rows = [
        (each.arm.name, each.grasp.name, each.relative_x, each.relative_y, height - each.torso, each.torso)
        for each, height in zip(choices, heights, strict=True)
        if each.torso is not None
    ]
    frame = pd.DataFrame(rows, columns=["arm", "grasp", "object_x", "object_y", "height", "torso_height"])
    done = [succeeds(each, Pose((1.3, 1.0, height))) for each, height in zip(choices, heights, strict=True)]
    return frame.assign(status=np.where(done, "SUCCEEDED", "FAILED"), robot="pr2")


@pytest.fixture(scope="module")
def frame() -> pd.DataFrame:
    return frame_of(*tries(2_000, 1))


@pytest.fixture(scope="module")
def fitted(frame: pd.DataFrame) -> SuccessModel:
    pytest.importorskip("sklearn")
    return SuccessModel.fit(frame)


# --- features -------------------------------------------------------------------------------------------------------


def test_both_arms_and_all_side_grasps_have_the_features_of_their_mirror_images_and_turns() -> None:
    context = PickUpContext(0.9, origin_height=0.1, edges=(Edge(0.2, math.pi),))
    left, right, turned = features_of(
        [
            PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.6, 0.2, 0.1),
            PickUpChoice(Arms.RIGHT, Grasp.FRONT, -0.6, -0.2, 0.1),
            PickUpChoice(Arms.LEFT, Grasp.RIGHT, -0.2, -0.6, 0.1),
        ],
        context,
    )
    assert left == pytest.approx(right, nan_ok=True)
    of_robot = [FEATURES.index(name) for name in ("top", "distance", "angle", "ahead", "aside", "height")]
    assert left[of_robot] == pytest.approx(turned[of_robot])
    named = dict(zip(FEATURES, left.tolist(), strict=True))
    assert named["distance"] == pytest.approx(math.hypot(0.6, 0.2))
    assert named["angle"] == pytest.approx(-math.atan2(0.2, 0.6))
    assert (named["height"], named["object_height"]) == pytest.approx((0.8, 0.9))
    assert (named["edge_distance"], named["base_clearance"]) == pytest.approx((0.2, 0.4))
    assert math.isnan(named["width"])
    base = Pose((-0.6, 0.2, 0), yaw_quaternion(math.atan2(-0.2, 0.6)))
    wrist = (base.inverse() @ Pose((-WRIST_M, 0, 0))).position
    assert (named["wrist_ahead"], named["wrist_aside"]) == pytest.approx(wrist[:2])
    aside, up = wrist.y - SHOULDER_M[0], 0.8 - SHOULDER_M[1]
    assert (named["reach"], named["reach_angle"]) == pytest.approx(
        (math.hypot(wrist.x, aside), math.atan2(aside, wrist.x))
    )
    assert named["stretch"] == pytest.approx(math.hypot(wrist.x, aside, up))
    assert named["elevation"] == pytest.approx(math.atan2(up, named["reach"]))
    shoulder = (base @ Pose((0, SHOULDER_M[0], 0))).position
    assert named["surface"] == pytest.approx(0.7)
    assert named["shoulder_clearance"] == pytest.approx(-shoulder.x - 0.2)
    assert named["wrist_clearance"] == pytest.approx(WRIST_M - 0.2)
    share = (0.2 - WRIST_M) / (-shoulder.x - WRIST_M)
    assert named["arm_above"] == pytest.approx(share * math.dist(shoulder[:2], (-WRIST_M, 0)))
    clearances = [named["wrist_clearance"], named["elbow_clearance"], named["shoulder_clearance"]]
    assert clearances == sorted(clearances)
    elbow = np.interp(clearances[1], clearances[::2], [named["reach"], 0.0]), named["elbow_over"] + 0.7 - SHOULDER_M[1]
    assert elbow[1] < 0
    assert (math.hypot(*elbow), math.dist(elbow, (named["reach"], up))) == pytest.approx(ARM_M)
    assert named["forearm_over"] == pytest.approx(np.interp(0.0, clearances[:2], [0.1, named["elbow_over"]]))


@pytest.mark.parametrize("grasp", list(Grasp))
@pytest.mark.parametrize("arm", [Arms.LEFT, Arms.RIGHT])
def test_the_place_of_features_is_the_place_they_were_computed_from(arm: Arms, grasp: Grasp) -> None:
    [row] = features_of([PickUpChoice(arm, grasp, 0.3, -0.7, 0.0)], PickUpContext(0.9))
    assert place_of(arm, grasp, row[1], row[2]) == pytest.approx((0.3, -0.7))


def test_a_frame_has_the_features_of_the_choices_it_was_recorded_from() -> None:
    context = PickUpContext(0.9, 0.2, TORSO_M, (0.06, 0.1, 0.2), 0.1, (Edge(0.2, 3.0), Edge(0.5, 0.0)))
    choices = tries(50, 3)[0]
    recorded = frame_of(choices, np.full(50, 0.9)).assign(**context.circumstances(choices))
    np.testing.assert_allclose(features_of_frame(recorded), features_of(choices, context), atol=1e-12)


def test_the_context_has_the_box_of_the_object_and_the_edges_of_what_it_stands_on() -> None:
    with Scene(kitchen=True, torso_height=0.2).entered() as stage:
        stage.target.set_pose(Pose(stage.target.pose.position, yaw_quaternion(0.5)))
        context = context_of(stage.target)
        assert context.size == pytest.approx((0.066, 0.066, 0.194))
        assert (context.origin_height, context.height, context.torso) == pytest.approx((0.088, 0.9, 0.2))
        assert context.torso_limits == pytest.approx(TORSO_M)
        surface = stage.world.object("kitchen").bounding_box("sink_area_surface")
        x, y, z = stage.target.pose.position
        ahead = {round(each.angle + 0.5, 3) % round(math.tau, 3): each.distance for each in context.edges}
        assert ahead[0.0] == pytest.approx(surface.max.x - x)
        assert ahead[round(math.pi / 2, 3)] == pytest.approx(surface.max.y - y)
        stage.target.set_pose(Pose((x, y, z + 0.1)))
        assert context_of(stage.target).edges == ()


# --- fitting --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_probabilities_equal_those_of_scikit_learn_also_where_features_are_missing(frame: pd.DataFrame) -> None:
    ensemble = pytest.importorskip("sklearn.ensemble")
    rng, count = np.random.default_rng(5), len(frame)
    succeeded = frame.status == "SUCCEEDED"
    edges = np.where(succeeded & (rng.random(count) < 0.9), np.nan, rng.uniform(0.1, 0.3, count))  # missing tells most
    circumstances = frame.assign(edge_distance=edges, edge_angle=rng.uniform(-3, 3, count), width=rng.random(count))
    model = SuccessModel.fit(circumstances)
    rows = features_of_frame(circumstances)
    varied = [number for number, values in enumerate(rows.T) if len(set(values[~np.isnan(values)])) > 1]
    theirs = ensemble.HistGradientBoostingClassifier(
        max_iter=len(model.trees),
        max_leaf_nodes=max(each.feature.count(-1) for each in model.trees),
        min_samples_leaf=10,
        early_stopping=False,
        random_state=0,
        learning_rate=0.05,
        l2_regularization=1.0,
    )
    with pytest.importorskip("threadpoolctl").threadpool_limits(
        1
    ):  # more threads wait for each other on a busy machine
        theirs.fit(rows[:, varied], succeeded)
    elsewhere = np.where(rng.random(rows.shape) < 0.2, np.nan, rng.normal(size=rows.shape))
    for each in (rows, elsewhere):
        expected = theirs.predict_proba(each[:, varied])[:, 1]
        np.testing.assert_allclose(model.probability_of(each), expected, atol=1e-9)
    assert max(max(each.threshold) for each in model.trees) > 1e300  # a split by what is missing alone
    assert SuccessModel.fit(circumstances) == model


@pytest.mark.slow
def test_a_model_does_not_take_the_luck_of_some_rows_for_a_chance() -> None:
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(44)
    near, ways = PickUpContext(0.9, torso_limits=TORSO_M), tries(4_000, 4)[0]
    distance = np.array([math.hypot(each.relative_x, each.relative_y) for each in ways])
    lucky = (distance < 0.8) & (rng.random(len(ways)) < 0.8)
    rows = [(each.arm.name, each.grasp.name, *each[2:4], 0.9 - (each.torso or 0), each.torso) for each in ways[:2_000]]
    columns = ["arm", "grasp", "object_x", "object_y", "height", "torso_height"]
    frame = pd.DataFrame(rows, columns=columns).assign(status=np.where(lucky[:2_000], "SUCCEEDED", "FAILED"))
    chances = SuccessModel.fit(frame).probability(ways[2_000:], near)
    likeliest = np.argsort(-chances)[:100]
    assert (distance[2_000:][likeliest] < 0.8).all()  # so that 80 % of them succeed
    assert chances[likeliest].mean() < 0.96  # 0.99 with trees of 31 leaves


@pytest.mark.slow
def test_a_model_finds_most_ways_that_succeed_and_few_others(fitted: SuccessModel) -> None:
    held_out, heights = tries(1_500, 2)
    recorded = frame_of(held_out, heights)
    assert fitted.coverage(recorded[recorded.status == "SUCCEEDED"]) > 0.75
    rng, done = np.random.default_rng(3), 0
    for height in rng.uniform(0.6, 1.2, 200).tolist():
        choice = fitted.draw(rng, tries(100, int(rng.integers(2**32)))[0], PickUpContext(height, torso_limits=TORSO_M))
        done += succeeds(choice, Pose((1.3, 1.0, height)))
    assert done >= 180  # of the default policy 40


@pytest.mark.slow
def test_too_little_experience_and_frames_without_the_features_are_refused(frame: pd.DataFrame) -> None:
    failed, succeeded = (frame[frame.status == status] for status in ("FAILED", "SUCCEEDED"))
    with pytest.raises(
        NotEnoughExperience, match=r"^0 successes are too few to learn from: .* 20 successes and as many"
    ):
        SuccessModel.fit(failed)
    with pytest.raises(NotEnoughExperience, match=r"^0 failures are too few"):
        SuccessModel.fit(succeeded)
    with pytest.raises(NotEnoughExperience, match=r"^0 successes"):
        SuccessModel.fit(frame[:0])
    with pytest.raises(CallerError, match="no column status: select the pick-ups that failed too"):
        SuccessModel.fit(frame.drop(columns="status"))
    with pytest.raises(CallerError, match="no column height"):
        SuccessModel.fit(frame.drop(columns="height"))
    with pytest.raises(CallerError, match=r"of several robots \(courier, pr2\)"):
        SuccessModel.fit(frame.assign(robot=["pr2", "courier"] * (len(frame) // 2)))
    with pytest.raises(CallerError, match="column edge_distance holds values that are not numbers"):
        SuccessModel.fit(frame.assign(edge_distance="near"))
    with pytest.raises(CallerError, match="min_samples_leaf=0"):
        SuccessModel.fit(frame, min_samples_leaf=0)


def test_a_model_rates_in_parts_what_it_rates_at_once(fitted: SuccessModel, frame: pd.DataFrame) -> None:
    rows = features_of_frame(frame)
    for rows_at_once in (1, 7, 512, 4_096):
        parts = list(fitted.parts_of(rows, rows_at_once))
        assert len(parts) == -(-len(rows) // rows_at_once)
        assert np.concatenate(parts).tolist() == fitted.probability_of(rows).tolist()


def test_draws_are_confident_uncertain_or_random_and_repeatable() -> None:
    context = PickUpContext(0.7, torso_limits=TORSO_M)
    ways = tries(100, 4)[0]
    shares = NEAR_AND_LOW.probability(ways, context)
    assert 0.3 < (shares >= CONFIDENT).mean() < 0.7
    drawn = {
        draws: [NEAR_AND_LOW.drawing(draws).draw(np.random.default_rng(seed), ways, context) for seed in range(200)]
        for draws in Draws
    }
    rates = {draws: NEAR_AND_LOW.probability(each, context).mean() for draws, each in drawn.items()}
    confident = {way for way, share in zip(ways, shares, strict=True) if share >= CONFIDENT}
    assert set(drawn[Draws.CONFIDENT]) <= confident
    assert len(set(drawn[Draws.CONFIDENT])) > len(confident) / 2
    assert rates[Draws.RANDOM] < rates[Draws.UNCERTAIN] < rates[Draws.CONFIDENT]
    far = [PickUpChoice(Arms.LEFT, Grasp.FRONT, -1.5, 0.0, 0.0), PickUpChoice(Arms.LEFT, Grasp.FRONT, -1.5, 0.0, 0.33)]
    assert NEAR_AND_LOW.draw(np.random.default_rng(1), far, PickUpContext(1.0)) == far[1]  # the likeliest of none
    for draws in Draws:
        model = NEAR_AND_LOW.drawing(draws)
        assert model.draw(np.random.default_rng(1), far, PickUpContext(1.0), lambda way: way == far[0]) == far[0]
        assert model.draw(np.random.default_rng(1), far, PickUpContext(1.0), lambda _: False) in far
    assert len({name_of(NEAR_AND_LOW.drawing(draws)) for draws in Draws}) == len(Draws)


def test_a_searching_model_draws_the_likeliest_unless_it_is_sure_and_then_where_it_is_unsure() -> None:
    context, model = PickUpContext(0.7, torso_limits=TORSO_M), NEAR_AND_LOW.drawing(Draws.SEARCHED)
    ways = tries(100, 4)[0]
    shares = model.probability(ways, context)
    assert sorted(set(shares.round(2))) == [0.12, 0.98]
    drawn = [model.draw(np.random.default_rng(seed), ways, context) for seed in range(200)]
    assert (model.probability(drawn, context) < 0.5).mean() > 0.6  # p (1 - p) is 0.105 there, and 0.018 elsewhere
    unsure = [way for way, share in zip(ways, shares, strict=True) if share < 0.5]
    likeliest = np.array([0.1] * len(unsure) + [0.9])
    assert model.draw(np.random.default_rng(1), [*unsure, ways[0]], context, shares=likeliest) == ways[0]


# --- polar trees ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_polar_tree_sets_the_torso_and_is_read_back_from_its_file(frame: pd.DataFrame, tmp_path: Path) -> None:
    pytest.importorskip("jpt")
    successes = frame[frame.status == "SUCCEEDED"]
    policy = learn_polar(successes)
    assert policy.coverage(successes) == 1.0
    save_policy(policy, tmp_path / "policy.json")
    assert load_policy(tmp_path / "policy.json") == policy
    done, context = 0, PickUpContext(0.7, torso_limits=TORSO_M)
    for height in np.random.default_rng(3).uniform(0.6, 1.2, 200).tolist():
        [choice] = policy.sample(np.random.default_rng(4), 1, PickUpContext(height, torso_limits=TORSO_M))
        assert choice.torso is not None
        assert TORSO_M[0] <= choice.torso <= TORSO_M[1]
        done += succeeds(choice, Pose((1.3, 1.0, height)))
    assert done > 140  # of the default policy 40
    one_by_one = np.random.default_rng(5)
    drawn = policy.sample(np.random.default_rng(5), 20, context)
    assert [policy.sample(one_by_one, 1, context)[0] for _ in drawn] == drawn
    assert (policy.likelihood(drawn, context) > 0).all()
    left_top = Evidence(frozenset({Arms.LEFT}), frozenset({Grasp.TOP}))
    assert {each[:2] for each in policy.sample(one_by_one, 20, context, left_top)} == {(Arms.LEFT, Grasp.TOP)}
    with pytest.raises(ImpossibleCondition, match=r"an object 2\.670 to 3\.000 m over the torso"):
        policy.sample(one_by_one, 1, PickUpContext(3.0, torso_limits=TORSO_M))
    with pytest.raises(CallerError, match=r"all objects were 0\.900 m over the torso"):
        learn_polar(successes.assign(height=0.9))
    with pytest.raises(NotEnoughExperience, match="5 successes are too few"):
        learn_polar(successes[:5])


def test_the_names_and_files_of_trees_of_places_are_those_of_version_1(tmp_path: Path) -> None:
    save_policy(default_policy(), tmp_path / "policy.json")
    assert name_of(default_policy()) == "c0792a8bba95"
    assert (tmp_path / "policy.json").read_bytes().startswith(b'{"format":"pycrorm policy","version":1,"crc32":')


# --- files ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_model_is_the_same_in_another_process_without_the_libraries_for_learning(tmp_path: Path) -> None:
    save_policy(NEAR_AND_LOW, tmp_path / "model.json")
    assert load_policy(tmp_path / "model.json") == NEAR_AND_LOW
    program = """
import sys
for name in ("jpt", "pandas", "scipy", "matplotlib", "sklearn"):
    sys.modules[name] = None
from pycrorm_async.learning.features import PickUpContext
from pycrorm_async.learning.policy import PickUpChoice, default_policy
from pycrorm_async.learning.policy_file import load_policy
import numpy as np
ways = default_policy().sample(np.random.default_rng(8), 200)
print(load_policy(sys.argv[1]).probability(ways, PickUpContext(0.9, 0.1)).tolist())
"""
    command = [sys.executable, "-c", program, str(tmp_path / "model.json")]
    there = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    ways = default_policy().sample(np.random.default_rng(8), 200)
    assert json.loads(there) == NEAR_AND_LOW.probability(ways, PickUpContext(0.9, 0.1)).tolist()


def test_files_of_other_versions_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.json"

    def written(content: bytes, version: int = 2) -> Path:
        heading = {"format": "pycrorm policy", "version": version, "crc32": zlib.crc32(content)}
        path.write_bytes(json.dumps(heading).encode() + b"\n" + content + b"\n")
        return path

    save_policy(NEAR_AND_LOW, path)
    content = path.read_bytes().splitlines()[1]
    assert load_policy(written(content)) == NEAR_AND_LOW
    with pytest.raises(PolicyFileRefused, match="has format version 4, but this program reads 1 to 3"):
        load_policy(written(content, version=4))
    newer = content.replace(b'"features_version":1', b'"features_version":5')
    with pytest.raises(PolicyFileRefused, match=r"grasp-polar, version 5, but this program has .*, versions 1 to 4"):
        load_policy(written(newer))
    for good, bad in (
        (b'"left":[1,1,2]', b'"left":[0,1,2]'),  # never ends
        (b'"right":[2,1,2]', b'"right":[3,1,2]'),
        (b'"feature":[1,-1,-1]', b'"feature":[27,-1,-1]'),
        (b'"value":[0.0,3.0,-3.0]', b'"value":[0.0,3.0]'),
        (b'"kind":"success model"', b'"kind":"oracle"'),
    ):
        assert good in content
        with pytest.raises(PolicyDamaged, match="holds no policy"):
            load_policy(written(content.replace(good, bad)))


# --- use ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def stage() -> Iterator[Stage]:
    with Scene().entered() as stage:
        yield stage


def ways_of(stage: Stage, model: SuccessModel = NEAR_AND_LOW, **options: Any) -> list[PredictedPickUpPerformable]:
    ways = list(MoveAndPickUp(stage.target, policy=model, rng=np.random.default_rng(1), **options))
    assert all(isinstance(each, PredictedPickUpPerformable) for each in ways)
    return ways  # type: ignore[return-value]  # just checked


def test_a_searching_model_draws_ways_that_random_ones_miss(stage: Stage) -> None:
    ring = SuccessModel(
        "grasp-polar", 1, -2.0, (split("distance", 0.7, 1.0, -1.0), split("distance", 0.6, 0.0, 1.0),
        split("distance", 0.61, 1.0, 0.0)), None, 100, 40,
    )  # fmt: skip
    drawn = {}
    for draws in (Draws.UNCERTAIN, Draws.SEARCHED):
        tries = MoveAndPickUp(stage.target, policy=ring.drawing(draws))
        ways = [tries.drawn(np.random.default_rng(seed)) for seed in range(50)]
        distances = [math.hypot(each.relative_x, each.relative_y) for each in ways]  # type: ignore[attr-defined]
        drawn[draws] = sum(0.6 < each <= 0.61 for each in distances)
    assert drawn[Draws.SEARCHED] > 40
    assert drawn[Draws.UNCERTAIN] < 20


def test_the_likeliest_of_many_ways_come_first_each_with_its_probability(stage: Stage) -> None:
    ways = ways_of(stage)
    assert len(ways) == 20
    shares = [each.probability for each in ways if each.probability is not None]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] == pytest.approx(1 / (1 + math.exp(-4)))
    assert all(each.torso is not None and each.height == pytest.approx(0.9 - each.torso) for each in ways)
    choices = [PickUpChoice(each.arm, each.grasp, each.relative_x, each.relative_y, each.torso) for each in ways]
    assert NEAR_AND_LOW.probability(choices, context_of(stage.target)).tolist() == pytest.approx(shares)
    limited = ways_of(stage, arms=[Arms.RIGHT], grasps=[Grasp.TOP], samples=5)
    assert {(each.arm, each.grasp) for each in limited} == {(Arms.RIGHT, Grasp.TOP)}
    with pytest.raises(CallerError, match="has no mode"):
        next(MoveAndPickUp(stage.target, policy=NEAR_AND_LOW).from_mode())


def test_a_way_that_no_random_one_meets_is_found_around_the_likeliest(stage: Stage) -> None:
    funnel = [
        tree
        for off_m in (0.3, 0.1, 0.03, 0.01)
        for name, middle in (("distance", 0.7), ("angle", 0.4), ("height", 0.65))
        for tree in (split(name, middle - off_m, -1.0, 0.0), split(name, middle + off_m, 0.0, -1.0))
    ]
    model = SuccessModel("grasp-polar", 1, 4.0, tuple(funnel), "pr2", 100, 40)
    best = 1 / (1 + math.exp(-4))
    assert MoveAndPickUp(stage.target, policy=model, rng=np.random.default_rng(1)).rated(5_000)[1].max() < best
    first = next(iter(ways_of(stage, model)))
    assert first.probability == pytest.approx(best)
    assert first.height == pytest.approx(0.65, abs=0.01)


def test_a_way_unlike_the_earlier_ones_is_tried_before_one_that_is_as_likely(stage: Stage) -> None:
    ways = ways_of(stage, samples=8)
    for number, way in enumerate(ways):
        for other in ways[:number]:
            if (way.arm, way.grasp) == (other.arm, other.grasp):
                off = (way.relative_x - other.relative_x, way.relative_y - other.relative_y, way.height - other.height)
                assert math.hypot(*off) > 0.2


def test_a_robot_without_a_torso_has_ways_at_the_height_over_its_base() -> None:
    with BulletWorld(), simulated_robot:
        Object("courier", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.6]))
        tries = MoveAndPickUp(milk, policy=SuccessModel.untrained(), samples=3)
        assert tries.height == pytest.approx(0.6)
        assert [each.torso for each in tries if isinstance(each, PredictedPickUpPerformable)] == [None] * 3


@pytest.mark.parametrize("kind", ["model", "tree", "polar"])
def test_a_policy_of_another_robot_is_refused_and_its_file_names_the_robot(
    stage: Stage, tmp_path: Path, kind: str
) -> None:
    other: AnyPolicy = SuccessModel("grasp-polar", 1, 0.0, (), "courier", 100, 40)
    if kind == "tree":
        other = replace(default_policy(), robot="courier")
    elif kind == "polar":
        evenly = Linear((0.0, 1.0), (0.0, 1.0))
        other = PolarPolicy("grasp-polar", 2, (PolarLeaf(1.0, (0.5, 0.5), evenly, evenly, evenly),), "courier")
    save_policy(other, tmp_path / "policy.json")
    read = load_policy(tmp_path / "policy.json")
    assert read == other
    assert name_of(read) == name_of(other)
    message = "was learned from pick-ups of courier, this robot is pr2: pass a policy of this robot"
    with pytest.raises(CallerError, match=message):
        next(iter(MoveAndPickUp(stage.target, policy=read)))
    with pytest.raises(CallerError, match=message):
        MoveAndPickUp(stage.target, policy=read).drawn(np.random.default_rng(1))


@pytest.mark.slow
async def test_the_torso_moves_first_and_the_node_records_the_prediction(stage: Stage, tmp_path: Path) -> None:
    stage.target.set_pose(Pose((1.3, 1.0, 0.9), yaw_quaternion(0.7)))
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="with a model"):
            await Retry(MoveAndPickUp(stage.target, policy=NEAR_AND_LOW, samples=50), max_tries=50).perform()
        await memory.flush()
        mapped = memory.mapped("PredictedPickUpAction")
        async with memory.session() as session:
            tried = (await session.scalars(select(mapped).order_by(mapped.id.desc()))).first()
        frame = await memory.dataframe(MoveAndPickUp.query_with_failures())
        assert await read_policy(memory.reading, name_of(NEAR_AND_LOW)) == NEAR_AND_LOW
    assert tried is not None
    torso = stage.robot.joint_position("torso_lift_joint")
    assert (tried.torso, tried.policy) == (pytest.approx(torso), name_of(NEAR_AND_LOW))
    last = frame.iloc[-1]
    assert (last.status, last.torso_height, last.height) == (
        "SUCCEEDED",
        pytest.approx(torso),
        pytest.approx(0.9 - torso),
    )
    assert (tried.relative_x, tried.relative_y) == pytest.approx((last.object_x, last.object_y))
    assert tried.probability == pytest.approx(NEAR_AND_LOW.probability_in(frame)[-1])


def test_where_no_place_is_free_there_is_no_way(stage: Stage) -> None:
    Object("wall", ObjectType.GENERIC_OBJECT, BLOCK, pose=Pose((1.3, 1.0, 0.0)))
    with pytest.raises(ObjectUnreachable):
        ways_of(stage)


_BOX = '<geometry><box size="6 6 0.1"/></geometry>'
BLOCK = f'<robot name="wall"><link name="wall"><visual>{_BOX}</visual><collision>{_BOX}</collision></link></robot>'


# --- rounds ---------------------------------------------------------------------------------------------------------

ROUNDS = Experiment(
    rollouts=150,
    rounds=2,
    evaluate=40,
    held_out=60,
    min_samples_leaf=10,
    scene=Scene(heights=(0.6, 1.2), turned=True, disturbance=Disturbance(base_m=0.01)),
    model=Learned.SUCCESS,
)


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_interrupted_rounds_continue_to_the_model_of_rounds_without_an_interruption(
    database_url: str, tmp_path: Path
) -> None:
    pytest.importorskip("sklearn")
    steps: list[tuple[str, int, int, Tally]] = []
    place = MemoryLocation(f"sqlite:///{tmp_path}/whole.db", tmp_path / "whole")
    whole = await run(replace(ROUNDS, workers=2), place, lambda *step: steps.append(step))
    *_, (name, done, total, solved) = steps
    assert (name, done, total, solved.rollouts) == ("ceiling, each scene once", 60, 60, 60)
    assert solved.success_rate == whole.ceiling
    assert [each[1] for each in steps if each[0] == name] == [*range(1, 61)]
    assert isinstance(whole.policy, SuccessModel)
    assert (whole.policy.rollouts, whole.policy.successes) == (300, len(whole.successes))
    assert whole.policy.robot == "pr2"  # so that another robot refuses the model
    default, second, evaluation, held_out = whole.phases
    assert default.policy == held_out.policy == name_of(SuccessModel.untrained())
    assert default.tally.success_rate < 0.35 < second.tally.success_rate
    assert evaluation.policy == name_of(whole.policy)
    assert evaluation.tally.success_rate > 0.6
    assert whole.coverage is not None
    assert 0.4 < whole.coverage <= 1
    async with Reading.open(f"sqlite:///{tmp_path}/whole.db") as reading:
        card = await read_card(reading, name_of(whole.policy))
    assert card.evaluation is not None
    assert (card.evaluation.coverage, card.evaluation.ceiling) == (whole.coverage, whole.ceiling)
    [tried] = card.evaluation.held_out
    assert (tried.by, tried.tries, tried.coverage) == ("seed", 60, whole.coverage)
    assert sum(each.tries for each in tried.calibration) == 60
    assert card.trainings[0].scene == str(ROUNDS.scene)
    assert "base off by 0.01 m" in card.trainings[0].scene

    class Interrupted(Exception):
        pass

    def interrupt(name: str, done: int, _total: int, _tally: Tally) -> None:
        if name == second.name and done > 30:
            raise Interrupted

    place = MemoryLocation(database_url, tmp_path / "spool")
    with pytest.raises(Interrupted):
        await run(ROUNDS, place, interrupt)
    resumed = await run(replace(ROUNDS, resume=True), place)
    assert resumed.default.done_now == 0
    assert 0 < resumed.phases[1].done_now < 150
    assert resumed.policy == whole.policy
    assert [each.tally for each in resumed.phases] == [each.tally for each in whole.phases]
    async with Reading.open(place.url) as reading:
        assert await read_policy(reading, second.policy) == (await _model_of(reading, ROUNDS)).drawing(Draws.UNCERTAIN)


async def _model_of(reading: Reading, experiment: Experiment) -> SuccessModel:
    """Return the model fitted to the first round, as it is recorded."""
    first = name_of(SuccessModel.untrained())
    frame = await read_rollouts(reading, experiment.scene, first, experiment.seed, experiment.rollouts, predicted=True)
    return SuccessModel.fit(frame, min_samples_leaf=experiment.min_samples_leaf)


@pytest.mark.slow
async def test_rollouts_whose_base_collides_count_as_failures(tmp_path: Path) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db", tmp_path / "spool")
    scene = Scene(collisions=True, table=True, disturbance=Disturbance(base_m=0.1))
    colliding = Experiment(rollouts=150, evaluate=1, held_out=1, min_samples_leaf=2, scene=scene)
    learned = await run(colliding, place)  # raises `InternalError` if a rollout is missing
    assert learned.default.tally.failures["NavigationGoalInCollision"] > 0
    assert learned.default.stages["before the pre-pose"] >= learned.default.tally.failures["NavigationGoalInCollision"]
