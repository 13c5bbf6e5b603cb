"""Append batches of events: each column as it is, each event once; what does not fit is refused alone."""

from __future__ import annotations

import asyncio
import json
import random
from typing import Any

import pytest
from sqlalchemy import BigInteger, Boolean, Column, Double, Integer, MetaData, Table, Text, select

from pycrorm_async import core
from pycrorm_async.errors import DamageError, LogDamaged, LogWentBack
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX, episode_text
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.append import Appending
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow
from tests.databases import Server, ask, ask_to_change, change_each
from tests.store.factories import HEADS, declaration, episode, name, record, run_of

# === append ===================================================================================================
#
# Append batches of events: each column as it is, each event once, and damage or an unavailable database reported.


async def test_every_column_is_stored_as_it_was_appended(log: EventLog, database_url: str) -> None:
    times = [(1_785_000_000_123_456_789, 9_007_199_254_740_993), (2**63 - 1, -(2**63)), (0, 2**53 + 1)]
    records = [
        record(episode(1), at, position=77, kind="ObjectAdded", version=3, wall_ns=wall, monotonic_ns=monotonic)
        for at, (wall, monotonic) in enumerate(times, 1)
    ]
    await log.append(records)
    assert ask(database_url, "SELECT * FROM event ORDER BY episode, sequence") == [
        (1, each.sequence, "ObjectAdded", 3, each.wall_ns, each.monotonic_ns, each.payload.decode()) for each in records
    ]
    assert [tuple(each) for each in await log.events(1, after=1)] == [(1, *each[2:]) for each in records[1:]]


_LARGER = "ALTER COLUMN {} TYPE bigint"
PAYLOADS = [
    '{"x":0.1,"y":1e-310,"z":-0.0,"w":123456789012345678,"v":1.0}',
    '{ "b" : 1,\n\t"a":2 , "b":3 }',
    r'{"escaped":"\u00e9 \ud83e\udd16 \\ \" \/ \n"}',
    '{"emoji":"🤖👩‍🍳","line":"\u2028\u2029","bom":"\ufeff","last":"\U0010ffff","rtl":"\u202e"}',
    '{"deep":' + "[" * 400 + "]" * 400 + "}",
    '{"long":"' + "ä" * 300_000 + '"}',
    "'; DROP TABLE event; --",
    "",
]


async def test_a_payload_is_stored_byte_for_byte(log: EventLog, database_url: str) -> None:
    await log.append(
        [record(episode(1), sequence, payload=text.encode()) for sequence, text in enumerate(PAYLOADS, start=1)]
    )
    assert [row[0] for row in ask(database_url, "SELECT payload FROM event ORDER BY sequence")] == PAYLOADS
    assert [each.payload for each in await log.events(1)] == [text.encode() for text in PAYLOADS]


