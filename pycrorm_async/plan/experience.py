"""Port through which location designators query a memory for past successful pick-ups.

`experience` is the experience of the current context: that of the open memory, or None. The plan layer does not depend
on its implementation.
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
    """One way in which an object was picked up successfully.

    Attributes:
        torso_height: m; None for a robot without a torso.
        stand: pose of the robot's base in the object's own frame.
        score: rating that also counts the failures of this way, between 0 and 1.
        times: number of successes with exactly these values.
    """

    arm: Arms
    grasp: Grasp
    torso_height: float | None
    stand: Pose
    score: float
    times: int = 1


class Experience(Protocol):
    """A source of past successes."""

    async def successes(self, object_type: ObjectType, *, arm: Arms | None) -> Sequence[PastSuccess]:
        """Return successful pick-ups of objects of that type, best first; `arm` None means any arm."""
        ...


experience: ConnectedVar[Experience] = ConnectedVar("experience")
