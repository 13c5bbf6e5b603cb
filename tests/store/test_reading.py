"""Reading the log, and ends that recovery computes."""

from __future__ import annotations

import sqlite3

import pytest
from sqlalchemy import text

from pycrorm_async.errors import LogDamaged
from pycrorm_async.events.codec import Record
from pycrorm_async.store import schema, sqlite
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog, advance_folded, park
from pycrorm_async.store.sqlite_engine import StoppableConnection
from pycrorm_async.store.stored import Incarnation, Span
from tests.databases import Server, ask, change_each
from tests.store.factories import episode, record, run_of


async def test_the_list_of_unfolded_episodes_shrinks_as_they_are_folded(
    log: EventLog,
) -> None:
    await log.append([*run_of(episode(1), 1, 3), *run_of(episode(2), 1, 2)])

    async def behind(*limits: int) -> list[tuple[int, int, int]]:
        return [(row.number, row.folded, row.head) for row in await log.behind(*limits)]

    assert await behind() == [(1, 0, 3), (2, 0, 2)]
    assert (await behind(1), await behind(0, 1)) == ([(2, 0, 2)], [(1, 0, 3)])
    async with log.engine.begin() as connection:
        assert await advance_folded(connection, [(1, 0, 2)])
    async with log.engine.begin() as connection:
        assert not await advance_folded(connection, [(2, 0, 2), (1, 0, 3)])  # the first was folded meanwhile
        await connection.rollback()
    assert await behind() == [(1, 2, 3), (2, 0, 2)]
    async with log.engine.begin() as connection:
        assert await advance_folded(connection, [(1, 2, 3)])
    with pytest.raises(Exception, match=r"(?i)check constraint"):
        async with log.engine.begin() as connection:
            await advance_folded(connection, [(2, 0, 3)])
    assert await behind() == [(2, 0, 2)]


async def test_a_parked_episode_is_not_behind_and_still_takes_events(log: EventLog) -> None:
    await log.append([*run_of(episode(1), 1, 3), *run_of(episode(2), 1, 1)])
    async with log.engine.begin() as connection:
        await park(connection, 1, "column height is an integer and a text")
    assert await log.append(run_of(episode(1), 4, 5)) == {}
    assert [row.number for row in await log.behind()] == [2]
    assert [(row.number, row.refused, row.parked) for row in await log.stopped()] == [
        (1, None, "column height is an integer and a text")
    ]
    async with log.engine.begin() as connection:
        await park(connection, 1, None)
    assert [(row.number, row.head) for row in await log.behind()] == [(1, 5), (2, 1)]
    assert await log.stopped() == []


async def test_a_snapshot_shows_the_same_events_while_others_are_appended(log: EventLog) -> None:
    count = text("SELECT count(*) FROM event")
    await log.append(run_of(episode(1), 1, 2))
    async with log.snapshot() as snapshot:
        assert (await snapshot.execute(count)).scalar_one() == 2
        await log.append(run_of(episode(1), 3, 4))
        assert (await snapshot.execute(count)).scalar_one() == 2
    async with log.reading() as later:
        assert (await later.execute(count)).scalar_one() == 4


async def test_each_time_the_log_went_back_is_noted_with_its_reason(log: EventLog) -> None:
    assert await log.incarnations() == []
    noted = [Incarnation(number, "robot 1", f"reason {number}") for number in (3, 1, 2)]
    for each in noted:
        await log.note_incarnation(*each)
    assert await log.incarnations() == noted


async def test_the_query_for_unfolded_episodes_reads_no_other_episode(file_log: EventLog) -> None:
    def plan_of(statement: object, *parameters: object) -> str:
        steps = ask(file_log.address.path, f"EXPLAIN QUERY PLAN {statement}", parameters)
        return " | ".join(row[3] for row in steps)

    compiled = dialect_of(file_log.engine).compile
    behind = plan_of(compiled(schema.SELECT_BEHIND), 0, 1, 0, 9, 0)
    assert "episode_behind" in behind
    assert "TEMP B-TREE" not in behind
    spans = plan_of(sqlite.SELECT_SPAN, 1, 0, 9)
    assert "SEARCH event USING INDEX" in spans
    assert "SCAN event" not in spans
    assert "episode_stopped" in plan_of(compiled(schema.SELECT_STOPPED))
    again = plan_of(compiled(schema.SELECT_EVENTS_BY_KEY), "[]")
    assert "SEARCH event USING INDEX" in again
    assert "SEARCH episode USING INTEGER PRIMARY KEY" in plan_of(compiled(schema.ADVANCE_FOLDED), "[]", "[]")
    assert "SEARCH episode USING INDEX" in plan_of(compiled(schema.LOCK_EPISODES), "[]")


