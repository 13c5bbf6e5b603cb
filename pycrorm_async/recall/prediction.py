"""Predict how likely an action is to succeed, from the remembered tries most like it.

>>> prediction = await memory.predict(PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]))
>>> prediction.chance, (prediction.low, prediction.high), prediction.reason, prediction.cases
(0.82, (0.61, 0.93), 'IKError', (8594230336, 8594229568))

A *try* is a case of the same type that succeeded or failed, with the same words: enum members, texts and booleans
among the parameters, the type of the object, the robot. Each try counts by its likeness w to the action as it would
begin now, 1 where all numbers are equal, exp(-1/2) where one of them is off by its tolerance:

    w = exp(-1/2 * sum of (difference / tolerance)^2)
    chance = (sum of w of the successes + prior) / (sum of w of all tries + 1)

The tolerance is `NEAR_M` for lengths and 0.5 rad for angles, and the standard deviation among the tries for other
numbers. Heights are compared over the torso, because the reach of an arm depends on these. The prior, (successes + 1) /
(tries + 2) among all tries with such objects, counts as one try. These are the score and the prior of
`recall.experience`, for every type of action. The interval is Wilson's for the sum of w of all tries, so that a try
that is less alike counts less; with less than `EVIDENCE_MIN` it is 0 to 1, because nothing is known.

Tries in rollouts whose scene names other joint limits or errors of the robot, or where furniture or collisions count
differently than at present, do not count (`Conditions`). Of other tries this is not known, so all of them count.

Where a success model has ranked the action (`MoveAndPickUp(policy=model)`), its prediction takes the place of the
prior, and the interval counts it as one try, so that it decides where little is remembered.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DesignatorTypeDeclared, ObjectAdded, ObjectReference, RobotValue
from pycrorm_async.plan.actions import MoveAndPickUpPerformable, PickUpActionPerformable
from pycrorm_async.plan.advice import Chance
from pycrorm_async.plan.failures import RefusedByPrediction, describe_error
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.locations import face
from pycrorm_async.plan.motions import innermost_choice
from pycrorm_async.plan.objects import ObjectDesignator, pose_of
from pycrorm_async.query.replay import ReplayedWorld, WorldObject
from pycrorm_async.query.success import interval_95
from pycrorm_async.recall import cases as case_rows
from pycrorm_async.recall.blocks import NEAR_M, CaseLibrary, Group
from pycrorm_async.recall.columns import is_angle
from pycrorm_async.recall.search import Wanted, dtype_of, never_seen
from pycrorm_async.record.plan_types import built_in_declaration, declared_type
from pycrorm_async.record.values import Field, pose_value, read_parameters
from pycrorm_async.world.bullet import BulletWorld, Object, current_world
from pycrorm_async.world.pose import ObjectType, Pose
from pycrorm_async.world.world_copy import acting_robot

EVIDENCE_MIN: Final = 0.5
"""The least sum of w with which something is known: that of one try 12 cm off."""
TRIES_MAX: Final = 20_000
"""Bounds the tries with the same words that are compared; the latest are taken."""
_CASES_MAX: Final = 20
"""Bounds the cases that a prediction names."""
_LIKE_MIN: Final = 0.1
"""The least w of a case that a prediction names: that of a try 21 cm off."""
_UNKNOWN: Final = (0.0, 1.0)
_NOT_COMPARED: Final = frozenset("object_name near held inside after after_status".split())
_PLACE: Final = ("stand_x", "stand_y", "stand_yaw", "height", "object_z")


@dataclass(frozen=True, slots=True)
class Prediction:
    """The predicted outcome of an action.

    Attributes:
        chance: of success, 0 to 1.
        low, high: the 95 % interval of the share of successes among actions like this one; 0 and 1 if nothing is known.
        tries: the number of remembered tries that it rests on, each counted by its likeness, 0 to 1.
        cases: ids of the task-tree nodes of the tries most like it, the likest first.
        reason: the failure that is most likely if it fails; None if no try like it failed.
        source: `recall`, or the name of the model whose prediction counts as one try.
        note: about a type of which no case is remembered, with those like it; None for another.
    """

    chance: float
    low: float
    high: float
    tries: float
    cases: tuple[int, ...]
    reason: str | None
    source: str = "recall"
    note: str | None = None

    @property
    def is_known(self) -> bool:
        """False if no remembered try is enough like the action: then the interval is from 0 to 1."""
        return (self.low, self.high) != _UNKNOWN

    def __str__(self) -> str:
        """Return it as `82 % (61-93 %) from 14.2 tries like it; if it fails, most likely by IKError`."""
        if not self.is_known:
            return f"not known: {self.note or f'{self.tries:.1f} tries like it are not enough'}"
        interval = f"{100 * self.chance:.0f} % ({100 * self.low:.0f}-{100 * self.high:.0f} %)"
        fails = f"; if it fails, most likely by {self.reason}" if self.reason else ""
        model = "" if self.source == "recall" else f" and the model {self.source}"
        return f"{interval} from {self.tries:.1f} tries like it{model}{fails}"


class Situation(NamedTuple):
    """What is compared with past tries.

    Attributes:
        type: dtype of the action.
        words: the words that a try must have, by feature.
        numbers: each with its tolerance; None means the standard deviation among the tries.
        over_torso: features among `numbers` from which the height of the torso is subtracted.
        expected, model: the chance that a model has predicted, and its name; None without a model.
    """

    type: str
    words: Mapping[str, str]
    numbers: Sequence[Wanted]
    over_torso: frozenset[str] = frozenset()
    expected: float | None = None
    model: str | None = None


def predict(
    library: CaseLibrary, situations: Iterable[Situation], left_out: Sequence[tuple[int, int]] = ()
) -> list[Prediction]:
    """Predict the outcome of an action in each of these situations.

    Tries whose node id is in a range of `left_out`, from its first id up to before its end, do not count.
    """
    bounds = np.sort(np.array(left_out, np.int64).reshape(-1, 2), axis=0)
    tries: dict[tuple[str, frozenset[tuple[str, str]]], _Tries] = {}
    predictions = []
    for each in situations:
        key = each.type, frozenset(each.words.items())
        if key not in tries:
            tries[key] = _Tries.of(library, each.type, each.words, bounds)
        predictions.append(tries[key].prediction(each, library))
    return predictions


class _Tries:
    """The latest tries of a type with the same words, as arrays."""

    def __init__(self, groups: Sequence[Group], successes: int, count: int) -> None:
        """Take the tries, and the numbers of successes and of all tries with such objects."""
        self._tries = Group.joined(groups) if groups else None
        if self._tries is not None and len(self._tries) > TRIES_MAX:
            self._tries = self._tries.taken(np.arange(TRIES_MAX))
        self._prior = (successes + 1) / (count + 2)

    @classmethod
    def of(cls, library: CaseLibrary, type_: str, words: Mapping[str, str], bounds: NDArray[np.int64]) -> _Tries:
        chosen, successes, count = [], 0, 0
        of_object = {name: words[name] for name in ("object_type", "robot") if name in words}
        for group in library.groups(type_):
            ended = _ended(group) & ~_within(bounds, group.nodes)
            like = ended & _having(group, of_object)
            successes += int((like & group.having("status", "SUCCEEDED")).sum())
            count += int(like.sum())
            rows = np.flatnonzero(like & _having(group, words))[:TRIES_MAX]
            if rows.size:
                chosen.append(group.taken(rows))
        return cls(chosen, successes, count)

    def prediction(self, situation: Situation, library: CaseLibrary) -> Prediction:
        tries, prior, expected = self._tries, self._prior, situation.expected
        evidence, successes, cases, reason = 0.0, 0.0, (), None
        if tries is not None:
            likeness = np.exp(-_distance(tries, situation, library) / 2)
            succeeded = tries.having("status", "SUCCEEDED")
            evidence, successes = float(likeness.sum()), float(likeness[succeeded].sum())
            order = np.argsort(-likeness, kind="stable")[:_CASES_MAX]
            cases, reason = tuple(tries.nodes[order[likeness[order] >= _LIKE_MIN]].tolist()), _reason(tries, likeness)
        prior, of_model = (prior, 0) if expected is None else (expected, 1)
        chance, count = (successes + prior) / (evidence + 1), evidence + of_model
        low, high = interval_95(successes + of_model * prior, count) if count >= EVIDENCE_MIN else _UNKNOWN
        source = (situation.model or "a model") if of_model else "recall"
        note = None if library.size(situation.type) else never_seen(situation.type, library)
        return Prediction(chance, min(low, chance), max(high, chance), evidence, cases, reason, source, note)


def _within(bounds: NDArray[np.int64], nodes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which nodes are in a range: there more of the sorted first ids have come than ends, shape (ranges, 2)."""
    begun, ended = (np.searchsorted(each, nodes, side="right") for each in bounds.T)
    return np.asarray(begun > ended)


