"""Define the findings of a verification: damage to the log, differences in the tables, parked and refused episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

from pycrorm_async.projections.verify.row_comparison import Difference

__all__ = ["Damage", "StoppedEpisode", "VerifyResult"]


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


class VerifyResult(NamedTuple):
    """The result of a verification.

    Attributes:
        episodes, events, rows: the number of each that was checked.
        behind: the number of events that are not folded yet, which is no fault.
        damage, drift: the number of findings of damage and of differences.
        damages, differences: the first hundred of each.
        remarks: the number of unusual event orders that correct plans produce too.
        not_compared: by name, the reason why the tables of a custom projection were not compared.
        stopped: the parked and refused episodes; the rows of their earlier events were compared.
        unmade: by dtype, the reason why a designator type has no tables.
        outdated: the reason why no table was compared: an older fold made them. None for tables of this version.
    """

    episodes: int
    events: int
    rows: int
    behind: int
    damage: int
    drift: int
    damages: list[Damage]
    differences: list[Difference]
    remarks: int
    not_compared: Mapping[str, str]
    stopped: list[StoppedEpisode]
    unmade: Mapping[str, str]
    outdated: str | None
