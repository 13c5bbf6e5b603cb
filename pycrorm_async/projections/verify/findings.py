"""The findings of a verification: damage of the log, differences of the tables, and what is not in them at all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

from pycrorm_async.projections.verify.row_comparison import Difference

__all__ = ["Damage", "Stopped", "Verified"]


class Damage(NamedTuple):
    """Where the log contradicts itself. Without an episode it is the database as a whole."""

    number: int | None
    sequence: int | None
    reason: str

    def __str__(self) -> str:
        if self.number is None:
            return self.reason
        return f"episode {self.number}, event {self.sequence}: {self.reason}"


class Stopped(NamedTuple):
    """An episode of which no more is folded (parked), or stored (refused)."""

    number: int
    how: Literal["parked", "refused"]
    reason: str


class Verified(NamedTuple):
    """What was found.

    Attributes:
        episodes, events, rows: that were looked at.
        behind: events that the tables do not show yet, which is no fault.
        damage, drift: how many findings of each kind there are.
        damages, differences: the first hundred of each.
        remarks: what is unusual in the order of events and happens in honest plans.
        not_compared: by name, why the tables of a projection of somebody's were not looked at.
        stopped: the episodes that are parked or refused, and why; the rows of what came before were compared.
        unmade: by dtype, why a designator type has no tables here.
        outdated: why no table was compared at all: an older fold made them. None if they are this version's.
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
    stopped: list[Stopped]
    unmade: Mapping[str, str]
    outdated: str | None
