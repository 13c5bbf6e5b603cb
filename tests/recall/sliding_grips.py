"""A plan whose grips slip above 1 m, for memories to recall."""

from __future__ import annotations

from dataclasses import dataclass

from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract, PlanFailure
from pycrorm_async.world import Arms

__all__ = [
    "FETCH",
    "GRIP",
    "FetchSlidingActionPerformable",
    "GripSlidingActionPerformable",
    "SlipperyFailure",
    "grip",
    "record",
]


class SlipperyFailure(PlanFailure):
    """The object slipped."""


@dataclass
class GripSlidingActionPerformable(ActionAbstract):
    """Fails above 1 m."""

    arm: Arms
    level: float
    item: str = "cup"

    async def perform(self) -> None:
        if self.level > 1:
            raise SlipperyFailure("it slipped")


@dataclass
class FetchSlidingActionPerformable(ActionAbstract):
    """Grips twice."""

    first: float
    second: float

    async def perform(self) -> None:
        for height in (self.first, self.second):
            try:
                await GripSlidingActionPerformable(Arms.LEFT, height).perform()
            except SlipperyFailure:
                continue


GRIP, FETCH = "GripSlidingAction", "FetchSlidingAction"


async def grip(arm: Arms, height: float) -> None:
    try:
        await GripSlidingActionPerformable(arm, height).perform()
    except SlipperyFailure:
        return


async def record(memory: Memory) -> None:
    """Two episodes: grips with both arms, and two fetches."""
    async with memory.episode(description="grips", tags=["kitchen"]):
        for step in range(8):
            await grip(Arms.LEFT if step % 2 else Arms.RIGHT, 0.6 + 0.1 * step)
    async with memory.episode(description="fetches"):
        await FetchSlidingActionPerformable(1.5, 0.8).perform()
        await FetchSlidingActionPerformable(0.7, 0.9).perform()
