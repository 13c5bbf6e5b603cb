"""A server that refuses the login, or is too old: one line, exit code 3, no password, and recorded events stay."""

import asyncio
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async.testing.postgresql_proxy import proxy_before
from tests.commands import answer, one_line_of, pycrorm
from tests.databases import Server, ask
from tests.store.test_postgresql_refusals import WRITTEN, guarded_in

pytestmark = pytest.mark.soak
"""Each of these tests starts many processes."""

PLAN = '''
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    async def perform(self): ...

async def plan():
    """Take a note."""
    await NoteActionPerformable("a").perform()
'''
EVENTS = 7
"""The events of the plan, with the declaration."""
VERBS = [["run", "notes.py"], ["writer"], ["writer", "--once"], ["episodes"]]
NOTES = "SELECT text FROM note_action"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a spool in which a plan has left its events."""
    (tmp_path / "notes.py").write_text(PLAN)
    left = pycrorm("run", "notes.py", "--writer", "daemon", "--spool", "spool", cwd=tmp_path)
    assert left.returncode == 0
    return tmp_path


def refused(url: str, folder: Path, ending: str) -> None:
    for verb in VERBS:
        done = pycrorm(*verb, "--url", url, "--spool", "spool", cwd=folder)
        message = one_line_of(done)
        assert message.startswith("pycrorm: postgresql://")
        assert message.endswith(ending)
        assert "s3cr" not in message
        assert (done.returncode, done.stdout) == (3, "")


def drained(url: str, folder: Path) -> int:
    stored: int = answer("writer", "--once", "--url", url, "--spool", "spool", cwd=folder)["events_stored"]
    return stored


def test_a_wrong_password_is_one_line_and_the_right_one_stores_the_waiting_events(server: Server, folder: Path) -> None:
    database = guarded_in(server)
    refused(
        server.url(database, user="guarded", password="s3cr-wrong"),
        folder,
        'password authentication failed for user "guarded": put the right password into PYCRORM_URL or ~/.pgpass',
    )
    assert drained(server.url(database, user="guarded", password=WRITTEN), folder) == EVENTS
    assert ask(server.url(database), NOTES) == [("a",)]


def test_a_wrong_database_name_is_one_line_and_the_right_one_stores_the_waiting_events(
    server: Server, folder: Path
) -> None:
    ending = 'database "nothing" does not exist: create it with `createdb`, or correct the URL'
    refused(server.url("nothing", password="s3cr"), folder, ending)
    url = server.new_database()
    assert drained(url, folder) == EVENTS
    assert ask(url, NOTES) == [("a",)]


async def test_a_server_that_is_too_old_is_one_line_and_nothing_is_made_there(server: Server, folder: Path) -> None:
    url = server.new_database()
    [[version]] = ask(url, "SELECT current_setting('server_version_num')::int")
    async with proxy_before(server.folder) as proxy:
        # A real server, of which a proxy replaces only the answer with its version.
        proxy.falsify(version.to_bytes(4), (130_011).to_bytes(4))
        through = proxy.url(urlsplit(url).path.removeprefix("/"), password="s3cr")
        await asyncio.to_thread(refused, through, folder, "PostgreSQL 14 or newer is needed, this is 13")
        assert ask(url, "SELECT count(*) FROM pg_namespace WHERE nspname IN ('pycrorm', 'memory')") == [(0,)]
        proxy.heal()
        assert await asyncio.to_thread(drained, through, folder) == EVENTS
    assert ask(url, NOTES) == [("a",)]
