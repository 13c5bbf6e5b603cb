"""What a location designator asks of a memory: where the robot stood when things went well before.

`experience` is that of this context: the one of the memory that is open, or None. The plan layer knows nothing
of where it comes from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.world.enums import Arms, Grasp, ObjectType
from pycrorm_async.world.pose import Pose

__all__ = ["Experience", "PastSuccess", "experience"]


@dataclass(frozen=True, slots=True)
class PastSuccess:
    """How an object was picked up once, or several times in the same way.

    Attributes:
        torso_height: m; None for a robot without a torso.
        stand: where the robot's base was, in the object's own frame.
        score: how well that way of doing it went, failures counted: between 0 and 1.
        times: how often it went well in exactly this way.
    """

    arm: Arms
    grasp: Grasp
    torso_height: float | None
    stand: Pose
    score: float
    times: int = 1


class Experience(Protocol):
    """Knows what went well."""

    async def successes(self, object_type: ObjectType, *, arm: Arms | None) -> Sequence[PastSuccess]:
        """The ways in which objects of that type were picked up, the best first; with this arm, or any."""
        ...


experience: ConnectedVar[Experience] = ConnectedVar("experience")
