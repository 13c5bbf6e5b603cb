"""Plans that take turns in one process, each in a task and a world of its own; and the action they perform."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack

from pycrorm_async.plan import PickUpActionPerformable
from pycrorm_async.plan.object_designators import designator_of
from pycrorm_async.world import Arms, Grasp, Object, ObjectType, Pose

__all__ = ["InTurns", "NothingActionPerformable", "nothing_action"]


class NothingActionPerformable(PickUpActionPerformable):
    """The parameters of picking up, and nothing done."""

    async def perform(self) -> None:
        return


def nothing_action() -> NothingActionPerformable:
    """In the current world, which gets a robot and a milk for it."""
    Object("pr2", ObjectType.ROBOT)
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
    return NothingActionPerformable(designator_of(milk), Arms.LEFT, Grasp.FRONT)


class InTurns(ABC):
    """A plan that performs when it is its turn."""

    def __init__(self) -> None:
        self._asked: asyncio.Queue[int] = asyncio.Queue()

    async def take_turn(self, performs: int) -> None:
        """Returns when so many are performed, and what is to follow them is done; 0 ends the plan."""
        self._asked.put_nowait(performs)
        await self._asked.join()

    async def run(self) -> None:
        """Until it is ended."""
        async with AsyncExitStack() as stack:
            take = await self.begin(stack)
            while performs := await self._asked.get():
                await take(performs)
                self._asked.task_done()
        self._asked.task_done()

    @abstractmethod
    async def begin(self, stack: AsyncExitStack) -> Callable[[int], Awaitable[None]]:
        """What takes a turn; what is needed for that is left with the stack."""
