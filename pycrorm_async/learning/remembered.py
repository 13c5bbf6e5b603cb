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

What a memory does not know of some pick-ups is recorded with the policy (`Evaluation.unknown`) and shown on its card.

**Evaluation.** The policy is learned from all tries. For each property in which they differ, such as the seed, the
height, the object or the scene, the groups with equal values are divided into `FOLDS` parts; each part is predicted by
what is learned from the others. So the figures hold for new values of the property, and those of `random` for the old
ones.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, and_, func, inspect, null, select
from sqlalchemy.orm import aliased

from pycrorm_async import orm
from pycrorm_async.errors import CallerError, NotEnoughExperience
from pycrorm_async.events.types import LinkBoxValue
from pycrorm_async.learning.experiment import KITCHEN_TRIAL, Learned, choices_of, learned_from, rated
from pycrorm_async.learning.features import NEAR_SURFACE_M, Edge, PickUpContext, edges_around
from pycrorm_async.learning.policy_cards import BAND_M
from pycrorm_async.learning.policy_file import AnyPolicy, name_of
from pycrorm_async.learning.recorded_policy import Evaluation, HeldOut, record_policy
from pycrorm_async.learning.rollouts import with_parameters
from pycrorm_async.learning.success_model import WITHOUT_HEIGHT
from pycrorm_async.memory import Memory
from pycrorm_async.projections.derived_views import parameters_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import ObjectType, Pose

if TYPE_CHECKING:
    import pandas as pd
    from sqlalchemy.sql.selectable import NamedFromClause

FOLDS: Final = 5
"""The parts into which the groups are divided, at most; each costs a fit."""
COLUMNS: Final = "robot object arm grasp policy description scene kind".split()
"""The columns that `select_tries` takes."""
_POSE: Final = "x y z qx qy qz qw frame".split()
_PLACE: Final = [f"place_{each}" for each in _POSE]
_OWN_WORLD: Final = "BulletWorld ("
"""The begin of the description of a world of this package."""


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
    """Return the pick-ups that succeeded or failed, without those of simulated episodes and of trials in the kitchen.

    `pycrorm learn` ends with such a trial, in another world than that of its rollouts, so that the pick-ups of the
    trial would be a second kind of experience.

    A pick-up at a chosen place (`MoveAndPickUpAction`) counts from its start on, also if the robot did not reach the
    place, and the frame has the place to which the robot was sent: of this one a policy must know the success. Of any
    other pick-up it has the place where the robot stood.

    The columns are those of `MoveAndPickUp.query_with_failures` and `features.CIRCUMSTANCES`, and id, uuid (of the
    episode), object, policy, description, scene (of the rollouts, else the world in one line), seed (of the rollouts),
    kind, place_from: `choice` (recorded with its circumstances), `goal` or `stood`, and furniture: whether the surface
    below the object is known, if there is one. Raises `MissingExtra` without pandas.
    """
    import pandas as pd

    frames = [await reading.dataframe(_at_chosen_places()), await reading.dataframe(_where_the_robot_stood())]
    frame = pd.concat(each.assign(place_from=place) for each, place in zip(frames, ("goal", "stood"), strict=True))
    frame = _with_choices(frame.sort_values("id").reset_index(drop=True))
    await _add_sizes(reading, frame)
    frame = (await _with_edges(reading, frame)).drop(columns=["episode", *_PLACE])
    rollouts, world = frame["rollouts"], frame["world"].fillna("")
    simulated = rollouts.notna() | world.str.startswith(_OWN_WORLD)
    frame["kind"] = [
        f"{robot if isinstance(robot, str) else 'a robot without a name'}, "
        + (f"simulated, {conditions_of(scene)}" if is_simulated else "real")
        for robot, is_simulated, scene in zip(frame["robot"], simulated, rollouts, strict=True)
    ]
    frame["scene"] = rollouts.where(rollouts.notna(), frame["world"])
    return frame


_episode = attrgetter("process_metadata_id")


def _at_chosen_places() -> Select[Any]:
    """Select the pick-ups at chosen places, with their recorded parameters as JSON."""
    move, batch = aliased(orm.MoveAndPickUpAction, flat=True), aliased(orm.BatchRolloutAction, flat=True)
    node, stand = aliased(orm.TaskTreeNode, name="tried"), aliased(orm.Pose)
    parameters = parameters_of(cast("NamedFromClause", inspect(node).selectable)).label("parameters")
    policy = func.coalesce(move.policy, batch.policy).label("policy")  # a batch of version 0.1.0 alone names it
    return (
        _tries(move, node, stand, policy, batch.scene.label("rollouts"), batch.seed, parameters)
        .outerjoin(batch, and_(batch.id == node.parent_id, _episode(batch) == _episode(node)))
        .join(stand, and_(stand.id == move.pose_id, _episode(stand) == _episode(move)))
    )


