"""Plans made at random, whose parts keep a record of their own of what happened to them.

A `Thing` is a part of a plan: it knows its place (path) and what it will do. `built` makes the performable of it, of
classes that write into a `Journal` when they start and how they end. The journal knows nothing of the task tree: who is
inside whom follows from the paths alone.
"""

from __future__ import annotations

import asyncio
import functools
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pycrorm_async.plan import (
    ActionAbstract,
    ActionDescription,
    Designator,
    Monitor,
    Parallel,
    PlanFailure,
    Repeat,
    Resource,
    Retry,
    Sequential,
    TryAll,
    TryInOrder,
)
from pycrorm_async.plan.failures import IKError, ObjectLost, Timeout
from pycrorm_async.world import Arms, Pose

Path = tuple[int, ...]

AT_ONCE = ("parallel", "all", "gather", "group")
FLAT = ("sequential", "in_order", "parallel", "all")
ACTIONS = ("then", "anyway", "cleanup", "gather", "group", "timeout")
ORDINARY = ("sequential", "in_order", "parallel", "all", "repeat", "retry", "alternatives", "then", "anyway", "gather")
WILD = (*ORDINARY, "monitor", "monitor", "cleanup", "group", "timeout")


@dataclass
class Thing:
    """A part of a plan.

    Attributes:
        does: of a leaf, what each of its runs does: ok, fail, bug, cancelled, cancels.
        times: rounds, tries, or the asking at which a monitor's condition holds.
    """

    kind: str
    path: Path
    children: list[Thing] = field(default_factory=list)
    does: list[str] = field(default_factory=list)
    pauses: int = 0
    times: int = 1
    wants: frozenset[Resource] = frozenset()
    nesting: int = 0

    def all(self) -> list[Thing]:
        return [self, *(each for child in self.children for each in child.all())]


class Generator:
    """Plans of nested expressions and actions.

    Args:
        wild: with bugs, cancellations, monitors, and parts of the robot they want.
        greedy: branches that want parts at the outermost level, often more inside of what they have.
    """

    def __init__(self, seed: int, *, wild: bool, greedy: bool) -> None:
        self._dice = random.Random(seed)
        self._kinds = WILD if wild or greedy else ORDINARY
        self._ends = ["ok"] * 12 + ["fail"] * 6 + (["bug", "cancelled", "cancels"] if wild else [])
        self._wild = wild
        self._greedy = greedy

    def plan(self) -> Thing:
        return self._thing((), 4, "", self._dice.choice(["parallel", "all"]) if self._greedy else None)

    def _thing(self, path: Path, depth: int, above: str, kind: str | None = None) -> Thing:
        dice = self._dice
        if depth == 0 or (path and dice.random() < 0.2):
            does = [dice.choice(self._ends) for _ in range(3)]
            return Thing("leaf", path, does=does, pauses=dice.choice([0, 0, 1, 2, 5]), wants=self._wants(0.5))
        # An expression in one of its own kind would be one with it: that is what `nesting` is for.
        kinds = [each for each in self._kinds if each != above or each not in FLAT]
        kind = kind or dice.choice(ACTIONS if above in AT_ONCE and self._greedy else kinds)
        count = (
            1 if kind in ("repeat", "retry", "monitor", "timeout") else 2 if kind == "cleanup" else dice.randint(2, 4)
        )
        return Thing(
            kind,
            path,
            [self._thing((*path, number), depth - 1, kind) for number in range(count)],
            times=dice.randint(1, 12) if kind == "monitor" else dice.randint(1, 3),
            pauses=dice.choice([0, 1, 3, 50]),
            wants=self._wants(0.3) if kind in ACTIONS else frozenset(),
            nesting=dice.randrange(3),
        )

    def _wants(self, chance: float) -> frozenset[Resource]:
        if not (self._wild or self._greedy) or self._dice.random() > (0.9 if self._greedy else chance):
            return frozenset()
        parts = [Resource.LEFT_ARM, Resource.RIGHT_ARM, Resource.BASE]
        return frozenset(self._dice.sample(parts, 1 if self._greedy else self._dice.randint(1, 2)))


@dataclass
class Entry:
    """One run of a thing."""

    thing: Thing
    dtype: str
    parent: int | None
    status: str = "RUNNING"
    reason: str | None = None
    message: str | None = None


