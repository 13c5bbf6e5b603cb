"""A reader has every case once, through merges, rebuilds and while cases of its own process are not stored yet."""

from __future__ import annotations

import random
from collections.abc import Collection, Mapping, Sequence

from pycrorm_async.recall.blocks import Block, merge
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.recall import CaseReader, StoredBlocks
from pycrorm_async.recall.search import forgotten
from tests.recall.random_cases import random_cases


class Memory:
    """Blocks in memory, and the cases of this process."""

    def __init__(self) -> None:
        self.generation = 1
        self.blocks: dict[int, Block] = {}
        self.ended: list[Case] = []
        self.unnumbered: list[Case] = []
        self.read_numbers: list[int] = []
        self._next = 0

    def store(self, cases: Sequence[Case]) -> None:
        self._next += 1
        self.blocks[self._next] = Block.of(cases)

    def merge(self, chance: random.Random) -> None:
        numbers = chance.sample(sorted(self.blocks), min(3, len(self.blocks)))
        if numbers:
            self._next += 1
            self.blocks[self._next] = merge([self.blocks.pop(number) for number in numbers])

    def rebuild(self) -> None:
        cases = [case for block in self.blocks.values() for case in block.cases()]
        self.generation += 1
        self.blocks, self._next = {}, 0
        if cases:
            self.store(cases)

    async def read(self, generation: int, known: Collection[int]) -> StoredBlocks:
        wanted = set(self.blocks) - (set(known) if generation == self.generation else set())
        self.read_numbers += wanted
        return StoredBlocks(self.generation, frozenset(self.blocks), {each: self.blocks[each] for each in wanted})

    async def present_names(self) -> Mapping[str, str]:
        return {}

    async def new(self) -> tuple[Sequence[Case], Sequence[Case]]:
        """The first case that ended has no number until the next call."""
        numbered, self.unnumbered, self.ended = [*self.unnumbered, *self.ended[1:]], self.ended[:1], []
        return numbered, [each._replace(node=each.node + (2**21 << 31)) for each in self.unnumbered]


async def test_every_case_is_at_hand_once_whatever_happens_to_the_blocks() -> None:
    for seed in range(20):
        chance = random.Random(seed)
        memory = Memory()
        reader = CaseReader(memory, memory)
        waiting: list[Case] = []
        cases = random_cases(60, seed)
        happened: set[int] = set()
        while cases:
            for _ in range(min(len(cases), chance.randrange(4))):
                case = cases.pop()
                happened.add(case.node)
                waiting.append(case)
                memory.ended.append(case)
            if chance.random() < 0.2:
                await reader.library()  # assigns every case its number
                assert sorted(case.node for case in await reader.library()) == sorted(happened)
            if chance.random() < 0.3 and waiting:
                memory.store(waiting)
                waiting = []
            if chance.random() < 0.2:
                memory.merge(chance)
            if chance.random() < 0.1:
                memory.rebuild()
        await reader.library()
        assert sorted(case.node for case in await reader.library()) == sorted(happened)


async def test_a_block_is_read_once() -> None:
    memory = Memory()
    reader = CaseReader(memory)
    memory.store(random_cases(5, 1))
    memory.store(random_cases(5, 2))
    library = await reader.library()
    assert await reader.library() is library
    memory.store(random_cases(5, 3))
    await reader.library()
    assert sorted(memory.read_numbers) == [1, 2, 3]
    assert await reader.sequences() is await reader.sequences()


async def test_what_is_forgotten_is_hidden_from_this_reader_until_it_forgets_less() -> None:
    memory = Memory()
    cases = random_cases(100, 4)
    memory.store(cases[:50])
    memory.store(cases[50:])
    reader, other = CaseReader(memory), CaseReader(memory)
    whole = await other.library()
    now_us = 10_000_000
    expected = forgotten(whole, threshold=-0.8, now_us=now_us)
    assert 0 < expected.cases < 100
    dry = await reader.forget(-0.8, now_us, dry_run=True)
    assert dry[:2] == expected[:2]
    assert len(await reader.library()) == 100
    assert (await reader.forget(-0.8, now_us, dry_run=False))[:2] == expected[:2]
    assert {case.node for case in await reader.library()} == {case.node for case in cases} - {*expected.nodes.tolist()}
    assert len(await other.library()) == 100
    dry_again = await reader.forget(-0.8, now_us, dry_run=True)
    assert dry_again[:2] == expected[:2], "what is hidden already is counted too"
    assert len(await reader.library()) == 100 - expected.cases
    await reader.forget(float("-inf"), now_us, dry_run=False)
    assert len(await reader.library()) == 100


async def test_nothing_is_left_of_a_memory_that_was_rebuilt_without_cases() -> None:
    memory = Memory()
    memory.store(random_cases(5, 1))
    reader = CaseReader(memory)
    assert len(await reader.library()) == 5
    memory.blocks.clear()
    memory.generation += 1
    assert len(await reader.library()) == 0
