"""Define protocols for the designators, arbiters and monitors that the execution of plans uses without importing them.

Designators import the execution, which creates their nodes; with these protocols the execution need not import them.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Coroutine
from typing import Any, ClassVar, Literal, Protocol

from pycrorm_async.plan.language.resources import Resource

NodeKind = Literal["root", "action", "motion", "language"]


class Performable(Protocol):
    """A designator, as its node sees it."""

    kind: ClassVar[NodeKind]
    dtype: ClassVar[str]
    concept: ClassVar[str | None]

    def perform(self) -> Coroutine[Any, Any, Any]:
        """Perform it and return when it has ended."""
        ...

    def resources(self) -> frozenset[Resource]:
        """Return the parts of the robot it uses exclusively from start to end."""
        ...


class Hold(Protocol):
    """A node's exclusive use of parts of the robot."""

    @property
    def parent(self) -> Hold | None:
        """The hold of the nearest ancestor that has one."""
        ...

    def release(self) -> None:
        """Release the parts after the node has ended."""
        ...


class Gate(Protocol):
    """Lets a node start when the parts of the robot that it uses are free."""

    @property
    def loop(self) -> AbstractEventLoop:
        """The event loop whose nodes it lets start."""
        ...

    async def claim(self, designator: Performable) -> Hold | None:
        """Wait for the designator's parts and hold them, in the current execution context; None if it needs none.

        Raises `ResourceDeadlock` if the wait would never end.
        """
        ...


class Interrupter(Protocol):
    """Interrupts the plan inside it when a condition holds."""

    @property
    def fired(self) -> bool:
        """True once it has interrupted the plan."""
        ...

    async def check(self) -> None:
        """Interrupt the plan and raise `CancelledError` if the condition holds."""
        ...
