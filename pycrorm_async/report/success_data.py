"""Count successes of episodes over two columns, pick-ups by default, for the heat maps of an overview."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.success.samples import PICK_UPS, success_samples
from pycrorm_async.query.success.success_table import Axis, success_table


class Plot(NamedTuple):
    """Two columns of a view over which successes are counted; the names are those of `pycrorm plot`."""

    x: str
    y: str
    of: str = PICK_UPS


_PICK_UPS = (Plot("relative_x", "relative_y"), Plot("arm", "grasp"))


async def success_documents(
    reading: Reading, numbers: Collection[int], plots: Collection[Plot] = ()
) -> list[dict[str, Any]]:
    """Return a table of successes of these episodes for each plot.

    Raises `CallerError` as `success_samples` does. Without plots the tables are those of pick-ups, if any has ended.
    """
    if plots:
        return [await _document(reading, numbers, each) for each in plots]
    try:
        return [await _document(reading, numbers, each) for each in _PICK_UPS]
    except CallerError:  # no pick-up, or more than are counted
        return []


async def _document(reading: Reading, numbers: Collection[int], plot: Plot) -> dict[str, Any]:
    table = success_table(await success_samples(reading, plot.x, plot.y, plot.of, episodes=numbers))
    return {
        "of": table.source,
        "x": _axis(table.x),
        "y": _axis(table.y),
        "cells": [list(each) for each in table.cells],
        "succeeded": table.succeeded,
        "rows": table.rows,
    }


def _axis(axis: Axis) -> dict[str, Any]:
    """Return the name, the labels of the cells or the texts of the edges between them, and the number of cells."""
    return {
        "name": axis.name,
        "unit": axis.unit,
        "labels": axis.labels,
        "edges": [axis.text(each) for each in axis.edges],
        "cells": axis.cells,
    }
