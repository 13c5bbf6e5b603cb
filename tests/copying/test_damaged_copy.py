"""Damage, gaps and contradictions in one of two memories are reported, and everything else is copied."""

from __future__ import annotations

import pytest

from pycrorm_async.events.types import NodeStarted
from pycrorm_async.operations.copy import copy_episodes
from tests.copying.memories import New, append_in_own_thread, declarations_as_records, notes
from tests.databases import ask, ask_to_change
from tests.projections.event_script import Script, declarations, declared, field, name_of
from tests.projections.factories import append_and_fold
from tests.table_comparison import logs_of
from tests.test_table_comparison import episode as hand_written
from tests.test_table_comparison import fill

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""


async def test_other_bytes_under_one_key_are_reported_and_the_other_episodes_are_copied(
    new_url: New, new_file: New
) -> None:
    source, target = new_file(), new_url()
    scripts = [hand_written(number) for number in (1, 2, 3)]
    await fill(source, scripts)
    other = [each._replace(wall_ns=each.wall_ns + (each.sequence == 5)) for each in scripts[1].records]
    await append_and_fold(target, [*declarations_as_records(source), *other[:9]])
    before = logs_of(target)
    done = await copy_episodes(source, target)
    (bad,) = [each for each in done.episodes if each.damage]
    identity = "00000000-0000-7000-8000-000000000002"
    assert bad.id == identity
    assert bad.damage is not None
    assert bad.damage.startswith(f"episode {identity}, event 5: ")
    assert (bad.were_there, bad.copied, bad.head) == (9, 0, 9)
    assert [(each.copied, each.damage) for each in done.episodes if each is not bad] == [(12, None)] * 2
    after = logs_of(target)
    assert after.pop(identity) == before[identity]
    copied_logs = logs_of(source)
    del copied_logs[identity]
    assert after == copied_logs


async def test_other_bytes_that_arrive_during_the_copy_are_reported_and_the_other_episodes_are_copied(
    new_url: New, new_file: New
) -> None:
    source, target = new_file(), new_url()
    await fill(source, [hand_written(number) for number in (1, 2, 3)])
    other = [each._replace(monotonic_ns=4) for each in hand_written(2).records]
    progress_calls = 0

    def append_other_bytes(*_: object) -> None:  # events were read and are not appended yet
        nonlocal progress_calls
        if progress_calls == 0:
            append_in_own_thread(target, other)
        progress_calls += 1

    done = await copy_episodes(source, target, report_progress=append_other_bytes)
    assert [each.damage is None for each in done.episodes] == [True, False, True]
    assert done.episodes[1].damage is not None
    assert "another event is stored under this number" in done.episodes[1].damage
    assert [each.head for each in done.episodes] == [12, 12, 12]
    copied_logs = logs_of(target)
    assert {event[4] for event in copied_logs.pop("00000000-0000-7000-8000-000000000002")} == {4}
    assert copied_logs == {each: events for each, events in logs_of(source).items() if each in copied_logs}


@pytest.mark.parametrize("sequence", [1, 7, 12])
async def test_of_an_episode_with_a_gap_the_events_before_it_are_copied(new_file: New, sequence: int) -> None:
    source, target = new_file(), new_file()
    await fill(source, [hand_written(number) for number in (1, 2)])
    ask_to_change(source, "DROP TRIGGER event_is_not_deleted")
    ask_to_change(source, f"DELETE FROM event WHERE episode = 1 AND sequence = {sequence}")
    for _ in range(2):
        done = await copy_episodes(source, target)
        (bad, good) = done.episodes
        assert bad.damage == (f"episode 00000000-0000-7000-8000-000000000001, event {sequence}: is missing in {source}")
        assert (bad.head, good.head, good.damage) == (sequence - 1, 12, None)
    copied_logs = logs_of(target)
    assert [event[0] for event in copied_logs.get(bad.id, [])] == list(range(1, sequence))
    assert copied_logs[good.id] == logs_of(source)[good.id]


@pytest.mark.parametrize("damaged", [0, 1])
@pytest.mark.parametrize("sequence", [1, 7, 12])
async def test_a_gap_in_both_memories_is_reported(new_file: New, sequence: int, damaged: int) -> None:
    source, target = both = new_file(), new_file()
    for url in both:
        await fill(url, [hand_written(number) for number in (1, 2)])
    ask_to_change(both[damaged], "DROP TRIGGER event_is_not_deleted")
    ask_to_change(both[damaged], f"DELETE FROM event WHERE episode = 1 AND sequence = {sequence}")
    (bad, good) = (await copy_episodes(source, target)).episodes
    assert bad.damage == f"episode {bad.id}, event {sequence}: is missing in {both[damaged]}"
    assert (good.were_there, good.copied, good.damage) == (12, 0, None)


@pytest.mark.parametrize("payload", ["", "{", '{"node":"four"}', "[1]", '{"node":4,"status":"SUCCEEDED"} x'])
async def test_of_an_episode_with_an_unreadable_event_the_events_before_it_are_copied(
    new_file: New, payload: str
) -> None:
    source, target = new_file(), new_file()
    await fill(source, [hand_written(number) for number in (1, 2)])
    ask_to_change(source, "DROP TRIGGER event_is_not_updated")
    ask_to_change(source, "UPDATE event SET payload = ? WHERE episode = 1 AND sequence = 5", [payload])
    (bad, good) = (await copy_episodes(source, target)).episodes
    assert bad.damage is not None
    assert bad.damage.startswith(f"episode {bad.id}, event 5: its payload cannot be read: ")
    assert (bad.head, good.head, good.damage) == (4, 12, None)


async def test_events_of_a_newer_version_are_copied_unchanged(new_url: New, new_file: New) -> None:
    source, target = new_file(), new_url()
    script = Script(1)
    script.put_payload("HandShaken", b'{"whom": "Ada", "firm": 1.50}')
    script.put_payload("NodeStarted", b'{"designator": ["of", "another", "shape"]}', 2)
    await append_and_fold(source, script.records)
    (done,) = (await copy_episodes(source, target)).episodes
    assert done.damage is None
    assert done.stopped == "event 1: HandShaken is not an event type of this version"
    assert logs_of(target) == logs_of(source)


async def test_an_episode_whose_type_contradicts_the_target_is_copied_and_folded_under_other_names(
    new_file: New,
) -> None:
    source, target = new_file(), new_file()
    await notes(target, "a text")
    number = declared("NoteAction", "note_action", field("text", "integer", 2))
    script = Script(1)
    script.put(NodeStarted("action", None, name_of(number), {"text": 5}))
    await append_and_fold(source, [*declarations(number), *script.records])
    (done,) = (await copy_episodes(source, target)).episodes
    assert (done.damage, done.stopped) == (None, None)
    assert logs_of(target)[done.id] == logs_of(source)[done.id]
    rows = ask(target, "SELECT text, text_integer FROM note_action ORDER BY id")
    assert rows == [("a text", None), (None, 5)]
