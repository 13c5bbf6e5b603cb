"""Run plans in turns in one process, each in its own task and world; define the action that they perform."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack

from pycrorm_async.plan import PickUpActionPerformable
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.world import Arms, Grasp, Object, ObjectType, Pose

__all__ = ["TurnTaker", "NothingActionPerformable", "nothing_action"]


class NothingActionPerformable(PickUpActionPerformable):
    """An action with the parameters of picking up that does nothing."""

    async def perform(self) -> None:
        return


def nothing_action() -> NothingActionPerformable:
    """Create the action in the current world, with a robot and a milk."""
    Object("pr2", ObjectType.ROBOT)
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
    return NothingActionPerformable(designator_of(milk), Arms.LEFT, Grasp.FRONT)


class TurnTaker(ABC):
    """A plan that performs only in its turns."""

    def __init__(self) -> None:
        self._requests: asyncio.Queue[int] = asyncio.Queue()

    async def take_turn(self, performs: int) -> None:
        """Perform the action `performs` times, and wait until the turn is complete; 0 ends the plan."""
        self._requests.put_nowait(performs)
        await self._requests.join()

    async def run(self) -> None:
        """Run the turns until the plan is ended."""
        async with AsyncExitStack() as stack:
            take = await self.begin(stack)
            while performs := await self._requests.get():
                await take(performs)
                self._requests.task_done()
        self._requests.task_done()

    @abstractmethod
    async def begin(self, stack: AsyncExitStack) -> Callable[[int], Awaitable[None]]:
        """Set up the plan, with its resources on the stack, and return the function that takes a turn."""
