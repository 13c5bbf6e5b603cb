"""Fold a script of events, and return its rows by table."""

from __future__ import annotations

from typing import Any

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.columns import COLUMNS
from pycrorm_async.projections.fold import fold
from pycrorm_async.projections.row_batch import Designators, Rows
from tests.projections.event_script import Script, name_of


def rows_of(script: Script, *types: DesignatorTypeDeclared, number: int = 1) -> dict[str, list[tuple[Any, ...]]]:
    """Return every row by table; the columns of leaf tables come with their names."""
    rows = folded(script, *types, number=number)
    rows_by_table = rows.to_insert()
    return {
        table if columns == COLUMNS.get(table) else f"{table}({','.join(columns)})": values
        for (table, columns), values in rows_by_table.items()
    }


def folded(script: Script, *types: DesignatorTypeDeclared, number: int = 1) -> Rows:
    rows = Rows()
    designators = Designators({name_of(each): each for each in types})
    for event in script.stored(number):
        fold(event, designators, rows)
    return rows
