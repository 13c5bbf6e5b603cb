"""Verify finds what was changed in the log behind its back: by the kept digests, and by digests kept elsewhere."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.types import DescriptionDeclared, EpisodeTagged, ObjectAdded
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.projections.findings import VerifyResult
from pycrorm_async.projections.verify import OutsideDigest, verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.backups import Backup
from tests.commands import COMMAND, answer, one_line_of, pycrorm
from tests.databases import ask, ask_to_change, run_in_own_loop
from tests.projections.event_script import pose
from tests.projections.verify_cases import fold_in_batches, full, in_parts, opened, rebuilt, unlock
from tests.store.factories import declaration

pytestmark = pytest.mark.slow

KEPT = "SELECT id, sequence, digest FROM pycrorm_digest JOIN episode ON number = episode ORDER BY id, sequence"
ID = "00000000-0000-7000-8000-00000000000{}"


async def fill(url: str) -> None:
    """Store and fold three episodes, of which the second has several blocks, and allow changes of the log."""
    log = await opened(url)
    await fold_in_batches(log, [full(1), full(2, rounds=40), full(3)], 10_000)
    await log.close()
    unlock(url)


@pytest.fixture(scope="module")
def prepared(request: pytest.FixtureRequest, module_database_url: str) -> Iterator[Backup]:
    run_in_own_loop(fill(module_database_url))
    on_server = module_database_url.startswith("postgresql")
    backup = Backup(module_database_url, request.getfixturevalue("server") if on_server else None)
    yield backup
    backup.drop()


@pytest.fixture
def filled_url(prepared: Backup, module_database_url: str) -> str:
    """The URL of the three episodes as they were stored."""
    prepared.restore()
    return module_database_url


@pytest.fixture
async def log(filled_url: str) -> AsyncIterator[EventLog]:
    """The log of the three episodes, open for reading."""
    reader = await EventLog.open(DatabaseAddress.parse(filled_url), create=False)
    yield reader
    await reader.close()


async def findings(log: EventLog, digests: tuple[OutsideDigest, ...], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the lines of damage, which are the same for all sizes of parts."""
    result = await verify(log, digests=digests)
    lines = [str(each) for each in result.damages]
    if not digests:
        assert sorted(str(each) for each in (await in_parts(log, 200, monkeypatch)).damages) == sorted(lines)
    return lines


async def digests_of(log: EventLog) -> tuple[OutsideDigest, ...]:
    last = await log.last_digests()
    return tuple(OutsideDigest(each.id, *last[each.number][1:]) for each in await log.episodes())


