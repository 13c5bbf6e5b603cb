"""A memory on a server behind a connection that is slow, or breaks."""

from urllib.parse import urlsplit

import pytest
from sqlalchemy import select

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.orm import Pose
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from tests.databases import Server, ask

pytestmark = pytest.mark.slow

MADE = """
    SELECT count(*) FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
    WHERE nspname IN ('pycrorm', 'memory_tables', 'memory') AND relkind IN ('r', 'i', 'v')
"""


async def opened(proxy: Proxy, url: str) -> EventLog:
    return await EventLog.open(DatabaseAddress.parse(proxy.url(urlsplit(url).path[1:])), create=True)


async def test_making_a_memory_takes_far_fewer_messages_than_it_has_tables(server: Server) -> None:
    url = server.new_database()
    async with proxy_before(server.folder) as proxy:
        log = await opened(proxy, url)
        await Projector(log).open()
        await log.close()
    [[statements]] = ask(url, MADE)
    assert statements > 200
    assert proxy.requests < statements / 2  # each message takes the delay of the line in both directions


async def test_a_connection_that_breaks_while_replaced_views_are_dropped_is_reported_as_such(server: Server) -> None:
    url = server.new_database()
    async with proxy_before(server.folder) as proxy:
        log = await opened(proxy, url)
        await Projector(log).open()
        proxy.cut_before(b"DROP SCHEMA")
        with pytest.raises(DatabaseUnavailable):
            await Projector(log, views=[UserView("heights", select(Pose.z))]).open()
        assert proxy.faults == 1
        await Projector(log, views=[UserView("heights", select(Pose.z))]).open()
        await log.close()
    assert ask(url, "SELECT count(*) FROM pg_namespace WHERE nspname LIKE 'memory%'") == [(2,)]
