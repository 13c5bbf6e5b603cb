"""Keep the cases of a memory at hand: the stored blocks, and the cases of this process that are not stored yet.

Theory of operation. Before each recall the reader asks the source for the numbers of the blocks, and reads those that
it does not have. A merge replaces blocks by one with a new number; the source returns both in one snapshot, so that no
case is missing or doubled. A rebuild begins another generation, and the reader begins again. A case of this process is
at hand as soon as its action has ended; when a stored block has it, the block's is taken.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.recall.activation import Forgotten, forgotten
from pycrorm_async.recall.blocks import EPISODE_SHIFT, Block
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.following import Sequences
from pycrorm_async.recall.library import CaseLibrary

__all__ = ["BlockSource", "CaseReader", "NoRunningCases", "RunningCases", "StoredBlocks"]


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

    async def read(self, generation: int, known: Collection[int]) -> StoredBlocks:
        """Return the numbers of all blocks, and those blocks that are not known to a reader of this generation."""
        ...


class RunningCases(Protocol):
    """The cases of this process, stored or not."""

    async def new(self) -> Sequence[Case]:
        """Return the cases of the actions that have ended since the last call."""
        ...


class NoRunningCases:
    """The cases of a process that records nothing."""

    async def new(self) -> Sequence[Case]:
        """Return nothing."""
        return ()


class CaseReader:
    """The cases of one memory, for one event loop."""

    def __init__(self, source: BlockSource, running: RunningCases | None = None) -> None:
        self._source = source
        self._running = running if running is not None else NoRunningCases()
        self._generation = -1
        self._blocks: dict[int, Block] = {}
        self._unstored: dict[int, Case] = {}
        self._hidden: NDArray[np.int64] = np.zeros(0, np.int64)
        self._library = CaseLibrary()
        self._sequences: tuple[CaseLibrary, Sequences] | None = None
        self._reading = asyncio.Lock()

    async def library(self) -> CaseLibrary:
        """Return all cases that have ended, those that are hidden left out."""
        async with self._reading:
            return await self._read()

    async def sequences(self) -> Sequences:
        """Return these cases in the order in which they happened."""
        library = await self.library()
        if self._sequences is None or self._sequences[0] is not library:
            self._sequences = library, Sequences(library)
        return self._sequences[1]

    async def forget(self, threshold: float, now_us: int, *, dry_run: bool) -> Forgotten:
        """Hide the cases whose ways have an activation below the threshold now, and no others, from this reader."""
        async with self._reading:
            hidden, self._hidden = self._hidden, np.zeros(0, np.int64)
            found = forgotten(await self._read(changed=hidden.size > 0), threshold=threshold, now_us=now_us)
            self._hidden = hidden if dry_run else found.nodes
            if self._hidden.size:
                await self._read(changed=True)
            return found

    async def _read(self, *, changed: bool = False) -> CaseLibrary:
        running = await self._running.new()
        stored = await self._source.read(self._generation, self._blocks.keys())
        if stored.generation != self._generation:
            self._generation, self._blocks, changed = stored.generation, {}, True
        merged = self._blocks.keys() - stored.numbers
        for number in merged:
            del self._blocks[number]
        self._blocks.update(stored.added)
        self._unstored.update((case.node, case) for case in running)
        before = len(self._unstored)
        looked_in = self._blocks if running else stored.added  # a new case may be in a block that was read before
        if self._unstored:
            for node in _nodes_in(looked_in.values(), self._unstored):
                del self._unstored[node]
        if changed or running or merged or stored.added or len(self._unstored) != before:
            self._library = CaseLibrary(self._visible())
        return self._library

    def _visible(self) -> list[Block]:
        blocks = [*self._blocks.values(), *([Block.of(self._unstored.values())] if self._unstored else [])]
        if not self._hidden.size:
            return blocks
        kept = [(block, ~np.isin(block.nodes, self._hidden)) for block in blocks]
        return [block if each.all() else block.where(each) for block, each in kept if each.any()]


def _nodes_in(blocks: Collection[Block], cases: Mapping[int, Case]) -> list[int]:
    """Return the nodes of these cases that a block has. Only the cases of their episodes are compared."""
    nodes = np.fromiter(cases, np.int64, len(cases))
    first, last = int(nodes.min()) >> EPISODE_SHIFT, (int(nodes.max()) >> EPISODE_SHIFT) + 1
    stored: list[int] = []
    for block in blocks:
        near = block.nodes[(block.nodes >= first << EPISODE_SHIFT) & (block.nodes < last << EPISODE_SHIFT)]
        stored += np.intersect1d(near, nodes).tolist()
    return stored
