"""Rules in the memory say how long episodes stay: the one with most tags decides, and the journal names it."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.types import EpisodeTagged
from pycrorm_async.operations.copy import _append
from pycrorm_async.operations.removal import erasable
from pycrorm_async.operations.retention import (
    RetentionRule,
    add_rule,
    apply_rules,
    deciding_rule,
    due_episodes,
    read_rules,
)
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.lake import query_lake
from pycrorm_async.store.log import EventLog
from tests.commands import one_line_of, pycrorm
from tests.databases import ask, ask_to_change
from tests.golden.unpacking import unpack_memory
from tests.golden.zoo import ZOO
from tests.operations.test_removal import PATIENT, assert_clean, places_with

DAY_S = 86_400


def rule(number: int, days: float | None, *tags: str) -> RetentionRule:
    return RetentionRule(number, f"{days}d", None if days is None else int(days * DAY_S), tags, None)


def test_of_the_rules_for_an_episode_the_one_with_most_tags_decides_and_then_the_one_that_keeps_longer() -> None:
    rules = [
        rule(1, 90),
        rule(2, 7, "tryout"),
        rule(3, None, "demo"),
        rule(4, 30, "tryout", "left"),
        rule(5, 9, "late"),
    ]

    def decides(*tags: str) -> int | None:
        decided = {each.number if (each := deciding_rule(some, tags)) else None for some in (rules, rules[::-1])}
        [number] = decided  # whatever their order
        return number

    assert [decides(), decides("other"), decides("tryout"), decides("left")] == [1, 1, 2, 1]
    assert [decides("demo"), decides("demo", "tryout"), decides("tryout", "late")] == [3, 3, 5]
    assert decides("demo", "tryout", "left") == 4
    assert deciding_rule(rules[1:], ()) is None


@pytest.mark.slow
@pytest.mark.parametrize("lake", [False, True], ids=["erase", "archive"])
async def test_what_no_rule_keeps_goes_and_what_runs_or_is_kept_by_its_tag_stays(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, lake: bool
) -> None:
    if lake:
        pytest.importorskip("duckdb_extension_ducklake", reason="the extra [lake] is not installed")
    monkeypatch.chdir(tmp_path)  # the default spool of a server is in the working directory
    address, place = DatabaseAddress.parse(database_url), f"ducklake:{tmp_path}/lake" if lake else None
    spool = address.default_spool
    async with Memory.open(database_url, settings=PATIENT) as memory:
        for name, tags in (("Zaunkönig", ()), ("Kranich", ("keep",)), ("Amsel", ("tryout",))):
            async with memory.episode(description=name, tags=tags):
                pass
        async with memory.episode(description="runs", tags=("tryout",)):
            await memory.flush()
            async with await EventLog.open(address, create=True) as log:
                assert (await read_rules(log), await due_episodes(log, [], 2**62)) == ([], [])
                ended_ns = {each.number: each.ended_wall_ns or 0 for each in await log.episodes()}
                await add_rule(log, "9d", timedelta(days=9), (), place)
                await add_rule(log, "2d", timedelta(days=2), ("tryout",), place)
                assert [each.keep_s for each in await read_rules(log)] == [9 * DAY_S, 2 * DAY_S]
                await add_rule(log, "1d", timedelta(days=1), ("tryout",), place)  # replaces it
                await add_rule(log, "forever", None, ("keep",), None)
                rules = await read_rules(log)
                assert [(each.number, each.keep, each.tags) for each in rules] == [
                    (1, "9d", ()), (2, "1d", ("tryout",)), (3, "forever", ("keep",)),
                ]  # fmt: skip

                async def due(now_ns: int) -> list[int]:
                    return [each.row.number for each in await due_episodes(log, rules, now_ns)]

                day_ns = DAY_S * 10**9
                assert [await due(ended_ns[3] + day_ns), await due(ended_ns[3] + day_ns + 1)] == [[], [3]]
                late_ns = ended_ns[3] + 1_000 * day_ns
                assert await due(late_ns) == [1, 3]
                result = await apply_rules(database_url, log, {1, 3, 4}, late_ns, spool=spool)
                assert await due(late_ns) == []
    removed = [*result.erased, *(each for some in result.archived.values() for each in some.removed)]
    assert len(removed) == 2
    assert ask(database_url, "SELECT number FROM episode ORDER BY 1") == [(2,), (4,)]
    option = f" --archive-to {place}" if lake else ""
    assert ask(database_url, "SELECT number, reason, archived_in FROM pycrorm_removed_episode ORDER BY 1") == [
        (1, f"retention --keep 9d{option}", place),
        (3, f"retention --keep 1d --tag tryout{option}", place),
    ]
    if place is not None:
        assert query_lake(place, "SELECT count(*) FROM episode")[1] == [(2,)]
    else:
        assert all(each.left for each in result.erased)  # the recorder that ran had the segment
        rename = "UPDATE pycrorm_removed_episode SET reason = '{}' WHERE number = 1"
        ask_to_change(database_url, rename.format("retention policy of the lab"))  # of a user, who finishes it
        async with await EventLog.open(address, create=True) as log:
            for number, reason in (3, "retention --keep 9d"), (1, ""):
                finished = await apply_rules(database_url, log, (), late_ns, spool=spool)
                assert [(each.removed.number, each.left) for each in finished.erased] == [(number, ())]
                ask_to_change(database_url, rename.format(reason))
        assert places_with("Amsel", database_url) == []
    await assert_clean(database_url)


@pytest.mark.slow
async def test_a_tag_that_is_not_in_the_tables_yet_keeps_its_episode(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url) as memory, memory.episode(description="old"):
        pass
    async with await EventLog.open(DatabaseAddress.parse(url), create=True) as log:
        await add_rule(log, "1d", timedelta(days=1), (), None)
        await add_rule(log, "forever", None, ("keep",), None)
        rules, [row] = await read_rules(log), await log.episodes()
        assert [each.row.number for each in await due_episodes(log, rules, 2**62)] == [1]
        await _append(log, row, EpisodeTagged(("keep",), ()), SYSTEM_CLOCK)
        assert ask(url, "SELECT folded < head FROM episode") == [(1,)]
        assert await due_episodes(log, rules, 2**62) == []


async def due_after_a_day(url: str, *tags: str) -> list[int]:
    """Return the due episodes of a memory in which episodes with these tags stay for a day."""
    async with await EventLog.open(DatabaseAddress.parse(url), create=True) as log:
        await add_rule(log, "1d", timedelta(days=1), tags, None)
        return [each.row.number for each in await due_episodes(log, await read_rules(log), 2**62)]


@pytest.mark.slow
async def test_a_rule_concerns_simulations_too(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool", settings=PATIENT) as memory:
        memory.recording.episode(description="thought", simulated=True, tags=("tryout",)).close()
        async with memory.episode(description="kept"):
            pass
    assert await due_after_a_day(database_url, "tryout") == [1]


@pytest.mark.slow
async def test_without_tables_of_this_version_the_tags_are_read_from_the_log(tmp_path: Path) -> None:
    url = unpack_memory(ZOO / "fold_3.tar.gz", tmp_path)
    assert await due_after_a_day(url, "tryout") == []
    assert await due_after_a_day(url) == [1]


@pytest.mark.slow
async def test_a_lake_that_is_away_keeps_only_what_it_would_get_and_the_rest_is_shown(tmp_path: Path) -> None:
    pytest.importorskip("duckdb_extension_ducklake", reason="the extra [lake] is not installed")
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url) as memory:
        for tags in (("away",), ("there",), ()):
            async with memory.episode(description="old", tags=tags):
                pass
    shift = "SET started_wall_ns = started_wall_ns - {0}, ended_wall_ns = ended_wall_ns - {0}"
    ask_to_change(url, f"UPDATE episode {shift.format(2 * DAY_S * 10**9)}")
    (tmp_path / "away").touch()  # where the folder of the lake was
    async with await EventLog.open(DatabaseAddress.parse(url), create=True) as log:
        for tag in ("away", "there"):
            await add_rule(log, "1d", timedelta(days=1), (tag,), f"ducklake:{tmp_path}/{tag}")
        await add_rule(log, "1d", timedelta(days=1), (), None)
    done = pycrorm("retention", "apply", "--yes", "--json", "--url", url, cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    assert f"ducklake:{tmp_path}/away" in one_line_of(done)
    outcomes = ["stays: parked, not visible yet, or changed meanwhile", "archived", "erased"]
    assert [each["then"] for each in json.loads(done.stdout)] == outcomes
    assert ask(url, "SELECT number FROM episode") == [(1,)]


@pytest.mark.slow
async def test_an_episode_of_a_clock_that_was_years_behind_is_as_old_as_what_was_stored_before_it(
    tmp_path: Path,
) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url) as memory:
        for each in "abcd":
            async with memory.episode(description=each):
                pass
    ask_to_change(url, "UPDATE episode SET started_wall_ns = 0, ended_wall_ns = 9 WHERE number IN (1, 4)")  # 1970
    day_ns = DAY_S * 10**9
    async with await EventLog.open(DatabaseAddress.parse(url), create=True) as log:
        rows = {each.number: each for each in await log.episodes()}
        await add_rule(log, "1d", timedelta(days=1), (), None)
        rules, last_ns = await read_rules(log), rows[3].started_wall_ns

        async def due(now_ns: int) -> list[int]:
            return [each.row.number for each in await due_episodes(log, rules, now_ns)]

        assert await due(last_ns) == [1]  # nothing shows that it is younger
        assert 4 not in await due(last_ns + day_ns)
        assert 4 in await due(last_ns + day_ns + 1)
        old = await erasable(log, [], ended_before=datetime.fromtimestamp(last_ns / 1e9 - 1, UTC))
        assert [each.number for each in old] == [1]


@pytest.mark.slow
async def test_the_command_lists_tries_asks_and_applies(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url) as memory:
        for tags in ((), ("demo",)):
            async with memory.episode(description="old", tags=tags):
                pass
    ask_to_change(url, "UPDATE episode SET ended_wall_ns = ended_wall_ns - 40 * 86400000000000")

    def run(*words: str, code: int = 0) -> str:
        done = pycrorm("retention", *words, "--url", url, cwd=tmp_path)
        assert done.returncode == code, done.stderr
        return done.stdout if code == 0 else one_line_of(done)

    assert json.loads(run("apply", "--json")) == []
    assert "is not an age: write 12h, 90d, 52w, 1y, or forever" in run("add", "--keep", "2026-01-01", code=2)
    assert "nothing to archive" in run("add", "--keep", "forever", "--archive-to", "ducklake:lake", code=2)
    assert "a lake is named ducklake:FOLDER" in run("add", "--keep", "1y", "--archive-to", "lake", code=2)
    assert "a tag must be a text of 1 to 100 characters" in run("add", "--keep", "1d", "--tag", "", code=2)
    run("add", "--keep", "30d")
    run("add", "--keep", "1y", "--tag", "demo", "--archive-to", "ducklake:lake")
    rules = json.loads(run("list", "--json"))
    assert [(each["number"], each["keep"], each["tags"], each["archive_to"]) for each in rules] == [
        (1, "30d", [], None), (2, "1y", ["demo"], f"ducklake:{tmp_path}/lake"),
    ]  # fmt: skip
    [due] = json.loads(run("apply", "--dry-run", "--json"))
    assert (due["number"], due["tags"], due["rule"], due["keep"], due["then"]) == (1, [], 1, "30d", "erase")
    assert "nothing was erased; --yes answers the question" in run("apply", code=2)
    [due] = json.loads(run("apply", "--yes", "--json"))
    assert due["then"] == "erased"
    assert "retention --keep 30d" in pycrorm("erase", "--url", url, cwd=tmp_path).stdout
    refused = pycrorm("erase", "2", "--reason", "retention --keep 9d", "--yes", "--url", url, cwd=tmp_path)
    assert (refused.returncode, "is that of a rule" in one_line_of(refused)) == (2, True)
    run("remove", "1")
    assert "there is no rule 1: `pycrorm retention list`" in run("remove", "1", code=2)
    assert [each["number"] for each in json.loads(run("list", "--json"))] == [2]
