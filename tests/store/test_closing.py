"""A connection to SQLite is closed once, whichever thread asks and when."""

import asyncio
import time
from pathlib import Path

from pycrorm_async.store.sqlite.engine import _connect


async def test_a_close_ends_although_its_thread_was_stopped_meanwhile(tmp_path: Path) -> None:
    """SQLAlchemy does this when a close is cancelled: the close continues, and its thread is stopped as well."""
    file = tmp_path / "memory.db"
    file.touch()
    connection = await _connect(f"{file.as_uri()}?mode=rw", 1.0)
    closing = asyncio.create_task(connection.close())
    await asyncio.sleep(0)
    connection.stop()
    time.sleep(0.2)  # noqa: ASYNC251  the thread ends its work before this loop is notified
    await asyncio.wait_for(closing, 10)
