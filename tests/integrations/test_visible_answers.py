"""No answer to an agent has a control character of what was recorded, because agents print answers in terminals."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.store.address import DatabaseAddress
from tests.cli.hostile_memory import BAD, DRIVES_A_TERMINAL, record_hostile_episodes

pytestmark = pytest.mark.slow

CALLS: list[tuple[str, dict[str, Any]]] = [
    ("episodes", {}),
    ("episodes", {"text": BAD}),
    ("show", {"episode": 1}),
    ("show", {"episode": BAD}),
    ("show", {BAD: 1}),
    ("why_failed", {}),
    ("at", {"when": "e12", "episode": 1}),
    ("at", {"when": BAD}),
    ("compare", {"first": 1, "second": 3}),
    ("schema", {}),
    ("schema", {"view": "object"}),
    ("query", {"sql": "SELECT * FROM object"}),
    ("query", {"sql": 'SELECT name AS "a\x9b" FROM object'}),
    ("query", {"sql": f"SELECT * FROM missing{BAD}"}),
]


async def test_no_answer_to_an_agent_drives_a_terminal(tmp_path: Path) -> None:
    from mcp import Client
    from mcp.types import TextContent

    from pycrorm_async.integrations.mcp_server import memory_server

    url = await asyncio.to_thread(record_hostile_episodes, tmp_path / "pycrorm.db")
    answers = {}
    with DatabaseAddress.parse(url).located() as address:
        async with Client(memory_server(address)) as client:
            for name, arguments in CALLS:
                done = await client.call_tool(name, arguments)
                for each in done.content:
                    assert isinstance(each, TextContent)
                    assert not DRIVES_A_TERMINAL.search(each.text), (name, arguments)
                    answers[name] = each.text
    assert len(answers) == len({name for name, _ in CALLS})
