"""`verify` names what is damaged in an episode's row, and does not blame the tables where the log has no digests."""

import json
import shutil
import sqlite3
from pathlib import Path

import pytest

from tests.commands import answer, pycrorm
from tests.golden.unpacking import unpack_memory
from tests.golden.zoo import ZOO

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def memory_without_digests(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("old")
    url = unpack_memory(ZOO / "fold_4_blobs.tar.gz", folder)
    assert pycrorm("rebuild", "--url", url, cwd=folder).returncode == 0
    return folder


@pytest.fixture
def database(memory_without_digests: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(memory_without_digests / "memory.db", tmp_path))


def change(database: Path, guard: str, statement: str, *values: str) -> None:
    with sqlite3.connect(database) as connection:
        connection.execute(f"DROP TRIGGER {guard}")
        connection.execute(statement, values)
    connection.close()


@pytest.mark.parametrize("identity", ["", "gar\x1bbage", "1" * 4000])
def test_a_damaged_id_of_an_episode_is_reported_as_damage(database: Path, tmp_path: Path, identity: str) -> None:
    change(database, "episode_is_not_renamed", "UPDATE episode SET id = ? WHERE number = 1", identity)
    url = f"sqlite:///{database}"
    for whole in ([], ["--episode", "1"]):
        done = pycrorm("verify", *whole, "--url", url, "--json", cwd=tmp_path)
        assert (done.returncode, "Traceback" in done.stderr) == (4, False)
        damages = json.loads(done.stdout)["damages"]
        assert [(each["number"], "its id" in each["reason"]) for each in damages] == [(1, True)]
        assert len(damages[0]["reason"]) < 200
    for verb in (["tag", "1", "seen"], ["copy", "--from", url, "--to", f"sqlite:///{tmp_path}/copy.db"]):
        done = pycrorm(*verb, *([] if verb[0] == "copy" else ["--url", url]), cwd=tmp_path)
        assert (done.returncode, "Traceback" in done.stderr) == (4, False)
        assert "its id" in done.stderr


def test_where_an_episode_without_a_digest_differs_no_rebuild_is_recommended(database: Path, tmp_path: Path) -> None:
    statement = "UPDATE event SET payload = replace(payload, '0.25', '0.75') WHERE type = 'NodeStarted'"
    change(database, "event_is_not_updated", statement)
    done = pycrorm("verify", "--url", f"sqlite:///{database}", cwd=tmp_path)
    assert done.returncode == 1
    last = done.stdout.splitlines()[-1]
    assert "the tables of 1 episode without a digest differ from the log" in last
    assert "the log is intact" not in done.stdout
    assert answer("verify", "--url", f"sqlite:///{database}", cwd=tmp_path, code=1)["undecided"] == 1