async def test_an_append_and_a_fold_find_their_episodes_on_a_server_by_an_index(server: Server) -> None:
    url = server.new_database()
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    await log.close()
    episodes = "SELECT number, number::text, 5, 0 FROM generate_series(1, 10000) AS number"
    change_each(url, (f"INSERT INTO episode (number, id, head, started_wall_ns) {episodes}", "ANALYZE episode"))
    for statement in (schema.LOCK_EPISODES, schema.SELECT_HEADS, schema.SELECT_NUMBERS, schema.ADVANCE_FOLDED):
        plan = ask(url, f"EXPLAIN {dialect_of(log.engine).compile(statement)}", ["[]"])
        assert "Seq Scan" not in str(plan), plan


async def test_events_are_read_even_if_together_they_exceed_the_limit_of_one_value(file_log: EventLog) -> None:
    records = [record(episode(1), sequence, payload=b'"%s"' % (b"x" * 500)) for sequence in range(1, 11)]
    await file_log.append(records)
    whole = await file_log.spans([Span(1, 2, 9)])
    assert [(each.sequence, each.payload) for each in whole] == [(each.sequence, each.payload) for each in records[2:9]]
    async with file_log.reading() as connection:
        driver = (await connection.get_raw_connection()).driver_connection
        assert isinstance(driver, StoppableConnection)
        await driver.visit(lambda raw: raw.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 3_000))
        assert await dialect_of(file_log.engine).spans(connection, [Span(1, 2, 9)]) == whole


async def test_streamed_rows_are_whole_and_in_order(file_log: EventLog) -> None:
    await file_log.append(run_of(episode(1), 1, 200))
    query = text("SELECT sequence FROM event ORDER BY sequence")
    async with file_log.reading() as connection:
        assert list((await connection.execute(query)).scalars()) == list(range(1, 201))
        streamed = await connection.stream(query)
        assert [row.sequence async for row in streamed] == list(range(1, 201))
        streamed = await connection.stream(query)
        assert [row[0] for row in await streamed.fetchmany(70)] == list(range(1, 71))
        assert (await streamed.fetchone()) == (71,)
        await streamed.close()


# === computed end =============================================================================================
#
# Computed ends: recovery reads only its folder, so that a log with more events of the episode keeps them.

EVENTS = "SELECT sequence, type, payload FROM event ORDER BY sequence"
HEADS = "SELECT head, ended_wall_ns, refused FROM episode"


def lost(sequence: int) -> Record:
    """Return the computed end after this many events."""
    return record(episode(1), sequence + 1, kind="EpisodeEnded", payload=b'{"status":"LOST"}', wall_ns=50 + sequence)


END = record(episode(1), 6, kind="EpisodeEnded", payload=b'{"status":"SUCCEEDED"}')


@pytest.mark.parametrize(
    ("stored", "known", "head"),
    [
        pytest.param(run_of(episode(1), 1, 5), 2, 6, id="it follows the events that only the log has"),
        pytest.param([*run_of(episode(1), 1, 5), END], 3, 6, id="it is left out behind an end"),
        pytest.param([], 3, 4, id="it is stored once"),
    ],
)
async def test_a_computed_end_ends_what_the_log_has(
    log: EventLog, database_url: str, stored: list[Record], known: int, head: int
) -> None:
    await log.append(stored)
    end = END if END in stored else lost(known)
    for _ in range(2):  # a repaired folder that is drained twice
        assert await log.append([*run_of(episode(1), 1, known), lost(known)]) == {}
        events = ask(database_url, EVENTS)
        assert [row[0] for row in events] == list(range(1, head + 1))
        assert events[-1][1:] == ("EpisodeEnded", end.payload.decode())
        assert ask(database_url, HEADS) == [(head, end.wall_ns, None)]


async def test_any_other_event_under_a_used_number_is_still_damage(log: EventLog) -> None:
    await log.append(run_of(episode(1), 1, 5))
    with pytest.raises(LogDamaged):
        await log.append([record(episode(1), 3, kind="EpisodeEnded", payload=b'{"status":"FAILED"}')])
    with pytest.raises(LogDamaged):
        await log.append([*run_of(episode(1), 1, 1), record(episode(1), 2, payload=b"{}"), lost(2)])


async def test_a_log_that_waits_for_missing_events_keeps_waiting(log: EventLog, database_url: str) -> None:
    await log.append(run_of(episode(1), 1, 3))
    refused = await log.append(run_of(episode(1), 6, 7))
    assert refused == {episode(1): "events 4 to 5 did not arrive before event 6"}
    assert await log.append([*run_of(episode(1), 1, 2), lost(2)]) == {}
    assert ask(database_url, HEADS) == [(3, None, "events 4 to 5 did not arrive before event 6")]
    assert await log.append(run_of(episode(1), 4, 7)) == {}
    assert ask(database_url, HEADS) == [(7, None, None)]