def _ended(group: Group) -> NDArray[np.bool_]:
    """Return a mask of the tries: what succeeded or failed, outside of simulations, and was not refused."""
    ended = group.having("status", "SUCCEEDED") | group.having("status", "FAILED")
    # What a prediction refused was not tried.
    return np.asarray(ended & group.performed & ~group.having("reason", RefusedByPrediction.__name__))


def _having(group: Group, words: Mapping[str, str]) -> NDArray[np.bool_]:
    mask = np.ones(len(group), np.bool_)
    for feature, word in words.items():
        mask &= group.having(feature, word)
    return mask


def _distance(tries: Group, situation: Situation, library: CaseLibrary) -> NDArray[np.float64]:
    """Return the sum of (difference / tolerance)^2 of each try; infinite where it lacks a number."""
    total = np.zeros(len(tries))
    for feature, value, tolerance in ((each.feature, each.value, each.tolerance) for each in situation.numbers):
        values = _numbers(tries, feature)
        if feature in situation.over_torso:
            values = values - np.nan_to_num(_numbers(tries, "torso"))
        off = values - value
        if is_angle(feature):
            off = np.remainder(off + np.pi, 2 * np.pi) - np.pi
        total += np.square(off / (library.tolerance(situation.type, feature) if tolerance is None else tolerance))
    return np.where(np.isnan(total), np.inf, total)


