"""Random actions with 12 texts and 6 numbers each, as arrays, and cues of several kinds that ask for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.events.ids import row_id
from pycrorm_async.recall.blocks import CaseBlock, Group
from pycrorm_async.recall.columns import Column, Words
from pycrorm_async.recall.search import Cue, Wanted

__all__ = ["Actions", "BLOCK_CASES", "CUES"]

BLOCK_CASES = 65_536
_TYPES = 24
_TEXTS: Mapping[str, tuple[int, float]] = {
    "object_type": (300, 1.3), "arm": (2, 0), "grasp": (6, 0), "robot": (8, 0), "surface": (40, 0.7), "plan": (50, 0),
    "inside": (24, 0), "after": (24, 0), "after_status": (4, 1.5), "tool": (10, 0.5), "room": (12, 0), "hand": (3, 0),
}  # fmt: skip
"""The number of words of each text, and the exponent of Zipf's law by which they occur; 0 for all alike."""
_NUMBERS = ("height", "torso", "stand_x", "stand_y", "stand_yaw", "object_z")
_K = 10


class Actions:
    """Random actions, the oldest first, of 24 types; the height decides how likely each succeeds."""

    def __init__(self, count: int, *, seed: int = 69) -> None:
        self.chance = np.random.default_rng(seed)
        self.types = self.chance.integers(0, _TYPES, count)
        self.texts = {name: self._words(size, exponent, count) for name, (size, exponent) in _TEXTS.items()}
        self.numbers = {name: self.chance.normal(0.9, 0.3, count).astype(np.float32) for name in _NUMBERS}
        self.succeeded = self.chance.random(count) < 0.2 + 0.6 * (np.abs(self.numbers["height"] - 0.9) < 0.2)

    def __len__(self) -> int:
        """Return the number of actions."""
        return int(self.types.size)

    def type_name(self, index: int) -> str:
        """Return the type of an action."""
        return f"Type{self.types[index]:02}Action"

    def word(self, index: int, feature: str) -> str:
        """Return a text of an action."""
        return f"{feature.upper()}_{self.texts[feature][index]}"

    @cached_property
    def rare(self) -> NDArray[np.int64]:
        """The actions whose object was seen at most 60 times, or else those with the rarest object."""
        sizes = np.bincount(self.texts["object_type"])
        seen = sizes[self.texts["object_type"]]
        return np.flatnonzero(seen <= max(60, int(sizes[sizes > 0].min())))

    def blocks(self) -> Iterator[CaseBlock]:
        """Yield the actions as blocks."""
        for first in range(0, len(self), BLOCK_CASES):
            rows = np.arange(first, min(len(self), first + BLOCK_CASES))[::-1]
            yield self._block(rows[np.argsort(self.types[rows], kind="stable")])

    def _block(self, rows: NDArray[np.int64]) -> CaseBlock:
        columns = {name: self._column(name, codes[rows]) for name, codes in self.texts.items()}
        columns["status"] = Column(self.succeeded[rows].astype(np.uint8) + 1, Words(("FAILED", "SUCCEEDED")))
        values = {name: Column(each[rows]) for name, each in self.numbers.items()}
        values["duration"] = Column(np.full(rows.size, 2.5, np.float32))
        nodes = row_id(1, 0, 0) + (rows + 1) * 32
        whole = Group("", nodes, rows * 1_000_000, np.zeros(rows.size, np.int32), columns, values)
        types = self.types[rows]
        names = {number: f"Type{number:02}Action" for number in np.unique(types).tolist()}
        return CaseBlock({name: replace(whole.taken(types == each), type=name) for each, name in names.items()})

    def _column(self, name: str, codes: NDArray[np.int16]) -> Column:
        words = Words(f"{name.upper()}_{code}" for code in range(_TEXTS[name][0]))
        width = np.uint8 if len(words) < 256 else np.uint16
        return Column((codes + 1).astype(width), words)

    def _words(self, size: int, exponent: float, count: int) -> NDArray[np.int16]:
        shares = np.arange(1, size + 1) ** -float(exponent)
        return self.chance.choice(size, count, p=shares / shares.sum()).astype(np.int16)

    # --- cues -------------------------------------------------------------------------------------------------

    def _any(self) -> int:
        return int(self.chance.integers(len(self)))

    def _pairs(self, index: int, *features: str) -> tuple[tuple[str, str], ...]:
        return tuple((feature, self.word(index, feature)) for feature in features)

    def _mixed(self, texts: int) -> tuple[str, tuple[tuple[str, str], ...], int]:
        """Return the type of an action, and texts of it and of another one."""
        first, second = self._any(), self._any()
        features = self.chance.choice(list(_TEXTS), texts, replace=False).tolist()
        half = (texts + 1) // 2
        return (
            self.type_name(first),
            (*self._pairs(first, *features[:half]), *self._pairs(second, *features[half:])),
            first,
        )

    def _wanted(self, index: int, count: int, tolerance: float) -> tuple[Wanted, ...]:
        names = self.chance.choice(_NUMBERS, count, replace=False).tolist()
        return tuple(Wanted(name, float(self.numbers[name][index]), tolerance) for name in names)

    def common(self) -> Cue:
        """Ask for the type, the object and the arm of an action."""
        index = self._any()
        return Cue(type=self.type_name(index), has=self._pairs(index, "object_type", "arm"), k=_K)

    def rarely_seen(self) -> Cue:
        """Ask for an object that was seen at most 60 times, and for the arm."""
        index = int(self.chance.choice(self.rare))
        return Cue(type=self.type_name(index), has=self._pairs(index, "object_type", "arm"), k=_K)

    def unseen(self) -> Cue:
        """Ask for an object that never occurred, and for the arm."""
        index = self._any()
        return Cue(type=self.type_name(index), has=(("object_type", "CACTUS"), ("arm", self.word(index, "arm"))), k=_K)

    def near_miss(self) -> Cue:
        """Ask for 3 to 5 texts of two actions, and for 2 or 3 numbers of one."""
        dtype, pairs, index = self._mixed(int(self.chance.integers(3, 6)))
        return Cue(type=dtype, has=pairs, near=self._wanted(index, int(self.chance.integers(2, 4)), 0.2), k=_K)

    def near_miss_texts(self) -> Cue:
        """Ask for 7 texts of two actions."""
        dtype, pairs, _ = self._mixed(7)
        return Cue(type=dtype, has=pairs, k=_K)

    def four_numbers(self) -> Cue:
        """Ask for 4 numbers of an action."""
        index = self._any()
        return Cue(type=self.type_name(index), near=self._wanted(index, 4, 0.2), k=_K)


CUES: Mapping[str, Callable[[Actions], Cue]] = {
    "common": Actions.common,
    "rare": Actions.rarely_seen,
    "unseen": Actions.unseen,
    "near miss, texts": Actions.near_miss_texts,
    "near miss, texts and numbers": Actions.near_miss,
    "numbers": Actions.four_numbers,
}
"""The kinds of cues, each with the function that makes one."""
