"""Rank past successful pick-ups for a location designator, the best first.

The score of a success is the share of successes among the attempts near it: with the same arm and grasp, with the robot
within 0.1 m in the object's frame, with the torso within 0.1 m of its height. One success and one failure are added to
the counts (Laplace's rule), so that a single success does not outrank many successes with a few failures:

    3 of 3 tries: (3 + 1) / (3 + 2) = 0.8       1 of 1: 0.67       2 of 3: 0.6       1 of 20: 0.09
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import Select, select

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import PickUpWithContextView
from pycrorm_async.plan.experience import PastSuccess
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp, ObjectType
from pycrorm_async.world.pose import Pose

__all__ = ["PickUpExperience", "Attempt", "best_first", "ATTEMPTS_MAX", "NEAR_M"]

ATTEMPTS_MAX = 2_000
"""Bounds the attempts that are read; the latest are taken."""
NEAR_M = 0.1
"""The distance in m, of the base and of the torso's height, within which attempts count as near each other."""
_SAME = 1e-4
"""The resolution, in m and in a quaternion's components, at which two poses count as equal."""


class Attempt(NamedTuple):
    """One pick-up; `stand` is the pose of the robot's base in the object's frame."""

    arm: Arms
    grasp: Grasp
    torso_height: float | None
    stand: Pose
    succeeded: bool


class PickUpExperience:
    """The visible pick-ups of one memory that succeeded or failed, without simulations.

    Pick-ups of this process are visible after `await memory.flush()`.
    """

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        self.is_closed = False
        """True once the memory is closed."""

    async def successes(self, object_type: ObjectType, *, arm: Arms | None) -> Sequence[PastSuccess]:
        """Return the ways in which objects of this type were picked up, the best first; with this arm, or with any.

        Reads the latest `ATTEMPTS_MAX` attempts. Raises `CallerError` once the memory is closed.
        """
        if self.is_closed:
            raise CallerError("the memory is closed, so its experience cannot be read: ask while it is open")
        async with self._reading.session() as session:
            connection = await session.connection()
            await dialect_of(connection).in_order(connection)
            rows = (await session.execute(_question(object_type, arm))).all()
        return best_first(
            [
                Attempt(arm, grasp, torso, _seen_from_object(place), status is TaskStatus.SUCCEEDED)
                for arm, grasp, torso, status, *place in rows
            ]
        )


def _question(object_type: ObjectType, arm: Arms | None) -> Select[*tuple[Any, ...]]:
    view = PickUpWithContextView
    # The subquery selects ids only, so that computed columns are computed for these rows only and not sorted.
    latest = select(view.id).where(view.obj_type == object_type).order_by(view.id.desc()).limit(ATTEMPTS_MAX)
    if arm is not None:
        latest = latest.where(view.arm == arm)
    return (
        select(
            view.arm, view.grasp, view.torso_height, view.status, view.object_x, view.object_y, view.object_z,
            view.object_qx, view.object_qy, view.object_qz, view.object_qw,
        )
        .where(view.id.in_(latest), view.status.in_([TaskStatus.SUCCEEDED, TaskStatus.FAILED]))
        .order_by(view.id.desc())
    )  # fmt: skip


def best_first(attempts: Sequence[Attempt]) -> list[PastSuccess]:
    """Return the successful ways, ordered by score, then by their number of successes, then as in `attempts`."""
    groups: dict[tuple[Arms, Grasp], list[Attempt]] = {}
    for each in attempts:
        groups.setdefault((each.arm, each.grasp), []).append(each)
    successes = [success for group in groups.values() for success in _scored(group)]
    order = {key: number for number, key in reversed(list(enumerate(map(_key, attempts))))}
    return sorted(successes, key=lambda each: (-each.score, -each.times, order[_key(each)]))


def _scored(group: Sequence[Attempt]) -> list[PastSuccess]:
    """Score each way that succeeded at least once, among attempts with one arm and grasp."""
    succeeded = np.array([each.succeeded for each in group])
    stands = np.array([each.stand.position for each in group])
    torsos = np.array([each.torso_height or 0.0 for each in group])
    times: dict[tuple[object, ...], int] = {}
    first: dict[tuple[object, ...], int] = {}
    for number in np.flatnonzero(succeeded).tolist():
        key = _key(group[number])
        times[key] = times.get(key, 0) + 1
        first.setdefault(key, number)
    successes = []
    for key, number in first.items():
        distances = np.linalg.norm(stands - stands[number], axis=1)
        near = (distances <= NEAR_M) & (np.abs(torsos - torsos[number]) <= NEAR_M)
        score = (int(succeeded[near].sum()) + 1) / (int(near.sum()) + 2)
        arm, grasp, torso_height, stand, _ = group[number]
        successes.append(PastSuccess(arm, grasp, torso_height, stand, score, times[key]))
    return successes


def _seen_from_object(place: Sequence[float]) -> Pose:
    """Return the stand, with the quaternion of its rotation that has w > 0."""
    sign = math.copysign(1.0, place[6])
    return Pose(place[:3], [sign * part for part in place[3:]], "object", time_ns=0)


def _key(way: Attempt | PastSuccess) -> tuple[object, ...]:
    """Return a key that is equal for two attempts in the same way."""
    numbers = (*way.stand.position, *way.stand.orientation, way.torso_height or 0.0)
    return way.arm, way.grasp, way.torso_height is None, *(round(each / _SAME) for each in numbers)
