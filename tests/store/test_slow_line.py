"""A memory on a server at the end of a slow line is opened all the same: few messages, however many tables."""

from urllib.parse import urlsplit

from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import Server, ask
from tests.proxy import proxy_before

MADE = """
    SELECT count(*) FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
    WHERE nspname IN ('pycrorm', 'memory_tables', 'memory') AND relkind IN ('r', 'i', 'v')
"""


async def test_a_memory_is_made_in_far_fewer_messages_than_it_has_tables(server: Server) -> None:
    url = server.new_database()
    async with proxy_before(server) as proxy:
        log = await EventLog.open(DatabaseAddress.parse(proxy.url(urlsplit(url).path[1:])), create=True)
        await Projector(log).open()
        await log.close()
    [[made]] = ask(url, MADE)
    assert made > 200
    assert proxy.said < made / 2  # each takes as long as the line is, there and back
