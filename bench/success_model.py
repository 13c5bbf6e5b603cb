"""Measure how few rollouts a success model and a polar tree need, over all heights of an object in the air.

    python -m bench.success_model            three seeds in as many processes; five minutes of processor time
    python -m bench.success_model --quick    one seed, fewer rollouts: seconds

The milk is at 0.6 to 1.2 m, and the torso is at any height: 20 % of the random ways succeed. A rollout is the geometry
and inverse kinematics of one in `Scene(heights=(0.6, 1.2), turned=True)`, without a world or a memory; `pycrorm learn
--model success --heights 0.6 1.2` performs and records such rollouts.

*rate*: the share of rollouts that succeed under the learned policy, each with its own height: a success model picks any
of 100 random ways of which it is confident (P >= 0.85), a tree draws a sample. *worst*: the least rate of six bands of
height, 10 cm each. *coverage*: the share of held-out random successes of which the model is confident, or that the tree
can draw. *best*: the rate of the likeliest of 100. *not inside*: learned without heights of 0.8 to 1.0 m, and tried at
these; *not at the edge*: without 1.05 to 1.2 m. Rounds try where the model is uncertain, four of equal length.

The script prints one JSON line; the table is on stderr.
"""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from rich.progress import track
from rich.table import Table

from bench.material.runs import options
from bench.reporting.figures import console
from pycrorm_async.learning import Draws, PickUpChoice, PickUpContext, PolarPolicy, SuccessModel, default_policy
from pycrorm_async.learning.tree import learn_polar
from pycrorm_async.query.success import interval_95
from pycrorm_async.world import Pose
from tests.learning.geometric_rollouts import succeeds

TORSO_M = (0.0, 0.33)
HEIGHTS_M = (0.6, 1.2)
PROPOSALS = 100
BANDS = 6
ROUNDS = 4


class Case(NamedTuple):
    """One row of the table: what is learned, from how many rollouts, without heights between `unseen`."""

    name: str
    rollouts: int
    tree: bool = False
    unseen: tuple[float, float] | None = None


CASES = (
    Case("success model", 3_000),
    Case("success model", 10_000),
    Case("polar tree", 20_000, tree=True),
    Case("not inside", 3_000, unseen=(0.8, 1.0)),
    Case("not at the edge", 3_000, unseen=(1.05, 1.2)),
)


class Figures(NamedTuple):
    """The results of a case and a seed."""

    successes: int
    rollouts: int
    worst: float
    coverage: float
    best: float


def proposals(rng: np.random.Generator, count: int) -> list[PickUpChoice]:
    """Return random ways, each with a random torso."""
    torsos = rng.uniform(*TORSO_M, count).tolist()
    ways = default_policy().sample(rng, count)
    return [each._replace(torso=torso) for each, torso in zip(ways, torsos, strict=True)]


def context(height: float) -> PickUpContext:
    return PickUpContext(height, torso_limits=TORSO_M)


def performed(ways: list[PickUpChoice], heights: list[float]) -> pd.DataFrame:
    """Perform the ways, each with the milk at its height, and return them as a memory's frame."""
    rows = [
        (way.arm.name, way.grasp.name, way.relative_x, way.relative_y, height - (way.torso or 0.0), way.torso)
        for way, height in zip(ways, heights, strict=True)
    ]
    frame = pd.DataFrame(rows, columns=["arm", "grasp", "object_x", "object_y", "height", "torso_height"])
    done = [succeeds(way, Pose((1.3, 1.0, height))) for way, height in zip(ways, heights, strict=True)]
    return frame.assign(status=np.where(done, "SUCCEEDED", "FAILED"))


def heights_of(rng: np.random.Generator, count: int, unseen: tuple[float, float] | None) -> list[float]:
    """Draw heights outside `unseen`."""
    drawn = rng.uniform(*HEIGHTS_M, 3 * count)
    low, high = unseen or (np.inf, np.inf)
    return [float(each) for each in drawn[(drawn < low) | (drawn > high)][:count]]


