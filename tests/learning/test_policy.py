"""A policy: the places that it samples, its file, and its record in the memory."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import zlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError, ImpossibleCondition, PolicyDamaged, PolicyFileRefused
from pycrorm_async.learning import MoveAndPickUp, Scene, batch_rollout, name_of, read_policy, record_policy
from pycrorm_async.learning.experiment import Experiment, run
from pycrorm_async.learning.policy import (
    Evidence,
    Leaf,
    Linear,
    Normal,
    PickUpChoice,
    Policy,
    Rectangle,
    Region,
    default_policy,
)
from pycrorm_async.learning.policy_file import load_policy, save_policy
from pycrorm_async.learning.pool import MemoryLocation
from pycrorm_async.learning.tree import learn
from pycrorm_async.orm import (
    BatchRolloutAction,
    LearnPolicyAction,
    MoveAndPickUpAction,
    Observation,
    PickUpWithContextView,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.plan import Retry
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.world.pose import Arms, Grasp
from tests.learning.geometric_rollouts import frame_of

LEFT, RIGHT = frozenset({Arms.LEFT}), frozenset({Arms.RIGHT})
WEST = Leaf(
    0.25,
    (1.0, 0.0),
    (0.5, 0.5, 0.0, 0.0),
    Linear((-1.0, -0.8, -0.5), (0.0, 0.8, 1.0)),
    Linear((0.0, 0.5), (0.0, 1.0)),
    Linear((0.5, 0.7), (0.0, 1.0)),
)
EAST = Leaf(
    0.75,
    (0.2, 0.8),
    (0.0, 0.0, 0.0, 1.0),
    Linear((0.5, 1.0), (0.0, 1.0)),
    Linear((-0.5, 0.0, 0.5), (0.0, 0.5, 1.0)),
    Linear((0.6, 1.0), (0.0, 1.0)),
)
TWO = Policy((WEST, EAST))
NEAR = Evidence(region=Region((Rectangle(0.21, 1 / 3, -1 / 7, 1 / 7),)))


def test_probabilities_are_sums_of_products() -> None:
    assert TWO.probability(Evidence()) == 1.0
    assert TWO.probability(Evidence(arms=LEFT)) == pytest.approx(0.25 + 0.75 * 0.2)
    assert TWO.probability(Evidence(arms=LEFT, grasps=frozenset({Grasp.TOP}))) == pytest.approx(0.75 * 0.2)
    assert TWO.probability(Evidence(height=(0.6, 0.7))) == pytest.approx(0.25 * 0.5 + 0.75 * 0.25)
    both = Region((Rectangle(-0.9, -0.65, 0.0, 0.1), Rectangle(0.6, 3.0, -9.0, 9.0)))
    assert TWO.probability(Evidence(region=both)) == pytest.approx(0.25 * 0.5 * 0.2 + 0.75 * 0.8)


def test_likelihoods_are_probability_times_density() -> None:
    choices = [
        PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.9, 0.1),
        PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.6, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.TOP, 0.7, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.FRONT, 0.7, 0.1),
        PickUpChoice(Arms.BOTH, Grasp.TOP, 0.7, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.TOP, 0.4, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.TOP, math.nan, 0.1),
    ]
    expected = [0.25 * 0.5 * 4.0 * 2.0, 0.25 * 0.5 * (0.2 / 0.3) * 2.0, 0.75 * 0.8 * 2.0 * 1.0, 0.0, 0.0, 0.0, 0.0]
    assert TWO.likelihood(choices) == pytest.approx(expected)
    assert TWO.coverage(choices) == pytest.approx(3 / 7)
    assert TWO.likelihood([]).tolist() == []


def test_evidence_on_the_height_changes_the_weights_of_the_leaves() -> None:
    low, high = TWO.condition(Evidence(height=(0.5, 0.6))), TWO.condition(Evidence(height=(0.75, 0.9)))
    assert low.probability(Evidence(arms=LEFT)) == pytest.approx(1.0)
    assert high.probability(Evidence(arms=LEFT)) == pytest.approx(0.2)
    assert low.likelihood([PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.9, 0.1)]) == pytest.approx([0.5 * 4.0 * 2.0])


def test_a_conditioned_density_integrates_to_one() -> None:
    region = Region((Rectangle(-0.9, -0.6, -1.0, 0.4), Rectangle(-0.6, 0.7, 0.1, 0.4)))
    policy = TWO.condition(Evidence(arms=LEFT, region=region, height=(0.55, 0.8)))
    places = [(-1.01 + 0.02 * column, -0.51 + 0.02 * row) for column in range(100) for row in range(52)]
    total = sum(
        policy.likelihood([PickUpChoice(arm, grasp, x, y) for x, y in places]).sum() * 0.02**2
        for arm in Arms
        for grasp in Grasp
    )
    assert total == pytest.approx(1.0, rel=1e-6)


def test_conditioning_twice_is_conditioning_on_both() -> None:
    first = Evidence(arms=LEFT, region=Region((Rectangle(-0.9, 0.8, -1.0, 0.3),)), height=(0.5, 0.68))
    second = Evidence(
        grasps=frozenset({Grasp.FRONT, Grasp.TOP}),
        region=Region((Rectangle(-0.7, 0.6, 0.0, 1.0), Rectangle(0.6, 0.9, 0.0, 1.0))),
        height=(0.62, 2.0),
    )
    both = Evidence(
        arms=LEFT,
        grasps=frozenset({Grasp.FRONT, Grasp.TOP}),
        region=Region((Rectangle(-0.7, 0.6, 0.0, 0.3), Rectangle(0.6, 0.8, 0.0, 0.3))),
        height=(0.62, 0.68),
    )
    assert TWO.condition(first).condition(second) == TWO.condition(both)
    assert TWO.condition(first).probability(second) == pytest.approx(TWO.probability(both) / TWO.probability(first))


def test_contradicting_evidence_is_impossible() -> None:
    apart = [
        (Evidence(arms=LEFT), Evidence(arms=RIGHT)),
        (Evidence(height=(0.5, 0.6)), Evidence(height=(0.6, 0.7))),
        (Evidence(region=Region((Rectangle(-1, 0, 0, 1),))), Evidence(region=Region((Rectangle(0, 1, 0, 1),)))),
        (Evidence(), Evidence(arms=frozenset({Arms.BOTH}))),
        (Evidence(), Evidence(region=Region(()))),
    ]
    for first, second in apart:
        policy = TWO.condition(first)
        assert policy.probability(second) == 0.0
        with pytest.raises(ImpossibleCondition, match="gives no probability to: arms "):
            policy.condition(second)


def test_conditioned_samples_match_the_evidence_and_are_possible() -> None:
    region = Region((Rectangle(-0.9, -0.7, 0.1, 0.2), Rectangle(0.6, 0.7, -0.1, 0.0)))
    policy = TWO.condition(Evidence(region=region, grasps=frozenset({Grasp.FRONT, Grasp.TOP})))
    choices = policy.sample(np.random.default_rng(5), 20_000)
    assert (policy.likelihood(choices) > 0).all()
    west = [choice for choice in choices if choice.relative_x < 0]
    assert {choice[:2] for choice in west} == {(Arms.LEFT, Grasp.FRONT)}
    assert {choice[:2] for choice in choices if choice.relative_x > 0} == {(arm, Grasp.TOP) for arm in list(Arms)[:2]}
    masses = 0.25 * 0.5 * (0.4 + 0.2 / 3) * 0.2, 0.75 * 0.2 * 0.1
    assert len(west) / 20_000 == pytest.approx(masses[0] / sum(masses), abs=0.015)
    dense = np.mean([choice.relative_x < -0.8 for choice in west])
    assert dense == pytest.approx(0.4 / (0.4 + 0.2 / 3), abs=0.01)
    x, y = (np.array([choice[part] for choice in choices]) for part in (2, 3))
    assert region.contains(x, y).all()


def test_the_same_generator_draws_the_same_samples_in_any_batches() -> None:
    at_once = TWO.sample(np.random.default_rng(6), 50)
    one_by_one = np.random.default_rng(6)
    assert [TWO.sample(one_by_one)[0] for _ in range(50)] == at_once
    assert TWO.sample(np.random.default_rng(7), 50) != at_once
    assert TWO.sample(np.random.default_rng(6), 0) == []


@pytest.mark.parametrize("drawn", [0.0, 1 - 2**-53], ids=["least", "most"])
def test_the_least_and_the_most_likely_draws_are_possible_too(drawn: float) -> None:
    class Fixed:
        def random(self, shape: tuple[int, int]) -> np.ndarray:
            return np.full(shape, drawn)

    region = Region((Rectangle(-0.9, -0.3 + 1e-12, 0.1, 1 / 3), Rectangle(-0.3 + 1e-12, 0.7, -1.9, -0.1)))
    for policy in (TWO.condition(Evidence(region=region)), default_policy(), default_policy().condition(NEAR)):
        (choice,) = policy.sample(Fixed())  # type: ignore[arg-type]
        assert policy.coverage([choice]) == 1.0


def test_the_mode_is_the_square_with_the_highest_probability() -> None:
    mode = TWO.mode(width_m=0.1)
    # 0.25 * 0.5 * 0.4 * 0.2 in the west is less than 0.75 * 0.8 * 0.2 * 0.1 in the east
    assert mode.evidence.arms == RIGHT
    assert mode.evidence.grasps == frozenset({Grasp.TOP})
    assert mode.evidence.region is not None
    assert mode.evidence.region.rectangles[0] == pytest.approx((0.5, 0.6, -0.5, -0.4))
    west = TWO.condition(Evidence(region=Region((Rectangle(-0.85, 0.0, 0.42, 0.5),)))).mode(width_m=0.1)
    assert west.evidence.arms == LEFT
    assert west.evidence.grasps == frozenset({Grasp.FRONT, Grasp.LEFT})
    assert west.evidence.region is not None
    assert west.evidence.region.rectangles[0] == pytest.approx((-0.85, -0.75, 0.42, 0.5))


def test_a_window_holds_as_much_as_any_of_its_width_can() -> None:
    linear = WEST.x
    assert linear.peak(-5.0, 5.0, 4.0).probability == pytest.approx(1.0)
    assert linear.peak(-5.0, 5.0, 0.3) == pytest.approx((-1.0, -0.7, 0.8 + 0.2 / 3))
    assert Linear((0.0, 1.0, 1.1), (0.0, 0.1, 1.0)).peak(-5.0, 5.0, 0.3) == pytest.approx((0.8, 1.1, 0.92))
    assert linear.peak(-0.9, -0.7, 4.0) == pytest.approx((-0.9, -0.7, 0.4 + 0.2 / 3))
    assert Normal(0.3, 1.0).peak(-1.0, 1.0, 0.2)[:2] == pytest.approx((0.2, 0.4))
    assert Normal(3.0, 1.0).peak(-1.0, 1.0, 0.2)[:2] == pytest.approx((0.8, 1.0))


@pytest.mark.parametrize(
    ("rectangles", "message"),
    [
        ([Rectangle(0, 1, 0, 1), Rectangle(2, 3, 0, 1), Rectangle(0.9, 2, 0.9, 2)], "must not overlap"),
        ([Rectangle(0, 0, 0, 1)], "finite limits, the smaller first"),
        ([Rectangle(1, 0, 0, 1)], "finite limits, the smaller first"),
        ([Rectangle(0, math.inf, 0, 1)], "finite limits, the smaller first"),
        ([Rectangle(0, math.nan, 0, 1)], "finite limits, the smaller first"),
    ],
)
def test_a_region_consists_of_rectangles_that_do_not_overlap(rectangles: list[Rectangle], message: str) -> None:
    with pytest.raises(CallerError, match=message):
        Region(tuple(rectangles))


def test_the_default_policy_places_the_base_as_in_the_thesis() -> None:
    rng = np.random.default_rng(5)
    drawn = rng.normal(0, math.sqrt(0.5), (30_000, 2))
    farthest = np.abs(drawn).max(axis=1)
    expected = np.abs(drawn[(farthest >= 0.2) & (farthest <= 2)])
    choices = default_policy().sample(rng, 20_000)
    places = np.abs([(each.relative_x, each.relative_y) for each in choices])
    assert places.mean(axis=0) == pytest.approx(expected.mean(axis=0), abs=0.015)
    farthest = places.max(axis=1)
    assert (farthest.min() >= 0.2, farthest.min() < 0.21, farthest.max() <= 2, farthest.max() > 1.95) == (True,) * 4
    for kind, members in (("arm", (Arms.LEFT, Arms.RIGHT)), ("grasp", Grasp)):
        shares = [sum(getattr(each, kind) is member for each in choices) / len(choices) for member in members]
        assert shares == pytest.approx([1 / len(shares)] * len(shares), abs=0.015)


def test_invalid_evidence_is_refused() -> None:
    with pytest.raises(CallerError, match="evidence on arms must be members of Arms"):
        Evidence(arms=frozenset({Grasp.LEFT}))  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="evidence on grasps must be members of Grasp"):
        Evidence(grasps=frozenset({"LEFT"}))  # type: ignore[arg-type]
    for height in ((0.9, 0.9), (1.0, 0.9), (0.9, math.nan)):
        with pytest.raises(CallerError, match="evidence on height takes an interval"):
            Evidence(height=height)
    with pytest.raises(CallerError, match="-1 choices"):
        default_policy().sample(np.random.default_rng(1), -1)
    with pytest.raises(CallerError, match="no choices"):
        default_policy().coverage([])
    with pytest.raises(CallerError, match="width_m must be > 0, got 0"):
        default_policy().mode(width_m=0)


# === policy file ==============================================================================================

LEARNED = Policy(
    (
        Leaf(
            1 / 3, (1.0, 0.0), (0.1, 0.2, 0.7, 0.0), Linear((-1 / 3, 0.1, 1e-17 + 2), (0.0, 1 / 3, 1.0)), Normal(0, 1)
        ),
        Leaf(2 / 3, (0.3, 0.7), (1.0, 0.0, 0.0, 0.0), Normal(0.1, 0.2), Normal(0, 1), Linear((0.5, 0.9), (0.0, 1.0))),
    ),
    Evidence(
        arms=frozenset({Arms.LEFT}),
        grasps=frozenset({Grasp.TOP, Grasp.FRONT}),
        region=Region((Rectangle(-1.0, 0.1, -0.7, 1 / 7), Rectangle(0.1, 2.0, -0.7, 1 / 7))),
        height=(0.55, 0.95),
    ),
    constant_height=None,
)

ELSEWHERE = """
import sys
for name in ("jpt", "pandas", "scipy", "matplotlib"):
    sys.modules[name] = None
