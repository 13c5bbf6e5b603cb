"""Load related rows from the part of the tables that has their episode, and unloaded attributes at the first access.

SQLAlchemy loads subclasses' columns and related rows by their ids. An id contains the number of its episode, but no
database can know that: where the tables are divided by episode, it would look for these ids in every part. So a load
of rows of one episode names the episode too. A load of rows of several episodes remains as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any
from weakref import ref

from sqlalchemy import BinaryExpression, ColumnElement, Connection, Result, Select, event
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine
from sqlalchemy.orm import ORMExecuteState, Session
from sqlalchemy.orm.identity import IdentityMap
from sqlalchemy.sql import visitors
from sqlalchemy.sql.operators import in_op
from sqlalchemy.util.concurrency import in_greenlet

from pycrorm_async.bulk_records import collecting_seldom
from pycrorm_async.events.ids import row_key
from pycrorm_async.orm.base import EPISODE
from pycrorm_async.orm.loading.batch_loads import KEYS, load_related
from pycrorm_async.query.sessions.load_on_access import LoadOnAccess


class _MapReference(ref[IdentityMap]):
    """The reference to a session's identity map that each of its objects holds; keeps `session` alive with them."""

    session: Session | None = None


class EpisodeSession(Session):
    """A session whose objects load attributes at the first access, also without `await` or after it is closed.

    Its loads of related rows name their episode.

    Args:
        on_access: runs the loads of attributes that are read without `await`.
        connect: opens the connections for these loads.
    """

    def __init__(
        self,
        *arguments: Any,
        on_access: LoadOnAccess,
        connect: Callable[[AsyncEngine], AbstractAsyncContextManager[AsyncConnection]] = AsyncEngine.connect,
        **options: Any,
    ) -> None:
        super().__init__(*arguments, **options)
        self._on_access = on_access
        self._connect = connect
        self._reference = self._refer()

    def execute(self, *arguments: Any, **options: Any) -> Result[Any]:
        """Execute a statement; a load of an attribute that is read without `await` runs in a thread of its own."""
        if in_greenlet():
            with collecting_seldom():
                return super().execute(*arguments, **options)
        # frozen: read while the load's connection is open
        load = super().execute
        return self._on_access.run(lambda: load(*arguments, **options).freeze(), self._connect)()

    def close(self) -> None:
        """Release the connection. The objects stay in the session, and it lives as long as one of them does."""
        if self.identity_map:
            self._reference.session = self
        transaction = self.get_transaction()
        while transaction is not None:
            parent = transaction.parent
            transaction.close()
            transaction = parent

    def expunge_all(self) -> None:
        """Remove all objects from the session, which has a new identity map then."""
        super().expunge_all()
        self._reference = self._refer()

    def _refer(self) -> _MapReference:
        # There is no public way to share a reference among the objects, and one of each object would double the time
        # of `close`, which made half a dictionary for each.
        reference = _MapReference(self.identity_map)
        self.identity_map._wr = reference  # noqa: SLF001
        return reference

    def _connection_for_bind(self, engine: Any, *arguments: Any, **options: Any) -> Connection:
        # There is no public way to execute a statement of a session on a connection outside its transaction.
        return self._on_access.connection or super()._connection_for_bind(engine, *arguments, **options)


event.listen(EpisodeSession, "do_orm_execute", load_related)


@event.listens_for(EpisodeSession, "do_orm_execute")
def _name_episode(state: ORMExecuteState) -> None:
    keys = state.parameters.get(KEYS) if isinstance(state.parameters, Mapping) else None
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
        if isinstance(each, BinaryExpression) and each.operator is in_op and getattr(each.right, "key", None) == KEYS:
            return each.left
    return None
