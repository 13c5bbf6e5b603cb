"""A reader of a memory sees each change of its blocks, and asks once where nothing has changed."""

from __future__ import annotations

from random import Random

import pytest
from sqlalchemy import event

from pycrorm_async import Reading
from pycrorm_async.recall.recall import CaseReader, DatabaseSource
from pycrorm_async.store.log import EventLog
from tests.recall.case_script import TYPES, cases_of, random_script
from tests.recall.test_stored_cases import projector_of, rebuilt, small_blocks


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
