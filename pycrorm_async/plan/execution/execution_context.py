"""What a node starts within, besides its parent: monitors that watch it, and parallel branches it takes turns with.

Nothing, for most plans: then a perform asks one ContextVar and goes on. Otherwise `entered` comes before the
node, so that a node that is interrupted first, or waits for a part of the robot, has not started yet.
"""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pycrorm_async.plan.designator import Designator
    from pycrorm_async.plan.language.monitor_watch import Watch
    from pycrorm_async.plan.language.resource_arbiter import Arbiter, Claim

__all__ = ["ExecutionContext", "surroundings"]


@dataclass(frozen=True, slots=True)
class ExecutionContext:
    """Inherited by asyncio tasks, as the current node is.

    Attributes:
        watches: of the monitors around, the outermost first.
        arbiter: of the outermost parallel expression around.
        claim: the nearest node above that holds parts of the robot, and through it those above that one.
    """

    watches: tuple[Watch, ...] = ()
    arbiter: Arbiter | None = None
    claim: Claim | None = None

    @property
    def interrupted(self) -> bool:
        """Whether a monitor around has interrupted what is inside."""
        return any(watch.fired for watch in self.watches)

    async def entered(self, designator: Designator) -> Claim | None:
        """A node of this designator may start; release the claim, if there is one, when it has ended.

        Raises:
            CancelledError: a monitor's condition holds now.
            ResourceDeadlock: the wait for a part of the robot would never end.
        """
        if self.watches and not self.interrupted:
            for watch in self.watches:
                await watch.check()
        if self.arbiter is None:
            return None
        return await self.arbiter.claimed(designator, self)


surroundings: ContextVar[ExecutionContext | None] = ContextVar("surroundings", default=None)
