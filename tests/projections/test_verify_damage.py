"""Verify reports contradictions in the log by episode and event, and still checks everything else."""

from __future__ import annotations

import random
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import PycrormError
from pycrorm_async.events.codec import encode, fingerprint, short_name
from pycrorm_async.projections.findings import VerifyResult
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask, ask_each, ask_to_change, run_in_own_loop
from tests.projections.event_script import NAVIGATE, PICK_UP
from tests.projections.verify_cases import (
    assert_clean,
    fold_in_batches,
    full,
    in_parts,
    look,
    opened,
    rows_of,
    set_columns,
    unlock,
    verified,
    visible_tables,
)

pytestmark = pytest.mark.slow


async def fill(url: str, rounds_of_second: int = 1) -> None:
    """Store and fold three episodes, and allow changes of the log."""
    log = await opened(url)
    await fold_in_batches(log, [full(1), full(2, rounds=rounds_of_second), full(3)], 10_000)
    await log.close()
    unlock(url)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("prepared") / "memory.db"
    run_in_own_loop(fill(f"sqlite:///{file}"))
    return file


@pytest.fixture
def database_url(tmp_path: Path, prepared: Path) -> str:
    """Three episodes with twenty events each, in a SQLite file that lets its log be changed."""
    return f"sqlite:///{shutil.copyfile(prepared, tmp_path / 'memory.db')}"


@pytest.fixture
async def log(database_url: str) -> AsyncIterator[EventLog]:
    reader = await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    yield reader
    await reader.close()


def everything(url: str) -> list[Any]:
    """Return all rows of log and tables."""
    logged = [f"SELECT * FROM {name} ORDER BY 1, 2" for name in ("event", "episode", "pycrorm_declaration")]
    return [*ask_each(url, logged), *(rows_of(url, each) for each in visible_tables(url))]


async def findings_for_any_parts(log: EventLog, url: str, monkeypatch: pytest.MonkeyPatch) -> VerifyResult:
    """Return the findings, which are the same for all sizes of parts; verify must write nothing."""
    before = everything(url)
    result = await look(log)
    other = await in_parts(log, 16, monkeypatch)
    assert sorted(map(str, other.damages)) == sorted(map(str, result.damages))
    assert sorted(other.differences, key=repr) == sorted(result.differences, key=repr)
    assert everything(url) == before
    return result


ONE_MORE = "INSERT INTO event SELECT {}, {}, type, version, wall_ns, monotonic_ns, payload FROM event"
OF_2 = "WHERE episode = 2 AND sequence = "
COPIED = "type, version, payload"
ENDED = f"UPDATE event SET ({COPIED}) = (SELECT {COPIED} FROM event WHERE episode = 1 AND sequence = 20)"
CANNOT = "is in the tables, and cannot be folded:"


