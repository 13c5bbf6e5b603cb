"""Count successes in the cells of two axes: ranges of a numeric column, categories of another one."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.query.success.interval import interval_95
from pycrorm_async.query.success.samples import Samples, Values

_BINS_MAX = 200
"""Bounds the ranges of one axis."""
_BINS_LEAST, _BINS_USUAL = 4, 16
"""Bounds the default number of ranges of one axis, from below and above."""
_ROWS_A_CELL = 5
"""The rows that a cell has on average, from which the default number of ranges follows."""
_DAY_S, _MINUTE_S = 86_400, 60


class Axis(NamedTuple):
    """One axis.

    Attributes:
        labels: of the categories; empty for a numeric column.
        edges: of the ranges, one more than there are cells; empty for categories.
        unit: of the edges; empty if it is not known.
    """

    name: str
    labels: tuple[str, ...] = ()
    edges: tuple[float, ...] = ()
    is_time: bool = False
    unit: str = ""

    @property
    def cells(self) -> int:
        """The number of cells along it."""
        return len(self.labels) or len(self.edges) - 1

    @property
    def step(self) -> float:
        """The width of a range."""
        return self.edges[1] - self.edges[0]

    def text(self, edge: float) -> str:
        """Format an edge."""
        if not self.is_time:
            return f"{edge + 0.0:.6g}"
        when = datetime.fromtimestamp(edge, UTC)
        if self.step >= _DAY_S:
            return f"{when:%Y-%m-%d}"
        return f"{when:%m-%d %H:%M}" if self.step >= _MINUTE_S else f"{when:%H:%M:%S.%f}"[:-4]

    def cell_text(self, cell: int) -> str:
        """Format a cell: its category, or its range."""
        if self.labels:
            return self.labels[cell]
        return f"{self.text(self.edges[cell])} to {self.text(self.edges[cell + 1])}"


class Cell(NamedTuple):
    """A cell with at least one row: its place along both axes, and how many of its rows succeeded."""

    x: int
    y: int
    succeeded: int
    rows: int

    @property
    def rate(self) -> float:
        """The share of successes."""
        return self.succeeded / self.rows

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the rate."""
        return interval_95(self.succeeded, self.rows)


class SuccessTable(NamedTuple):
    """The successes over two axes; `missing` and `running` are those of `Samples`."""

    source: str
    x: Axis
    y: Axis
    cells: tuple[Cell, ...]
    succeeded: int
    rows: int
    missing: int
    running: int


def success_table(samples: Samples, *, bins: int | None = None) -> SuccessTable:
    """Count the samples in at most about `bins` ranges of each numeric column, with round edges.

    By default the number of ranges grows with the number of rows. Raises `CallerError`.
    """
    if bins is None:
        usual = round(math.sqrt(len(samples.succeeded) / _ROWS_A_CELL))
        bins = min(max(usual, _BINS_LEAST), _BINS_USUAL)
    if not 1 <= bins <= _BINS_MAX:
        raise CallerError(f"bins must be 1 to {_BINS_MAX}, got {bins}")
    x, columns = _axis(samples.x, bins)
    y, rows = _axis(samples.y, bins)
    counts = np.zeros((2, x.cells, y.cells), dtype=int)
    np.add.at(counts, (samples.succeeded.astype(int), columns, rows), 1)
    failed, succeeded = counts
    cells = tuple(
        Cell(int(i), int(j), int(succeeded[i, j]), int(succeeded[i, j] + failed[i, j]))
        for i, j in np.argwhere(succeeded + failed)
    )
    total = int(samples.succeeded.sum())
    return SuccessTable(samples.source, x, y, cells, total, len(samples.succeeded), samples.missing, samples.running)


def _axis(values: Values, bins: int) -> tuple[Axis, NDArray[np.int64]]:
    """Return the axis of a column, and the cell of each value along it."""
    if values.categories:
        return Axis(values.name, values.categories), values.numbers.astype(np.int64)
    low, high = float(values.numbers.min()), float(values.numbers.max())
    step = _round_step((high - low) / bins) if high > low else max(abs(low) * 1e-3, 1.0)
    first = math.floor(low / step)
    last = max(math.ceil(high / step), first + 1)
    edges = tuple(index * step for index in range(first, last + 1))
    cells = np.clip(np.floor(values.numbers / step).astype(np.int64) - first, 0, last - first - 1)
    return Axis(values.name, edges=edges, is_time=values.is_time, unit=values.unit), cells


def _round_step(width: float) -> float:
    """Return the least of 1, 2, 2.5, 5 and 10, times a power of ten, that is not below the width."""
    power = 10.0 ** math.floor(math.log10(width))
    return next((factor * power for factor in (1, 2, 2.5, 5) if factor * power >= width * (1 - 1e-9)), 10 * power)