def _where_the_robot_stood() -> Select[Any]:
    """Select the pick-ups that are no part of one at a chosen place."""
    picked, move = aliased(orm.PickUpAction, flat=True), aliased(orm.MoveAndPickUpAction, flat=True)
    node, stand = aliased(orm.TaskTreeNode), aliased(orm.Pose)
    nothing = [null().label(name) for name in ("policy", "rollouts", "seed", "parameters")]
    return (
        _tries(picked, node, stand, *nothing)
        .join(stand, and_(stand.id == node.robot_pose_id, _episode(stand) == _episode(node)))
        .outerjoin(move, and_(move.id == node.parent_id, _episode(move) == _episode(node)))
        .where(move.id.is_(None))
    )


def _tries(action: Any, node: Any, stand: Any, *columns: Any) -> Select[Any]:
    """Select the nodes of an action that succeeded or failed, with the pose of the object, and columns of `stand`."""
    taken, added, place = aliased(orm.Object), aliased(orm.Object), aliased(orm.Pose)
    poses = [
        getattr(pose, each).label(f"{name}_{each}")
        for name, pose in (("stand", stand), ("place", place))
        for each in _POSE
    ]
    return (
        select(
            node.id, _episode(node).label("episode"), orm.ProcessMetaData.uuid,
            action.arm, action.grasp, node.status, node.robot, node.torso_height,
            taken.obj_type.label("object"), orm.ProcessMetaData.description, orm.ProcessMetaData.world,
            added.description_fingerprint.label("model"), *poses, *columns,
        )
        .select_from(action)
        .join(node, and_(node.id == action.id, _episode(node) == _episode(action)))
        .join(orm.ProcessMetaData, orm.ProcessMetaData.id == _episode(node))
        .join(taken, and_(taken.id == action.object_id, _episode(taken) == _episode(action)))
        .join(place, and_(place.id == taken.pose_id, _episode(place) == _episode(taken)))
        .outerjoin(added, and_(added.id == taken.identity_id, _episode(added) == _episode(taken)))
        .where(node.status.in_([TaskStatus.SUCCEEDED, TaskStatus.FAILED]))
        .where(orm.ProcessMetaData.description.is_distinct_from(KITCHEN_TRIAL))
    )  # fmt: skip


