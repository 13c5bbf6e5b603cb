"""Let the workers of rollouts be forked from the server of the tests' commands, which has loaded their modules."""

from __future__ import annotations

import pytest

from tests.commands import start_server


@pytest.fixture(scope="session", autouse=True)
def _server() -> None:
    start_server()
