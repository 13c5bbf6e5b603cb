"""Port through which plans query a memory for past successful pick-ups.

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


@dataclass(frozen=True, slots=True)
class PastSuccess:
    """One way in which an object was picked up successfully.

    Attributes:
        torso_height: m; None for a robot without a torso.
        stand: pose of the robot's base in the object's own frame.
        score: the share of successes that is expected of this way, between 0 and 1; failures count.
        times: number of successes with exactly these values.
        evidence: number of tries that the score is based on, each counted by its likeness to this way.
        prior: the score of a way of which nothing is known.
    """

    arm: Arms
    grasp: Grasp
    torso_height: float | None
    stand: Pose
    score: float
    times: int = 1
    evidence: float = 1.0
    prior: float = 0.0


class Experience(Protocol):
    """A source of past successes."""

    async def successes(
        self, object_type: ObjectType, *, arm: Arms | None, height: float | None = None, torso: float | None = None
    ) -> Sequence[PastSuccess]:
        """Return ways in which objects of that type were picked up, each once, that with the highest score first.

        Args:
            arm: of the ways; None means any.
            height: of the object over the robot's base, m, for which the ways are scored; None means for each way the
                height at which it succeeded.
            torso: height of the torso for which they are scored, m; None means for each way its own.
        """
        ...


experience: ConnectedVar[Experience] = ConnectedVar("experience")