@pytest.mark.parametrize(
    ("change", "reasons"),
    [
        (
            "DELETE FROM event WHERE episode = 2 AND sequence IN (5, 6, 9)",
            ["event 5: is missing", "event 9: is missing"],
        ),
        ("DELETE FROM event WHERE episode = 2", ["event 1: is missing"]),
        (f"{ONE_MORE.format(2, 21)} {OF_2} 20", ["event 21: exists, but the episode must end with event 20"]),
        (
            f"UPDATE event SET sequence = 25 {OF_2} 20",
            ["event 25: exists, but the episode must end with event 20", "event 20: is missing"],
        ),
        (
            f"UPDATE event SET payload = '?' {OF_2} 9",
            [f"event 9: {CANNOT} ObjectDetected cannot be decoded: JSON is malformed: invalid character (byte 0)"],
        ),
        (
            f"UPDATE event SET type = 'RobotDanced' {OF_2} 4",
            [f"event 4: {CANNOT} RobotDanced is not an event type of this version"],
        ),
        (
            f"UPDATE event SET version = 2 {OF_2} 20",
            [f"event 20: {CANNOT} EpisodeEnded has version 2, this version reads 1"],
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
async def test_damage_is_reported_by_episode_and_event_and_the_others_are_checked(
    log: EventLog, database_url: str, change: str, reasons: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ask_to_change(database_url, change)
    third = next(table for table in visible_tables(database_url) if table.name == "pose")
    row = rows_of(database_url, third)[-1]
    set_columns(database_url, third, row, {"x": 9.5})
    result = await findings_for_any_parts(log, database_url, monkeypatch)
    lines = [str(each) for each in result.damages]
    assert len(lines) == len(reasons) == result.damage
    for line, reason in zip(lines, reasons, strict=True):
        assert line.startswith(f"episode 2, {reason}")
    assert result.episodes == 3
    assert [each.number for each in result.differences if each.number != 2] == [3]
    assert {each.number for each in result.differences if each.number == 2} <= (
        {2} if "8: node" in reasons[0] else set()
    ) | ({2} if "ended already" in reasons[0] else set())
    assert (await look(log, episode=2)).damage == result.damage
    assert (await look(log, episode=1)).damage == 0


async def test_a_changed_value_in_a_payload_is_a_difference_of_the_tables(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The log is the truth: its events can be folded and are in order, and an earlier version stored no digests.
    ask_to_change(database_url, "DELETE FROM pycrorm_digest")
    ask_to_change(database_url, f"UPDATE event SET wall_ns = wall_ns + 5000000 {OF_2} 5")
    ask_to_change(database_url, f"UPDATE event SET monotonic_ns = monotonic_ns + 1 {OF_2} 8")
    ask_to_change(database_url, f"UPDATE event SET payload = replace(payload, 'camera', 'world_state') {OF_2} 9")
    result = await findings_for_any_parts(log, database_url, monkeypatch)
    assert (result.damage, result.without_digest) == (0, 3)
    assert [(each.sequence, each.table, each.column) for each in result.differences] == [
        (5, "task_tree_node", "start_time"),
        (5, "task_tree_node", "end_ns"),
        (9, "detection", "source"),
        (9, "detection", "source"),
    ]
    assert result.differences[2][4:] == ("camera", "world_state")


async def test_swapped_or_changed_declarations_are_reported(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = fingerprint(encode(NAVIGATE)), fingerprint(encode(PICK_UP))
    payloads = {first: encode(NAVIGATE).decode(), second: encode(PICK_UP).decode()}
    for name, other in ((first, second), (second, first)):
        change = f"UPDATE pycrorm_declaration SET payload = '{payloads[other]}' WHERE fingerprint = '{name}'"
        ask_to_change(database_url, change)
    result = await findings_for_any_parts(log, database_url, monkeypatch)
    assert {str(each) for each in result.damages} == {
        f"the declaration {name} does not match its fingerprint" for name in (first, second)
    }
    assert result.drift == 0
    ask_to_change(database_url, f"UPDATE pycrorm_declaration SET payload = '?' WHERE fingerprint = '{first}'")
    result = await findings_for_any_parts(log, database_url, monkeypatch)
    of_event = f"event 10: {CANNOT} the designator type {short_name(second)} was never declared"
    assert {f"episode {number}, {of_event}" for number in (1, 2, 3)} < {str(each) for each in result.damages}
    assert result.drift == 0


async def test_events_of_an_episode_without_a_row_are_reported(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (9, 0, 12):
        ask_to_change(database_url, f"{ONE_MORE.format(number, 1)} {OF_2} 20")
    result = await findings_for_any_parts(log, database_url, monkeypatch)
    assert [str(each) for each in result.damages] == [
        f"there are events of an episode {number}, which is not in the log" for number in (0, 9, 12)
    ]


async def test_an_unreadable_event_is_damage_even_before_it_is_folded(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask_to_change(database_url, "UPDATE episode SET folded = 8, parked = 'why' WHERE number = 2")
    ask_to_change(database_url, f"UPDATE event SET payload = '{'[' * 100_000}' {OF_2} 9")
    result = await findings_for_any_parts(log, database_url, monkeypatch)
    (line,) = map(str, result.damages)
    assert line.startswith("episode 2, event 9: ObjectDetected cannot be decoded: ")
    assert result.behind == 12


# --- the file ------------------------------------------------------------------------------------------------------


@pytest.fixture
async def file(tmp_path: Path) -> Path:
    """Three episodes in a SQLite file that no process has open, the second with several hundred events."""
    await fill(f"sqlite:///{tmp_path / 'memory.db'}", 30)
    return tmp_path / "memory.db"


async def test_invalid_text_is_damage(file: Path) -> None:
    payload = b'{"source":"camera","object_type":"\xff"}'.hex()
    ask_to_change(file, f"UPDATE event SET payload = CAST(x'{payload}' AS TEXT) {OF_2} 9")
    result = await verified(f"sqlite:///{file}")
    (line,) = map(str, result.damages)
    assert line.startswith(f"episode 2, event 9: {CANNOT} ObjectDetected cannot be decoded: 'utf-8' codec")
    ask_to_change(file, f"UPDATE event SET type = CAST(x'ff' AS TEXT) {OF_2} 7")
    result = await verified(f"sqlite:///{file}")
    (line,) = map(str, result.damages)
    assert line.startswith("episode 2, event 7: cannot be read: ")
    assert result.episodes == 3


async def test_an_overwritten_page_of_the_log_is_reported_by_episode_and_event(file: Path) -> None:
    assert_clean(await verified(f"sqlite:///{file}"))
    [(payload,)] = ask(file, "SELECT payload FROM event WHERE episode = 2 AND sequence = 250")
    # Located by a text that occurs nowhere else.
    ask_to_change(file, "UPDATE event SET payload = replace(payload, 'x', 'x') WHERE episode = 2 AND sequence = 250")
    ask_to_change(file, "UPDATE zz_pose__1001 SET y = 7.5 WHERE id = (SELECT max(id) FROM zz_pose__1001)")
    image = bytearray(file.read_bytes())
    places = [place for place in range(len(image)) if image.startswith(payload.encode(), place)]
    page = places[len(places) // 2] // 4096
    image[page * 4096 : (page + 1) * 4096] = b"\xee" * 4096
    file.write_bytes(image)
    result = await verified(f"sqlite:///{file}")
    (unreadable,) = [each for each in result.damages if each.number is not None]
    assert unreadable.number == 2
    assert unreadable.sequence is not None
    assert 20 < unreadable.sequence <= 454
    assert "cannot be read" in unreadable.reason
    assert "malformed" in unreadable.reason
    assert result.damage > 1
    assert result.episodes == 3
    assert [(each.number, each.table, each.column, each.stored) for each in result.differences] == [
        (3, "pose", "y", 7.5)
    ]
    assert file.read_bytes() == image


async def test_flipped_bytes_anywhere_cause_findings_or_an_error_and_never_a_traceback(
    file: Path, tmp_path: Path
) -> None:
    dice = random.Random(8)
    whole = file.read_bytes()
    pages = [at for at in range(4096, len(whole), 4096) if whole[at : at + 4096].count(0) < 3900]  # of tables with rows
    findings_for_any_parts = 0
    for _ in range(12):
        image = bytearray(whole)
        page = dice.choice(pages)
        for _ in range(20):
            image[page + dice.randrange(4096)] = dice.randrange(256)
        copy = tmp_path / "copy.db"
        copy.write_bytes(image)
        try:
            result = await verified(f"sqlite:///{copy}")
            findings_for_any_parts += bool(result.damage or result.drift)
        except PycrormError:
            findings_for_any_parts += 1
        assert copy.read_bytes() == image
        for each in tmp_path.glob("copy.db*"):
            each.unlink()
    assert findings_for_any_parts > 6
    shutil.rmtree(tmp_path)