def _numbers(tries: Group, feature: str) -> NDArray[np.float64]:
    column = tries.numbers.get(feature)
    return np.full(len(tries), np.nan) if column is None else column.values.astype(np.float64)


def _reason(tries: Group, likeness: NDArray[np.float64]) -> str | None:
    """Return the reason of the failures that are likest together; None if none of them is like the situation."""
    column = tries.texts.get("reason")
    if column is None:
        return None
    weights = np.bincount(column.values, likeness, minlength=len(column.words) + 1)
    weights[0] = 0.0
    best = int(weights.argmax())
    return str(column.words[best - 1]) if weights[best] >= _LIKE_MIN else None


# === conditions ===============================================================================================
#
# Leave out tries of rollouts under other conditions than the present ones, which the words of their scene name.


class Conditions(NamedTuple):
    """What rollouts agree in whose outcomes can be compared.

    Attributes:
        limits: of the arms' joints, in words.
        collisions: whether they count.
        furniture: whether there is any.
        errors: of the robot, in words, empty for none; None if they are not known, as those of a real robot.
    """

    limits: str
    collisions: bool
    furniture: bool
    errors: str | None

    @classmethod
    def of_scene(cls, scene: str | None) -> Conditions | None:
        """Return those that the description of a scene names (`learning.Scene`); None if it names no limits."""
        parts = (scene or "").split(", ")
        at = next((number for number, part in enumerate(parts) if part.endswith(" limits")), None)
        if at is None:
            return None
        limits, *others = parts[at:]
        errors = [each for each in others if each.startswith(("base off", "object off")) or each.endswith(" slip")]
        furniture = not {"in the kitchen", "on a table"}.isdisjoint(others)
        return cls(limits, "collisions count" in others, furniture, ", ".join(errors))

    @classmethod
    def at_present(cls) -> Conditions | None:
        """Return those of the chosen robot in its world; None without a choice or a world."""
        choice, world = innermost_choice(), current_world.get()
        if choice is None or world is None:
            return None
        furniture = any(each.object_type is ObjectType.ENVIRONMENT for each in world.objects)
        limits = f"{choice.limits.name.lower()} limits"
        return cls(limits, choice.collisions, furniture, getattr(choice.modules, "errors", None))


def unlike_rollouts(batches: Sequence[tuple[int, int, str | None]]) -> list[tuple[int, int]]:
    """Return the ranges of node ids of the batches of rollouts whose conditions are other than the present ones.

    Args:
        batches: of each batch the first id, the end of its ids, and the description of its scene.
    """
    present, scenes = Conditions.at_present(), dict[str | None, bool]()
    if present is None:
        return []
    for scene in {scene for *_, scene in batches}:
        recorded = Conditions.of_scene(scene)
        errors = None if recorded is None else recorded.errors if present.errors is None else present.errors
        scenes[scene] = recorded in (None, present._replace(errors=errors))
    return [(first, end) for first, end, scene in batches if not scenes[scene]]


# === present situation ========================================================================================
#
# Describe the world as it is, as if an action began now: the features that its case would have.


