"""The experience of a memory: `DatabaseCostmapLocation` and `RecalledPickUp` find ways to pick an object up in it.

**Past pick ups.** Score the ways in which objects were picked up, by the tries like them: successes and failures.

A *try* is a pick-up that succeeded or failed. A *way* is what successes with equal values have in common: the arm, the
grasp, the pose of the robot's base in the object's frame, and the height of the torso. The score of a way at a height
is the share of successes among the tries with the same arm and grasp, each counted by its likeness w: 1 for the same
position of the base and the same height over the torso, exp(-1/2) where one of the two is `NEAR_M` off. The yaw does
not count.

    score = (sum of w of the successes + prior) / (sum of w of all tries + 1)

The prior, (successes + 1) / (tries + 2) among all tries with such objects, counts as one try, so that a single success
does not outrank many successes with a few failures. A way that succeeded at another height only has little evidence at
this one, and its score is near the prior.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import PickUpAction
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.blocks import NEAR_M, CaseLibrary, Group
from pycrorm_async.recall.recall import CaseReader, DatabaseSource
from pycrorm_async.world.pose import Arms, Grasp, ObjectType, Pose, yaw_quaternion


class PickUpExperience:
    """The pick-ups of one memory that succeeded or failed, without simulations. Implements `Experience`.

    A pick-up of this process counts as soon as it has ended; one of another process, when it is visible in the tables.
    """

    def __init__(self, reading: Reading, reader: Callable[[], CaseReader]) -> None:
        self._reading = reading
        self._reader = reader
        self._pick_up_types = {"PickUpAction": True}
        self.is_closed = False
        """True once the memory is closed."""

    @classmethod
    def of(cls, reading: Reading) -> Self:
        """Return the experience of a memory that is open for reading."""
        reader = CaseReader(DatabaseSource(reading))
        return cls(reading, lambda: reader)

    async def successes(
        self, object_type: ObjectType, *, arm: Arms | None, height: float | None = None, torso: float | None = None
    ) -> Sequence[PastSuccess]:
        """Return the ways in which objects of this type were picked up; see `Experience` and `past_pick_ups`.

        Raises `CallerError` once the memory is closed.
        """
        if self.is_closed:
            raise CallerError("the memory is closed, so its experience cannot be read: ask while it is open")
        library = await self._reader().library()
        tries = tries_of(library, await self._pick_ups(library), object_type, arm)
        return best_first(tries, height=height, torso=torso)

    async def _pick_ups(self, library: CaseLibrary) -> list[str]:
        """Return `PickUpAction` and the types derived from it, also of a program's own once they are stored."""
        unknown = library.types.keys() - self._pick_up_types.keys()
        if unknown:
            await self._reading.refresh()
            for dtype in unknown:
                with suppress(CallerError):  # a type of this process that is not stored yet
                    self._pick_up_types[dtype] = issubclass(self._reading.mapped(dtype), PickUpAction)
        return [dtype for dtype, is_pick_up in self._pick_up_types.items() if is_pick_up]


# === past pick ups ============================================================================================

Floats: TypeAlias = NDArray[np.float64]

_FEATURES = frozenset("arm grasp object_type status stand_x stand_y stand_yaw object_z".split())
_NUMBERS = frozenset("stand_x stand_y stand_yaw object_z torso height".split())

TRIES_MAX: Final = 2_000
"""Bounds the tries that are compared; the latest are taken."""
_WAYS_MAX: Final = 500
"""Bounds the ways with one arm and grasp that are scored; those that succeeded nearest to the height are taken."""
_DIGITS: Final = 6
"""Decimals to which lengths and angles are rounded, because cases store float32."""
_SAME: Final = 1e-4
"""The resolution, in m and rad, at which two ways count as equal."""


class Tries(NamedTuple):
    """Pick-ups that succeeded or failed, the latest first, as arrays with one element for each.

    Attributes:
        arm, grasp: names of the members.
        x, y, yaw: pose of the robot's base in the object's frame, m and rad.
        over_base: height of the object over the robot's base, m.
        torso: height of the torso, m; NaN for a robot without one.
        succeeded: False for a try that failed.
    """

    arm: NDArray[Any]
    grasp: NDArray[Any]
    x: Floats
    y: Floats
    yaw: Floats
    over_base: Floats
    torso: Floats
    succeeded: NDArray[np.bool_]

    @property
    def over_torso(self) -> Floats:
        """Height of the object over the lifted torso, or over the base of a robot without a torso, m."""
        return self.over_base - np.nan_to_num(self.torso)


def tries_of(library: CaseLibrary, types: Iterable[str], object_type: ObjectType, arm: Arms | None) -> Tries:
    """Return the latest tries of these designator types with objects of one type, with this arm; None means any.

    Leaves out simulations, tries that neither succeeded nor failed, and tries without a known place, as with an object
    that lay on its side.
    """
    groups = [group for type_ in types for group in library.groups(type_)]
    parts = [part for group in groups if (part := _tries(group, object_type, arm)) is not None]
    if not parts:
        return Tries._make(np.zeros(0, np.bool_ if name == "succeeded" else np.float64) for name in Tries._fields)
    started_us = np.concatenate([each for each, _ in parts])
    latest = np.argsort(-started_us, kind="stable")[:TRIES_MAX]
    return Tries._make(np.concatenate(columns)[latest] for columns in zip(*(each for _, each in parts), strict=True))


