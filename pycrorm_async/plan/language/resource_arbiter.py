"""Who may use which part of the robot, and who waits: the turns that branches of a parallel expression take.

A node takes all it needs at once, or waits, before it starts; it holds it until it ends. What a node holds,
those inside it may use, but of two that run at once inside it only one. First come, first served, except that
nobody queues behind one who waits for the end of what he is part of. A wait that can never end is refused.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextvars import Token
from typing import TYPE_CHECKING, Any, TypeAlias

from pycrorm_async.plan.execution.execution_context import ExecutionContext, execution_context
from pycrorm_async.plan.failures import ResourceDeadlock
from pycrorm_async.plan.language.resources import Resource
from pycrorm_async.world.observers import current_world

if TYPE_CHECKING:
    from pycrorm_async.plan.designator import Designator

__all__ = ["Arbiter", "Claim"]

Part: TypeAlias = tuple[Any, Resource]
"""A part of the robot of one world: branches in different worlds are not in each other's way."""


class Claim:
    """What a node needs, or holds."""

    __slots__ = ("_arbiter", "_token", "designator", "granted", "parent", "parts")

    def __init__(self, arbiter: Arbiter, designator: Designator, parts: frozenset[Part], parent: Claim | None) -> None:
        self.designator = designator
        self.parts = parts
        self.parent = parent
        self.granted: asyncio.Future[None] | None = None
        """Only while it waits."""
        self._arbiter = arbiter
        self._token: Token[ExecutionContext | None] | None = None

    def above(self) -> Iterator[Claim]:
        """Those of the nodes it is inside of."""
        each = self.parent
        while each is not None:
            yield each
            each = each.parent

    def enter(self, around: ExecutionContext) -> None:
        """From now on what starts in this context is inside."""
        self._token = execution_context.set(ExecutionContext(around.watches, self._arbiter, self))

    def release(self) -> None:
        """The node ended: the next ones may go on."""
        self._arbiter.release(self)
        assert self._token is not None
        try:
            execution_context.reset(self._token)
        except ValueError:
            # A dropped plan is closed in another context, whose surroundings are not ours to change.
            return


class Arbiter:
    """Settles the claims of all that runs inside one parallel expression; belongs to one event loop."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self._holding: list[Claim] = []
        self._waiting: list[Claim] = []

    async def claim(self, designator: Designator, around: ExecutionContext) -> Claim | None:
        """What the designator needs is its own; None if it needs nothing. Raises `ResourceDeadlock`."""
        wanted = designator.resources()
        if not wanted or asyncio.get_running_loop() is not self.loop:
            return None
        world = current_world.get()
        claim = Claim(self, designator, frozenset((world, resource) for resource in wanted), around.claim)
        self._check_deadlock(claim)
        self._waiting.append(claim)
        self._grant()
        if claim not in self._holding:
            claim.granted = self.loop.create_future()
            try:
                await claim.granted
            except BaseException:
                self._withdraw(claim)
                raise
        claim.enter(around)
        return claim

    def release(self, claim: Claim) -> None:
        """What it held is free, but for those above it."""
        self._holding.remove(claim)
        self._grant()

    # --- inside -----------------------------------------------------------------------------------------------

    def _withdraw(self, claim: Claim) -> None:
        """The wait was cancelled, perhaps just after it was over."""
        (self._holding if claim in self._holding else self._waiting).remove(claim)
        self._grant()

    def _grant(self) -> None:
        """Let all go on that can, in the order they came; one that does may let an earlier one pass another."""
        granted = True
        while granted:
            granted = False
            for claim in tuple(self._waiting):
                if not self._holders(claim) and not self._must_queue(claim):
                    granted = True
                    self._waiting.remove(claim)
                    self._holding.append(claim)
                    if claim.granted is not None and not claim.granted.done():
                        claim.granted.set_result(None)

    def _holders(self, claim: Claim) -> list[Claim]:
        """Those in its way: they hold a part it needs, and it is not inside of them."""
        above = set(claim.above())
        return [each for each in self._holding if each not in above and each.parts & claim.parts]

    def _must_queue(self, claim: Claim) -> bool:
        """Whether one who came earlier goes first."""
        above = set(claim.above())
        return any(not self._waits_for(earlier, above) for earlier in self._earlier_rivals(claim))

    def _earlier_rivals(self, claim: Claim) -> list[Claim]:
        """Those before it in the queue that need some of the same."""
        before = self._waiting[: self._waiting.index(claim)]
        return [each for each in before if each.parts & claim.parts]

    def _waits_for(self, waiter: Claim, ends: set[Claim]) -> bool:
        """Whether its turn comes, or may come, only after one of these has ended."""
        ahead, seen = [waiter], set()
        while ahead:
            each = ahead.pop()
            if each in seen:
                continue
            seen.add(each)
            for holder in self._holders(each):
                if holder in ends:
                    return True
                ahead += self._waiting_in(holder)
            ahead += self._earlier_rivals(each)
        return False

    def _waiting_in(self, holder: Claim) -> list[Claim]:
        """Those it cannot end before: they wait inside of it."""
        return [each for each in self._waiting if holder in each.above()]

    def _check_deadlock(self, claim: Claim) -> None:
        """Raise `ResourceDeadlock` if one that is in the way waits, in the end, for what the claim is inside of."""
        ends = set(claim.above())
        for first in self._holders(claim):
            ahead, seen = [first], set()
            while ahead:
                holder = ahead.pop()
                if holder in ends:
                    resource = min((resource for _, resource in first.parts & claim.parts), key=lambda each: each.name)
                    raise ResourceDeadlock(
                        resource, first.designator.dtype, claim.designator.dtype, holder.designator.dtype
                    )
                if holder not in seen:
                    seen.add(holder)
                    for waiter in self._waiting_in(holder):
                        ahead += self._holders(waiter)