def situations_of(actions: Sequence[Designator]) -> list[Situation]:
    """Return the situation of each action, as if it began now.

    A `MoveAndPickUpPerformable` is compared as the pick-up that it makes at its place, with all tries of pick-ups; its
    `torso`, if it has one, is the height to which it lifts the torso, and `probability` what a model has predicted.
    """
    world = current_world.get()
    sequences = _sequences(world) if world is not None else {}
    replayed, rows = _world(world, sequences) if world is not None else ReplayedWorld(), _Rows(sequences)
    types: dict[type[Designator], tuple[Sequence[Field], case_rows.FeatureFields]] = {}
    situations = []
    for each in actions:
        action, place, torso, expected, model = each, None, None, None, None
        if isinstance(each, MoveAndPickUpPerformable):
            target, height_m = pose_of(each.object_designator), each.standing_position.position.z
            place = face(each.standing_position, target, height_m=height_m)
            action = PickUpActionPerformable(each.object_designator, each.arm, each.grasp)
            torso, expected, model = getattr(each, "torso", None), getattr(each, "probability", None), each.policy
        if type(action) not in types:
            declared = declared_type(type(action), strict=False)
            types[type(action)] = declared.fields, case_rows.FeatureFields.of(declared.declaration)
        readers, fields = types[type(action)]
        missing: dict[str, str] = {}
        parameters = read_parameters(action, readers, rows, missing)
        # As the event of its start has them.
        recorded = msgspec.json.decode(msgspec.json.encode({k: v for k, v in parameters.items() if k not in missing}))
        robot = _robot(world, sequences, place, torso) if world is not None else None
        situation = compared(fields.dtype, *case_rows.situation(fields, recorded, robot, replayed), fields)
        situations.append(situation._replace(expected=expected, model=model))
    return situations


def compared(
    dtype: str, symbols: case_rows.Symbols, numbers: case_rows.Numbers, fields: case_rows.FeatureFields
) -> Situation:
    """Return the features of an action that past tries must have or be near to."""
    words = {name: each for name, each in symbols.items() if name not in _NOT_COMPARED and isinstance(each, str)}
    left_out = {"torso", *(("object_z",) if "height" in numbers else ())}
    if symbols.get("object_type") in symbols.get("held", ()):
        left_out.update(_PLACE)  # of an object in the gripper the place follows from the arm
    lengths = {*_PLACE, *(name for _, features in fields.poses for name in features[:3])} - {"stand_yaw"}
    torso, over_torso = numbers.get("torso", 0.0), frozenset(features[2] for _, features in fields.poses)
    wanted = [
        Wanted(name, each - torso if name in over_torso else each, NEAR_M if name in lengths else None)
        for name, each in numbers.items()
        if name not in left_out
    ]
    return Situation(dtype, words, wanted, over_torso)


class _Rows:
    """The references to the objects of a world, as an episode that began now would have them."""

    def __init__(self, sequences: Mapping[Object, int]) -> None:
        self._sequences = sequences

    def reference(self, key: Any, /) -> ObjectReference | None:
        sequence = self._sequences.get(key)
        return ObjectReference(sequence, sequence) if sequence is not None else None


def present_situation(
    target: Object | ObjectDesignator, action: str | type
) -> tuple[case_rows.Symbols, case_rows.Numbers]:
    """Return the features of an action that would start now, without those of parameters other than the object.

    `action` is a designator class, or a built-in type by its description or its dtype.

    Raises `CallerError` for an object that is in no world, and for another class.
    """
    body = target.world_object if isinstance(target, ObjectDesignator) else target
    if not isinstance(body, Object) or body not in body.world.objects:
        raise CallerError(f"{target!r} is not an object in a world, so it has no situation: add it to a world first")
    fields, sequences = case_rows.FeatureFields.of(_declaration(action)), _sequences(body.world)
    parameters: dict[str, Any] = {}
    if fields.objects:
        parameters[fields.objects[0]] = {"object": sequences[body], "row": sequences[body]}
    return case_rows.situation(fields, parameters, _robot(body.world, sequences), _world(body.world, sequences))


def _declaration(action: str | type) -> DesignatorTypeDeclared:
    if isinstance(action, type) and issubclass(action, Designator):
        return declared_type(action, strict=False).declaration
    declaration = built_in_declaration(dtype_of(action) or "")
    if declaration is None:
        raise CallerError(f"{action!r} is not a designator class: give one, such as PickUpAction")
    return declaration


