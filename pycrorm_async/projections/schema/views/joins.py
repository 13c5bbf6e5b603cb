"""Join the rows of one episode by id.

All tables have the episode's column in common, so from inner joins PostgreSQL concludes that it can join a row with all
rows of its episode before the row that names one of them. Without statistics it does, and 100 pick-ups took half a
minute. An outer join follows the rows that its condition names, unless a filter on one of its columns makes it an inner
join.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from sqlalchemy import ColumnElement, FromClause, and_, func

from pycrorm_async.projections.schema.core_columns import EPISODE
from pycrorm_async.projections.schema.views.portable_expressions import PerDatabase


def same_episode(one: FromClause, other: FromClause, condition: ColumnElement[bool]) -> ColumnElement[bool]:
    """Return the condition of a join within an episode."""
    return and_(condition, one.c[EPISODE] == other.c[EPISODE])


def present(row: FromClause) -> ColumnElement[bool]:
    """Return the condition that an outer join has a row. From IS NOT NULL PostgreSQL would make it an inner join."""
    return func.coalesce(row.c.id, 0) > 0


def numbers(row: FromClause, names: str) -> Any:
    """Return columns of an outer join's row that is `present`, as attributes.

    On PostgreSQL a filter on one of them does not make the join an inner join.
    """
    columns = {name: row.c[name] for name in names.split()}
    return SimpleNamespace(
        **{name: PerDatabase(each, postgresql=func.coalesce(each, 0.0)) for name, each in columns.items()}
    )
