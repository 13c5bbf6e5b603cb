"""`@with_tree` records the outermost call of a plan as one episode, as the thesis' plans are decorated."""

import asyncio
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, with_tree
from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Action, ProcessMetaData
from pycrorm_async.plan import ActionAbstract, PlanFailure


@dataclass
class StirActionPerformable(ActionAbstract):
    rounds: int

    async def perform(self) -> None:
        if self.rounds < 0:
            raise PlanFailure("it is stirred backwards")


@with_tree
async def stir(rounds: int, *, twice: bool = False) -> int:
    """Stir the soup.

    Slowly.
    """
    await StirActionPerformable(rounds).perform()
    await StirActionPerformable(rounds + 1).perform()
    return rounds + (await stir(rounds) if twice else 0)


@with_tree
async def cook() -> list[int]:
    return list(await asyncio.gather(stir(1), stir(2, twice=True)))


async def episodes(memory: Memory) -> list[tuple[str, str | None, str, int]]:
    await memory.flush()
    async with memory.session() as session:
        rows = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
        counts = [action.process_metadata_id for action in (await session.scalars(select(Action))).all()]
        return [(each.description, each.plan, each.status, counts.count(each.id)) for each in rows]


async def test_the_outermost_call_is_one_episode_and_inner_ones_are_part_of_it(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        assert await cook() == [1, 4]
        assert await stir(5) == 5
        with pytest.raises(PlanFailure):
            await stir(-1)
        async with memory.episode(description="by hand"):
            await stir(7)
        assert await episodes(memory) == [
            ("cook", "cook", "SUCCEEDED", 6),
            ("Stir the soup.", "stir", "SUCCEEDED", 2),
            ("Stir the soup.", "stir", "FAILED", 1),
            ("by hand", None, "SUCCEEDED", 2),
        ]


async def test_without_a_memory_the_plan_is_performed_and_keeps_its_name() -> None:
    assert await stir(1, twice=True) == 2
    assert (stir.__name__, stir.__doc__ and stir.__doc__.split("\n")[0]) == ("stir", "Stir the soup.")


async def test_a_connected_memory_records_it_in_every_context(tmp_path: Path) -> None:
    memory = await Memory.connect(f"sqlite:///{tmp_path}/memory.db")
    try:
        await asyncio.create_task(stir(3))
        assert [each[0] for each in await episodes(memory)] == ["Stir the soup."]
    finally:
        await memory.close()
    assert await stir(3) == 3


def test_a_function_that_cannot_be_awaited_is_refused_where_it_is_defined() -> None:
    with pytest.raises(CallerError, match="with_tree needs an `async def`, got <function"):
        with_tree(lambda: None)  # type: ignore[arg-type, return-value]


async def test_a_plan_with_some_arguments_fixed_is_named_by_the_plan(tmp_path: Path) -> None:
    async def pour(rounds: int) -> None:
        await StirActionPerformable(rounds).perform()

    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        await with_tree(partial(pour, 3))()
        assert await episodes(memory) == [("pour", "pour", "SUCCEEDED", 1)]
