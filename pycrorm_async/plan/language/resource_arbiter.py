"""Arbitrate the parts of the robot between the branches of a parallel expression.

Theory of operation
-------------------

The outermost parallel expression creates an `Arbiter`; every node inside it that declares `resources` makes a `Claim`
before it starts. A part is a pair of the acting robot (without a robot, the world) and resource, so branches in
different worlds, or of different robots, do not compete. A claim is in one of three states: waiting, holding, or
released. It gets all its parts together or none, and holds them until its node ends. Claims form a tree through
`parent`, which is the claim of the nearest ancestor node.

A claim can be granted if no claim other than its ancestors holds one of its parts: a node may use the parts of its
ancestors, but two nodes that run in parallel inside one holder exclude each other. Grants follow the order of
arrival for each part. There is one exception: a claim does not queue behind an earlier one that itself waits for the
end of one of this claim's ancestors, because that earlier one cannot proceed before this claim has ended.

A deadlock needs a holder that waits, directly or through the claims that wait inside it, for an ancestor of the new
claim, while the new claim waits for that holder. `_check_deadlock` searches this chain before a claim waits and raises
`ResourceDeadlock` instead of waiting forever. Every claim is checked once, when it arrives: a chain that closes later
is closed by a later claim, which is checked in its turn.

All methods run in the thread of one event loop, and only `await claim.granted` suspends, so the two lists change
between awaits only and need no lock. A waiting task can be cancelled at any time, also after its claim was granted but
before it resumed; `_withdraw` therefore removes the claim from whichever list holds it. A branch that runs in another
event loop (a thread of the plan's own) makes no claim.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextvars import Token
from typing import Any, TypeAlias

from pycrorm_async.plan.execution.execution_context import ExecutionContext, execution_context
from pycrorm_async.plan.failures import ResourceDeadlock
from pycrorm_async.plan.language.resources import Resource
from pycrorm_async.plan.protocols import Hold, Performable
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.robots.acting_robot import acting_robot

Part: TypeAlias = tuple[Any, Resource]
"""A part of one robot."""


class Claim:
    """The parts of the robot that a node waits for or holds."""

    __slots__ = ("_arbiter", "_token", "designator", "granted", "parent", "parts")

    def __init__(self, arbiter: Arbiter, designator: Performable, parts: frozenset[Part], parent: Hold | None) -> None:
        self.designator = designator
        self.parts = parts
        self.parent = parent
        self.granted: asyncio.Future[None] | None = None
        """Set while the claim waits; resolved when it is granted."""
        self._arbiter = arbiter
        self._token: Token[ExecutionContext | None] | None = None

    def above(self) -> Iterator[Hold]:
        """Yield the claims of the ancestor nodes, nearest first."""
        each = self.parent
        while each is not None:
            yield each
            each = each.parent

    def enter(self, context: ExecutionContext) -> None:
        """Make this claim the parent of claims made later in this context."""
        self._token = execution_context.set(ExecutionContext(context.watches, self._arbiter, self))

    def release(self) -> None:
        """Release the parts after the node has ended, and grant waiting claims."""
        self._arbiter.release(self)
        assert self._token is not None
        try:
            execution_context.reset(self._token)
        except ValueError:
            # A dropped plan is closed in another context, whose execution context must not change.
            return


class Arbiter:
    """Grants the claims of all nodes inside one parallel expression; belongs to one event loop."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self._holding: list[Claim] = []
        self._waiting: list[Claim] = []

    async def claim(self, designator: Performable) -> Claim | None:
        """Wait until the designator's parts are free and hold them in this context; None if it needs none.

        Raises `ResourceDeadlock` if the wait would never end.
        """
        resources = designator.resources()
        if not resources or asyncio.get_running_loop() is not self.loop:
            return None
        context = execution_context.get()
        assert context is not None, "an arbiter belongs to an execution context"
        world = current_world.get()
        robot = (acting_robot(world) or world) if world is not None else None
        claim = Claim(self, designator, frozenset((robot, resource) for resource in resources), context.claim)
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
        claim.enter(context)
        return claim

    def release(self, claim: Claim) -> None:
        """Release the claim's parts; its ancestors may still hold them."""
        self._holding.remove(claim)
        self._grant()

    # --- granting and deadlock detection ----------------------------------------------------------------------

    def _withdraw(self, claim: Claim) -> None:
        """Remove a claim whose wait was cancelled, possibly just after it was granted."""
        (self._holding if claim in self._holding else self._waiting).remove(claim)
        self._grant()

    def _grant(self) -> None:
        """Grant every claim that can be granted, in the order of arrival.

        Repeat until nothing changes, because a grant may free an earlier claim from queueing behind another.
        """
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
        """Return the claims that hold a part it needs, except its ancestors."""
        above = set(claim.above())
        return [each for each in self._holding if each not in above and each.parts & claim.parts]

    def _must_queue(self, claim: Claim) -> bool:
        """Return whether an earlier claim goes first."""
        above = set(claim.above())
        return any(not self._waits_for(earlier, above) for earlier in self._earlier_rivals(claim))

    def _earlier_rivals(self, claim: Claim) -> list[Claim]:
        """Return the earlier waiting claims that need some of the same parts."""
        earlier = self._waiting[: self._waiting.index(claim)]
        return [each for each in earlier if each.parts & claim.parts]

    def _waits_for(self, waiter: Claim, ends: set[Hold]) -> bool:
        """Return whether `waiter` can be granted, or may be, only after one of `ends` has ended."""
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

    def _waiting_in(self, holder: Hold) -> list[Claim]:
        """Return the claims that wait inside the holder, which cannot end before they do."""
        return [each for each in self._waiting if holder in each.above()]

    def _check_deadlock(self, claim: Claim) -> None:
        """Raise `ResourceDeadlock` if a holder waits, directly or indirectly, for an ancestor of the claim."""
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
