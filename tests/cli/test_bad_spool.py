"""A spool or server that cannot be used: one line, the documented exit code, no password, no lost event."""

import asyncio
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async.testing.postgresql_proxy import proxy_before
from tests.commands import NOTES_PLAN, answer, environment, one_line_of, pycrorm
from tests.databases import Server, ask
from tests.store.test_postgresql_logins import WRITTEN, guarded_in

pytestmark = pytest.mark.soak


# === bad spool ================================================================================================
#
# A spool that is unusable or holds foreign content: one line, the documented exit code, no loss.

NOTES = "SELECT text FROM note_action ORDER BY id"
EVENTS = 11
"""The events of the plan, with the declaration."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    return tmp_path


def left_in(spool: Path, folder: Path) -> Path:
    """Return the folder of a recorder that was never drained."""
    assert pycrorm("run", "notes.py", "--writer", "daemon", "--spool", spool, cwd=folder).returncode == 0
    return recorder_in(spool)


def recorder_in(spool: Path) -> Path:
    [recorder] = [path for path in spool.iterdir() if path.is_dir() and path.name != "stored"]
    return recorder


def notes(folder: Path) -> list[str]:
    return [text for (text,) in ask(folder / "pycrorm.db", NOTES)]


# --- a disk without space or permission -------------------------------------------------------------------------------

REFUSING = """
import errno, os, sys
place, fault = sys.argv.pop(1), getattr(errno, sys.argv.pop(1))
def refusing(call):
    def refused(path, *rest, **options):
        where = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.path.abspath(path)
        if where.startswith(place):
            raise OSError(fault, os.strerror(fault), where)
        return call(path, *rest, **options)
    return refused
os.posix_fallocate = refusing(os.posix_fallocate)
if fault == errno.EROFS:
    os.mkdir = refusing(os.mkdir)
