"""The execution context of a node: the monitors around it, and the arbiter and claims of its parallel branches.

Most plans have none; then a perform reads one ContextVar only. Otherwise `ExecutionContext.enter` runs before the node
is created, so that a node that is interrupted or waits for a part of the robot has not started yet.
"""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass

from pycrorm_async.plan.protocols import Gate, Hold, Interrupter, Performable


@dataclass(frozen=True, slots=True)
class ExecutionContext:
    """The monitors and claims that apply in a context; asyncio tasks inherit it.

    Attributes:
        watches: the watches of all enclosing monitors, the outermost first.
        arbiter: the arbiter of the outermost enclosing parallel expression.
        claim: the claim of the nearest ancestor that holds parts of the robot; its `parent` leads to the others.
    """

    watches: tuple[Interrupter, ...] = ()
    arbiter: Gate | None = None
    claim: Hold | None = None

    @property
    def interrupted(self) -> bool:
        """True if an enclosing monitor has interrupted its operand."""
        return any(watch.fired for watch in self.watches)

    async def enter(self, designator: Performable) -> Hold | None:
        """Check the monitors, then wait for the parts of the robot that the designator needs.

        The caller releases the returned claim, if there is one, when the node has ended.

        Raises:
            CancelledError: a monitor's condition holds.
            ResourceDeadlock: the wait for a part of the robot would never end.
        """
        if self.watches and not self.interrupted:
            for watch in self.watches:
                await watch.check()
        if self.arbiter is None:
            return None
        return await self.arbiter.claim(designator)


execution_context: ContextVar[ExecutionContext | None] = ContextVar("execution_context", default=None)
