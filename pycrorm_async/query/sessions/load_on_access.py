"""Load attributes that are read without `await`, on a connection of their own.

Theory of operation. Reading `action.arm` is not a coroutine, so the loop of the session cannot await the database
meanwhile, and the session's connection belongs to that loop. So the load runs in a loop of its own, in a thread, on
another connection, and blocks the loop of the reader until it has ended, for the time of a query or two. Only that
thread uses the session meanwhile, because the session's loop is blocked. Each load sees the present state of the
database, as each statement of a PostgreSQL session does. The engine keeps no connection between two loads, because a
connection belongs to the loop that opened it; a lock makes the loads of several threads take turns.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from contextvars import ContextVar
from threading import Lock
from typing import TypeVar

from sqlalchemy import Connection
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

_Result = TypeVar("_Result")


class LoadOnAccess:
    """Runs loads of attributes in a thread, on connections of an engine that nothing else uses.

    Args:
        engine: of the memory; its connections are opened and closed for each load.
        translated: translates the driver's errors.
    """

    def __init__(self, engine: AsyncEngine, translated: Callable[[], AbstractContextManager[None]]) -> None:
        self.engine = engine
        self._translated = translated
        self._lock = Lock()
        self._connection: ContextVar[Connection | None] = ContextVar("connection_of_load", default=None)

    @property
    def connection(self) -> Connection | None:
        """The connection of the load that runs in this context; None outside of loads."""
        return self._connection.get()

    def run(
        self,
        load: Callable[[], _Result],
        connect: Callable[[AsyncEngine], AbstractAsyncContextManager[AsyncConnection]] = AsyncEngine.connect,
    ) -> _Result:
        """Run a load with a connection from `connect`, and wait for its result. Raises as the load does."""

        def with_connection(connection: Connection) -> _Result:
            self._connection.set(connection)
            return load()

        async def in_own_loop() -> _Result:
            try:
                async with connect(self.engine) as connection:
                    return await connection.run_sync(with_connection)
            finally:
                await self.engine.dispose()

        with self._lock, self._translated(), ThreadPoolExecutor(1, thread_name_prefix="pycrorm-load") as thread:
            return thread.submit(asyncio.run, in_own_loop()).result()