from pycrorm_async.cli.main import main
main()
"""
"""Run the command on a machine that can make no file below a place, for machines that permit no mount."""


class Disk:
    """A mounted disk, or a folder that simulates one."""

    def __init__(self, place: Path, size: str) -> None:
        self.place = place
        place.mkdir()
        self._mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
        self.mounted = False

    def mount(self) -> None:
        self.mounted = subprocess.run(self._mount, capture_output=True, check=False).returncode == 0

    def make_read_only(self, mode: str) -> None:
        if self.mounted:
            subprocess.run(["mount", "-o", f"remount,{mode}", str(self.place)], check=True)

    def pycrorm(self, fault: str, *arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
        if self.mounted:
            return pycrorm(*arguments, cwd=cwd)
        return subprocess.run(
            [sys.executable, "-c", REFUSING, str(self.place), fault, *map(str, arguments)],
            cwd=cwd,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )

    def release(self) -> None:
        if self.mounted:
            subprocess.run(["umount", str(self.place)], check=True)


@pytest.fixture(params=["mounted", "simulated"])
def disk(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Disk]:
    small_disk = Disk(tmp_path / "disk", "1m" if "full" in request.node.name else "40m")
    if request.param == "mounted":
        small_disk.mount()
    yield small_disk
    small_disk.release()


def test_a_spool_on_a_read_only_disk_is_reported_in_one_line_and_loses_nothing(folder: Path, disk: Disk) -> None:
    spool = disk.place / "spool"
    left_in(spool, folder)
    disk.make_read_only("ro")
    calls: list[list[str | Path]] = [["run", "notes.py", "--spool", spool]]
    if disk.mounted:
        calls += [["writer", "--once", "--spool", spool], ["writer", "--spool", spool]]
    for call in calls:
        done = disk.pycrorm("EROFS", *call, cwd=folder)
        message = one_line_of(done)
        assert message.startswith(f"pycrorm: spool {spool}")
        assert message.endswith("Read-only file system")
        assert (done.returncode, done.stdout) == (3, "")
    assert answer("spool", "inspect", spool, cwd=folder)["recorders"][0]["records"] == EVENTS
    disk.make_read_only("rw")
    assert answer("writer", "--once", "--spool", spool, cwd=folder)["events_stored"] == EVENTS
    assert notes(folder) == ["a", "b", "c"]


def test_a_spool_on_a_full_disk_is_refused_in_one_line(folder: Path, disk: Disk) -> None:
    done = disk.pycrorm("ENOSPC", "run", "notes.py", "--spool", disk.place / "spool", cwd=folder)
    assert one_line_of(done).startswith(f"pycrorm: spool {disk.place}/spool/")
    assert one_line_of(done).endswith("No space left on device")
    assert (done.returncode, done.stdout) == (3, "")
    assert [path for path in (disk.place / "spool").iterdir() if path.is_dir() and path.name != "stored"] == []
    assert pycrorm("run", "notes.py", cwd=folder).returncode == 0
    assert notes(folder) == ["a", "b", "c"]


# --- foreign content --------------------------------------------------------------------------------------------------


def test_foreign_files_in_a_spool_are_not_touched_and_no_event_is_lost(folder: Path) -> None:
    spool = folder / "pycrorm.db.spool"
    recorder = left_in(spool, folder)
    strangers = [spool / "notes.txt", spool / "photos" / "robot.jpg", recorder / "core.1234"]
    (spool / "photos").mkdir()
    for each in strangers:
        each.write_text("mine")
    assert pycrorm("writer", "--once", cwd=folder).returncode == 0
    assert notes(folder) == ["a", "b", "c"]
    assert [each.read_text() for each in strangers] == ["mine"] * 3
    assert pycrorm("run", "notes.py", cwd=folder).returncode == 0
    assert notes(folder) == ["a", "b", "c"] * 2


def test_a_folder_of_a_newer_version_is_named_and_kept_and_the_others_are_drained(folder: Path) -> None:
    spool = folder / "pycrorm.db.spool"
    newer = left_in(spool, folder)
    segment = newer / "00000001.segment"
    content = segment.read_bytes()
    segment.write_bytes(content[:8] + (99).to_bytes(4, "little") + content[12:])
    done = pycrorm("writer", "--once", cwd=folder)
    message = one_line_of(done)
    assert done.returncode == 3
    assert str(segment) in message
    assert "format 99" in message
    assert pycrorm("run", "notes.py", cwd=folder).returncode == 0
    assert notes(folder) == ["a", "b", "c"]
    assert recorder_in(spool) == newer
    segment.write_bytes(content)
    assert pycrorm("writer", "--once", cwd=folder).returncode == 0
    assert notes(folder) == ["a", "b", "c"] * 2


# --- contradictions ---------------------------------------------------------------------------------------------------


def test_the_same_event_with_other_bytes_is_damage_and_both_are_kept(folder: Path) -> None:
    spool = folder / "pycrorm.db.spool"
    recorder = left_in(spool, folder)
    shutil.copytree(recorder, folder / "kept" / recorder.name)
    assert pycrorm("writer", "--once", cwd=folder).returncode == 0
    # An operator bypasses the log's own refusal.
    with closing(sqlite3.connect(folder / "pycrorm.db")) as connection, connection:
        connection.executescript(
            "DROP TRIGGER event_is_not_updated;"
            "UPDATE event SET payload = replace(payload, '\"b\"', '\"B\"') WHERE sequence = 5"
        )
    connection.close()
    [(changed,)] = ask(folder / "pycrorm.db", "SELECT payload FROM event WHERE sequence = 5")
    assert '"B"' in changed
    shutil.copytree(folder / "kept" / recorder.name, recorder)
    done = pycrorm("writer", "--once", cwd=folder)
    assert one_line_of(done).endswith("event 5: another event is stored under this number already")
    assert recorder.name in one_line_of(done)
    assert done.returncode == 4
    assert ask(folder / "pycrorm.db", "SELECT payload FROM event WHERE sequence = 5") == [(changed,)]
    inspected = answer("spool", "inspect", spool, cwd=folder)
    assert [each["records"] for each in inspected["recorders"]] == [EVENTS]


# === bad server ===============================================================================================
#
# A server that refuses the login, or is too old: one line, exit code 3, no password, and recorded events stay.

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
SERVER_EVENTS = 7
"""The events of the plan, with the declaration."""
VERBS = [["run", "notes.py"], ["writer"], ["writer", "--once"], ["episodes"]]
NOTE_TEXTS = "SELECT text FROM note_action"


@pytest.fixture
def left_folder(tmp_path: Path) -> Path:
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


def test_a_wrong_password_is_one_line_and_the_right_one_stores_the_waiting_events(
    server: Server, left_folder: Path
) -> None:
    database = guarded_in(server)
    refused(
        server.url(database, user="guarded", password="s3cr-wrong"),
        left_folder,
        'password authentication failed for user "guarded": put the right password into PYCRORM_URL or ~/.pgpass',
    )
    assert drained(server.url(database, user="guarded", password=WRITTEN), left_folder) == SERVER_EVENTS
    assert ask(server.url(database), NOTE_TEXTS) == [("a",)]


def test_a_wrong_database_name_is_one_line_and_the_right_one_stores_the_waiting_events(
    server: Server, left_folder: Path
) -> None:
    ending = 'database "nothing" does not exist: create it with `createdb`, or correct the URL'
    refused(server.url("nothing", password="s3cr"), left_folder, ending)
    url = server.new_database()
    assert drained(url, left_folder) == SERVER_EVENTS
    assert ask(url, NOTE_TEXTS) == [("a",)]


async def test_a_server_that_is_too_old_is_one_line_and_nothing_is_made_there(
    server: Server, left_folder: Path
) -> None:
    url = server.new_database()
    [[version]] = ask(url, "SELECT current_setting('server_version_num')::int")
    async with proxy_before(server.folder) as proxy:
        # A real server, of which a proxy replaces only the answer with its version.
        proxy.falsify(f"PostgreSQL {version // 10_000}.".encode(), b"PostgreSQL 13.")
        through = proxy.url(urlsplit(url).path.removeprefix("/"), password="s3cr")
        await asyncio.to_thread(refused, through, left_folder, "PostgreSQL 14 or newer is needed, this is 13")
        assert ask(url, "SELECT count(*) FROM pg_namespace WHERE nspname IN ('pycrorm', 'memory')") == [(0,)]
        proxy.heal()
        assert await asyncio.to_thread(drained, through, left_folder) == SERVER_EVENTS
    assert ask(url, NOTE_TEXTS) == [("a",)]
