"""What a fault cost: the truth that whoever made the events kept, against what was found in the end."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import ClassVar

__all__ = ["Event", "Outcome", "Step"]

Event = tuple[str, int, str]
"""An episode, a sequence in it, and what the event says."""

Step = Callable[[], None]
"""Called after every round."""


@dataclass
class Outcome:
    """Counts over all rounds of one fault.

    Attributes:
        rounds: how often the fault was made.
        events: how many events had been acknowledged to whoever made them.
        lost: acknowledged, and not found.
        duplicated: found more than once.
        misordered: found at another place of its episode than it was put at, or behind a gap.
        changed: found and never put, or put with other content.
        told: acknowledged, not found, and named one by one by a repair: damage, not a crash.
        broke: an error that ended the rounds early.
        note: what else a reader should know.
        rounds_failed: which rounds these were, from 1 on.
        took_s: how long all rounds took.
    """

    rounds: int = 0
    events: int = 0
    lost: int = 0
    duplicated: int = 0
    misordered: int = 0
    changed: int = 0
    told: int = 0
    broke: str | None = None
    note: str = ""
    rounds_failed: list[int] = field(default_factory=list)
    took_s: float = 0.0

    COUNTS: ClassVar = ("rounds", "events", "lost", "duplicated", "misordered", "changed", "told")

    @property
    def counts(self) -> tuple[int, ...]:
        return tuple(getattr(self, name) for name in self.COUNTS)

    @property
    def clean(self) -> bool:
        return not (self.lost or self.duplicated or self.misordered or self.changed or self.broke)

    def compare(
        self,
        acknowledged: Iterable[Event],
        found: Iterable[Event],
        *,
        put: Iterable[Event] = (),
        told: Iterable[Event] = (),
    ) -> None:
        """One round. `acknowledged` must be in `found` or `told`; more may be only of `put`, tried and not answered."""
        sure, there = set(acknowledged), list(found)
        count = Counter(there)
        before = (self.lost, self.duplicated, self.misordered, self.changed)
        self.rounds += 1
        self.events += len(sure)
        missing = sure - count.keys()
        self.lost += len(missing - set(told))
        self.told += len(missing & set(told))
        self.duplicated += sum(count.values()) - len(count)
        self.changed += len(count.keys() - sure - set(put))
        last: defaultdict[str, int] = defaultdict(int)
        for episode, sequence, _ in there:
            self.misordered += sequence not in (last[episode] + 1, last[episode])
            last[episode] = sequence
        if (self.lost, self.duplicated, self.misordered, self.changed) != before:
            self.rounds_failed.append(self.rounds)

    def note_changed(self, count: int) -> None:
        """Add to `changed` of the round that was compared last, which failed if this is not 0."""
        self.changed += count
        if count and self.rounds not in self.rounds_failed:
            self.rounds_failed.append(self.rounds)
