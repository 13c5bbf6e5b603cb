"""Blocks of cases and their readers: nothing is lost or doubled through merges, rebuilds and changes."""

from __future__ import annotations

import random
from collections.abc import Collection, Mapping, Sequence
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import event

from pycrorm_async import Reading
from pycrorm_async.events.ids import row_id, row_key
from pycrorm_async.recall import blocks
from pycrorm_async.recall.blocks import CaseBlock, decode, encode, is_same, merge
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.recall import CaseReader, DatabaseSource, StoredBlocks
from pycrorm_async.recall.search import forgotten
from pycrorm_async.store.log import EventLog
from tests.recall.cases import CASES, TYPES, cases_of, kept_case, random_cases, random_script
from tests.recall.test_cases import projector_of, rebuilt, small_blocks

# === blocks ===================================================================================================
#
# Blocks of cases: nothing is lost in their bytes or in a merge.


def kept(cases: list[Case]) -> list[Case]:
    """The cases as a block has them: bounded, by type, the newest first."""
    ordered = sorted(map(kept_case, cases), key=lambda case: (case.started_us, case.node), reverse=True)
    return sorted(ordered, key=lambda case: case.type)


@settings(max_examples=10)
@given(CASES)
def test_a_block_returns_its_cases_from_its_bytes(cases: list[Case]) -> None:
    block = decode(encode(CaseBlock.of(cases)))
    assert list(block.cases()) == kept(cases)
    assert len(block) == len(cases)


@settings(max_examples=10)
@given(CASES, st.randoms())
def test_the_same_cases_make_the_same_bytes_in_any_order_and_in_any_parts(
    cases: list[Case], chance: random.Random
) -> None:
    data = encode(CaseBlock.of(cases))
    mixed = chance.sample(cases, len(cases))
    borders = sorted(chance.choices(range(len(cases) + 1), k=3))
    parts = [mixed[: borders[0]], mixed[borders[0] : borders[1]], mixed[borders[1] : borders[2]], mixed[borders[2] :]]
    blocks = [decode(encode(CaseBlock.of(part))) for part in parts if part]
    assert encode(merge(blocks)) == data


@settings(max_examples=10)
@given(CASES, CASES, st.randoms())
def test_blocks_are_the_same_where_their_cases_are_whatever_else_they_had(
    cases: list[Case], others: list[Case], chance: random.Random
) -> None:
    episode = max(row_key(each.node).number for each in cases) + 1
    elsewhere = [each._replace(node=row_id(episode, row_key(each.node).sequence, 0), parent=None) for each in others]
    block = CaseBlock.of(cases)
    assert is_same(block, CaseBlock.of([*cases, *elsewhere]).of_episodes(0, episode))
    changed = chance.choice(cases)
    rest = [each for each in cases if each is not changed]
    symbols, numbers = {**changed.symbols, "changed": "yes"}, {**changed.numbers, "changed": 1.0}
    for other in (
        rest,
        [*cases, changed],
        [*rest, changed._replace(symbols=symbols)],
        [*rest, changed._replace(numbers=numbers)],
        [*rest, changed._replace(type="ChangedAction")],
        [*rest, changed._replace(started_us=changed.started_us + 1)],
        [*rest, changed._replace(status="CHANGED")],
        [*rest, changed._replace(duration_s=None if changed.duration_s else 1.0)],
    ):
        assert not is_same(block, CaseBlock.of(other))


def test_a_case_keeps_its_parent_and_that_it_was_simulated() -> None:
    case = Case(row_id(3, 9, 0), 5, "PlaceAction", {}, {}, "LOST", parent=row_id(3, 4, 0), simulated=True)
    assert list(decode(encode(CaseBlock.of([case]))).cases()) == [case]


def stored(case: Case) -> Case:
    """The case after it was stored."""
    (stored,) = decode(encode(CaseBlock.of([case]))).cases()
    return stored


