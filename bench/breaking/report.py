"""Keep outcomes in two files: `FILE` is a table for a reader, `FILE.jsonl` has one line for each finished slice.

An interrupted run continues from the lines: a slice that has one is not run again, unless it ended with an error. The
line of the error stays in the file, and the table shows the outcome of the repeated slice.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench.breaking.outcome import Outcome

__all__ = ["Report", "Slice", "summed"]


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
