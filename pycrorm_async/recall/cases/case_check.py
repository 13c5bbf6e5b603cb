"""Compare the stored cases with those that the log makes, episode by episode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DamageError
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_key
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.run.batch_fold import Batch
from pycrorm_async.projections.verify.findings import VerifyResult
from pycrorm_async.projections.verify.parts import EpisodeRange
from pycrorm_async.projections.verify.row_comparison import Comparison, Difference
from pycrorm_async.projections.verify.verify_custom import ProjectionCheck
from pycrorm_async.recall.blocks import Block
from pycrorm_async.recall.case import Case
from pycrorm_async.recall.cases.case_batch import CaseBatch
from pycrorm_async.recall.cases.stored_blocks import BLOCKS, BlockHeading, read_blocks, read_headings

_BLOCKS_KEPT: Final = 20
"""Bounds the blocks that are kept decoded between parts, because a full one has the cases of many parts: 5 MB each."""


class CaseCheck(ProjectionCheck):
    """The check of the blocks of cases. Implements `PartCheck`; a part consists of whole episodes."""

    def __init__(self, projection: Projection, result: VerifyResult) -> None:
        super().__init__(projection, result)
        self._blocks: dict[int, Block | None] = {}

    async def differences(
        self, connection: AsyncConnection, comparison: Comparison, rows: Batch, episodes: EpisodeRange
    ) -> Sequence[Difference]:
        assert isinstance(rows, CaseBatch)
        number = comparison.generation.number
        end = EPISODE_NUMBER_MAX + 1 if episodes.end is None else episodes.end
        headings = [
            each
            for each in await read_headings(connection, number)
            if each.episode_min < end and each.episode_max >= episodes.first
        ]
        blocks = [block for each in headings if (block := await self._block(connection, number, each)) is not None]
        left_out = frozenset().union(*(each.left_out for each in blocks))
        folded = Block.of(rows.cases) if rows.cases else None
        expected = {each.node: each for each in _without(left_out, folded.cases() if folded is not None else ())}
        stored: dict[int, Case] = {}
        differences: list[Difference] = []
        for block in blocks:
            for case in _without(left_out, _of_episodes(block, episodes.first, end)):
                self.result.rows += 1
                if case.node in stored:
                    differences.append(_difference(case.node, "blocks with it", 2, 1))
                stored[case.node] = case
        for node in sorted(expected.keys() | stored.keys()):
            differences += _compared(node, stored.get(node), expected.get(node))
        return differences

    async def _block(self, connection: AsyncConnection, generation: int, heading: BlockHeading) -> Block | None:
        """Read a block, once for all parts whose cases it contains. A damaged one is reported, and counts as empty."""
        kept = self._blocks
        if heading.number not in kept:
            block: Block | None = None
            try:
                block = (await read_blocks(connection, generation, [heading.number])).get(heading.number)
                if block is None or len(block) != heading.cases:
                    cases = 0 if block is None else len(block)
                    self._report(heading, f"has {cases} cases, and should have {heading.cases}")
            except DamageError as fault:
                self._report(heading, str(fault))
            kept[heading.number] = block
            if len(kept) > _BLOCKS_KEPT:
                kept.pop(next(iter(kept)))
        return kept[heading.number]

    def _report(self, heading: BlockHeading, fault: str) -> None:
        self.result.add_difference(
            Difference(heading.episode_min, 1, BLOCKS, f"block {heading.number}", fault, "as it was written")
        )


def _of_episodes(block: Block, first: int, end: int) -> Iterator[Case]:
    for group in block.groups.values():
        for row in np.flatnonzero((group.episodes >= first) & (group.episodes < end)).tolist():
            yield group.case(row)


def _compared(node: int, stored: Case | None, expected: Case | None) -> Iterator[Difference]:
    if stored == expected:
        return
    if stored is None or expected is None:
        yield _difference(node, None, stored, expected)
        return
    for name, was, should in zip(Case._fields, stored, expected, strict=True):
        if was == should:
            continue
        if not isinstance(was, Mapping) or not isinstance(should, Mapping):
            yield _difference(node, name, was, should)
            continue
        for feature in sorted(was.keys() | should.keys()):
            if was.get(feature) != should.get(feature):
                yield _difference(node, feature, was.get(feature), should.get(feature))


def _difference(node: int, column: str | None, stored: Any, expected: Any) -> Difference:
    number, sequence, _ = row_key(node)
    return Difference(number, sequence, BLOCKS, column, stored, expected)


def _without(features: frozenset[str], cases: Iterable[Case]) -> Iterator[Case]:
    """Return the cases without the features that a block has left out, because their dictionaries are too long."""
    for case in cases:
        symbols = {name: value for name, value in case.symbols.items() if name not in features}
        yield case if len(symbols) == len(case.symbols) else case._replace(symbols=symbols)
