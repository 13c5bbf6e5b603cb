"""One episode that cannot be read or shown stops no other: not in reports, exports, copies, checks or the live list."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.live.follower import Activity, LogFollower
from pycrorm_async.projections import verify as verification
from pycrorm_async.projections.fold import fold_happening
from pycrorm_async.query.reading import Reading
from pycrorm_async.report import document
from pycrorm_async.report.overview import overview
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.cli.hostile_memory import record_hostile_episodes
from tests.commands import answer, pycrorm
from tests.databases import ask_to_change

pytestmark = pytest.mark.slow
DAMAGED, HOSTILE, CLEAN = 1, 2, 3


@pytest.fixture
def url(tmp_path: Path) -> str:
    """The URL of a memory with a damaged episode, a hostile one and a clean one."""
    url = record_hostile_episodes(tmp_path / "pycrorm.db")
    with sqlite3.connect(tmp_path / "pycrorm.db") as database:
        database.execute("DROP TRIGGER event_is_not_updated")
        for sequence, payload in ((5, "no JSON"), (9, "[" * 100_000)):
            changed = database.execute(
                "UPDATE event SET payload = ? WHERE episode = ? AND sequence = ?", (payload, DAMAGED, sequence)
            )
            assert changed.rowcount == 1
    return url


def test_every_verb_names_the_damaged_episode_and_serves_the_others(url: str, tmp_path: Path) -> None:
    written = pycrorm("report", "--all", "--out", "all.html", cwd=tmp_path)
    assert (written.returncode, written.stderr.count("episode 1 has no page: ")) == (1, 1)
    pages = {each.name for each in (tmp_path / "all.pages").iterdir()}
    assert pages == {f"episode-{HOSTILE}.html", f"episode-{CLEAN}.html"}
    exported = pycrorm("export", "1", "2", "3", "--format", "lerobot", "--out", "set", cwd=tmp_path)
    assert exported.returncode == 1
    assert "episode 1 is not in it: " in exported.stderr
    assert "of 2 episodes" in exported.stderr
    alone = pycrorm("export", "1", "--format", "lerobot", "--out", "alone", cwd=tmp_path)
    assert (alone.returncode, "Traceback" in alone.stderr, (tmp_path / "alone").exists()) == (4, False, False)
    copied = answer("copy", "--to", "sqlite:///copy.db", cwd=tmp_path, code=4)
    assert [bool(each["damage"]) for each in copied["episodes"]] == [True, False, False]
    assert [each["copied"] > 0 for each in copied["episodes"][1:]] == [True, True]
    checked = answer("verify", cwd=tmp_path, code=4)
    assert {each["sequence"] for each in checked["damages"]} == {5, 9}
    assert checked["episodes"] == 3
    for verb in ("episodes", "status"):
        assert "clean" in pycrorm(verb, cwd=tmp_path).stdout or verb == "status"


@pytest.mark.parametrize(
    "identity",
    [
        b"\xff1",
        pytest.param(b"01a21b3f\x00\xff", marks=pytest.mark.soak),
        pytest.param(b"01A21B3F-8D6E-70B2-AB1D-1283293A2663", marks=pytest.mark.soak),
    ],
)
async def test_a_damaged_id_is_named_with_its_episode_and_the_others_are_served(
    tmp_path: Path, identity: bytes
) -> None:
    url = record_hostile_episodes(tmp_path / "pycrorm.db")
    with sqlite3.connect(tmp_path / "pycrorm.db") as database:
        database.execute("DROP TRIGGER episode_is_not_renamed")
        database.execute("UPDATE episode SET id = CAST(? AS TEXT) WHERE number = ?", (identity, HOSTILE))
    database.close()
    for verb in ("verify", "rebuild"):
        done = pycrorm(verb, cwd=tmp_path)
        assert (done.returncode, "Traceback" in done.stderr) == (4, False)
        assert f"episode {HOSTILE}" in done.stdout + done.stderr
        assert "its id" in done.stdout + done.stderr
    assert answer("verify", cwd=tmp_path, code=4)["episodes"] == 3
    copied = answer("copy", "--to", "sqlite:///copy.db", cwd=tmp_path, code=4)
    assert [bool(each["damage"]) for each in copied["episodes"]] == [False, True, False]
    assert [each["copied"] > 0 for each in copied["episodes"]] == [True, False, True]
    assert answer("verify", "--url", "sqlite:///copy.db", cwd=tmp_path)["episodes"] == 2
    done = pycrorm("export", "1", "2", "3", "--format", "parquet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert pycrorm("report", "--all", "--out", "all.html", cwd=tmp_path).returncode == 0
    follower = LogFollower(DatabaseAddress.parse(url))
    try:
        log = await follower.log()
        assert await follower.overview.catch_up(log, await log.episodes())
        assert {each["number"] for each in follower.overview.entries(0)} == {1, 2, 3}
    finally:
        await follower.close()


@pytest.mark.parametrize(
    ("column", "change"),
    [("started_wall_ns", "{} - 1"), ("ended_wall_ns", "{} + 86400000000000"), ("ended_wall_ns", "NULL")],
)
async def test_a_changed_time_or_a_removed_end_of_an_episode_is_damage(
    tmp_path: Path, column: str, change: str
) -> None:
    url = record_hostile_episodes(tmp_path / "pycrorm.db")
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        assert (await verification.verify(log)).damages == []
        ask_to_change(url, f"UPDATE episode SET {column} = {change.format(column)} WHERE number = {HOSTILE}")
        [damage] = (await verification.verify(log)).damages
    finally:
        await log.close()
    assert damage.number == HOSTILE
    assert f"the episode's {column} is " in damage.reason


async def test_an_episode_that_no_page_can_be_made_of_leaves_the_pages_of_the_others(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _break(monkeypatch, document.EpisodePage, "read", lambda page, *_: page.number == HOSTILE)
    async with Reading.open(url) as reading:
        written = await overview(reading, tmp_path / "all.html")
    assert set(written.unreadable) == {DAMAGED, HOSTILE}
    assert written.unreadable[HOSTILE] == "its page cannot be made: TypeError: broken"
    follower = LogFollower(DatabaseAddress.parse(url))
    try:
        faults = [(await follower.feed(str(number))).fault for number in (HOSTILE, CLEAN)]
        assert faults == ["its events cannot be shown: TypeError: broken", None]
    finally:
        await follower.close()


async def test_an_episode_that_cannot_be_folded_leaves_the_list_of_the_others_and_their_check(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower = LogFollower(DatabaseAddress.parse(url))
    try:
        log = await follower.log()

        _break(monkeypatch, Activity, "read", lambda activity, *_: activity.row.number == HOSTILE)
        assert await follower.overview.catch_up(log, await log.episodes())
        entries = {each["number"]: each for each in follower.overview.entries(0)}
        assert entries[CLEAN]["status"] == "SUCCEEDED"
        assert "TypeError: broken" in str(entries[HOSTILE])
    finally:
        await follower.close()
    real = fold_happening

    def fold(event: Any, *others: Any) -> None:
        if event.type == "Observed":
            raise TypeError("broken")
        real(event, *others)

    monkeypatch.setattr("pycrorm_async.projections.fold.fold_happening", fold)
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        found = await verification.verify(log)
    finally:
        await log.close()
    assert found.episodes == 3
    assert [each.number for each in found.damages if "TypeError: broken" in str(each)] == [HOSTILE]


def _break(monkeypatch: pytest.MonkeyPatch, owner: type, name: str, is_bad: Any) -> None:
    """Let a method raise, as a defect of ours would, where its arguments are bad."""
    real = getattr(owner, name)

    def method(*arguments: Any) -> Any:
        if is_bad(*arguments):
            raise TypeError("broken")
        return real(*arguments)

    monkeypatch.setattr(owner, name, method)
