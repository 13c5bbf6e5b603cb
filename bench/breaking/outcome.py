"""Compare the acknowledged events with those that exist after a fault, and keep the outcomes in files."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

# === outcome ==================================================================================================
#
# Compare the events that were acknowledged before a fault with the events that exist after it.

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


# === report ===================================================================================================
#
# Keep outcomes in two files: `FILE` is a table for a reader, `FILE.jsonl` has one line for each finished slice.
#
# An interrupted run continues from the lines: a slice that has one is not run again, unless it ended with an error. The
# line of the error stays in the file, and the table shows the outcome of the repeated slice.


class Slice(NamedTuple):
    """A numbered part of the rounds of one fault, from 1 on; number 0 is the sum of all parts."""

    fault: str
    number: int
    outcome: Outcome

    def line(self, seed: int) -> dict[str, Any]:
        return {"bench": "faults", "fault": self.fault, "seed": seed, "slice": self.number} | self.outcome.line()


def summed(outcomes: Iterable[Outcome]) -> Outcome:
    """Sum the outcomes of slices; failed rounds are numbered across all slices."""
    total = Outcome()
    for each in outcomes:
        total.rounds_failed += [total.rounds + number for number in each.rounds_failed]
        for name in Outcome.COUNTS:
            setattr(total, name, getattr(total, name) + getattr(each, name))
        total.took_s += each.took_s
        total.error = total.error or each.error
        total.note = each.note
    total.took_s = round(total.took_s, 1)
    return total


class Report:
    """The slices of one seed. Without a path they are kept in memory only."""

    def __init__(self, path: Path | None, *, seed: int, quick: bool, command: str, order: Sequence[str]) -> None:
        self.seed = seed
        self._path = path
        self._lines = None if path is None else path.with_name(f"{path.name}.jsonl")
        self._quick = quick
        self._command = command
        self._order = order
        self._slices: dict[tuple[str, int], Outcome] = {}
        if self._lines is not None and self._lines.exists():
            self._read(self._lines.read_text().splitlines(keepends=True))

    def _read(self, lines: list[str]) -> None:
        for text in lines:
            if not text.endswith("\n"):  # the run was killed while it wrote this line
                continue
            line = json.loads(text)
            if (line["seed"], line["quick"]) == (self.seed, self._quick):
                self._slices[line["fault"], line["slice"]] = Outcome.of_line(line)

    def finished(self, fault: str, number: int) -> Outcome | None:
        """Return the outcome of this slice in an earlier run; None if the slice must run."""
        outcome = self._slices.get((fault, number))
        return None if outcome is None or outcome.error else outcome

    def add(self, finished: Slice) -> None:
        """Add a slice and write both files."""
        self._slices[finished.fault, finished.number] = finished.outcome
        if self._path is None or self._lines is None:
            return
        with self._lines.open("a") as file:
            file.write(json.dumps(finished.line(self.seed) | {"quick": self._quick}) + "\n")
        self._path.write_text(self._table())

    def _table(self) -> str:
        by_fault: dict[str, list[Outcome]] = {}
        for (fault, _), outcome in sorted(self._slices.items(), key=lambda each: self._order.index(each[0][0])):
            by_fault.setdefault(fault, []).append(outcome)
        headings = ["fault", *Outcome.COUNTS, "seconds", "note"]
        rows = [
            [fault, *(f"{each:,}" for each in total.counts), f"{total.took_s:,.0f}", _remark(total)]
            for fault, total in ((fault, summed(outcomes)) for fault, outcomes in by_fault.items())
        ]
        lines = [" | ".join(row) for row in (headings, ["---", *["---:"] * (len(headings) - 2), "---"], *rows)]
        return "\n".join([f"`{self._command}`, seed {self.seed}", "", *(f"| {line} |" for line in lines), ""])


def _remark(total: Outcome) -> str:
    return " ".join((total.error or total.note).split())
