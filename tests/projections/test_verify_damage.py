"""Where the log contradicts itself verify says so, by episode and event, and looks at everything else all the same."""

from __future__ import annotations

import random
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import PycrormError
from pycrorm_async.events.codec import encode
from pycrorm_async.projections.verify.verify import VerifyResult, verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask, ask_to_change
from tests.projections.event_script import NAVIGATE, PICK_UP, name_of
from tests.projections.verify_cases import (
    assert_clean,
    fold_in_batches,
    full,
    in_parts,
    look,
    opened,
    rows_of,
    set_columns,
    shown,
)

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""On a server these take long; there they run in turns, and other modules show that it answers alike."""

TRIGGERS = "SELECT name FROM sqlite_master WHERE type = 'trigger'"


@pytest.fixture
async def log(database_url: str) -> AsyncIterator[EventLog]:
    """Three episodes of twenty events, open for reading only, in a database that lets its log be changed."""
    made = await opened(database_url)
    await fold_in_batches(made, [full(1), full(2), full(3)], 10_000)
    await made.close()
    unlock(database_url)
    reader = await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    yield reader
    await reader.close()


def unlock(url: str) -> None:
    if url.startswith("postgresql:"):
        for table in ("event", "episode", "pycrorm_declaration"):
            ask_to_change(url, f"ALTER TABLE pycrorm.{table} DISABLE TRIGGER ALL")
    else:
        for (name,) in ask(url, TRIGGERS):
            ask_to_change(url, f"DROP TRIGGER {name}")


def everything(url: str) -> list[Any]:
    """All rows of log and tables."""
    logged = [ask(url, f"SELECT * FROM {name} ORDER BY 1, 2") for name in ("event", "episode", "pycrorm_declaration")]
    return [*logged, *(rows_of(url, table) for table in shown(url))]


async def told(log: EventLog, url: str, monkeypatch: pytest.MonkeyPatch) -> VerifyResult:
    """What is found, whatever the parts; and nothing was written."""
    before = everything(url)
    found = await look(log)
    other = await in_parts(log, 6, monkeypatch)
    assert sorted(map(str, other.damages)) == sorted(map(str, found.damages))
    assert sorted(other.differences, key=repr) == sorted(found.differences, key=repr)
    assert everything(url) == before
    return found


ONE_MORE = "INSERT INTO event SELECT {}, {}, type, version, wall_ns, monotonic_ns, payload FROM event"
OF_2 = "WHERE episode = 2 AND sequence = "
ENDED = "UPDATE event SET (type, payload) = (SELECT type, payload FROM event WHERE episode = 1 AND sequence = 20)"
CANNOT = "is in the tables, and cannot be folded:"


@pytest.mark.parametrize(
    ("change", "reasons"),
    [
        (f"DELETE FROM event {OF_2} 9", ["event 9: is missing"]),
        (
            "DELETE FROM event WHERE episode = 2 AND sequence IN (5, 6, 9)",
            ["event 5: is missing", "event 9: is missing"],
        ),
        (f"DELETE FROM event {OF_2} 20", ["event 20: is missing"]),
        ("DELETE FROM event WHERE episode = 2", ["event 1: is missing"]),
        (f"{ONE_MORE.format(2, 21)} {OF_2} 20", ["event 21: exists, but the episode must end with event 20"]),
        (f"{ONE_MORE.format(2, 0)} {OF_2} 20", ["event 0: exists, but the episode must end with event 20"]),
        (
            f"UPDATE event SET sequence = 25 {OF_2} 20",
            ["event 25: exists, but the episode must end with event 20", "event 20: is missing"],
        ),
        (
            f"UPDATE event SET payload = '?' {OF_2} 9",
            [f"event 9: {CANNOT} ObjectDetected cannot be decoded: JSON is malformed: invalid character (byte 0)"],
        ),
        (
            f'UPDATE event SET payload = \'{{"node":"x","status":"LOST"}}\' {OF_2} 8',
            [f"event 8: {CANNOT} NodeEnded cannot be decoded: Expected `int`, got `str` - at `$.node`"],
        ),
        (
            f"UPDATE event SET type = 'RobotDanced' {OF_2} 4",
            [f"event 4: {CANNOT} RobotDanced is not an event this version knows"],
        ),
        (
            f"UPDATE event SET version = 2 {OF_2} 20",
            [f"event 20: {CANNOT} EpisodeEnded has version 2, this version knows 1"],
        ),
        (f"UPDATE event SET type = 'ObjectAdded' {OF_2} 11", ["event 11: "]),
        (
            f'UPDATE event SET payload = \'{{"node":99,"status":"FAILED"}}\' {OF_2} 8',
            ["event 8: node 99 ends and never"],
        ),
        (
            f"{ENDED} {OF_2} 19",
            ["event 20: the episode has ended already"],
        ),
    ],
)
async def test_damage_is_told_by_episode_and_event_and_the_others_are_looked_at(
    log: EventLog, database_url: str, change: str, reasons: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ask_to_change(database_url, change)
    third = next(table for table in shown(database_url) if table.name == "pose")
    row = rows_of(database_url, third)[-1]
    set_columns(database_url, third, row, {"x": 9.5})
    found = await told(log, database_url, monkeypatch)
    lines = [str(each) for each in found.damages]
    assert len(lines) == len(reasons) == found.damage
    for line, reason in zip(lines, reasons, strict=True):
        assert line.startswith(f"episode 2, {reason}")
    assert found.episodes == 3
    assert [each.number for each in found.differences if each.number != 2] == [3]
    assert {each.number for each in found.differences if each.number == 2} <= (
        {2} if "8: node" in reasons[0] else set()
    ) | ({2} if "ended already" in reasons[0] else set())
    assert (await look(log, episode=2)).damage == found.damage
    assert (await look(log, episode=1)).damage == 0


async def test_another_value_in_a_payload_is_a_difference_of_the_tables(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The log is the truth: what it says can be folded and is in order.
    ask_to_change(database_url, f"UPDATE event SET wall_ns = wall_ns + 5000000 {OF_2} 8")
    ask_to_change(database_url, f"UPDATE event SET payload = replace(payload, 'camera', 'world_state') {OF_2} 9")
    found = await told(log, database_url, monkeypatch)
    assert found.damage == 0
    assert [(each.sequence, each.table, each.column) for each in found.differences] == [
        (5, "task_tree_node", "end_time"),
        (9, "detection", "source"),
        (9, "detection", "source"),
    ]
    assert found.differences[1][4:] == ("camera", "world_state")


async def test_declarations_that_were_swapped_or_changed_are_told(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = name_of(NAVIGATE), name_of(PICK_UP)
    payloads = {first: encode(NAVIGATE).decode(), second: encode(PICK_UP).decode()}
    for name, other in ((first, second), (second, first)):
        change = f"UPDATE pycrorm_declaration SET payload = '{payloads[other]}' WHERE fingerprint = '{name}'"
        ask_to_change(database_url, change)
    found = await told(log, database_url, monkeypatch)
    assert {str(each) for each in found.damages} == {
        f"the declaration {name} does not match its fingerprint" for name in (first, second)
    }
    assert found.drift == 0
    ask_to_change(database_url, f"UPDATE pycrorm_declaration SET payload = '?' WHERE fingerprint = '{first}'")
    found = await told(log, database_url, monkeypatch)
    of_event = f"event 10: {CANNOT} the designator type {second} was never declared"
    assert {f"episode {number}, {of_event}" for number in (1, 2, 3)} < {str(each) for each in found.damages}
    assert found.drift == 0


async def test_events_of_an_episode_that_is_not_in_the_log_are_told(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (9, 0, 12):
        ask_to_change(database_url, f"{ONE_MORE.format(number, 1)} {OF_2} 20")
    found = await told(log, database_url, monkeypatch)
    assert [str(each) for each in found.damages] == [
        f"there are events of an episode {number}, which is not in the log" for number in (0, 9, 12)
    ]


async def test_an_event_that_nobody_can_read_is_damage_also_before_it_is_folded(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask_to_change(database_url, "UPDATE episode SET folded = 8, parked = 'why' WHERE number = 2")
    ask_to_change(database_url, f"UPDATE event SET payload = '{'[' * 100_000}' {OF_2} 9")
    found = await told(log, database_url, monkeypatch)
    (line,) = map(str, found.damages)
    assert line.startswith("episode 2, event 9: ObjectDetected cannot be decoded: ")
    assert found.behind == 12


# --- the file ------------------------------------------------------------------------------------------------------


@pytest.fixture
async def file(tmp_path: Path) -> Path:
    """Three episodes in a SQLite file that nobody has open, the second with some hundred events."""
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    made = await opened(url)
    await fold_in_batches(made, [full(1), full(2, rounds=30), full(3)], 10_000)
    await made.close()
    unlock(url)
    return tmp_path / "memory.db"


async def verified(file: Path) -> VerifyResult:
    reader = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{file}"), create=False)
    try:
        return await verify(reader)
    finally:
        await reader.close()


async def test_text_that_is_no_text_is_damage(file: Path) -> None:
    payload = b'{"source":"camera","object_type":"\xff"}'.hex()
    ask_to_change(file, f"UPDATE event SET payload = CAST(x'{payload}' AS TEXT) {OF_2} 9")
    found = await verified(file)
    (line,) = map(str, found.damages)
    assert line.startswith(f"episode 2, event 9: {CANNOT} ObjectDetected cannot be decoded: 'utf-8' codec")
    ask_to_change(file, f"UPDATE event SET type = CAST(x'ff' AS TEXT) {OF_2} 7")
    found = await verified(file)
    (line,) = map(str, found.damages)
    assert line.startswith("episode 2, event 7: cannot be read: ")
    assert found.episodes == 3


async def test_a_page_of_the_log_that_was_overwritten_is_told_by_episode_and_event(file: Path) -> None:
    assert_clean(await verified(file))
    [(payload,)] = ask(file, "SELECT payload FROM event WHERE episode = 2 AND sequence = 250")
    # Found by a text that is nowhere else.
    ask_to_change(file, "UPDATE event SET payload = replace(payload, 'x', 'x') WHERE episode = 2 AND sequence = 250")
    ask_to_change(file, "UPDATE pose__1 SET y = 7.5 WHERE id = (SELECT max(id) FROM pose__1)")
    image = bytearray(file.read_bytes())
    places = [place for place in range(len(image)) if image.startswith(payload.encode(), place)]
    page = places[len(places) // 2] // 4096
    image[page * 4096 : (page + 1) * 4096] = b"\xee" * 4096
    file.write_bytes(image)
    found = await verified(file)
    (unreadable,) = [each for each in found.damages if each.number is not None]
    assert unreadable.number == 2
    assert unreadable.sequence is not None
    assert 20 < unreadable.sequence <= 454
    assert "cannot be read" in unreadable.reason
    assert "malformed" in unreadable.reason
    assert found.damage > 1
    assert found.episodes == 3
    assert [(each.number, each.table, each.column, each.stored) for each in found.differences] == [
        (3, "pose", "y", 7.5)
    ]
    assert file.read_bytes() == image


async def test_whatever_bytes_are_flipped_there_is_an_answer_and_never_a_traceback(file: Path, tmp_path: Path) -> None:
    dice = random.Random(7)
    whole = file.read_bytes()
    told = 0
    for _ in range(25):
        image = bytearray(whole)
        page = dice.randrange(1, len(image) // 4096) * 4096
        for _ in range(20):
            image[page + dice.randrange(4096)] = dice.randrange(256)
        copy = tmp_path / "copy.db"
        copy.write_bytes(image)
        try:
            found = await verified(copy)
            told += bool(found.damage or found.drift)
        except PycrormError:
            told += 1
        assert copy.read_bytes() == image
        for each in tmp_path.glob("copy.db*"):
            each.unlink()
    assert told > 15
    shutil.rmtree(tmp_path)
