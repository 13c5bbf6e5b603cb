"""Memories to be made: `new_url` gives the URL of one that is not there yet, for each kind of database in turn."""

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