def test_what_a_memory_cannot_compare_is_left_out_of_a_case() -> None:
    texts: dict[str, str | tuple[str, ...]] = {"prose": "a" * 121, "arm": "LEFT", "near": ("b" * 1_000_000, "CUP")}
    case = stored(Case(32, 0, "A", texts, {"x": float("nan"), "y": float("inf"), "z": 0.1}, "FAILED", "c" * 121))
    assert case == Case(32, 0, "A", {"arm": "LEFT", "near": ("CUP",)}, {"z": float(np.float32(0.1))}, "FAILED")
    assert case.numbers["z"] != 0.1, "numbers are float32"
    many = tuple(f"f{number:05}" for number in range(1_000))
    crowded = Case(32, 0, "A", {"near": many, **dict.fromkeys(many, "x")}, dict.fromkeys(many, 1.0), "FAILED")
    assert stored(crowded) == crowded, "any number of features and words is kept"


def test_a_feature_cannot_have_the_name_of_an_outcome() -> None:
    with pytest.raises(AssertionError, match="status"):
        CaseBlock.of([Case(32, 0, "A", {"status": "x"}, {}, "FAILED")])


def test_a_feature_with_too_many_words_is_left_out_and_stays_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "WORDS_MAX", 16)
    cases = [Case(row_id(1, n, 0), n, "A", {"arm": "LEFT", "id": f"{n}"}, {}, "FAILED") for n in range(1, 20)]
    halves = [CaseBlock.of(cases[:10]), CaseBlock.of(cases[10:])]
    assert [each.left_out for each in halves] == [frozenset(), frozenset()]
    merged = merge(halves)
    assert merged.left_out == {"id"}
    assert {name for case in merged.cases() for name in case.symbols} == {"arm"}
    again = merge([decode(encode(merged)), CaseBlock.of(random_cases(3, seed=1))])
    assert again.left_out == {"id"}


# === case reader ==============================================================================================
#
# A reader has every case once, through merges, rebuilds and while cases of its own process are not stored yet.


class Memory:
    """Blocks in memory, and the cases of this process."""

    def __init__(self) -> None:
        self.generation = 1
        self.blocks: dict[int, CaseBlock] = {}
        self.ended: list[Case] = []
        self.unnumbered: list[Case] = []
        self.read_numbers: list[int] = []
        self._next = 0

    def store(self, cases: Sequence[Case]) -> None:
        self._next += 1
        self.blocks[self._next] = CaseBlock.of(cases)

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
    for seed in range(4):
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


# === database source ==========================================================================================
#
# A reader of a memory sees each change of its blocks, and asks once where nothing has changed.


@pytest.mark.soak_on("postgresql")
async def test_a_reader_sees_new_merged_and_rebuilt_blocks_and_asks_once_where_none_has_changed(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_blocks(monkeypatch)
    random = Random(5)
    scripts = [random_script(number, random, actions=20) for number in range(1, 5)]
    await log.append([*TYPES, *scripts[0].records])
    projector = await projector_of(log)
    await projector.catch_up()
    async with Reading.open(database_url) as reading:
        reader = CaseReader(DatabaseSource(reading))
        statements: list[str] = []

        @event.listens_for((await reading.log()).engine.sync_engine, "before_cursor_execute")
        def note(*arguments: object) -> None:
            if str(arguments[2]).startswith("SELECT"):  # and not a BEGIN
                statements.append(str(arguments[2]))

        for count in range(1, 5):
            if count > 1:
                await log.append(scripts[count - 1].records)
                await projector.catch_up()
            nodes = [each.node for each in cases_of(*scripts[:count])]
            library = await reader.library()
            assert sorted(each.node for each in library) == nodes
            statements.clear()
            assert await reader.library() is library
            assert len(statements) == 1, statements
        await rebuilt(log)  # which drops the tables that the reader has found
        assert sorted(each.node for each in await reader.library()) == nodes
        statements.clear()
        await reader.library()
        assert len(statements) == 1, statements
