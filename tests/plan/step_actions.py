"""Actions that log their runs, for tests of the plan language."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from pycrorm_async.plan import ActionAbstract, CollectedTree, PlanFailure, Resource


@dataclass
class Step(ActionAbstract):
    """Returns its name, after some turns of the loop.

    Attributes:
        log: gets "name" when it starts and "name." when it is done.
        fails: what it raises then.
    """

    name: str
    log: list[str] = field(default_factory=list)
    turns: int = 0
    fails: BaseException | None = None
    needs: Iterable[Resource] = ()

    def resources(self) -> frozenset[Resource]:
        return frozenset(self.needs)

    async def perform(self) -> str:
        self.log.append(self.name)
        for _ in range(self.turns):
            await asyncio.sleep(0)
        if self.fails is not None:
            raise self.fails
        self.log.append(f"{self.name}.")
        return self.name


@dataclass
class Around(ActionAbstract):
    """Perform one action inside itself, and hold the resources meanwhile."""

    inner: ActionAbstract
    needs: Iterable[Resource] = ()
    before: int = 0

    def resources(self) -> frozenset[Resource]:
        return frozenset(self.needs)

    async def perform(self) -> object:
        for _ in range(self.before):
            await asyncio.sleep(0)
        return await self.inner.perform()


def failing(name: str, message: str = "", turns: int = 0) -> Step:
    return Step(name, fails=PlanFailure(message or f"{name} failed"), turns=turns)


def drawn(tree: CollectedTree) -> list[str]:
    """Return the drawing of the tree without durations."""
    return re.sub(r" \d+\.\d ms", "", str(tree)).splitlines()