CHANGED = "or their digest, was changed after it was stored: the digest does not match"
OTHER_TIME = "and the event has another time: one of them was changed after it was stored"
CUT = [
    "DELETE FROM event WHERE episode = 2 AND sequence > 580",
    "UPDATE episode SET head = 580, folded = 580 WHERE number = 2",
]
KEYS = {"event": "episode", "episode": "number", "pycrorm_digest": "episode"}


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(
    ("changes", "lines"),
    [
        ([], []),
        (
            ["UPDATE event SET payload = replace(payload, 'jug', 'mug') WHERE episode = 2 AND sequence = 9"],
            [f"episode 2, event 1: one of the events 1 to 256, {CHANGED}"],
        ),
        (
            ["UPDATE event SET monotonic_ns = monotonic_ns - 1 WHERE episode = 2 AND sequence = 257"],
            [f"episode 2, event 257: one of the events 257 to 512, {CHANGED}"],
        ),
        (
            ["UPDATE event SET wall_ns = wall_ns + 1 WHERE episode = 2 AND sequence = {last}"],
            ["episode 2, event {last}: the episode's ended_wall_ns is {ended}, " + OTHER_TIME],
        ),
        (
            ["UPDATE event SET payload = replace(payload, 'e3', 'e4') WHERE episode = 3 AND sequence = 1"],
            [f"episode 3, event 1: one of the events 1 to 20, {CHANGED}"],
        ),
        (
            [
                "DELETE FROM event WHERE episode = 2 AND sequence > 580",
                "UPDATE episode SET head = 580, folded = 580, ended_wall_ns = NULL WHERE number = 2",
            ],
            ["episode 2, event 581: the events 581 to {last} were deleted: a digest at event {last} exists"],
        ),
        (
            ["DELETE FROM event WHERE episode = 3", "DELETE FROM episode WHERE number = 3"],
            ["episode 3 was deleted: the log has its digests and not its events"],
        ),
        (
            [*CUT, "DELETE FROM pycrorm_digest WHERE episode = 2 AND sequence > 580"],
            ["episode 2, event 581: it and all behind it were deleted: the episode has an end, and no EpisodeEnded"],
        ),
        (
            [
                *CUT,
                "DELETE FROM pycrorm_digest WHERE episode = 2 AND sequence > 580",
                "UPDATE episode SET ended_wall_ns = NULL WHERE number = 2",
            ],
            ["episode 2, event 581: the events 581 to 603 were deleted: the tables have rows of event 603"],
        ),
        (
            [f"DELETE FROM {table} WHERE {key} = 3" for table, key in KEYS.items()],
            ["episode 3 was deleted: the tables have rows of its events up to 18, and the log has none of them"],
        ),
        (
            ["DELETE FROM pycrorm_digest WHERE episode = 2 AND sequence = 512"],
            ["episode 2, event 512: its digest is missing, although other digests of the episode exist"],
        ),
        (
            ["UPDATE pycrorm_digest SET digest = 'x' WHERE episode = 2 AND sequence = {last}"],
            ["episode 2, event 513: one of the events 513 to {last}, " + CHANGED],
        ),
        (
            ["UPDATE episode SET id = '00000000-0000-7000-8000-000000000009' WHERE number = 3"],
            [f"episode 3, event 1: one of the events 1 to 20, {CHANGED}"],
        ),
    ],
)
@pytest.mark.soak_on("postgresql")
async def test_each_change_of_the_log_is_found_and_named_in_one_line(
    log: EventLog, filled_url: str, changes: list[str], lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    [(head, ended)] = ask(filled_url, "SELECT head, ended_wall_ns FROM episode WHERE number = 2")
    for change in changes:
        ask_to_change(filled_url, change.format(last=head))
    assert await findings(log, (), monkeypatch) == [each.format(last=head, ended=ended) for each in lines]


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (["DELETE FROM event WHERE episode = 3", "DELETE FROM episode WHERE number = 3"], "episode {id} is missing: "),
        (
            [
                "DELETE FROM event WHERE episode = 2 AND sequence > 400",
                "UPDATE episode SET head = 400, folded = 400 WHERE number = 2",
            ],
            "episode 2, event 401: the events 401 to {last} are missing: a digest at the last one is given",
        ),
        ([], "episode 2, event {last}: the digest at this event is missing: one of the events 1 to {last} was changed"),
    ],
)
async def test_digests_kept_elsewhere_find_what_was_deleted_with_its_digests(
    log: EventLog, filled_url: str, changes: list[str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests, head = await digests_of(log), ask(filled_url, "SELECT head FROM episode WHERE number = 2")[0][0]
    assert await findings(log, digests, monkeypatch) == []
    for change in (*changes, "DELETE FROM pycrorm_digest"):
        ask_to_change(filled_url, change)
    assert line.format(id=ID.format(3), last=head) in "\n".join(await findings(log, digests, monkeypatch))


async def test_new_digests_over_changed_events_differ_from_those_kept_elsewhere(
    log: EventLog, filled_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = await digests_of(log)
    ask_to_change(filled_url, "UPDATE event SET wall_ns = wall_ns + 1 WHERE episode = 3 AND sequence = 2")
    ask_to_change(filled_url, "DELETE FROM pycrorm_digest")
    forged = f"sqlite:///{tmp_path}/forged.db"
    await copy_episodes(filled_url, forged)
    other = await EventLog.open(DatabaseAddress.parse(forged), create=False)
    assert (await verify(other)).damage == 0
    lines = await findings(other, digests, monkeypatch)
    await other.close()
    reason = "the digest at this event differs from the given one: one of the events 1 to 20 was changed"
    assert lines == [f"episode 3, event 20: {reason}"]


async def test_a_copy_has_the_same_digests_and_adds_them_to_episodes_without(
    log: EventLog, filled_url: str, tmp_path: Path
) -> None:
    before = ask(filled_url, KEPT)
    ask_to_change(filled_url, "DELETE FROM pycrorm_digest WHERE episode < 3")
    assert (await verify(log)).without_digest == 2
    copied = f"sqlite:///{tmp_path}/copy.db"
    await copy_episodes(filled_url, copied)
    assert [tuple(each) for each in ask(copied, KEPT)] == [tuple(each) for each in before]


async def test_an_episode_that_is_being_recorded_is_covered_up_to_its_last_block(database_url: str) -> None:
    log = await opened(database_url)
    script = full(1, rounds=40)
    records, script.records = script.records, script.records[:-30]
    await fold_in_batches(log, [script], 10_000)
    result: VerifyResult = await verify(log)
    assert (result.damage, result.without_digest) == (0, 0)
    unlock(database_url)
    ask_to_change(database_url, "UPDATE event SET wall_ns = wall_ns + 1 WHERE sequence = 520")
    assert (await verify(log)).damage == 0
    await log.append(records[-30:])
    ask_to_change(database_url, "UPDATE event SET wall_ns = wall_ns + 1 WHERE sequence = 521")
    assert (await verify(log)).damage == 1
    await log.close()


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(
    ("change", "finding"),
    [
        ("UPDATE event SET wall_ns = wall_ns + 1 WHERE sequence = 21", CHANGED),
        ("DELETE FROM pycrorm_digest WHERE sequence = 21", "its digest is missing"),
    ],
)
async def test_a_tag_behind_the_end_is_covered(database_url: str, change: str, finding: str) -> None:
    log = await opened(database_url)
    script = full(1)
    await fold_in_batches(log, [script], 10_000)
    last = script.records[-1]
    tag = last._replace(sequence=last.sequence + 1, type="EpisodeTagged", payload=encode(EpisodeTagged(("seen",))))
    await log.append([tag])
    assert tag.sequence == 21
    assert (await verify(log)).damage == 0
    unlock(database_url)
    ask_to_change(database_url, change)
    assert [finding in str(each) for each in (await verify(log)).damages] == [True]
    await log.close()


@pytest.mark.soak_on("postgresql")
async def test_no_rebuild_is_advised_where_it_would_delete_the_rows_of_deleted_events(
    log: EventLog, filled_url: str, tmp_path: Path
) -> None:
    for change in (*CUT, *(f"DELETE FROM {table} WHERE {key} = 3" for table, key in KEYS.items())):
        ask_to_change(filled_url, change)
    done = pycrorm("verify", "--url", filled_url, cwd=tmp_path)
    result = await verify(log)
    assert done.returncode == 4
    assert done.stdout.splitlines()[-1].endswith(
        f": events were deleted from the log, and the tables have {result.rows_without_event} rows of them, which"
        " `pycrorm rebuild` would delete; restore a backup, or compare digests kept elsewhere (`--digests`)"
    )
    assert result.deleted == {2, 3}
    writing = await opened(filled_url)
    await rebuilt(writing)
    await writing.close()
    after = await verify(log)
    assert (after.rows_without_event, after.drift, after.deleted) == (0, 0, {2})


async def test_a_missing_digest_is_damage_where_the_version_that_stored_the_episode_keeps_digests(
    tmp_path: Path,
) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    log = await opened(url)
    description = encode(DescriptionDeclared("e30="))
    described, undescribed = full(1), full(2)
    name = fingerprint(description, "DescriptionDeclared")
    payload = encode(ObjectAdded("pr2", "ROBOT", pose(), {"torso": 0.1}, description=name))
    described.records[2] = described.records[2]._replace(payload=payload)
    await log.append([declaration(description)._replace(type="DescriptionDeclared")])
    await fold_in_batches(log, [described, undescribed], 10_000)
    assert ((await verify(log)).damages, (await verify(log)).without_digest) == ([], 0)
    unlock(url)
    ask_to_change(url, "DELETE FROM pycrorm_digest")
    result = await verify(log)
    reason = "its digest is missing, although the version that stored the episode keeps digests"
    assert [str(each) for each in result.damages] == [f"episode 1, event 20: {reason}"]
    assert result.without_digest == 1
    await log.close()


@pytest.mark.soak_on("postgresql")
async def test_the_command_compares_with_a_document_of_digests(log: EventLog, filled_url: str, tmp_path: Path) -> None:
    url = ("--url", filled_url)
    document = answer("episodes", "--simulated", *url, cwd=tmp_path)
    heads = dict(tuple(each) for each in ask(filled_url, "SELECT number, head FROM episode"))
    assert [(each["number"], each["digest_sequence"]) for each in document] == sorted(heads.items())
    assert {each["id"]: each["digest"] for each in document} == {each.id: each.digest for each in await digests_of(log)}
    file = tmp_path / "digests.json"
    file.write_text(json.dumps(document))
    assert pycrorm("verify", "--digests", str(file), *url, cwd=tmp_path).returncode == 0
    for table, column in KEYS.items():
        ask_to_change(filled_url, f"DELETE FROM {table} WHERE {column} = 3")
    line = f"damage: episode {ID.format(3)} is missing: a digest at event 20 is given"
    done = pycrorm("verify", "--digests", str(file), *url, cwd=tmp_path)
    assert (done.returncode, done.stdout.splitlines()[0]) == (4, line)
    piped = await asyncio.to_thread(
        subprocess.run,
        [*COMMAND, "verify", "--digests", "-", *url],
        check=False,
        input=file.read_text(),
        capture_output=True,
        text=True,
    )
    assert (piped.returncode, piped.stdout.splitlines()[0]) == (4, line)
    file.write_text("{}")
    wrong = pycrorm("verify", "--digests", str(file), *url, cwd=tmp_path)
    assert wrong.returncode == 2
    assert "holds no digests" in one_line_of(wrong)
