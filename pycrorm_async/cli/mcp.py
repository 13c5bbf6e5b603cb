"""Serve the memory to an agent by the Model Context Protocol.

Panel: Ask, 7.
"""

import asyncio

from pycrorm_async.cli.reading import ReadingPlace


def mcp(place: ReadingPlace) -> None:
    """Serve the memory to an agent by the Model Context Protocol; nothing is ever written.

    Needs the extra 'mcp'. The agent's program starts this command; `pycrorm_async/integrations/README.md` shows how to
    enter it there.
    """
    address, replica = place.place.shared_address, place.replica
    from pycrorm_async.integrations.mcp_server import memory_server  # here, because it needs the extra

    place.place.note_pending_events()  # on stderr, which the agent's program shows or keeps
    asyncio.run(memory_server(address, replica).run_stdio_async())
