"""Events that do not fit their episode or the database are refused, and no other episode is."""

from __future__ import annotations

import pytest

from pycrorm_async.errors import LogWentBack
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Basis
from tests.databases import ask, ask_to_change
from tests.store.factories import HEADS, episode, name, record, run_of


async def test_a_log_that_holds_less_than_it_confirmed_refuses_the_batch(log: EventLog, database_url: str) -> None:
    await log.append(run_of(episode(1), 1, 3))
    with pytest.raises(LogWentBack, match=f"1 to 5 of episode {name(1)} and holds 3"):
        await log.store(run_of(episode(2), 1, 2), Basis((episode(1), 5), lambda _: None, 0))
    with pytest.raises(LogWentBack):
        await log.store(run_of(episode(2), 1, 2), Basis((episode(3), 1), lambda _: None, 0))
    await log.store(run_of(episode(2), 1, 1), Basis((episode(1), 3), lambda _: None, 0))
    assert ask(database_url, "SELECT number, head FROM episode ORDER BY number") == [(1, 3), (2, 1)]


async def test_an_episode_gets_its_former_number_unless_another_has_it(log: EventLog, database_url: str) -> None:
    await log.append(run_of(episode(1), 1, 1))
    former = {episode(2): 1, episode(3): 2}
    await log.store(
        [*run_of(episode(2), 1, 1), *run_of(episode(3), 1, 1, position=2)], Basis(None, former.__getitem__, 2)
    )
    numbers = dict(ask(database_url, "SELECT id, number FROM episode"))
    assert (numbers[name(1)], numbers[name(3)]) == (1, 2)
    assert numbers[name(2)] > 2


async def test_a_gap_stops_its_episode_before_the_gap_and_no_other(log: EventLog, database_url: str) -> None:
    refused = await log.append(
        [*run_of(episode(1), 1, 2), *run_of(episode(2), 1, 3), *run_of(episode(1), 5, 6), *run_of(episode(2), 4, 4)]
    )
    reason = "events 3 to 4 did not arrive before event 5"
    assert refused == {episode(1): reason}
    assert [(row[1], row[2], row[6]) for row in ask(database_url, HEADS)] == [
        (name(1), 2, reason),
        (name(2), 4, None),
    ]
    assert [(row.id, row.refused) for row in await log.stopped()] == [(name(1), reason)]


async def test_an_episode_with_a_gap_stays_refused_and_shows_its_first_reason(log: EventLog, database_url: str) -> None:
    await log.append([*run_of(episode(1), 1, 2), *run_of(episode(1), 4, 4)])
    refused = await log.append([*run_of(episode(1), 5, 9), *run_of(episode(2), 1, 1)])
    assert refused == {episode(1): "event 3 did not arrive before event 4"}
    assert ask(database_url, "SELECT head FROM episode ORDER BY number") == [(2,), (1,)]


async def test_an_episode_that_begins_with_a_gap_has_a_row_and_is_refused(log: EventLog, database_url: str) -> None:
    assert await log.append(run_of(episode(1), 2, 4)) == {episode(1): "event 1 did not arrive before event 2"}
    assert [row[:3] for row in ask(database_url, HEADS)] == [(1, name(1), 0)]


async def test_a_refusal_ends_when_the_missing_events_arrive(log: EventLog, database_url: str) -> None:
    await log.append([*run_of(episode(1), 1, 2), *run_of(episode(1), 4, 6)])
    assert await log.append(run_of(episode(1), 3, 6)) == {}
    assert ask(database_url, "SELECT head, refused FROM episode") == [(6, None)]
    assert await log.stopped() == []


async def test_repeating_stored_events_does_not_change_a_refusal(log: EventLog, database_url: str) -> None:
    await log.append([*run_of(episode(1), 1, 2), *run_of(episode(1), 4, 6)])
    assert await log.append(run_of(episode(1), 1, 2)) == {}
    assert ask(database_url, "SELECT head, refused FROM episode") == [(2, "event 3 did not arrive before event 4")]


@pytest.mark.parametrize("payload", [b'{"name":"a\x00b"}', b'{"name":"\xff"}', b'{"name":"\xc3', b'"\xed\xa0\x80"'])
async def test_text_that_no_database_can_hold_stops_its_episode(
    log: EventLog, database_url: str, payload: bytes
) -> None:
    refused = await log.append(
        [
            *run_of(episode(2), 1, 2),
            record(episode(1), 1),
            record(episode(1), 2, payload=payload),
            record(episode(1), 3),
        ]
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
        episode(2): "all 4,194,303 episode numbers of this memory are used:"
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
