"""Computed ends: recovery reads only its folder, so that a log with more events of the episode keeps them."""

from __future__ import annotations

import pytest

from pycrorm_async.errors import LogDamaged
from pycrorm_async.events.codec import Record
from pycrorm_async.store.log import EventLog
from tests.databases import ask
from tests.store.factories import episode, record, run_of

EVENTS = "SELECT sequence, type, payload FROM event ORDER BY sequence"
HEADS = "SELECT head, ended_wall_ns, refused FROM episode"


def lost(sequence: int) -> Record:
    """Return the computed end after this many events."""
    return record(episode(1), sequence + 1, kind="EpisodeEnded", payload=b'{"status":"LOST"}', wall_ns=50 + sequence)


async def test_a_computed_end_follows_the_events_of_the_log_when_the_folder_had_fewer(
    log: EventLog, database_url: str
) -> None:
    await log.append(run_of(episode(1), 1, 5))
    for _ in range(2):  # a repaired folder that is drained twice
        assert await log.append([*run_of(episode(1), 1, 2), lost(2)]) == {}
        assert [row[0] for row in ask(database_url, EVENTS)] == [1, 2, 3, 4, 5, 6]
        assert ask(database_url, EVENTS)[-1] == (6, "EpisodeEnded", '{"status":"LOST"}')
        assert ask(database_url, HEADS) == [(6, 52, None)]


async def test_a_computed_end_is_ignored_when_the_log_has_an_end(log: EventLog, database_url: str) -> None:
    whole = [*run_of(episode(1), 1, 5), record(episode(1), 6, kind="EpisodeEnded", payload=b'{"status":"SUCCEEDED"}')]
    await log.append(whole)
    assert await log.append([*run_of(episode(1), 1, 3), lost(3)]) == {}
    assert [row[0] for row in ask(database_url, EVENTS)] == [1, 2, 3, 4, 5, 6]
    assert ask(database_url, HEADS)[0][0] == 6


async def test_a_computed_end_is_stored_once_when_the_folder_and_the_log_agree(
    log: EventLog, database_url: str
) -> None:
    for _ in range(2):
        assert await log.append([*run_of(episode(1), 1, 3), lost(3)]) == {}
    assert [row[0] for row in ask(database_url, EVENTS)] == [1, 2, 3, 4]


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
