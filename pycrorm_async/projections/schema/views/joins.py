"""Join the rows of one episode by id.

All tables have the episode's column in common, so from inner joins PostgreSQL concludes that it can join a row with all
rows of its episode before the row that names one of them. Without statistics it does, and 100 pick-ups took half a
minute. An outer join follows the rows that its condition names, unless a filter on one of its columns makes it an inner
join.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Self

from sqlalchemy import ColumnElement, FromClause, and_, func
from sqlalchemy.ext.compiler import compiles

from pycrorm_async.projections.schema.core_columns import EPISODE


def same_episode(one: FromClause, other: FromClause, condition: ColumnElement[bool]) -> ColumnElement[bool]:
    """Return the condition of a join within an episode."""
    return and_(condition, one.c[EPISODE] == other.c[EPISODE])


def present(row: FromClause) -> ColumnElement[bool]:
    """Return the condition that an outer join has a row. From IS NOT NULL PostgreSQL would make it an inner join."""
    return func.coalesce(row.c.id, 0) > 0


class _Number(ColumnElement[float]):
    """A number of an outer join's row that is `present`. On PostgreSQL a filter on it does not make an inner join."""

    inherit_cache = False

    def __init__(self, value: ColumnElement[float]) -> None:
        self.type = value.type
        self.value = value

    def self_group(self, against: Any = None) -> Self:  # noqa: ARG002  SQLAlchemy's signature
        return self


@compiles(_Number)
def _itself(element: _Number, compiler: Any, **options: Any) -> str:
    return str(compiler.process(element.value, **options))


@compiles(_Number, "postgresql")
def _coalesced(element: _Number, compiler: Any, **options: Any) -> str:
    return str(compiler.process(func.coalesce(element.value, 0.0), **options))


def numbers(row: FromClause, names: str) -> Any:
    """Return columns of an outer join's row that is `present`, as attributes."""
    return SimpleNamespace(**{name: _Number(row.c[name]) for name in names.split()})