def _sequences(world: BulletWorld) -> Mapping[Object, int]:
    """Number the objects as an episode that began now would: events refer to them by the sequence that added them."""
    return {each: number for number, each in enumerate(world.objects, 1)}


def _robot(
    world: BulletWorld, sequences: Mapping[Object, int], place: Pose | None = None, torso: float | None = None
) -> RobotValue | None:
    """Return the state of the acting robot; as if it stood at `place` and had lifted its torso, if these are set."""
    robot = acting_robot(world)
    if robot is None or robot not in sequences:
        return None
    joint = robot.robot_description.torso_joint if robot.robot_description is not None else None
    reference = ObjectReference(sequences[robot], sequences[robot])
    height = robot.joint_position(joint) if joint is not None and torso is None else torso
    return RobotValue(pose_value(place or robot.pose), robot.object_type.name, height, reference, robot.name)


def _world(world: BulletWorld, sequences: Mapping[Object, int]) -> ReplayedWorld:
    replayed = ReplayedWorld()
    for each, sequence in sequences.items():
        attachment = world.attachments.of(each)
        added = ObjectAdded(each.name, each.object_type.name, pose_value(each.pose))
        present = WorldObject(added, added.pose, sequence)
        if attachment is not None:
            present.attached_to = sequences[attachment.parent], attachment.link
        replayed.objects[sequence], replayed.added[sequence] = present, added
    return replayed


# === adviser ==================================================================================================
#
# Advise plans (`plan.advice`). A memory never stops a robot: without an answer in time the plan goes on unadvised.

ANSWER_WAIT_S: Final = 5.0
"""The longest time in s that a plan waits for predictions before it goes on without them. The first ones wait until the
memory has stored all that was recorded before, and read its cases."""
_log = logging.getLogger("pycrorm_async")


class MemoryAdviser:
    """The adviser of the plans in one `Memory.advising`. Implements `plan.advice.Adviser`.

    Args:
        predict: predicts the outcome of each action.
        observe: records a dict in the open episode, at the current node.
        minimum: the least chance with which an alternative is tried.
        explore: whether alternatives are tried of which too little is known.
    """

    def __init__(
        self,
        predict: Callable[[Sequence[Designator]], Coroutine[Any, Any, Sequence[Prediction]]],
        observe: Callable[[str, Mapping[str, Any]], None],
        minimum: float,
        *,
        explore: bool,
    ) -> None:
        self._predict = predict
        self._observe = observe
        self.minimum = minimum
        self._explore = explore
        self._late: set[asyncio.Task[Sequence[Prediction]]] = set()  # questions that no plan waits for any longer
        self._has_failed = False

    def allows(self, chance: Chance) -> bool:
        is_known = (chance.low, chance.high) != _UNKNOWN
        return chance.chance >= self.minimum if is_known else self._explore

    async def chances(self, alternatives: Sequence[Designator]) -> Sequence[Prediction] | None:
        if not all(each.done() for each in self._late):
            return None  # the memory still works on an earlier question, as reading many cases for the first time
        asking = asyncio.create_task(self._predict([*alternatives]), name="prediction for a plan")
        try:
            await asyncio.wait([asking], timeout=ANSWER_WAIT_S)
        finally:
            if not asking.done():
                self._late.add(asking)
                asking.add_done_callback(self._forget)
        try:
            return asking.result()
        except asyncio.InvalidStateError:
            self._note_failure(f"no answer in {ANSWER_WAIT_S:g} s")
        except Exception as error:  # noqa: BLE001  whatever fails in a memory, the plan goes on
            self._note_failure(describe_error(error))
        return None

    def note(self, chances: Sequence[Chance], taken: int) -> None:
        best = chances[taken]
        refused = sum(not self.allows(each) for each in chances)
        figures = {"chance": best.chance, "low": best.low, "high": best.high}
        self._observe("advice", {**figures, "alternatives": len(chances), "refused": refused})

    def close(self) -> None:
        """Drop the questions that no plan waits for any longer."""
        for each in self._late:
            each.cancel()

    def _forget(self, asked: asyncio.Task[Sequence[Prediction]]) -> None:
        self._late.discard(asked)
        asked.cancelled() or asked.exception()  # else asyncio logs it

    def _note_failure(self, reason: str) -> None:
        if not self._has_failed:
            self._has_failed = True
            _log.warning("the memory predicts nothing, so the plan goes on unadvised: %s", reason)
