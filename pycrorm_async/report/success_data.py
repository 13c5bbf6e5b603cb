"""Count the pick-ups of episodes by place and by arm and grasp, for the heat maps of an overview."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import select

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import PickUpWithContextView
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.success.samples import success_samples
from pycrorm_async.query.success.success_table import Axis, SuccessTable, success_table

_PAIRS = (("relative_x", "relative_y"), ("arm", "grasp"))


async def success_documents(reading: Reading, numbers: Collection[int]) -> list[dict[str, Any]]:
    """Return a table of successes for each pair of columns; an empty list if no pick-up of these episodes has ended."""
    of = select(PickUpWithContextView).where(PickUpWithContextView.process_metadata_id.in_(numbers))
    try:
        return [_document(success_table(await success_samples(reading, x, y, of))) for x, y in _PAIRS]
    except CallerError:  # no pick-up, or more than are counted
        return []


def _document(table: SuccessTable) -> dict[str, Any]:
    return {
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
