"""What was found, in two files: `FILE` is a table for a reader, `FILE.jsonl` a line for each slice, added at once.

The lines are what an interrupted run goes on from: a slice that has one is not made again, unless it broke off by an
error; then its line stays in the file, and the table has what came of it when it was made again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NamedTuple

from bench.breaking.outcome import Outcome

__all__ = ["Report", "Slice", "summed"]


class Slice(NamedTuple):
    """A part of the rounds of one fault, by its number from 1 on; 0 for all of them together."""

    fault: str
    number: int
    outcome: Outcome

    def line(self, seed: int) -> dict[str, Any]:
        return {"bench": "faults", "fault": self.fault, "seed": seed, "slice": self.number} | asdict(self.outcome)


def summed(outcomes: Iterable[Outcome]) -> Outcome:
    """Slices as one; a round that failed is told by its number among all."""
    total = Outcome()
    for each in outcomes:
        total.rounds_failed += [total.rounds + number for number in each.rounds_failed]
        for name in Outcome.COUNTS:
            setattr(total, name, getattr(total, name) + getattr(each, name))
        total.took_s += each.took_s
        total.broke = total.broke or each.broke
        total.note = each.note
    total.took_s = round(total.took_s, 1)
    return total


class Report:
    """The slices of one seed. Without a path nothing is kept."""

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
        names = {each.name for each in fields(Outcome)}
        for text in lines:
            if not text.endswith("\n"):  # of a run that was killed while it wrote
                continue
            line = json.loads(text)
            if (line["seed"], line["quick"]) == (self.seed, self._quick):
                outcome = Outcome(**{name: value for name, value in line.items() if name in names})
                self._slices[line["fault"], line["slice"]] = outcome

    def known(self, fault: str, number: int) -> Outcome | None:
        """What this slice found in an earlier run; None if it is to be made."""
        outcome = self._slices.get((fault, number))
        return None if outcome is None or outcome.broke else outcome

    def add(self, made: Slice) -> None:
        """Writes both files."""
        self._slices[made.fault, made.number] = made.outcome
        if self._path is None or self._lines is None:
            return
        with self._lines.open("a") as file:
            file.write(json.dumps(made.line(self.seed) | {"quick": self._quick}) + "\n")
        self._path.write_text(self._table())

    def _table(self) -> str:
        by_fault: dict[str, list[Outcome]] = {}
        for (fault, _), outcome in sorted(self._slices.items(), key=lambda each: self._order.index(each[0][0])):
            by_fault.setdefault(fault, []).append(outcome)
        head = ["fault", *Outcome.COUNTS, "seconds", "note"]
        rows = [
            [fault, *(f"{each:,}" for each in total.counts), f"{total.took_s:,.0f}", _in_a_line(total)]
            for fault, total in ((fault, summed(outcomes)) for fault, outcomes in by_fault.items())
        ]
        lines = [" | ".join(row) for row in (head, ["---", *["---:"] * (len(head) - 2), "---"], *rows)]
        return "\n".join([f"`{self._command}`, seed {self.seed}", "", *(f"| {line} |" for line in lines), ""])


def _in_a_line(total: Outcome) -> str:
    return " ".join((total.broke or total.note).split())
