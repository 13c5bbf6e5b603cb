"""Compare the events that were acknowledged before a fault with the events that exist after it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar

__all__ = ["Event", "Outcome", "Step"]

Event = tuple[str, int, str]
"""An episode, a sequence in it, and the content of the event."""

Step = Callable[[], None]
"""A callback, called after every round."""


@dataclass
class Outcome:
    """Counts over all rounds of one fault.

    Attributes:
        rounds: number of times the fault was injected.
        events: number of acknowledged events.
        lost: acknowledged events that do not exist afterwards.
        duplicated: events that exist more than once.
        misordered: events that follow a gap, or have the wrong place in their episode.
        corrupted: events that were never put, or were put with other content.
        reported: acknowledged events that do not exist, but are reported one by one; after damage, never after a crash.
        error: an error that ended the rounds early.
        note: a remark for the reader of the table.
        rounds_failed: numbers of the failed rounds, from 1 on.
        took_s: duration of all rounds.
    """

    rounds: int = 0
    events: int = 0
    lost: int = 0
    duplicated: int = 0
    misordered: int = 0
    corrupted: int = 0
    reported: int = 0
    error: str | None = None
    note: str = ""
    rounds_failed: list[int] = field(default_factory=list)
    took_s: float = 0.0

    COUNTS: ClassVar = ("rounds", "events", "lost", "duplicated", "misordered", "corrupted", "reported")
    KEYS: ClassVar = {"corrupted": "changed", "reported": "told", "error": "broke"}
    """Keys of attributes that reports on disk name differently."""

    @property
    def counts(self) -> tuple[int, ...]:
        return tuple(getattr(self, name) for name in self.COUNTS)

    @property
    def clean(self) -> bool:
        return not (self.lost or self.duplicated or self.misordered or self.corrupted or self.error)

    @classmethod
    def of_line(cls, line: Mapping[str, Any]) -> Outcome:
        """Read an outcome from a line of a report, ignoring its other keys."""
        keys = {each.name: cls.KEYS.get(each.name, each.name) for each in fields(cls)}
        return cls(**{name: line[key] for name, key in keys.items() if key in line})

    def line(self) -> dict[str, Any]:
        """Return the values by their keys in a report."""
        return {self.KEYS.get(name, name): value for name, value in asdict(self).items()}

    def compare(
        self,
        acknowledged: Iterable[Event],
        existing: Iterable[Event],
        *,
        put: Iterable[Event] = (),
        reported: Iterable[Event] = (),
    ) -> None:
        """Count one round.

        Every acknowledged event must be in `existing` or in `reported`. Further existing events must be in `put`:
        events that a recorder tried to put without an acknowledgement.
        """
        expected, events = set(acknowledged), list(existing)
        count = Counter(events)
        before = (self.lost, self.duplicated, self.misordered, self.corrupted)
        self.rounds += 1
        self.events += len(expected)
        missing = expected - count.keys()
        self.lost += len(missing - set(reported))
        self.reported += len(missing & set(reported))
        self.duplicated += sum(count.values()) - len(count)
        self.corrupted += len(count.keys() - expected - set(put))
        last: defaultdict[str, int] = defaultdict(int)
        for episode, sequence, _ in events:
            self.misordered += sequence not in (last[episode] + 1, last[episode])
            last[episode] = sequence
        if (self.lost, self.duplicated, self.misordered, self.corrupted) != before:
            self.rounds_failed.append(self.rounds)

    def add_corrupted(self, count: int) -> None:
        """Add to `corrupted` of the round that was compared last; the round failed if `count` is not 0."""
        self.corrupted += count
        if count and self.rounds not in self.rounds_failed:
            self.rounds_failed.append(self.rounds)
