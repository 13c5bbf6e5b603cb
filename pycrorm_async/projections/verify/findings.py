"""Define the findings of a verification: damage to the log, differences in the tables, parked and refused episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from pycrorm_async.projections.verify.row_comparison import Difference

_FINDINGS_MAX = 100
"""Bounds the findings of each kind that are kept; all are counted."""


class Damage(NamedTuple):
    """A place where the log contradicts itself; without an episode, the whole database."""

    number: int | None
    sequence: int | None
    reason: str

    def __str__(self) -> str:
        if self.number is None:
            return self.reason
        return f"episode {self.number}, event {self.sequence}: {self.reason}"


class StoppedEpisode(NamedTuple):
    """An episode that is no longer folded (parked) or no longer stored (refused)."""

    number: int
    how: Literal["parked", "refused"]
    reason: str


@dataclass(kw_only=True)
class VerifyResult:
    """The result of a verification, complete when `verify` returns it.

    Attributes:
        episodes, events, rows: the number of each that was checked.
        behind: the number of events that are not folded yet, which is normal while robots record.
        damage, drift: the number of findings of damage and of differences.
        damages, differences: the first hundred of each.
        remarks: the number of unusual event orders that correct plans produce too.
        not_compared: by name, the reason why the tables of a custom projection were not compared.
        stopped: the parked and refused episodes; the rows of their earlier events were compared.
        unmade: by dtype, the reason why a designator type has no tables.
        failed_views: by name, the reason why a user's view is left out.
        blobs: by hash, the first event that refers to this blob; the content of each is compared with its hash.
        without_digest: the number of episodes without a digest; for them it is not known whether one was deleted.
        deleted: the episodes of which events were deleted.
        rows_without_event: the number of rows, among the differences, of events that the log does not have.
        outdated: the reason why no table was compared: an older fold made them. None for tables of this version.
    """

    episodes: int = 0
    events: int = 0
    rows: int = 0
    behind: int = 0
    damage: int = 0
    drift: int = 0
    damages: list[Damage] = field(default_factory=list)
    differences: list[Difference] = field(default_factory=list)
    remarks: int = 0
    not_compared: Mapping[str, str] = field(default_factory=dict)
    stopped: list[StoppedEpisode] = field(default_factory=list)
    unmade: Mapping[str, str] = field(default_factory=dict)
    failed_views: Mapping[str, str] = field(default_factory=dict)
    blobs: dict[str, tuple[int | None, int | None]] = field(default_factory=dict)
    without_digest: int = 0
    deleted: set[int] = field(default_factory=set)
    rows_without_event: int = 0
    outdated: str | None = None

    def add_damage(self, number: int | None, sequence: int | None, reason: str) -> None:
        """Count a damage and keep it, unless there are many."""
        self.damage += 1
        if len(self.damages) < _FINDINGS_MAX:
            self.damages.append(Damage(number, sequence, " ".join(reason.split())))

    def add_deleted(self, number: int, first: int | None, reason: str) -> None:
        """Add the damage that an episode's events from `first` on, or all of them, were deleted; once for each."""
        if number not in self.deleted:
            self.deleted.add(number)
            self.add_damage(None if first is None else number, first, reason)

    def add_difference(self, difference: Difference) -> None:
        """Count a difference and keep it, unless there are many."""
        self.drift += 1
        if len(self.differences) < _FINDINGS_MAX:
            self.differences.append(difference)
