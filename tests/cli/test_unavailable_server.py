"""A PostgreSQL that cannot be used is one line, exit code 3 or 2, and no password on the screen."""

from pathlib import Path

import pytest

from tests.commands import one_line_of, pycrorm

pytestmark = pytest.mark.slow

PLAN = """
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    async def perform(self):
        return None

async def plan():
    await NoteActionPerformable("a").perform()
"""


@pytest.mark.parametrize("verb", [["episodes"], ["show", "last"], ["run", "plan.py"], ["writer", "--once"]])
def test_an_unreachable_server_is_one_line_without_a_password(tmp_path: Path, verb: list[str]) -> None:
    (tmp_path / "plan.py").write_text(PLAN)
    done = pycrorm(*verb, "--url", "postgresql://ada:s3cr@127.0.0.1:1/memory", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    message = one_line_of(done)
    reached = "cannot be reached: Connection refused: start the server, or correct the URL"
    assert message == f"pycrorm: postgresql://ada:***@127.0.0.1:1/memory: {reached}"


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("postgresql://ada:s3cr@127.0.0.1:99999/memory", "a port is a number from 1 to 65535"),
        ("postgresql://ada:s3@cr@lab/memory", "an @ in a password is written %40"),
        ("postgresql://ada@lab/memory?s3cr=1", "a PostgreSQL URL takes the parameters host, port"),
        ("postgresql://ada:s3cr@lab", "a PostgreSQL URL names its database"),
    ],
)
def test_an_invalid_url_is_one_line_without_a_password(tmp_path: Path, url: str, reason: str) -> None:
    done = pycrorm("episodes", "--url", url, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    message = one_line_of(done)
    assert message.startswith(f"pycrorm: {reason}")
    assert "s3" not in message
    assert "cr@" not in message
