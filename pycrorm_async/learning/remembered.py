"""Learn from all pick-ups that a memory holds of one kind, of real robots too: `pycrorm learn --from-memory`.

>>> tries = select_tries(await read_tries(memory.reading), {"robot": "pr2", "object": "MILK"})
>>> learned = learn_remembered(tries)
>>> await record_remembered(memory, learned)

Experience of unlike kinds must not be mixed: a place from which a robot with wide joint limits, or without furniture,
picks an object up may be out of reach, or occupied, for another. The kind of a pick-up is:

| part | read from |
|---|---|
| the robot | its name at the node |
| `simulated` or `real` | `simulated` in rollouts and in worlds of this package, `real` if another executive recorded |
| limits, collisions, furniture, disturbance | the scene of the rollouts; `outside of rollouts` where there is none |

**Evaluation.** The policy is learned from all tries. For each property in which they differ, such as the seed, the
height, the object or the scene, the groups with equal values are divided into `FOLDS` parts; each part is predicted by
what is learned from the others. So the figures hold for new values of the property, and those of `random` for the old
ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, and_, select
from sqlalchemy.orm import aliased

from pycrorm_async.errors import CallerError, NotEnoughExperience
from pycrorm_async.learning.experiment import Learned, choices_of
from pycrorm_async.learning.features import features_of_frame
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.policy import Floats, Policy
from pycrorm_async.learning.policy_cards import BAND_M
from pycrorm_async.learning.policy_file import AnyPolicy, name_of
from pycrorm_async.learning.recorded_policy import CalibrationBin, Evaluation, HeldOut, record_policy
from pycrorm_async.learning.success_model import CONFIDENT, WITHOUT_HEIGHT, SuccessModel
from pycrorm_async.learning.tree import learn, learn_polar
from pycrorm_async.memory import Memory
from pycrorm_async.orm import (
    BatchRolloutAction,
    LearnPolicyAction,
    PickUpWithContextView,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    import pandas as pd

FOLDS: Final = 5
"""The parts into which the groups are divided, at most; each costs a fit."""
COLUMNS: Final = "robot object arm grasp policy description scene kind".split()
"""The columns that `select_tries` takes."""
_OWN_WORLD: Final = "BulletWorld ("
"""The begin of the description of a world of this package."""
_BINS: Final = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


@dataclass(frozen=True)
class RememberedPolicy:
    """A policy that was learned from remembered pick-ups, with its origin and its evaluation."""

    policy: AnyPolicy
    episodes: tuple[str, ...]
    successes: int
    min_samples_leaf: int
    seeds: tuple[int, ...]
    evaluation: Evaluation


# === tries ====================================================================================================


async def read_tries(reading: Reading) -> pd.DataFrame:
    """Return the pick-ups that succeeded or failed, without those of simulated episodes.

    The columns are those of `MoveAndPickUp.query_with_failures`, and id, uuid (of the episode), object, policy,
    description, scene (of the rollouts, else the world in one line), seed (of the rollouts) and kind. Raises
    `MissingExtra` without pandas.
    """
    frame = await reading.dataframe(_tries())
    rollouts, world = frame["rollouts"], frame["world"].fillna("")
    simulated = rollouts.notna() | world.str.startswith(_OWN_WORLD)
    frame["kind"] = [
        f"{robot if isinstance(robot, str) else 'a robot without a name'}, "
        + (f"simulated, {conditions_of(scene)}" if is_simulated else "real")
        for robot, is_simulated, scene in zip(frame["robot"], simulated, rollouts, strict=True)
    ]
    frame["scene"] = rollouts.where(rollouts.notna(), frame["world"])
    return frame


def _tries() -> Select[Any]:
    view, episode = PickUpWithContextView, attrgetter("process_metadata_id")
    picked, tried = aliased(TaskTreeNode), aliased(TaskTreeNode)
    batch = aliased(BatchRolloutAction, flat=True)
    return (
        MoveAndPickUp.query_with_failures()
        .add_columns(
            view.id,
            ProcessMetaData.uuid,
            view.obj_type.label("object"),
            view.policy,
            view.description,
            view.scene.label("world"),
            batch.scene.label("rollouts"),
            batch.seed,
        )
        .join(ProcessMetaData, ProcessMetaData.id == episode(view))
        .join(picked, and_(picked.id == view.id, episode(picked) == episode(view)))
        .outerjoin(tried, and_(tried.id == picked.parent_id, episode(tried) == episode(picked)))
        .outerjoin(batch, and_(batch.id == tried.parent_id, episode(batch) == episode(tried)))
        .order_by(view.id)
    )


def conditions_of(scene: object) -> str:
    """Return the part of a scene's description in which experience of one kind agrees.

    >>> conditions_of("milk at 1.3, 1, 0.9 m, torso at 0 m, soft limits, collisions count")
    'soft limits, collisions count'
    """
    if not isinstance(scene, str):
        return "outside of rollouts"
    parts = scene.split(", ")
    number = next((number for number, part in enumerate(parts) if part.endswith(" limits")), 0)
    return ", ".join(parts[number:]) or "rollouts in no named scene"


def select_tries(tries: pd.DataFrame, where: Mapping[str, str]) -> pd.DataFrame:
    """Return the tries with these values, which are of one kind.

    Args:
        tries: from `read_tries`.
        where: values by column, of `COLUMNS`.

    Raises:
        CallerError: for another column, and for tries of several kinds, which it lists.
        NotEnoughExperience: no try has these values.
    """
    for column, value in where.items():
        if column not in COLUMNS:
            known = nearest(column, COLUMNS) or f"; there are {', '.join(COLUMNS)}"
            raise CallerError(f"pick-ups have no column {column!r} to choose by{known}")
        tries = tries[tries[column] == value]
    chosen = "".join(f", with {column} {value}" for column, value in where.items())
    if tries.empty:
        raise NotEnoughExperience(f"no pick-up is remembered that succeeded or failed{chosen}: record some first")
    counts, successes = Counter(tries["kind"]), Counter(tries["kind"][_succeeded(tries)])
    if len(counts) > 1:
        kinds = counts.most_common()
        listed = "; ".join(f"{kind!r} ({successes[kind]:,} of {count:,} succeeded)" for kind, count in kinds)
        raise CallerError(
            f"{len(counts)} kinds of pick-ups are remembered{chosen}, but a policy is learned from one kind: {listed};"
            f" choose one by --where {'kind=' + kinds[0][0]!r} (where=)"
        )
    return tries


# === learning =================================================================================================


def learn_remembered(
    tries: pd.DataFrame,
    model: Learned = Learned.SUCCESS,
    *,
    min_samples_leaf: int = 10,
    report_progress: Callable[[int, int, str], None] = lambda *_: None,
) -> RememberedPolicy:
    """Learn from these tries, and evaluate on those of them that are held out in turn.

    Args:
        tries: of one kind, from `select_tries`.
        model: what is learned: a success model from successes and failures, or a tree from the successes alone.
        min_samples_leaf: minimum number of rows in a leaf.
        report_progress: called with the number of fits, those in total, and what is fitted.

    Raises `NotEnoughExperience`, `MissingExtra` and `CallerError`, as `SuccessModel.fit`, `learn` and `learn_polar`.
    """

    def fit(rows: pd.DataFrame) -> AnyPolicy:
        match model:
            case Learned.SUCCESS:
                return SuccessModel.fit(rows, min_samples_leaf=min_samples_leaf)
            case Learned.PLACES:
                return learn(rows[_succeeded(rows)], min_samples_leaf=min_samples_leaf)
            case Learned.POLAR:
                return learn_polar(rows[_succeeded(rows)], min_samples_leaf=min_samples_leaf)

    with_height = tries.dropna(subset=["height"]).reset_index(drop=True)
    if with_height.empty:
        raise NotEnoughExperience(f"all {len(tries):,} pick-ups {WITHOUT_HEIGHT}")
    tries = with_height
    policy, groups = fit(tries), [*_groups(tries)]
    total, held_out = 1 + sum(folds.max() + 1 for _, _, folds in groups), []
    done = 1
    for name, count, folds in groups:
        report_progress(done, total, f"held out by {name}")
        with suppress(NotEnoughExperience):  # without one of the parts too few tries are left
            held_out.append(_held_out(name, count, tries, folds, fit))
        done += folds.max() + 1
    report_progress(total, total, "done")
    successes = int(_succeeded(tries).sum())
    failures = len(tries) - successes if model is Learned.SUCCESS else None
    coverage = next((each.coverage for each in held_out if each.by == "random"), None)
    return RememberedPolicy(
        policy,
        tuple(dict.fromkeys(tries["uuid"])),
        successes,
        min_samples_leaf,
        tuple(sorted({int(seed) for seed in tries["seed"].dropna()})),
        Evaluation(tries["kind"].iloc[0], failures, tuple(held_out), coverage),
    )


def _succeeded(tries: pd.DataFrame) -> NDArray[np.bool_]:
    return np.asarray(tries["status"] == TaskStatus.SUCCEEDED.value)


def _groups(tries: pd.DataFrame) -> Iterator[tuple[str, int, NDArray[np.int64]]]:
    """Yield the properties in which the tries differ, each with the number of values and the fold of each try."""
    yield "random", len(tries), np.random.default_rng(0).permutation(len(tries)) % FOLDS
    heights = tries["height"] + tries["torso_height"].fillna(0.0)
    bands = np.floor(heights / BAND_M + 1e-6)
    columns = {"seed": tries["seed"], "height": bands, "object": tries["object"], "scene": tries["scene"]}
    for name, values in columns.items():
        known = sorted(set(values.dropna()))
        if len(known) > 1:
            numbers = {value: number for number, value in enumerate(known)}
            yield name, len(known), np.array([numbers.get(value, 0) % FOLDS for value in values], dtype=np.int64)


def _held_out(
    name: str,
    groups: int,
    tries: pd.DataFrame,
    folds: NDArray[np.int64],
    fit: Callable[[pd.DataFrame], AnyPolicy],
) -> HeldOut:
    """Predict each fold by what is learned from the others. Raises `NotEnoughExperience`."""
    probabilities, confident = np.full(len(tries), np.nan), np.zeros(len(tries), np.bool_)
    for fold in range(folds.max() + 1):
        part = folds == fold
        policy = fit(tries[~part])
        if isinstance(policy, SuccessModel):
            probabilities[part] = policy.probability_in(tries[part])
            confident[part] = probabilities[part] >= CONFIDENT
        elif isinstance(policy, Policy):
            confident[part] = policy.likelihood(choices_of(tries[part])) > 0
        else:
            confident[part] = policy.density_of(features_of_frame(tries[part])) > 0
    succeeded = _succeeded(tries)
    figures = len(tries), int(succeeded.sum()), int(confident.sum()), int((confident & succeeded).sum())
    if np.isnan(probabilities).any():
        return HeldOut(name, groups, *figures)
    brier = float(np.square(probabilities - succeeded).mean())
    return HeldOut(name, groups, *figures, brier, tuple(_calibration(probabilities, succeeded)))


def _calibration(probabilities: Floats, succeeded: NDArray[np.bool_]) -> Iterator[CalibrationBin]:
    numbers = np.clip(np.searchsorted(_BINS, probabilities, side="right") - 1, 0, len(_BINS) - 2)
    for number, (low, high) in enumerate(pairwise(_BINS)):
        part = numbers == number
        if part.any():
            mean = float(probabilities[part].mean())
            yield CalibrationBin(low, high, mean, int(part.sum()), int(succeeded[part].sum()))


async def record_remembered(memory: Memory, learned: RememberedPolicy) -> str:
    """Record the policy with its training episodes and its evaluation, unless it is recorded; return its name."""
    name = name_of(learned.policy)
    async with memory.session() as session:
        if await session.scalar(select(LearnPolicyAction.id).where(LearnPolicyAction.policy == name).limit(1)):
            return name
    async with memory.episode(description=f"policy {name} learned from memory", plan="learn"):
        await record_policy(
            memory,
            learned.policy,
            episodes=learned.episodes,
            successes=learned.successes,
            min_samples_leaf=learned.min_samples_leaf,
            seeds=learned.seeds,
            evaluation=learned.evaluation,
        )
    await memory.flush()
    return name