def learned(case: Case, rng: np.random.Generator) -> SuccessModel | PolarPolicy:
    if case.tree:
        frame = performed(proposals(rng, case.rollouts), heights_of(rng, case.rollouts, case.unseen))
        return learn_polar(frame[frame.status == "SUCCEEDED"])
    model, frames = SuccessModel.untrained(), []
    for number in range(ROUNDS):
        draws = Draws.UNCERTAIN if number else Draws.RANDOM
        heights = heights_of(rng, case.rollouts // ROUNDS, case.unseen)
        explorer = model.drawing(draws)
        count = PROPOSALS if draws is not Draws.RANDOM else 1
        ways = [explorer.draw(rng, proposals(rng, count), context(height)) for height in heights]
        frames.append(performed(ways, heights))
        model = SuccessModel.fit(pd.concat(frames))
    return model


def measured(case: Case, seed: int, tries: int, held_out: int) -> Figures:
    rng = np.random.default_rng((seed, case.rollouts, len(case.name)))
    policy = learned(case, rng)
    low, high = case.unseen or HEIGHTS_M
    heights = rng.uniform(low, high, tries).tolist()
    rate = policy.probability if isinstance(policy, SuccessModel) else policy.likelihood
    drawn: list[PickUpChoice] = []
    best: list[PickUpChoice] = []
    for height in heights:
        if isinstance(policy, SuccessModel):
            ways = proposals(rng, PROPOSALS)
            drawn.append(policy.draw(rng, ways, context(height)))
        else:
            ways = policy.sample(rng, PROPOSALS if len(best) < tries // 4 else 1, context(height))
            drawn.append(ways[0])
        if len(best) < tries // 4:
            best.append(ways[int(rate(ways, context(height)).argmax())])
    done = (performed(drawn, heights).status == "SUCCEEDED").to_numpy()
    band = ((np.array(heights) - low) / (high - low) * BANDS).astype(int)
    random = performed(proposals(rng, held_out), rng.uniform(low, high, held_out).tolist())
    return Figures(
        int(done.sum()),
        tries,
        min(float(done[band == each].mean()) for each in range(BANDS)),
        policy.coverage(random[random.status == "SUCCEEDED"]),
        float((performed(best, heights[: len(best)]).status == "SUCCEEDED").mean()),
    )


def measure(cases: tuple[Case, ...], seeds: int, tries: int, held_out: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for case in cases:
        title = f"{case.name}, {case.rollouts}"
        with ProcessPoolExecutor(seeds, get_context("spawn")) as processes:
            running = processes.map(
                measured, *zip(*((case, seed, tries, held_out) for seed in range(seeds)), strict=True)
            )
            each = list(track(running, title, total=seeds, console=console()))
        successes, total = sum(one.successes for one in each), sum(one.rollouts for one in each)
        rows.append(
            {
                "learned": case.name,
                "rollouts": case.rollouts,
                "rate": round(successes / total, 4),
                "interval": [round(limit, 4) for limit in interval_95(successes, total)],
                "seeds": [round(one.successes / one.rollouts, 4) for one in each],
                "worst": [round(one.worst, 3) for one in each],
                "coverage": [round(one.coverage, 3) for one in each],
                "best": [round(one.best, 4) for one in each],
            }
        )
        console().print(rows[-1])
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    table = Table("learned", "rollouts", "rate", "95 %", "seeds", "worst band", "coverage", "best of 100")
    for row in rows:
        low, high = row["interval"]
        spread = [" ".join(f"{share:.1%}" for share in row[name]) for name in ("seeds", "worst", "coverage", "best")]
        table.add_row(row["learned"], f"{row['rollouts']:,}", f"{row['rate']:.1%}", f"{low:.1%}-{high:.1%}", *spread)
    console().print(table)


def main() -> None:
    parser = options(__doc__, quick="one seed, fewer rollouts")
    quick = parser.parse_args().quick
    cases = tuple(each._replace(rollouts=each.rollouts // 3) for each in CASES[2:]) if quick else CASES
    rows = measure(cases, 1 if quick else 3, 200 if quick else 1_000, 500 if quick else 2_000)
    show(rows)
    print(json.dumps({"bench": "success_model", "cases": rows}))


if __name__ == "__main__":
    main()