class Journal:
    """What the things say of themselves.

    Attributes:
        entries: in the order they started.
        fired: paths of the monitors whose condition held, until they run again.
        collisions: things that held the same part of the robot at once in branches of one parallel expression.
        tasks: that were started by actions of the plan.
    """

    def __init__(self, plan: Thing) -> None:
        self.entries: list[Entry] = []
        self.fired: set[Path] = set()
        self.collisions: list[tuple[Path, Path]] = []
        self.tasks: list[asyncio.Task[Any]] = []
        self._runs: dict[Path, int] = {}
        self.plan = plan
        self._kinds = {thing.path: thing.kind for thing in plan.all()}
        self.counts: dict[Path, int] = {}

    def started(self, thing: Thing, dtype: str) -> Entry:
        parent = self._runs[thing.path[:-1]] if thing.path else None
        entry = Entry(thing, dtype, parent)
        for other in self.entries:
            if other.status == "RUNNING" and other.thing.wants & thing.wants and self._in_turns(other.thing, thing):
                self.collisions.append((other.thing.path, thing.path))
        self._runs[thing.path] = len(self.entries)
        self.entries.append(entry)
        return entry

    def ended(self, entry: Entry, error: BaseException | None, *, interrupted: bool = False) -> None:
        if error is None:
            entry.status = "INTERRUPTED" if interrupted else "SUCCEEDED"
            return
        entry.reason = type(error).__name__
        entry.message = str(error)
        if isinstance(error, asyncio.CancelledError):
            path = entry.thing.path
            inside = any(path[:length] in self.fired for length in range(len(path)))
            entry.status = "INTERRUPTED" if inside else "CANCELLED"
        else:
            entry.status = "FAILED" if all(isinstance(each, PlanFailure) for each in _leaves(error)) else "ERROR"

    def next_does(self, thing: Thing) -> str:
        """What this run of a leaf does."""
        run = self.counts[thing.path] = self.counts.get(thing.path, -1) + 1
        return thing.does[run % len(thing.does)]

    def _in_turns(self, one: Thing, other: Thing) -> bool:
        """Whether neither is inside the other, and both are inside of one parallel expression."""
        if one.path == other.path[: len(one.path)] or other.path == one.path[: len(other.path)]:
            return False
        shared = [a for a, b in zip(one.path, other.path, strict=False) if a == b]
        common = next(
            (number for number, (a, b) in enumerate(zip(one.path, other.path, strict=False)) if a != b), len(shared)
        )
        return any(self._kinds[one.path[:length]] in ("parallel", "all") for length in range(common + 1))


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for each in error.exceptions for leaf in _leaves(each)]
    return [error]


class Told:
    """What the classes below share: a thing, and a journal to tell."""

    thing: Any
    journal: Any

    async def tell(self, run: Callable[[], Awaitable[Any]]) -> Any:
        entry = self.journal.started(self.thing, type(self).dtype)  # type: ignore[attr-defined]  # of the designator
        try:
            result = await run()
        except BaseException as error:
            self.journal.ended(entry, error)
            raise
        self.journal.ended(entry, None, interrupted=isinstance(self, Monitor) and result.interrupted)
        return result


class ToldAction(Told, ActionAbstract):
    """A leaf, or an action that performs others as its kind says."""

    dtype: ClassVar[str] = "ToldAction"

    def __init__(self, thing: Thing, journal: Journal, parts: list[Designator]) -> None:
        self.thing = thing
        self.journal = journal
        self.parts = parts

    def resources(self) -> frozenset[Resource]:
        wants: frozenset[Resource] = self.thing.wants
        return wants

    async def perform(self) -> Any:
        return await self.tell(getattr(self, f"_{self.thing.kind}"))

    async def _leaf(self) -> str:
        does = self.journal.next_does(self.thing)
        for _ in range(self.thing.pauses):
            await asyncio.sleep(0)
        name = ".".join(map(str, self.thing.path))
        if does == "fail":
            kinds = (PlanFailure(name), ObjectLost(name, 7), IKError(Pose([1, 2, 3]), Arms.LEFT, name))
            raise kinds[sum(self.thing.path) % 3]
        if does == "bug":
            raise ValueError(name)
        if does == "cancelled":
            raise asyncio.CancelledError(name)
        if does == "cancels":
            task = asyncio.current_task()
            assert task is not None
            task.cancel(name)
            await asyncio.sleep(0)
        return name

    async def _then(self) -> None:
        for part in self.parts:
            await part.perform()

    async def _anyway(self) -> None:
        for part in self.parts:
            try:
                await part.perform()
            except PlanFailure:
                continue

    async def _cleanup(self) -> None:
        first, last = self.parts
        try:
            await first.perform()
        finally:
            await last.perform()

    async def _gather(self) -> None:
        tasks = [asyncio.create_task(part.perform()) for part in self.parts]
        self.journal.tasks += tasks
        try:
            await asyncio.gather(*tasks)
        finally:
            await asyncio.wait(tasks)

    async def _group(self) -> None:
        async with asyncio.TaskGroup() as group:
            for part in self.parts:
                self.journal.tasks.append(group.create_task(part.perform()))

    async def _timeout(self) -> None:
        (part,) = self.parts
        try:
            async with asyncio.timeout(self.thing.pauses / 1e4):
                await part.perform()
        except TimeoutError:
            raise Timeout("too late") from None