async def test_events_are_stored_alike_in_the_larger_columns_of_an_earlier_version(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = []
    for kinds in ((), ("episode", "sequence", "version")):
        for copy_rows in (core.copy_rows, core._copy_rows):
            url = server.new_memory()
            if kinds:
                larger = f"ALTER TABLE pycrorm.event {', '.join(map(_LARGER.format, kinds))}"
                change_each(url, ["DROP SCHEMA memory CASCADE", larger])
            monkeypatch.setattr(core, "copy_rows", copy_rows)
            async with await EventLog.open(DatabaseAddress.parse(url), create=True) as log:
                await log.append([record(episode(1), at, payload=text.encode()) for at, text in enumerate(PAYLOADS, 1)])
                await log.append(run_of(episode(1), len(PAYLOADS) + 1, 3_000))
            rows.append(ask(url, "SELECT * FROM event ORDER BY sequence"))
    assert len(rows[0]) == 3_000
    assert rows[1:] == [rows[0]] * 3


async def test_episodes_are_numbered_in_the_order_in_which_they_appear(log: EventLog, database_url: str) -> None:
    interleaved = [record(episode(which), sequence) for sequence in range(1, 41) for which in (9, 3)]
    await log.append(interleaved)
    await log.append([*run_of(episode(5), 1, 1), *run_of(episode(3), 41, 42)])
    assert [row[:3] for row in ask(database_url, HEADS)] == [(1, name(9), 40), (2, name(3), 42), (3, name(5), 1)]
    counts = ask(database_url, "SELECT count(*), min(sequence), max(sequence) FROM event GROUP BY episode ORDER BY 1")
    assert counts == [(1, 1, 1), (40, 1, 40), (42, 1, 42)]
    assert [await log.episode_number(episode(each)) for each in (3, 8)] == [2, None]
    assert episode_text(episode(9)) == name(9)


async def test_an_episode_row_has_the_times_of_its_start_and_end(log: EventLog, database_url: str) -> None:
    await log.append([record(episode(1), 1, wall_ns=100), record(episode(1), 2, wall_ns=200)])
    assert ask(database_url, HEADS) == [(1, name(1), 2, 0, 100, None, None, None)]
    await log.append([record(episode(1), 3, wall_ns=300, kind="EpisodeEnded")])
    assert ask(database_url, HEADS) == [(1, name(1), 3, 0, 100, 300, None, None)]
    assert await log.episodes() == [EpisodeRow(1, name(1), 3, 0, 100, 300, None, None)]
    await log.append([record(episode(1), 4, wall_ns=400, kind="NodeEnded")])
    assert ask(database_url, HEADS) == [(1, name(1), 4, 0, 100, 300, None, None)]


# --- repeated batches -------------------------------------------------------------------------------------------------


async def test_of_a_batch_that_repeats_or_overlaps_stored_events_the_new_ones_are_stored(
    log: EventLog, database_url: str
) -> None:
    records = [declaration(b'{"dtype":"A"}'), *run_of(episode(1), 1, 5), *run_of(episode(2), 1, 3)]
    for _ in range(2):
        assert await log.append(records) == {}
        assert [row[:3] for row in ask(database_url, HEADS)] == [(1, name(1), 5), (2, name(2), 3)]
        assert ask(database_url, "SELECT count(*) FROM pycrorm_declaration") == [(1,)]
    assert await log.append([*run_of(episode(1), 3, 8), *run_of(episode(1), 7, 9)]) == {}
    sequences = ask(database_url, "SELECT sequence FROM event WHERE episode = 1 ORDER BY sequence")
    assert sequences == [(n,) for n in range(1, 10)]


async def test_a_different_event_under_a_used_number_or_event_zero_is_damage_and_stores_nothing(
    log: EventLog, database_url: str
) -> None:
    await log.append(run_of(episode(1), 1, 3))
    before = ask(database_url, "SELECT * FROM event ORDER BY episode, sequence")
    second = record(episode(1), 2)
    others = [
        second._replace(payload=b'{"kind":"motion"}'),
        second._replace(payload=second.payload + b" "),
        second._replace(type="NodeEnded"),
        second._replace(version=2),
        second._replace(wall_ns=1),
        second._replace(monotonic_ns=1),
        record(episode(1), 0),
    ]
    batches = [[*run_of(episode(2), 1, 4), each, *run_of(episode(1), 3, 6)] for each in others]
    batches.append([*run_of(episode(1), 4, 6), record(episode(1), 5, payload=b"{}")])  # twice in one batch
    for batch, sequence in zip(batches, (2, 2, 2, 2, 2, 2, 0, 5), strict=True):
        with pytest.raises(LogDamaged) as caught:
            await log.append(batch)
        assert (caught.value.episode, caught.value.sequence) == (name(1), sequence)
        assert ask(database_url, "SELECT * FROM event ORDER BY episode, sequence") == before
        assert [row[:3] for row in ask(database_url, HEADS)] == [(1, name(1), 3)]


# --- declarations ---------------------------------------------------------------------------------------------


async def test_declarations_are_stored_once_in_the_order_of_their_first_arrival(
    log: EventLog, database_url: str
) -> None:
    one, two, three = (json.dumps({"dtype": letter, "ü": "\u2028"}, ensure_ascii=False).encode() for letter in "CAB")
    await log.append([declaration(one), *run_of(episode(1), 1, 2), declaration(two), declaration(one)])
    await log.append([declaration(two), declaration(three)])
    assert await log.declarations() == [one, two, three]
    assert ask(database_url, "SELECT fingerprint FROM pycrorm_declaration ORDER BY ordinal") == [
        (fingerprint(one),),
        (fingerprint(two),),
        (fingerprint(three),),
    ]


async def test_designator_types_are_read_without_the_descriptions(log: EventLog) -> None:
    description = declaration(b'{"urdf":"e30="}')._replace(type="DescriptionDeclared")
    name = fingerprint(description.payload, "DescriptionDeclared")
    await log.append([description, declaration(b'{"dtype":"A"}')])
    assert await log.declarations() == [b'{"dtype":"A"}']
    assert await log.descriptions([name, "urdf-missing"]) == {name: description.payload}
    assert await log.descriptions([]) == {}


async def test_declarations_are_committed_in_the_order_in_which_they_are_read(log: EventLog) -> None:
    if log.address.is_sqlite:
        return  # one transaction writes at a time
    other = await EventLog.open(log.address, create=True)
    try:
        async with log.writing() as connection:
            await Appending(dialect_of(connection), [declaration(b'{"dtype":"A"}')]).write(connection)
            second = asyncio.create_task(other.append([declaration(b'{"dtype":"B"}')]))
            await asyncio.wait([second], timeout=0.3)
            assert not second.done()
        await second
        assert await log.declarations() == [b'{"dtype":"A"}', b'{"dtype":"B"}']
        async with log.writing() as connection:
            await Appending(dialect_of(connection), [declaration(b'{"dtype":"C"}')]).write(connection)
            await other.append([declaration(b'{"dtype":"A"}'), *run_of(episode(1), 1, 2)])  # a repeat waits for nothing
    finally:
        await other.close()


async def test_a_record_without_an_episode_that_is_no_declaration_is_damage(log: EventLog, database_url: str) -> None:
    odd = declaration(b"{}", position=12)._replace(type="Other")
    with pytest.raises(DamageError, match="record 12 belongs to no episode and is a Other"):
        await log.append([*run_of(episode(1), 1, 2), odd])
    assert ask(database_url, "SELECT count(*) FROM event") == [(0,)]


# --- an unavailable database ------------------------------------------------------------------------------------------


async def test_a_log_replaced_by_garbage_is_reported_as_a_fault_of_the_system(file_log: EventLog) -> None:
    await file_log.append(run_of(episode(1), 1, 3))
    await file_log.close()
    content = bytearray(file_log.address.path.read_bytes())
    content[4096:] = b"\xff" * (len(content) - 4096)
    file_log.address.path.write_bytes(content)
    with pytest.raises(DamageError, match="is damaged: database disk image is malformed"):
        await file_log.events(1)


@pytest.mark.parametrize(
    "meanwhile", ["nothing", "the same", "a part of it", "folded", "refused", "other", "different"]
)
async def test_values_prepared_before_the_transaction_are_prepared_again_if_the_episode_has_changed(
    file_log: EventLog, meanwhile: str
) -> None:
    log, file = file_log, file_log.address.path  # PostgreSQL appends without preparing
    await log.append([*run_of(episode(1), 1, 3), *run_of(episode(2), 1, 1)])
    batch = [*run_of(episode(1), 3, 9), *run_of(episode(2), 2, 4), *run_of(episode(3), 1, 2)]
    appending = Appending(dialect_of(log.engine), batch)
    async with log.reading() as connection:
        await appending.prepare(connection)
    match meanwhile:
        case "the same":
            await log.append(batch)
        case "a part of it":
            await log.append([*run_of(episode(1), 4, 6), *run_of(episode(3), 1, 1)])
        case "folded":
            ask_to_change(file, "UPDATE episode SET folded = 2 WHERE number = 1")
        case "refused":
            await log.append(run_of(episode(2), 9, 9))
        case "other":
            await log.append([record(episode(4), 1), record(episode(1), 4)])
        case "different":
            await log.append([record(episode(1), 4, payload=b"{}")])
            with pytest.raises(LogDamaged):
                async with log.writing() as connection:
                    await appending.write(connection)
            return
    async with log.writing() as connection:
        assert (await appending.write(connection)).refusals == {}
    numbers = {1: 1, 2: 2, 3: 4, 4: 3} if meanwhile == "other" else {1: 1, 2: 2, 3: 3}
    stored = ask(file, "SELECT episode, sequence, payload FROM event ORDER BY episode, sequence")
    expected = {1: 9, 2: 4, 3: 2} | ({4: 1} if meanwhile == "other" else {})
    assert stored == sorted(
        (numbers[of], sequence, f'{{"kind":"action","parent":{sequence}}}')
        for of, last in expected.items()
        for sequence in range(1, last + 1)
    )
    assert [row[:1] + row[2:4] + row[6:7] for row in ask(file, HEADS)] == sorted(
        (numbers[of], last, 2 if (meanwhile, of) == ("folded", 1) else 0, None) for of, last in expected.items()
    )


# === multi row insert =========================================================================================
#
# Multi-row inserts into SQLite keep every value, whichever columns are None and however many rows there are.

COLUMNS = ("id", "whole", "text", "real", "truth", "empty", "late")
TABLE = Table(
    "kept",
    MetaData(),
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("whole", BigInteger),
    Column("text", Text),
    Column("real", Double),
    Column("truth", Boolean),
    Column("empty", Text),
    Column("late", BigInteger),
)
VALUES: tuple[tuple[Any, ...], ...] = (
    (None, 0, 1, -1, 2**62, -(2**62)),
    (None, "", "0", "null", "NULL", "'", "\u2028ü"),
    (None, 0.0, 0.1, 1e-320, float("inf")),
    (None, True, False),
    (None,),
)


def any_rows(count: int, *, empty_often: float) -> list[tuple[Any, ...]]:
    """Return rows with columns that are None in all, some and no rows; the last column has its first value late."""
    choice = random.Random(count)
    rows = []
    for number in range(count):
        some = (None if choice.random() < empty_often else choice.choice(values) for values in VALUES)
        rows.append((number + 1, *some, None if number < count - 3 else number))
    return rows


@pytest.mark.parametrize(("count", "empty_often"), [(1, 0.5), (65, 0.0), (300, 1.0), (5_000, 0.5)])
async def test_inserted_and_updated_rows_hold_the_values_that_were_passed(
    file_log: EventLog, count: int, empty_often: float
) -> None:
    rows = any_rows(count, empty_often=empty_often)
    async with file_log.engine.begin() as connection:
        await connection.run_sync(TABLE.create)
        dialect = dialect_of(connection)
        await dialect.insert(connection, await dialect.insertion({("kept", COLUMNS): rows}))
        stored = [tuple(row) for row in await connection.execute(select(TABLE).order_by(TABLE.c.id))]
        assert repr(stored) == repr(rows)

        changed = [(row[0], *other[1:]) for row, other in zip(rows, reversed(rows), strict=True)]
        kinds = {name: TABLE.c[name].type.compile(dialect=connection.dialect) for name in COLUMNS}
        await dialect.update_rows(connection, "kept", kinds, changed)
        stored = [tuple(row) for row in await connection.execute(select(TABLE).order_by(TABLE.c.id))]
        assert repr(stored) == repr(changed)


# === refused events ===========================================================================================
#
# Events that do not fit their episode or the database are refused, and no other episode is.


async def test_a_log_that_holds_less_than_it_confirmed_refuses_the_batch(log: EventLog, database_url: str) -> None:
    await log.append(run_of(episode(1), 1, 3))
    with pytest.raises(LogWentBack, match=f"1 to 5 of episode {name(1)} and holds 3"):
        await log.store(run_of(episode(2), 1, 2), witness=(episode(1), 5))
    with pytest.raises(LogWentBack):
        await log.store(run_of(episode(2), 1, 2), witness=(episode(3), 1))
    await log.store(run_of(episode(2), 1, 1), witness=(episode(1), 3))
    assert ask(database_url, "SELECT number, head FROM episode ORDER BY number") == [(1, 3), (2, 1)]


async def test_an_episode_gets_its_former_number_unless_another_has_it(log: EventLog, database_url: str) -> None:
    await log.append(run_of(episode(1), 1, 1))
    former = {episode(2): 1, episode(3): 7}
    await log.skip_numbers(7)
    await log.store([*run_of(episode(2), 1, 1), *run_of(episode(3), 1, 1, position=2)], numbers=former)
    await log.append(run_of(episode(4), 1, 1))
    numbers = dict(ask(database_url, "SELECT id, number FROM episode"))
    assert [numbers[name(each)] for each in (1, 3, 2, 4)] == [1, 7, 8, 9]


FIRST, GAP = "event 1 did not arrive before event 2", "events 3 to 4 did not arrive before event 5"


@pytest.mark.parametrize(
    ("batches", "refused", "head", "kept"),
    [
        pytest.param([[1, 2, 5, 6]], GAP, 2, GAP, id="a gap stops its episode before the gap"),
        pytest.param([[2, 3, 4]], FIRST, 0, FIRST, id="an episode may begin with a gap"),
        pytest.param([[1, 2, 5], [6, 7, 9]], GAP, 2, GAP, id="the first reason is kept"),
        pytest.param([[1, 2, 5, 6], [3, 4, 5, 6]], None, 6, None, id="the missing events end a refusal"),
        pytest.param([[1, 2, 5], [1, 2]], None, 2, GAP, id="repeats do not end a refusal"),
    ],
)
async def test_a_gap_stops_its_episode_and_no_other(
    log: EventLog, database_url: str, batches: list[list[int]], refused: str | None, head: int, kept: str | None
) -> None:
    for number, sequences in enumerate(batches, 1):
        records = [record(episode(1), each) for each in sequences]
        refusals = await log.append([record(episode(2), number), *records, record(episode(3), number)])
    assert refusals == ({} if refused is None else {episode(1): refused})
    heads = {row[1]: (row[2], row[6]) for row in ask(database_url, HEADS)}
    assert heads == {name(1): (head, kept)} | {name(each): (len(batches), None) for each in (2, 3)}
    assert [(row.id, row.refused) for row in await log.stopped()] == ([] if kept is None else [(name(1), kept)])


@pytest.mark.parametrize("payload", [b'{"name":"a\x00b"}', b'"\xed\xa0\x80"'])
async def test_text_that_no_database_can_hold_stops_its_episode(
    log: EventLog, database_url: str, payload: bytes
) -> None:
    refused = await log.append(
        [*run_of(episode(2), 1, 2), record(episode(1), 1), record(episode(1), 2, payload=payload)]
    )
    assert refused == {episode(1): "event 2: its payload is not text that a database can hold"}
    assert [(row[1], row[2]) for row in ask(database_url, HEADS)] == [(name(2), 2), (name(1), 1)]


async def test_an_episode_number_beyond_the_last_is_refused_and_nothing_else_is(
    log: EventLog, database_url: str
) -> None:
    await log.append(run_of(episode(1), 1, 1))
    taken = f"INSERT INTO episode (number, id, head, started_wall_ns) VALUES ({EPISODE_NUMBER_MAX}, 'x', 0, 0)"
    ask_to_change(database_url, taken)
    if database_url.startswith("postgresql"):  # PostgreSQL takes the numbers from a sequence
        ask_to_change(database_url, f"SELECT setval('pycrorm.episode_number', {EPISODE_NUMBER_MAX})")
    refused = await log.append([*run_of(episode(2), 1, 2), *run_of(episode(1), 2, 3)])
    assert refused == {
        episode(2): "all 2,147,483,647 episode numbers of this memory are used:"
        " move its spool to a new memory with `pycrorm spool rebind`"
    }
    assert ask(database_url, "SELECT head FROM episode WHERE number = 1") == [(3,)]
    assert ask(database_url, "SELECT count(*) FROM episode") == [(2,)]


async def test_an_event_number_beyond_the_last_is_refused(log: EventLog, database_url: str) -> None:
    await log.append(run_of(episode(1), 1, 1))
    ask_to_change(database_url, f"UPDATE episode SET head = {SEQUENCE_MAX - 1}")
    refused = await log.append(run_of(episode(1), SEQUENCE_MAX, SEQUENCE_MAX + 2))
    assert refused == {episode(1): "event 67108864: an episode holds at most 67,108,863 events"}
    assert ask(database_url, "SELECT head FROM episode") == [(67_108_863,)]
