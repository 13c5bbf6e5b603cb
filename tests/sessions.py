"""Open a session on a log, as `Reading.session` does, but without mapping the types that are declared in it."""

from __future__ import annotations

from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async.orm.base import known_classes
from pycrorm_async.query.reading import EpisodeSession, LoadOnAccess
from pycrorm_async.store.log import EventLog

__all__ = ["session_on"]


def session_on(log: EventLog) -> AsyncSession:
    """Return a session whose objects load what is read of them, with the classes of the log's engine."""
    engine = log.address.engine(read_only=True)
    vars(engine.dialect)["pycrorm_known_classes"] = known_classes(log.engine.dialect)
    on_access = LoadOnAccess(engine, log.translated)
    return AsyncSession(log.engine, expire_on_commit=False, sync_session_class=EpisodeSession, on_access=on_access)
