"""Decide about each record of a batch: new, repeated or refused, and why. Pure.

An episode's events are stored without a gap: the next accepted sequence is always `head + 1`. A record at or below the
head is a repeat, to be compared with the stored event. The first record that cannot be accepted stops the episode for
this batch: the records before it are stored, the reason is kept, and other episodes are not affected.

An end that recovery computed is not a repeat, because a folder that was damaged or restored from a backup may lack
events that the log holds. Such an end follows the log's last event; it is left out if the log holds an end already or
waits for missing events.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from pycrorm_async.errors import DamageError
from pycrorm_async.events.codec import DECLARATION_TYPES, fingerprint
from pycrorm_async.events.envelope import Record, is_computed_end
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX, EpisodeId, episode_text
from pycrorm_async.store.stored import EpisodeRow, StoredEvent

_CHECKED_AT_ONCE: Final = 256
"""Bounds the payloads that are joined to be checked by one call, so that they stay in the processor's cache: joining
10,000 takes five times as long."""


@dataclass(frozen=True, slots=True)
class SortedBatch:
    """A batch split into declarations, by fingerprint, and episodes, each in the order of arrival."""

    declarations: dict[str, bytes]
    episodes: dict[EpisodeId, list[Record]]


@dataclass(frozen=True, slots=True)
class EpisodeStep:
    """The effect of a batch on one episode: the row afterwards, the records to insert, and the repeats to compare.

    `skipped_ends` counts the computed ends that are left out.
    """

    after: EpisodeRow
    fresh: list[Record]
    again: list[Record] = field(default_factory=list)
    skipped_ends: int = 0


class NumbersExhausted(ValueError):
    """All episode numbers are used."""

    def __init__(self) -> None:
        super().__init__(
            f"all {EPISODE_NUMBER_MAX:,} episode numbers of this memory are used:"
            " move its spool to a new memory with `pycrorm spool rebind`"
        )


def sort(records: Iterable[Record]) -> SortedBatch:
    """Split a batch by episode. Raises `DamageError` for a record without an episode that is not a declaration."""
    declarations: dict[str, bytes] = {}
    episodes: dict[EpisodeId, list[Record]] = {}
    for record in records:
        episode = record.episode
        if episode is None:
            declared = _declaration(record)
            declarations[fingerprint(declared, record.type)] = declared
        elif episode in episodes:
            episodes[episode].append(record)
        else:
            episodes[episode] = [record]
    return SortedBatch(declarations, episodes)


def step(records: Sequence[Record], row: EpisodeRow) -> EpisodeStep:
    """Compute the effect of these records, all of one episode, on its row."""
    first = records[0].sequence
    if first == row.head + 1 and _consecutive(records) and _sound(records):
        return EpisodeStep(_advanced(row, records, refused=None), list(records))
    return _careful_step(records, row)


def new_episode(episode: EpisodeId, first: Record, number: int) -> EpisodeRow:
    """Create the row of an episode without stored events. Raises `NumbersExhausted`."""
    if number > EPISODE_NUMBER_MAX:
        raise NumbersExhausted
    return EpisodeRow(number, episode_text(episode), head=0, folded=0, started_wall_ns=first.wall_ns)


def differing(again: Iterable[Record], stored: Mapping[int, StoredEvent]) -> int | None:
    """Return the first sequence whose stored event differs from the record; None if all are equal."""
    return min((each.sequence for each in again if not _same(each, stored.get(each.sequence))), default=None)


def _same(record: Record, stored: StoredEvent | None) -> bool:
    # From the type on, a record and a stored event have the same fields in the same order.
    return stored is not None and tuple(record[3:]) == tuple(stored[2:])


def _careful_step(records: Sequence[Record], row: EpisodeRow) -> EpisodeStep:
    fresh: list[Record] = []
    again: list[Record] = []
    refused: str | None = None
    skipped_ends = 0
    expected = row.head + 1
    for record in records:
        if record.sequence < expected:
            if not is_computed_end(record):
                again.append(record)
                continue
            if row.ended_wall_ns is not None or row.refused is not None:
                skipped_ends += 1
                continue
            record = record._replace(sequence=expected)
        refused = _refusal(record, expected)
        if refused is not None:
            break
        fresh.append(record)
        expected += 1
    return EpisodeStep(_advanced(row, fresh, refused=refused), fresh, again, skipped_ends)


def _refusal(record: Record, expected: int) -> str | None:
    if record.sequence > expected:
        missing = (
            f"event {expected}" if record.sequence == expected + 1 else f"events {expected} to {record.sequence - 1}"
        )
        return f"{missing} did not arrive before event {record.sequence}"
    if record.sequence > SEQUENCE_MAX:
        return f"event {record.sequence}: an episode holds at most {SEQUENCE_MAX:,} events"
    if not _is_text(record.payload):
        return f"event {record.sequence}: its payload is not text that a database can hold"
    return None


def _advanced(row: EpisodeRow, fresh: Sequence[Record], *, refused: str | None) -> EpisodeRow:
    if not fresh:  # repeats alone do not end an earlier refusal
        return row._replace(refused=row.refused or refused)
    last = fresh[-1]
    end = next((each for each in reversed(fresh) if each.type != "EpisodeTagged"), last)  # tags may follow the end
    ended = end.wall_ns if end.type == "EpisodeEnded" else row.ended_wall_ns
    return row._replace(head=last.sequence, ended_wall_ns=ended, refused=refused)


def _consecutive(records: Sequence[Record]) -> bool:
    first = records[0].sequence
    return [record.sequence for record in records] == list(range(first, first + len(records)))


def _sound(records: Sequence[Record]) -> bool:
    return records[-1].sequence <= SEQUENCE_MAX and all(
        _is_text(b"\n".join([each.payload for each in records[start : start + _CHECKED_AT_ONCE]]))
        for start in range(0, len(records), _CHECKED_AT_ONCE)
    )


def _is_text(payload: bytes) -> bool:
    if b"\0" in payload:
        return False
    try:
        payload.decode()
    except UnicodeDecodeError:
        return False
    return True


def _declaration(record: Record) -> bytes:
    if record.type not in DECLARATION_TYPES:
        raise DamageError(f"record {record.position} belongs to no episode and is a {record.type}, not a declaration")
    if not _is_text(record.payload):
        raise DamageError(f"record {record.position}: the declaration is not text that a database can hold")
    return record.payload
