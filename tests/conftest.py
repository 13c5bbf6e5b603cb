"""One PostgreSQL server for all tests that want one; it starts in half a second, at the first of them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.databases import Server, server_in


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A server with short paths, as a socket's has to be."""
    with tempfile.TemporaryDirectory(prefix="pg") as folder, server_in(Path(folder), syncs=False) as running:
        yield running


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Each test that asks for this runs on both kinds of database, each time on a new one."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'memory.db'}"
        return
    running: Server = request.getfixturevalue("server")
    url = running.new_database()
    yield url
    running.drop(url)  # some hundred files, which would be written to the disk and deleted at the end of all


_LONG = """
test_verify test_verify_damage test_custom_projections test_cancelled test_rebuild_kill test_copy test_dynamic_classes
test_contradictions test_session_views
""".split()
"""Modules whose tests take long on a server; there they run on demand, and the others show that it answers alike."""
_LONGER = "test_bad_server test_bad_spool test_dead_letters_killed cli/test_custom_projections".split()
"""Modules that walk through many processes, each started anew: all of them run on demand."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes long is left to `-m soak`."""
    for item in items:
        stem = item.path.stem
        is_longer = stem in _LONGER or f"{item.path.parent.name}/{stem}" in _LONGER
        if is_longer or (stem in _LONG and "[postgresql" in item.name):
            item.add_marker(pytest.mark.soak)