def _tries(group: Group, object_type: ObjectType, arm: Arms | None) -> tuple[NDArray[np.int64], Tries] | None:
    """Return start (µs) and values of the latest tries in a group; None if it lacks one of `_FEATURES`."""
    if not {*group.texts, *group.numbers} >= _FEATURES:
        return None
    numbers = {name: column.values.astype(np.float64) for name, column in group.numbers.items() if name in _NUMBERS}
    torso, height = (numbers.get(name, np.full(len(group), np.nan)) for name in ("torso", "height"))
    # `height` is over the torso. Without a torso only the height in the map is known; bases stand on its floor, z = 0.
    over_base = np.where(np.isnan(torso), numbers["object_z"], height + torso)
    arms, grasps = _texts(group, "arm"), _texts(group, "grasp")
    wanted = _texts(group, "object_type") == object_type.name
    wanted &= np.isin(arms, [*Arms.__members__] if arm is None else [arm.name])  # another executive may have other arms
    wanted &= np.isin(grasps, [*Grasp.__members__])
    succeeded = _texts(group, "status") == "SUCCEEDED"
    wanted &= succeeded | (_texts(group, "status") == "FAILED")
    wanted &= group.performed
    wanted &= ~np.isnan(numbers["stand_x"] + numbers["stand_y"] + numbers["stand_yaw"] + over_base)
    rows = np.flatnonzero(wanted)[:TRIES_MAX]  # the newest come first
    place = (numbers["stand_x"], numbers["stand_y"], numbers["stand_yaw"], over_base, torso)
    values = [each[rows] for each in (arms, grasps, *place, succeeded)]
    return group.started_us[rows], Tries._make(values)


def _texts(group: Group, feature: str) -> NDArray[Any]:
    """Return a text feature of each case; empty where it has none, or several."""
    column = group.texts[feature]
    words = np.array(["", *("" if isinstance(each, tuple) else each for each in column.words)])
    texts: NDArray[Any] = words[column.values]
    return texts


def best_first(tries: Tries, *, height: float | None = None, torso: float | None = None) -> list[PastSuccess]:
    """Return the ways that succeeded, ordered by score, then by number of successes, then by the latest success.

    Args:
        height: of the object over the robot's base, m; None means for each way the height at which it succeeded.
        torso: height of the torso, m; None means for each way its own. It has no effect if `height` is None.
    """
    prior = (int(tries.succeeded.sum()) + 1) / (tries.succeeded.size + 2)
    ways = [way for rows in _alike(tries) for way in _scored(tries, rows, height, torso, prior)]
    return [way for row, way in sorted(ways, key=lambda each: (-each[1].score, -each[1].times, each[0]))]


def _alike(tries: Tries) -> Iterator[NDArray[np.int64]]:
    """Yield the rows of the tries with one arm and grasp, for each of them."""
    pairs = np.char.add(np.char.add(tries.arm.astype(str), " "), tries.grasp.astype(str))
    for pair in np.unique(pairs):
        yield np.flatnonzero(pairs == pair)


def _scored(
    tries: Tries, rows: NDArray[np.int64], height: float | None, torso: float | None, prior: float
) -> Iterator[tuple[int, PastSuccess]]:
    """Yield each way that succeeded among tries with one arm and grasp, with the row of its latest success."""
    succeeded = rows[tries.succeeded[rows]]
    if not succeeded.size:
        return
    keys = np.stack([tries.x, tries.y, tries.yaw, tries.over_base, np.nan_to_num(tries.torso)], axis=1)[succeeded]
    _, first, times = np.unique(np.round(keys / _SAME), axis=0, return_index=True, return_counts=True)
    ways = succeeded[first]
    at = tries.over_torso[ways]
    if height is not None:
        at = height - np.nan_to_num(tries.torso[ways] if torso is None else np.full(ways.size, torso))
    nearest = np.argsort(np.abs(at - tries.over_torso[ways]), kind="stable")[:_WAYS_MAX]
    ways, times, at = ways[nearest], times[nearest], at[nearest]
    off = [
        np.subtract.outer(tries.x[ways], tries.x[rows]),
        np.subtract.outer(tries.y[ways], tries.y[rows]),
        np.subtract.outer(at, tries.over_torso[rows]),
    ]
    likeness = np.exp(sum(np.square(each) for each in off) / (-2 * NEAR_M**2))
    evidence = likeness.sum(axis=1)
    scores = ((likeness * tries.succeeded[rows]).sum(axis=1) + prior) / (evidence + 1)
    for row, number, score, weight in zip(
        ways.tolist(), times.tolist(), scores.tolist(), evidence.tolist(), strict=True
    ):
        place = (tries.x, tries.y, tries.yaw, tries.over_base, tries.torso)
        x, y, yaw, over_base, torso_height = (round(float(each[row]), _DIGITS) for each in place)
        stand = Pose((x, y, -over_base), yaw_quaternion(yaw), "object", time_ns=0)
        has_torso = torso_height == torso_height
        arm, grasp = Arms[str(tries.arm[row])], Grasp[str(tries.grasp[row])]
        yield row, PastSuccess(arm, grasp, torso_height if has_torso else None, stand, score, number, weight, prior)
