"""Fixtures for memories to be made: `new_url` returns the URL of one that does not exist yet, for each kind of
database.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.databases import Server


@pytest.fixture
def new_file(tmp_path: Path) -> Callable[[], str]:
    numbers = itertools.count(1)
    return lambda: f"sqlite:///{tmp_path}/memory_{next(numbers)}.db"


@pytest.fixture(params=["sqlite", "postgresql"])
def new_url(request: pytest.FixtureRequest, new_file: Callable[[], str]) -> Callable[[], str]:
    if request.param == "sqlite":
        return new_file
    server: Server = request.getfixturevalue("server")
    return server.new_database