def _with_choices(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the frame with the place in the object's frame, the height, and what the choices record."""
    dx, dy, dz = (frame[f"stand_{axis}"] - frame[f"place_{axis}"] for axis in "xyz")
    x, y, z, w = (frame[f"place_q{axis}"] for axis in "xyzw")
    frame["place_from"] = frame["place_from"].mask(
        frame["parameters"].str.contains('"relative_x":', na=False), "choice"
    )
    placed = frame.assign(
        # The rows of the transposed rotation matrix.
        object_x=(1 - 2 * (y * y + z * z)) * dx + 2 * (x * y + z * w) * dy + 2 * (x * z - y * w) * dz,
        object_y=2 * (x * y - z * w) * dx + (1 - 2 * (x * x + z * z)) * dy + 2 * (y * z + x * w) * dz,
        height=-dz - frame["torso_height"].astype(float).fillna(0.0),
        parameters=frame["parameters"].fillna("{}"),
    )[frame["stand_frame"] == frame["place_frame"]]
    return with_parameters(placed.drop(columns=[name for name in frame.columns if name.startswith("stand_")]))


async def _add_sizes(reading: Reading, frame: pd.DataFrame) -> None:
    """Add the size of objects where a try did not record it, from their descriptions."""
    unknown = frame["width"].isna() & frame["model"].notna()
    described = orm.ObjectDescription.fingerprint.in_(sorted(set(frame["model"][unknown])))
    async with reading.session() as session:
        descriptions = (await session.scalars(select(orm.ObjectDescription).where(described))).all()
    for each in descriptions:
        boxes, rows = each.declared.link_boxes, frame.index[unknown & (frame["model"] == each.fingerprint)]
        if boxes:
            center, half = (np.array([getattr(box, name) for box in boxes]) for name in ("center", "half"))
            low, high = (center - half).min(axis=0), (center + half).max(axis=0)
            x, y, z = (high - low).tolist()
            context = PickUpContext(math.nan, size=(x, y, z), origin_height=-float(low[2]))
            for name, values in context.circumstances(choices_of(frame.loc[rows])).items():
                frame.loc[rows, name] = values


async def _with_edges(reading: Reading, frame: pd.DataFrame) -> pd.DataFrame:
    """Add the edge of the surface below the object where a try did not record it, from the furniture as it was then."""
    piece, added, chosen = aliased(orm.Object), aliased(orm.Object), frame["place_from"] == "choice"
    columns = [getattr(orm.Pose, each) for each in _POSE]
    question = (
        select(_episode(piece), piece.identity_id, piece.id, added.description_fingerprint, *columns)
        .join(orm.Pose, and_(orm.Pose.id == piece.pose_id, _episode(orm.Pose) == _episode(piece)))
        .join(added, and_(added.id == piece.identity_id, _episode(added) == _episode(piece)))
        .where(piece.obj_type == ObjectType.ENVIRONMENT)
        .order_by(piece.id)
    )
    episodes: dict[int, dict[int, list[tuple[int, str, Pose]]]] = {}
    async with reading.session() as session:
        for episode, identity, number, model, *pose in await session.execute(question):
            episodes.setdefault(episode, {}).setdefault(identity, []).append((number, model, _pose(*pose)))
        models = {model for pieces in episodes.values() for [(_, model, _), *_] in pieces.values()}
        described = orm.ObjectDescription.fingerprint.in_(models)
        descriptions = (await session.scalars(select(orm.ObjectDescription).where(described))).all()
    boxes = {each.fingerprint: each.declared.link_boxes for each in descriptions}
    frame = frame.assign(furniture=chosen | frame["episode"].isin(episodes))
    tries = frame[frame["furniture"] & ~chosen & frame["origin_height"].notna()]
    edges: list[tuple[float, float]] = []
    rows = tries[["episode", "id", "origin_height", *_PLACE]].itertuples(index=False, name=None)
    for choice, (episode, node, origin_height, *pose) in zip(choices_of(tries), rows, strict=True):
        place, around = _pose(*pose), tuple[Edge, ...]()
        for history in episodes[episode].values():
            before = bisect_left(history, node, key=itemgetter(0))  # where it was when the try began
            if before and not around:
                _, model, at = history[before - 1]
                around = _edges_below(place, origin_height, at, boxes.get(model, ()))
        known = PickUpContext(math.nan, edges=around).circumstances([choice])
        edges.append((known["edge_distance"].item(), known["edge_angle"].item()))
    frame.loc[tries.index, ["edge_distance", "edge_angle"]] = np.array(edges).reshape(-1, 2)
    return frame


def _pose(x: float, y: float, z: float, qx: float, qy: float, qz: float, qw: float, frame: str) -> Pose:
    return Pose((x, y, z), (qx, qy, qz, qw), frame)


def _edges_below(place: Pose, origin_height: float, piece: Pose, boxes: Sequence[LinkBoxValue]) -> tuple[Edge, ...]:
    """Return the edges of the highest of these boxes that an object at this place stands on, in its frame."""
    x, y, z = place.relative_to(piece).position
    if place.frame != piece.frame:
        return ()
    below = [
        box
        for box in boxes
        if abs(x - box.center[0]) <= box.half[0]
        and abs(y - box.center[1]) <= box.half[1]
        and abs(z - origin_height - box.center[2] - box.half[2]) <= NEAR_SURFACE_M
    ]
    if not below:
        return ()
    top = max(below, key=lambda box: box.center[2] + box.half[2])
    low, high = (np.array(top.center) + sign * np.array(top.half) for sign in (-1, 1))
    return tuple(edges_around(x, y, low.tolist(), high.tolist(), piece.yaw - place.yaw))


def _unknown(tries: pd.DataFrame) -> tuple[str, ...]:
    """Return what the memory does not know of these tries, each as a line with the number of tries."""
    counts = {
        "the place to which the robot was sent: learned from where it stood": tries["place_from"] == "stood",
        "the size of the object": tries["width"].isna(),
        "the surface below the object": ~tries["furniture"],
        "joint limits, collisions and disturbance": tries["rollouts"].isna(),
    }
    return tuple(f"{what} ({count:,} of {len(tries):,})" for what, each in counts.items() if (count := int(each.sum())))


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
        return learned_from(rows, model, min_samples_leaf)

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
        Evaluation(tries["kind"].iloc[0], failures, tuple(held_out), coverage, unknown=_unknown(tries)),
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
        confident[part], rates = rated(fit(tries[~part]), tries[part])
        probabilities[part] = np.nan if rates is None else rates
    is_known = not np.isnan(probabilities).any()
    return HeldOut.of(name, groups, _succeeded(tries), confident, probabilities if is_known else None)


async def record_remembered(memory: Memory, learned: RememberedPolicy) -> str:
    """Record the policy with its training episodes and its evaluation, unless it is recorded; return its name."""
    name = name_of(learned.policy)
    async with memory.session() as session:
        if await session.scalar(select(orm.LearnPolicyAction.id).where(orm.LearnPolicyAction.policy == name).limit(1)):
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
