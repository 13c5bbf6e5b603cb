"""Read related rows from the part of the tables that has their episode.

SQLAlchemy loads subclasses' columns and related rows by their ids. An id contains the number of its episode, but no
database can know that: where the tables are divided by episode, it would look for these ids in every part. So a load
of rows of one episode names the episode too. A load of rows of several episodes remains as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import BinaryExpression, ColumnElement, Select, event
from sqlalchemy.orm import ORMExecuteState, Session
from sqlalchemy.sql import visitors
from sqlalchemy.sql.operators import in_op

from pycrorm_async.events.ids import row_key
from pycrorm_async.orm.base import EPISODE

__all__ = ["EpisodeSession"]

_KEYS = "primary_keys"
"""The parameter in which SQLAlchemy's loads pass the ids."""


class EpisodeSession(Session):
    """An ordinary session whose loads of related rows name their episode."""


@event.listens_for(EpisodeSession, "do_orm_execute")
def _name_episode(state: ORMExecuteState) -> None:
    keys = state.parameters.get(_KEYS) if isinstance(state.parameters, Mapping) else None
    if not keys or not isinstance(state.statement, Select) or not all(isinstance(each, int) for each in keys):
        return
    number = row_key(min(keys)).number
    if number != row_key(max(keys)).number:
        return
    column = _loaded_by(state.statement)
    if column is not None and column.key != EPISODE and EPISODE in column.table.c:  # else the keys are episodes
        state.statement = state.statement.where(column.table.c[EPISODE] == number)


def _loaded_by(statement: Select[Any]) -> Any:
    """Return the column that a load compares with the ids."""
    criteria: ColumnElement[bool] | None = statement.whereclause
    for each in visitors.iterate(criteria) if criteria is not None else ():
        if isinstance(each, BinaryExpression) and each.operator is in_op and getattr(each.right, "key", None) == _KEYS:
            return each.left
    return None
