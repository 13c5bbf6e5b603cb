"""`pycrorm mcp` answers the questions of an agent about a memory, over stdin and stdout."""

from __future__ import annotations

import asyncio

from pycrorm_async.cli.output import DEFAULT_URL, SpoolOption, UrlOption
from pycrorm_async.cli.reading import note_pending_events
from pycrorm_async.operations.destination import shared_address


def mcp(url: UrlOption = DEFAULT_URL, spool: SpoolOption = None) -> None:
    """Serve the memory to an agent by the Model Context Protocol; nothing is ever written.

    Needs the extra 'mcp'. The agent's program starts this command; `pycrorm_async/integrations/README.md` shows how to
    enter it there.
    """
    address = shared_address(url)
    from pycrorm_async.integrations.mcp_server import memory_server  # here, because it needs the extra

    note_pending_events(url, spool)  # on stderr, which the agent's program shows or keeps
    asyncio.run(memory_server(address).run_stdio_async())
