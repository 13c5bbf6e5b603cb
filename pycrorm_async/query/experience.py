"""What went well before, as a location designator asks for it: pick-ups that succeeded, the best way of doing it first.

How good a way is, is the share of successes among what was tried near it: with the same arm and grasp, from within
0.1 m in the object's own frame, with the torso not more than 0.1 m higher or lower. One success and one failure are
added to what was counted (Laplace's rule), so that a single success does not outdo many with a few failures:

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
"""So many attempts at most are looked at, the latest."""
NEAR_M = 0.1
_SAME = 1e-4
"""What differs by less, in m or in a quaternion's components, is the same."""


class Attempt(NamedTuple):
    """One pick-up; the stand is the robot's base in the object's frame."""

    arm: Arms
    grasp: Grasp
    torso_height: float | None
    stand: Pose
    succeeded: bool


class PickUpExperience:
    """The pick-ups of one memory: those that were really done, ended well or failed, and are in its tables.

    What was performed in this process is there after `await memory.flush()`.
    """

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        self.over = False
        """Set when the memory is closed."""

    async def successes(self, object_type: ObjectType, *, arm: Arms | None) -> Sequence[PastSuccess]:
        """The ways in which objects of that type were picked up, the best first; with this arm, or any.

        The latest `ATTEMPTS_MAX` are looked at. Raises `CallerError` once the memory is closed.
        """
        if self.over:
            raise CallerError("the memory that was to tell what went well is closed: ask while it is open")
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
    # First which, then what: the columns that are reckoned are reckoned for these only, and nothing wide is sorted.
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
    """The ways that went well, by their score, then by how often they did, then as given."""
    groups: dict[tuple[Arms, Grasp], list[Attempt]] = {}
    for each in attempts:
        groups.setdefault((each.arm, each.grasp), []).append(each)
    found = [success for group in groups.values() for success in _scored(group)]
    order = {key: number for number, key in reversed(list(enumerate(map(_key, attempts))))}
    return sorted(found, key=lambda each: (-each.score, -each.times, order[_key(each)]))


def _scored(group: Sequence[Attempt]) -> list[PastSuccess]:
    """Each way that went well once, of attempts with one arm and grasp."""
    succeeded = np.array([each.succeeded for each in group])
    stands = np.array([each.stand.position for each in group])
    torsos = np.array([each.torso_height or 0.0 for each in group])
    times: dict[tuple[object, ...], int] = {}
    first: dict[tuple[object, ...], int] = {}
    for number in np.flatnonzero(succeeded).tolist():
        key = _key(group[number])
        times[key] = times.get(key, 0) + 1
        first.setdefault(key, number)
    found = []
    for key, number in first.items():
        apart = np.linalg.norm(stands - stands[number], axis=1)
        near = (apart <= NEAR_M) & (np.abs(torsos - torsos[number]) <= NEAR_M)
        score = (int(succeeded[near].sum()) + 1) / (int(near.sum()) + 2)
        arm, grasp, torso_height, stand, _ = group[number]
        found.append(PastSuccess(arm, grasp, torso_height, stand, score, times[key]))
    return found


def _seen_from_object(place: Sequence[float]) -> Pose:
    """The stand; of the two quaternions of a turn, the one that has w above 0."""
    sign = math.copysign(1.0, place[6])
    return Pose(place[:3], [sign * part for part in place[3:]], "object", time_ns=0)


def _key(way: Attempt | PastSuccess) -> tuple[object, ...]:
    """Equal for what is the same way of doing it."""
    numbers = (*way.stand.position, *way.stand.orientation, way.torso_height or 0.0)
    return way.arm, way.grasp, way.torso_height is None, *(round(each / _SAME) for each in numbers)