class ToldSequential(Told, Sequential):
    async def perform(self) -> Any:
        return await self.tell(super().perform)


class ToldTryInOrder(Told, TryInOrder):
    async def perform(self) -> Any:
        return await self.tell(super().perform)


class ToldParallel(Told, Parallel):
    async def perform(self) -> Any:
        return await self.tell(super().perform)


class ToldTryAll(Told, TryAll):
    async def perform(self) -> Any:
        return await self.tell(super().perform)


class ToldRepeat(Told, Repeat):
    async def perform(self) -> Any:
        return await self.tell(super().perform)


class ToldRetry(Told, Retry):
    async def perform(self) -> Any:
        return await self.tell(super().perform)


class ToldMonitor(Told, Monitor):
    async def perform(self) -> Any:
        self.journal.fired.discard(self.thing.path)
        self.journal.counts[self.thing.path] = 0
        return await self.tell(super().perform)


EXPRESSIONS: dict[str, type[ToldSequential | ToldTryInOrder | ToldParallel | ToldTryAll]] = {
    "sequential": ToldSequential,
    "in_order": ToldTryInOrder,
    "parallel": ToldParallel,
    "all": ToldTryAll,
}


def built(thing: Thing, journal: Journal) -> Designator:
    """What performs it."""
    parts = [built(child, journal) for child in thing.children]
    made: Any
    if thing.kind == "leaf" or thing.kind in ACTIONS:
        return ToldAction(thing, journal, parts)
    if thing.kind in FLAT:
        made = nested(EXPRESSIONS[thing.kind], parts, thing.nesting)
    elif thing.kind == "repeat":
        made = ToldRepeat(parts[0], thing.times)
    elif thing.kind == "monitor":
        made = parts[0] >> ToldMonitor(functools.partial(_holds, thing, journal), interval_s=0.0005)
    else:
        made = ToldRetry(parts[0] if thing.kind == "retry" else Alternatives(parts), thing.times)
    made.thing, made.journal = thing, journal
    return made  # type: ignore[no-any-return]  # one of those above


def nested(kind: type[Any], parts: list[Designator], nesting: int) -> Any:
    """The same expression, whole, or with its beginning or its end in an expression of the same kind."""
    if len(parts) < 3 or nesting == 0:
        return kind(*parts)
    return kind(kind(*parts[:2]), *parts[2:]) if nesting == 1 else kind(parts[0], kind(*parts[1:]))


class Alternatives(ActionDescription[Designator]):
    """A description whose alternatives are these."""

    def __init__(self, parts: list[Designator]) -> None:
        super().__init__(lambda part: part, part=parts)


def _holds(thing: Thing, journal: Journal) -> Any:
    """Whether a monitor's condition holds; half of them are async."""
    if thing.times % 2:
        return _holds_later(thing, journal)
    return _counted(thing, journal)


async def _holds_later(thing: Thing, journal: Journal) -> bool:
    await asyncio.sleep(0)
    return _counted(thing, journal)


def _counted(thing: Thing, journal: Journal) -> bool:
    journal.counts[thing.path] += 1
    holds = journal.counts[thing.path] > thing.times
    if holds:
        journal.fired.add(thing.path)
    return holds


__all__ = ["AT_ONCE", "Entry", "Journal", "Path", "Thing", "built", "Generator"]
