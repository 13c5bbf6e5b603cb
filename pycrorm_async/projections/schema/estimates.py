"""Estimate the rows of tables for SQLite's planner, which has no statistics of a new memory."""

from __future__ import annotations

from pycrorm_async.projections.schema.core_columns import CORE, LINK_BOX, Storage
from pycrorm_async.projections.schema.tables import indexed
from pycrorm_async.projections.table_names import index_name, physical_name
from pycrorm_async.store.dialect import Expected

_EXPECTED = {"process_metadata": 1_000, "simulated_episode": 100, LINK_BOX: 1_000}
_EXPECTED_CORE, _EXPECTED_LEAF = 1_000_000, 50_000
_ALIKE = {
    "process_metadata_id": [1_000],
    "parent_id": [4],
    "status": [250_000],
    "dtype": [50_000, 25_000],
    "obj_type": [10_000],
}
_ALIKE_OTHERS = [10]
"""Estimates for a memory of a thousand episodes, given to SQLite's planner: the rows of each table, and the rows that
have the same value in an index's first column and in its first two."""


def expected(name: str, columns: dict[str, Storage], generation: int) -> Expected:
    """Return the estimates for a planner without statistics of its own; the proportions matter, not the sizes."""
    rows = _EXPECTED.get(name, _EXPECTED_CORE if name in CORE else _EXPECTED_LEAF)
    alike = {
        index_name(name, column, generation): _ALIKE.get(column, _ALIKE_OTHERS) for column in indexed(name, columns)
    }
    return Expected(physical_name(name, generation), rows, alike)
