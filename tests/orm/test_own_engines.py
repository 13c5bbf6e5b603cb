"""Generated classes in sessions of a caller's own engine, and classes that are newer than the memory."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, select
from sqlalchemy.ext.asyncio import AsyncEngine, AsyncSession, create_async_engine
from sqlalchemy.orm import Mapped, Session, aliased

from pycrorm_async import Memory
from pycrorm_async.errors import TablesOutdated
from pycrorm_async.orm import Action, PlaceAction
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.query.reading import Reading
from tests.databases import ask_to_change, put_memory


@dataclass
class WaveActionPerformable(ActionAbstract):
    hand: str
    times: int = 1

    async def perform(self) -> None:
        """Succeed without doing anything."""


class ORMNewcomer(Action):
    __tablename__ = "newcomer_action"
    name: Mapped[str]


@asynccontextmanager
async def own_engine(url: str) -> AsyncIterator[AsyncEngine]:
    if url.startswith("sqlite"):
        engine = create_async_engine(url.replace("sqlite:", "sqlite+aiosqlite:"))
    else:
        options = {"server_settings": {"search_path": "memory, pycrorm, public"}}
        engine = create_async_engine(url.replace("postgresql:", "postgresql+asyncpg:"), connect_args=options)
    yield engine
    await engine.dispose()


@pytest.mark.slow
async def test_a_session_of_an_own_engine_selects_generated_classes_in_every_way(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory, own_engine(database_url) as engine:
        await WaveActionPerformable("left").perform()
        await WaveActionPerformable("right", 3).perform()
        await memory.flush()
        wave = memory.mapped("WaveAction")
        other: Any = aliased(wave)
        async with AsyncSession(engine) as session:
            assert [each.hand for each in await session.scalars(select(wave).order_by(wave.id))] == ["left", "right"]
        async with AsyncSession(engine) as session:
            [(thrice,)] = await session.execute(select(other).where(other.times == 3))
            assert (type(thrice), thrice.hand) == (wave, "right")
            assert await session.get(wave, thrice.id) is thrice
        async with AsyncSession(engine) as session:
            assert {type(each) for each in await session.scalars(select(Action))} == {wave}
            assert list(await session.scalars(select(wave.times).order_by(wave.id))) == [1, 3]


async def test_an_own_engine_knows_the_classes_of_the_memory_that_is_open(tmp_path: Path) -> None:
    url = put_memory(tmp_path / "memory.db")
    engine = create_engine(url)
    for count in (1, 2):
        async with Memory.open(url) as memory:
            await WaveActionPerformable("left").perform()
            await memory.flush()
            wave = memory.mapped("WaveAction")
            with Session(engine) as session:
                assert [(type(each), each.hand) for each in session.scalars(select(wave))] == [(wave, "left")] * count
        with Session(engine) as session:  # its classes are unmapped
            assert {type(each) for each in session.scalars(select(Action))} == {Action}
    engine.dispose()


async def test_a_reader_says_which_class_an_older_memory_has_no_table_for(database_url: str) -> None:
    schema = "memory." if database_url.startswith("postgresql") else ""
    for view in ("place_action", "newcomer_action"):
        ask_to_change(database_url, f"DROP VIEW IF EXISTS {schema}{view}")
    remedies: dict[Any, str] = {PlaceAction: "run `pycrorm rebuild --url", ORMNewcomer: "open it with `Memory.open`"}
    async with Reading.open(database_url) as reading:
        for class_, remedy in remedies.items():
            message = f"older than the class {class_.__name__} and has no table for it: {remedy}"
            async with reading.session() as session:
                for query in (session.scalars, session.execute, session.scalar, session.stream):
                    with pytest.raises(TablesOutdated, match=message):
                        await query(select(class_))
                    await session.rollback()
                with pytest.raises(TablesOutdated, match=message):
                    await session.get(class_, 5)
            with pytest.raises(TablesOutdated, match=message):
                await reading.dataframe(class_)
            with pytest.raises(TablesOutdated, match=message):
                await reading.rows(select(class_.id))
        assert len(await reading.dataframe(Action)) == 0
