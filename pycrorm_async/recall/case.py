"""A case is one action that has ended: the situation in which it was started, and its outcome.

The situation consists of symbols and numbers, each under the name of its feature, known before the action ran. The
outcome (status, reason, duration) is never compared with a cue unless the cue names it. A case never changes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

import numpy as np

from pycrorm_async.events.ids import row_key

OUTCOME = ("status", "reason", "duration")
"""The features of the outcome. They are found by name like others, but only if a cue names them."""
RESERVED = frozenset({"node", "parent", "started", "type", "simulated", *OUTCOME})
"""Names that a feature of a situation cannot have, because the case itself has them."""
FEATURES_MAX = 256
"""Bounds the features of one case; beyond them the last ones in alphabetical order are left out."""
SYMBOLS_MAX = 255
"""Bounds the symbols of one feature, as the objects nearby; beyond them the last ones in order are left out."""
TEXT_MAX = 120
"""The longest symbol in characters. A longer text is prose, which hardly ever recurs, and is left out."""
SINGLE_MAX = 2.0**24
"""Up to this magnitude a number is kept as float32, which here is exact to 1 or better; beyond it as float64."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Case(NamedTuple):
    """One action that has ended.

    Attributes:
        node: id of its task-tree node: episode number, sequence and slot 0 in one integer.
        started_us: wall time of its start, µs since 1970.
        type: its dtype, as `PickUpAction`.
        symbols: texts by feature; a tuple for a feature with several values at once, as the types of nearby objects.
        numbers: finite numbers by feature, in m, rad and s. A feature whose name ends in `yaw` is an angle.
        status: name of the `TaskStatus` with which it ended.
        reason: class of the failure; None without one.
        duration_s: None for an action that is LOST.
        parent: id of the node of the nearest action around it; None outside any.
        simulated: whether it belongs to a simulation.
    """

    node: int
    started_us: int
    type: str
    symbols: Mapping[str, str | tuple[str, ...]]
    numbers: Mapping[str, float]
    status: str
    reason: str | None = None
    duration_s: float | None = None
    parent: int | None = None
    simulated: bool = False

    @property
    def episode(self) -> int:
        """The number of its episode in this database."""
        return row_key(self.node).number

    @property
    def sequence(self) -> int:
        """The sequence of its start in its episode."""
        return row_key(self.node).sequence

    @property
    def started_at(self) -> datetime:
        """The moment of its start, to the microsecond."""
        return _EPOCH + timedelta(microseconds=self.started_us)


def bounded_case(case: Case) -> Case:
    """Return the case as blocks store it: without infinite numbers, long texts and excess features, numbers rounded.

    The result depends on the case alone, so an action gives the same case in any block.
    """
    symbols = {name: kept for name, value in case.symbols.items() if (kept := _bounded(value))}
    numbers = {name: _stored(value) for name, value in case.numbers.items() if math.isfinite(value)}
    taken = RESERVED & (symbols.keys() | numbers.keys())
    assert not taken, f"features of a situation cannot be named {', '.join(sorted(taken))}"
    if len(symbols) + len(numbers) > FEATURES_MAX:
        kept_names = set(sorted({*symbols, *numbers})[:FEATURES_MAX])
        symbols = {name: value for name, value in symbols.items() if name in kept_names}
        numbers = {name: value for name, value in numbers.items() if name in kept_names}
    duration_s = case.duration_s
    if duration_s is not None:
        duration_s = _stored(duration_s) if math.isfinite(duration_s) else None
    reason = case.reason if case.reason and len(case.reason) <= TEXT_MAX else None
    return case._replace(symbols=symbols, numbers=numbers, duration_s=duration_s, reason=reason)


def is_angle(feature: str) -> bool:
    """Return whether the feature is an angle in rad, so that -3.1 is near 3.1."""
    return feature.endswith("yaw")


def _bounded(value: str | tuple[str, ...]) -> str | tuple[str, ...]:
    if isinstance(value, str):
        return value if len(value) <= TEXT_MAX else ""
    return tuple(sorted({each for each in value if each and len(each) <= TEXT_MAX}))[:SYMBOLS_MAX]


def _stored(value: Any) -> float:
    return float(value) if abs(value) > SINGLE_MAX else float(np.float32(value))
