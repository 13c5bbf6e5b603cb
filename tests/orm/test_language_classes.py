"""The mapped classes of the plan language agree with the expressions, and a fresh memory has a table for each."""

from __future__ import annotations

import pytest
from sqlalchemy import Table, func, inspect, select
from sqlalchemy.ext.asyncio import AsyncSession

import pycrorm_async.orm
from pycrorm_async.orm import Action, Language, Motion
from pycrorm_async.plan import Code, Monitor, Parallel, Repeat, Retry, Sequential, TryAll, TryInOrder
from pycrorm_async.projections.columns import Layout
from pycrorm_async.projections.mapped_tables import mapped_leaves
from pycrorm_async.record.declarations import declared_type
from pycrorm_async.store.log import EventLog
from tests.projections.sql_queries import stored_and_folded

pytestmark = pytest.mark.slow

EXPRESSIONS = [Sequential, TryInOrder, Parallel, TryAll, Repeat, Monitor, Code, Retry]
COLUMNS = {
    "Repeat": {"times"},
    "Monitor": {"condition", "interval_s"},
    "Code": {"function"},
    "Retry": {"max_tries"},
}


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=lambda each: each.__name__)
def test_every_expression_has_a_mapped_class(expression: type) -> None:
    declaration = declared_type(expression).declaration
    mapped = getattr(pycrorm_async.orm, expression.__name__)
    table = inspect(mapped).local_table
    assert isinstance(table, Table)
    assert (declaration.kind, declaration.dtype, declaration.bases) == ("language", expression.__name__, ())
    assert issubclass(mapped, Language)
    assert mapped.__tablename__ == declaration.table
    assert {each.name for each in table.columns} == {
        "id",
        "process_metadata_id",
        *COLUMNS.get(expression.__name__, ()),
    }
    for field in declaration.fields:
        assert hasattr(mapped, field.name), field.name
    layout = Layout().with_leaves(mapped_leaves())
    assert layout.with_declaration(declaration) == layout


async def test_a_fresh_memory_has_an_empty_table_for_each_expression(log: EventLog) -> None:
    await stored_and_folded(log, [])
    async with AsyncSession(log.engine) as session:
        for name in ("Language", *(each.__name__ for each in EXPRESSIONS)):
            mapped = getattr(pycrorm_async.orm, name)
            assert (await session.scalars(select(mapped))).all() == []
            assert await session.scalar(select(func.count()).select_from(mapped)) == 0
    assert not issubclass(Language, Action | Motion)
