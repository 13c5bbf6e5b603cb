"""Clear the blackboard of py_trees, which all trees of a process share, before and after each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from py_trees.blackboard import Blackboard


@pytest.fixture(autouse=True)
def _clear_blackboard() -> Iterator[None]:
    Blackboard.clear()
    yield
    Blackboard.clear()
