"""Keep the cases of a memory in this process: the stored blocks, and its own cases that are not stored yet.

Theory of operation. Before each recall the reader asks the source for the numbers of the blocks, and reads those that
it does not have. A merge replaces blocks by one with a new number; the source returns both in one snapshot, so that no
case is missing or doubled. In another generation, which a rebuild has made, all blocks are new. A case of this process
is included as soon as its action has ended; once a stored block has it too, that of the block is used.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.recall.activation import Forgotten, forgotten
from pycrorm_async.recall.blocks import Block, merge
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.following import Sequences
from pycrorm_async.recall.library import CaseLibrary

_UNSTORED_BLOCKS = 16
"""Bounds the blocks of cases of this process, each of one recall; more of them are merged."""


class StoredBlocks(NamedTuple):
    """The blocks that a memory has at one moment.

    Attributes:
        generation: of the tables; a block's number means another block in another generation.
        numbers: of all blocks.
        added: those that the reader did not have, by number.
    """

    generation: int
    numbers: frozenset[int]
    added: Mapping[int, Block]


class BlockSource(Protocol):
    """The blocks of a memory."""

    async def read(self, generation: int, block_numbers: Collection[int]) -> StoredBlocks:
        """Return the numbers of all blocks, and the blocks that a reader lacks.

        The reader has the blocks with these numbers of this generation; of another generation it gets all blocks.
        """
        ...

    async def present_names(self) -> Mapping[str, str]:
        """Return the present name of each type that the memory knows, by all the names that it had."""
        ...


class RunningCases(Protocol):
    """The cases of this process, stored or not."""

    async def new(self) -> tuple[Sequence[Case], Sequence[Case]]:
        """Return the new cases of actions that have ended, and all cases whose episodes have no number yet."""
        ...


class NoRunningCases:
    """The cases of a process that records nothing."""

    async def new(self) -> tuple[Sequence[Case], Sequence[Case]]:
        """Return nothing."""
        return (), ()


class CaseReader:
    """The cases of one memory, for one event loop."""

    def __init__(self, source: BlockSource, running: RunningCases | None = None) -> None:
        self._source = source
        self._running = running if running is not None else NoRunningCases()
        self._generation = -1
        self._blocks: dict[int, Block] = {}
        self._unstored: list[Block] = []
        self._unnumbered: Sequence[Case] = ()
        self._hidden: NDArray[np.int64] = np.zeros(0, np.int64)
        self._library = CaseLibrary()
        self._names: Mapping[str, str] = {}
        self._aliases: dict[str, str] = {}
        self._sequences: tuple[CaseLibrary, Sequences] | None = None
        self._reading = asyncio.Lock()

    async def library(self, type: str | None = None, aliases: Collection[str] = ()) -> CaseLibrary:  # noqa: A002
        """Return all cases that are not hidden, under the present names of their types.

        Args:
            type: the type of the next cue, because the memory may know it by another name.
            aliases: former names of this type, also if the memory does not know them yet.
        """
        async with self._reading:
            library = await self._read()
            unknown = {*library.recorded_types, *([] if type is None else [type])} - self._names.keys()
            if unknown or not self._aliases.keys() >= {*aliases}:
                self._aliases |= {alias: type for alias in aliases if type is not None}
                names = dict(await self._source.present_names())
                names |= {alias: each for alias, each in self._aliases.items() if names.get(alias, alias) == alias}
                if library.joins(names):
                    self._library = CaseLibrary(library.blocks, names)
                self._names = names
            return self._library

    async def sequences(self, type: str | None = None, aliases: Collection[str] = ()) -> Sequences:  # noqa: A002
        """Return these cases in the order in which they happened."""
        library = await self.library(type, aliases)
        if self._sequences is None or self._sequences[0] is not library:
            self._sequences = library, Sequences(library)
        return self._sequences[1]

    async def forget(self, threshold: float, now_us: int, *, dry_run: bool) -> Forgotten:
        """Hide the cases whose ways have an activation below the threshold now, and no others, from this reader."""
        async with self._reading:
            hidden, self._hidden = self._hidden, np.zeros(0, np.int64)
            cases = forgotten(await self._read(changed=hidden.size > 0), threshold=threshold, now_us=now_us)
            self._hidden = hidden if dry_run else cases.nodes
            if self._hidden.size:
                await self._read(changed=True)
            return cases

    async def _read(self, *, changed: bool = False) -> CaseLibrary:
        running, unnumbered = await self._running.new()
        stored = await self._source.read(self._generation, self._blocks.keys())
        self._generation = stored.generation  # of another generation the source has returned all blocks
        gone = self._blocks.keys() - stored.numbers
        for number in gone:
            del self._blocks[number]
        self._blocks.update(stored.added)
        unstored = self._unstored
        if stored.added:
            unstored = _without(unstored, stored.added.values())
        if running:
            unstored = [*unstored, *_without([Block.of(running)], self._blocks.values())]
        if changed or gone or stored.added or unstored != self._unstored or [*unnumbered] != [*self._unnumbered]:
            self._unstored = unstored if len(unstored) <= _UNSTORED_BLOCKS else [merge(unstored)]
            self._unnumbered = unnumbered
            self._library = CaseLibrary(self._visible(), self._names)
        return self._library

    def _visible(self) -> list[Block]:
        blocks = [*self._blocks.values(), *self._unstored, *([Block.of(self._unnumbered)] if self._unnumbered else [])]
        if not self._hidden.size:
            return blocks
        kept = [(block, ~np.isin(block.nodes, self._hidden)) for block in blocks]
        return [block if each.all() else block.where(each) for block, each in kept if each.any()]


def _without(blocks: Sequence[Block], stored: Collection[Block]) -> list[Block]:
    """Return the blocks without the cases that a stored block has; a block of which none are left is left out."""
    left: list[Block] = []
    for block in blocks:
        first, last = block.nodes.min(), block.nodes.max()
        both = [np.isin(block.nodes, each.nodes[(each.nodes >= first) & (each.nodes <= last)]) for each in stored]
        kept = ~np.logical_or.reduce(both) if both else np.ones(len(block), np.bool_)
        if kept.any():
            left.append(block if kept.all() else block.where(kept))
    return left
