"""`pycrorm events`: the log of an episode as text for its user, or as JSON for a program."""

import asyncio
import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.events.codec import Record
from tests.commands import COMMAND, environment, one_line_of, pycrorm
from tests.databases import ask_to_change
from tests.projections.event_script import Script
from tests.projections.factories import append_and_fold
from tests.store.factories import episode, run_of
from tests.test_table_comparison import episode as hand_written

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""

URL = "sqlite:///pycrorm.db"
IDENTITY = "00000000-0000-7000-8000-000000000001"


def lines_of(done: subprocess.CompletedProcess[str], code: int = 0) -> list[dict[str, Any]]:
    assert done.returncode == code, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def text_of(record: Record, time: str) -> dict[str, Any]:
    """Return the line of an event."""
    return {
        "sequence": record.sequence,
        "type": record.type,
        "version": record.version,
        "time": time,
        "wall_ns": record.wall_ns,
        "monotonic_ns": record.monotonic_ns,
        "payload": json.loads(record.payload),
    }


async def test_every_event_is_a_line_with_all_its_fields(database_url: str, tmp_path: Path) -> None:
    script = hand_written(1)
    script.put_payload("HandShaken", '{"of": "a newer version", "ü": 1.50}'.encode(), 7)
    script.records[1] = script.records[1]._replace(wall_ns=1_700_000_000_000_000_009)
    await append_and_fold(database_url, script.records, folded=False)
    expected = [text_of(each, f"2023-11-14T22:13:{20 + each.sequence:02}.000000000Z") for each in script.records]
    expected[1]["time"] = "2023-11-14T22:13:20.000000009Z"
    assert lines_of(pycrorm("events", "1", "--url", database_url, cwd=tmp_path)) == expected
    assert lines_of(pycrorm("events", "last", "--after", "11", "--url", database_url, cwd=tmp_path)) == expected[11:]
    some = pycrorm(
        "events", IDENTITY, "--type", "NodeEnded", "--type", "ObjectAdded", "--url", database_url, cwd=tmp_path
    )
    assert lines_of(some) == [each for each in expected if each["type"] in ("NodeEnded", "ObjectAdded")]


def test_no_character_is_lost_on_a_terminal_with_ascii_alone(tmp_path: Path) -> None:
    script = Script(1)
    script.put_payload("NodeStarted", '{"kind":"root","text":"Grüße, 牛奶"}'.encode())
    asyncio.run(append_and_fold(f"sqlite:///{tmp_path}/pycrorm.db", script.records, folded=False))
    done = subprocess.run(
        [*COMMAND, "events", "1"],
        cwd=tmp_path,
        env=environment() | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        capture_output=True,
        check=True,
    )
    assert json.loads(done.stdout)["payload"]["text"] == "Grüße, 牛奶"


def test_a_reader_that_closes_the_pipe_ends_the_command_without_a_message(tmp_path: Path) -> None:
    asyncio.run(append_and_fold(f"sqlite:///{tmp_path}/pycrorm.db", run_of(episode(1), 1, 5_000), folded=False))
    process = subprocess.Popen(
        [*COMMAND, "events", "1"], cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert json.loads(process.stdout.readline())["sequence"] == 1
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(60) == 0
    process.stderr.close()


async def test_of_a_damaged_log_the_events_before_the_damage_are_printed(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    await append_and_fold(url, hand_written(1).records, folded=False)
    ask_to_change(url, "DROP TRIGGER event_is_not_deleted")
    ask_to_change(url, "DROP TRIGGER event_is_not_updated")
    ask_to_change(url, "DELETE FROM event WHERE sequence = 9")
    done = pycrorm("events", "1", cwd=tmp_path)
    assert [each["sequence"] for each in lines_of(done, code=4)] == list(range(1, 9))
    assert one_line_of(done) == f"pycrorm: episode {IDENTITY}, event 9: is missing in sqlite:///pycrorm.db"
    assert [each["sequence"] for each in lines_of(pycrorm("events", "1", "--after", "9", cwd=tmp_path))] == [10, 11, 12]
    ask_to_change(url, "UPDATE event SET payload = '{\"node' WHERE sequence = 4")
    done = pycrorm("events", "1", cwd=tmp_path)
    assert [each["sequence"] for each in lines_of(done, code=4)] == [1, 2, 3]
    assert one_line_of(done).startswith(f"pycrorm: episode {IDENTITY}, event 4: its payload cannot be read: ")


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (["7"], 2, "there is no episode '7' (`pycrorm episodes` lists all 2)"),
        (["0000"], 2, "2 episodes have an id that begins with '0000': use more of its digits"),
        (["9" * 5000], 2, "there is no episode"),
        (["1", "--type", "nodestarted"], 2, "unknown event type 'nodestarted'; known types: DescriptionDeclared, "),
        (["1", "--url", "sqlite:///none.db"], 3, "does not exist"),
        (["1", "--url", "sqlite://"], 2, "sqlite:// exists only in its own process"),
        (["1", "--url", "oracle://lab/memory"], 2, "oracle:// is not a supported database"),
        (["1", "--url", "postgresql://ada:s3cr@127.0.0.1:1/memory"], 3, "cannot be reached: Connection refused"),
    ],
)
async def test_an_impossible_request_is_one_line(tmp_path: Path, arguments: list[str], code: int, reason: str) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    await append_and_fold(url, [*hand_written(1).records, *hand_written(2).records], folded=False)
    done = pycrorm("events", *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (code, "")
    assert reason in one_line_of(done)
    assert "s3cr" not in done.stderr