from pathlib import Path
import numpy as np
from pycrorm_async.learning.policy_file import load_policy
for path in sys.argv[1:]:
    policy = load_policy(Path(path))
    print(policy.likelihood(policy.sample(np.random.default_rng(8), 500)).tolist())
"""


@pytest.mark.slow
def test_a_policy_is_the_same_in_another_process_without_the_libraries_for_learning(tmp_path: Path) -> None:
    policies = {tmp_path / "default.json": default_policy(), tmp_path / "learned.json": LEARNED}
    for path, policy in policies.items():
        save_policy(policy, path)
        assert load_policy(path) == replace(policy, robot="pr2")
    here = [each.likelihood(each.sample(np.random.default_rng(8), 500)).tolist() for each in policies.values()]
    other_process = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, *policies], check=True, capture_output=True, text=True
    ).stdout
    assert [json.loads(line) for line in other_process.splitlines()] == here


def test_a_saved_policy_replaces_the_one_before_and_leaves_no_other_file(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(default_policy(), path)
    save_policy(LEARNED, path)
    assert load_policy(path) == LEARNED
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_is_json_with_enum_members_by_name(tmp_path: Path) -> None:
    save_policy(LEARNED, tmp_path / "policy.json")
    heading, content = (json.loads(line) for line in (tmp_path / "policy.json").read_text().splitlines())
    assert (heading["format"], heading["version"]) == ("pycrorm policy", 1)
    assert content["arms"] == ["LEFT", "RIGHT"]
    assert content["evidence"]["grasps"] == ["FRONT", "TOP"]
    assert content["leaves"][1]["height"] == {"type": "linear", "knots": [0.5, 0.9], "cumulative": [0.0, 1.0]}


def test_no_changed_byte_yields_another_policy(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(LEARNED, path)
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises((PolicyFileRefused, PolicyDamaged), match=f"policy {path}"):
            load_policy(path)


def test_no_cut_yields_another_policy(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(LEARNED, path)
    whole = path.read_bytes()
    for length in range(len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises((PolicyFileRefused, PolicyDamaged), match=f"policy {path}"):
            load_policy(path)
    path.write_bytes(whole[:-1])
    assert load_policy(path) == LEARNED, "the last newline says nothing"
    path.write_bytes(whole + b"more")
    with pytest.raises(PolicyDamaged, match="checksum"):
        load_policy(path)


def test_another_version_is_refused_by_its_number(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    path.write_text('{"format":"pycrorm policy","version":4,"crc32":0,"more":1}\n{"nodes":[]}\n')
    with pytest.raises(PolicyFileRefused, match="has format version 4, but this program reads 1 to 3"):
        load_policy(path)


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"PK\x03\x04", b"[1]\n", b'{"format":"else","version":1,"crc32":0}\n']
)
def test_a_file_of_another_kind_is_no_policy(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "model.bin"
    path.write_bytes(content)
    with pytest.raises(PolicyFileRefused, match="holds no policy"):
        load_policy(path)


def test_a_file_that_cannot_be_read_or_written_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(PolicyFileRefused, match=r"nothing\.json: cannot be read: No such file"):
        load_policy(tmp_path / "nothing.json")
    with pytest.raises(PolicyFileRefused, match="cannot be read: Is a directory"):
        load_policy(tmp_path)
    with pytest.raises(PolicyFileRefused, match="cannot be written: No such file"):
        save_policy(LEARNED, tmp_path / "no" / "policy.json")
    (tmp_path / "taken").mkdir()
    with pytest.raises(PolicyFileRefused, match="cannot be written: "):
        save_policy(LEARNED, tmp_path / "taken")
    with pytest.raises(PolicyFileRefused, match="cannot be written: "):
        save_policy(LEARNED, "")
    assert [each.name for each in tmp_path.iterdir()] == ["taken"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arms": ["RIGHT", "LEFT"]}, "probabilities of arms"),
        ({"leaves": []}, "weights of the leaves"),
        ({"constant_height": "high"}, "constant_height"),
        ({"more": 1}, "more"),
        ({"evidence": {"arms": ["THIRD"], "grasps": None, "region": None, "height": None}}, "THIRD"),
        ({"evidence": {"arms": [], "grasps": None, "region": None, "height": None}}, "no probability"),
        ({"evidence": {"arms": None, "grasps": None, "region": None, "height": [2, 1]}}, "interval"),
    ],
)
def test_a_crafted_file_is_checked_although_its_checksum_matches(
    change: dict[str, object], message: str, tmp_path: Path
) -> None:
    _refused(change, message, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weight": 0.5}, "weights of the leaves"),
        ({"weight": -1.0}, "weight"),
        ({"arms": [0.5, 0.6]}, "probabilities"),
        ({"arms": [1.0]}, "probabilities"),
        ({"grasps": [1.5, -0.5, 0.0, 0.0]}, "probabilities"),
        ({"x": {"type": "normal", "mean": 0.0, "sigma": 0.0}}, "sigma"),
        ({"x": {"type": "linear", "knots": [0.0, 0.0], "cumulative": [0.0, 1.0]}}, "do not rise"),
        ({"x": {"type": "linear", "knots": [0.0, 1.0, 2.0], "cumulative": [0.0, 1.1, 1.0]}}, "do not rise"),
        ({"x": {"type": "linear", "knots": [0.0, 1.0], "cumulative": [0.1, 1.0]}}, "from 0 to 1"),
        ({"x": {"type": "linear", "knots": [0.0], "cumulative": [0.0]}}, "two or more"),
        ({"x": {"type": "linear", "knots": [0.0, None], "cumulative": [0.0, 1.0]}}, "knots"),
        ({"x": {"type": "uniform"}}, "uniform"),
    ],
)
def test_a_crafted_leaf_is_checked(change: dict[str, object], message: str, tmp_path: Path) -> None:
    save_policy(default_policy(), tmp_path / "policy.json")
    leaf = json.loads((tmp_path / "policy.json").read_text().splitlines()[1])["leaves"][0]
    _refused({"leaves": [leaf | change]}, message, tmp_path)


def _refused(change: dict[str, object], message: str, tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(default_policy(), path)
    heading, content = (json.loads(line) for line in path.read_text().splitlines())
    line = json.dumps(content | change)
    path.write_text(json.dumps(heading | {"crc32": zlib.crc32(line.encode())}) + "\n" + line + "\n")
    with pytest.raises(PolicyDamaged, match=f"its checksum matches, but it holds no policy: .*{message}"):
        load_policy(path)


# === recorded policy ==========================================================================================
#
# A learned policy is in the memory with its content, its training episodes and its settings.

SMALL = Experiment(rollouts=600, evaluate=30, held_out=30, rounds=2)


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_a_recorded_policy_is_read_back_by_its_name(database_url: str, tmp_path: Path) -> None:
    policy = default_policy()
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="training") as training:
            pass
        name = await record_policy(memory, policy, episodes=[str(training)], successes=7, min_samples_leaf=3)
        await memory.flush()
        read = await read_policy(memory.reading, name)
        async with memory.session() as session:
            (learned,) = (await session.scalars(select(LearnPolicyAction))).all()
    assert isinstance(read, Policy)
    assert name == name_of(policy) == name_of(read) == learned.policy
    assert read.sample(np.random.default_rng(1), 5) == policy.sample(np.random.default_rng(1), 5)
    assert (learned.successes, learned.min_samples_leaf, learned.rollouts, learned.scene) == (7, 3, None, None)
    assert (learned.training_episodes, learned.episode_count, learned.seeds) == ([str(training)], 1, [])


OTHER = replace(default_policy(), constant_height=0.25, robot="pr2")
"""A policy whose name is not that of the default one."""


async def test_the_policy_of_rollouts_is_read_back_after_its_file_was_overwritten(
    database_url: str, tmp_path: Path
) -> None:
    file = tmp_path / "policy.json"
    save_policy(OTHER, file)
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        with Scene().entered() as stage:
            for seed in (1, 2):
                action = MoveAndPickUp(stage.target, policy=load_policy(file))
                await batch_rollout(action, 2, seed=seed, reset=stage.reset)
        save_policy(default_policy(), file)
        await memory.flush()
        async with memory.session() as session:
            batches = (await session.scalars(select(BatchRolloutAction))).all()
            chosen = set(await session.scalars(select(MoveAndPickUpAction.policy)))
            contents = await session.scalar(select(func.count(Observation.id)))
            picked = (await session.scalars(select(PickUpWithContextView.policy))).all()
        read = await read_policy(memory.reading, batches[0].policy)
    assert [each.policy for each in batches] == [name_of(OTHER)] * 2
    assert (chosen, read, contents) == ({name_of(OTHER)}, OTHER, 1)
    assert picked == [name_of(OTHER)] * 4


@pytest.mark.parametrize(("robot", "version", "read"), [(None, 1, "pr2"), ("pr2", 1, "pr2"), ("courier", 3, "courier")])
def test_a_tree_of_places_is_read_back_for_the_robot_it_was_learned_for(
    tmp_path: Path, robot: str | None, version: int, read: str
) -> None:
    save_policy(replace(OTHER, robot=robot), tmp_path / "policy.json")
    assert f'"version":{version},' in (tmp_path / "policy.json").read_text()
    assert load_policy(tmp_path / "policy.json") == replace(OTHER, robot=read)


async def test_rollouts_with_one_arm_keep_the_name_of_the_policy_as_it_was_passed(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'm.db'}") as memory:
        with Scene().entered() as stage:
            action = MoveAndPickUp(stage.target, [Arms.LEFT], policy=OTHER)
            await batch_rollout(action, 2, seed=1, reset=stage.reset)
        await memory.flush()
        async with memory.session() as session:
            batch = (await session.scalars(select(BatchRolloutAction))).one()
            tries = (await session.scalars(select(MoveAndPickUpAction))).all()
            assert (batch.policy, batch.arms, batch.grasps) == (name_of(OTHER), ["LEFT"], [])
            assert {(each.policy, each.arm) for each in tries} == {(name_of(OTHER), Arms.LEFT)}
        assert await read_policy(memory.reading, batch.policy) == OTHER


async def test_each_try_of_a_retried_pick_up_names_its_policy_and_the_memory_holds_it(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'm.db'}") as memory:
        with Scene().entered() as stage:
            action = MoveAndPickUp(stage.target, policy=OTHER, rng=np.random.default_rng(1))
            with suppress(PlanFailure):
                await Retry(action, max_tries=2).perform()
        await memory.flush()
        async with memory.session() as session:
            tries = (await session.scalars(select(MoveAndPickUpAction))).all()
            assert {each.policy for each in tries} == {name_of(OTHER)}
            kept = (await session.scalars(select(Observation))).one()
            node = await session.get_one(TaskTreeNode, kept.node_id)
            assert node.dtype == "Retry"
        assert await read_policy(memory.reading, tries[0].policy or "") == OTHER


@pytest.mark.soak_on("postgresql")
async def test_a_policy_that_is_not_recorded_is_named(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        with pytest.raises(CallerError, match="the memory holds no policy '0123456789ab'"):
            await read_policy(memory.reading, "0123456789ab")


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_the_rollouts_of_an_experiment_lead_to_their_policy_and_its_training_episodes(
    database_url: str, tmp_path: Path
) -> None:
    place = MemoryLocation(database_url, tmp_path / "spool")
    learned = await run(SMALL, place)
    assert isinstance(learned.policy, Policy)
    save_policy(default_policy(), tmp_path / "policy.json")  # what the file holds does not matter
    async with Reading.open(place.url) as reading:
        evaluation = learned.evaluation
        assert name_of(await read_policy(reading, evaluation.policy)) == name_of(learned.policy) == evaluation.policy
        async with reading.session() as session:
            first, last = (await session.scalars(select(LearnPolicyAction).order_by(LearnPolicyAction.id))).all()
            batches = (await session.scalars(select(BatchRolloutAction))).all()
            uuids = {each.id: each.uuid for each in await session.scalars(select(ProcessMetaData))}
    assert (first.policy, last.policy) == (learned.phases[1].policy, evaluation.policy)
    assert (first.rollouts, last.rollouts, first.seeds, last.seeds) == (600, 1_200, [69], [69, 70])
    assert last.successes == len(learned.successes)
    assert learn(frame_of(learned.successes), min_samples_leaf=25).leaves == learned.policy.leaves  # of both rounds
    assert (last.min_samples_leaf, last.scene) == (25, str(SMALL.scene))
    for each, seeds in ((first, {69}), (last, {69, 70})):
        training = {uuids[batch.process_metadata_id] for batch in batches if batch.seed in seeds}
        assert training == set(each.training_episodes)
        assert each.episode_count == len(training) > 1
    again = await run(Experiment(**{**vars(SMALL), "resume": True}), place)
    assert again.policy == learned.policy
    async with Reading.open(place.url) as reading, reading.session() as session:
        assert len((await session.scalars(select(LearnPolicyAction))).all()) == 2
