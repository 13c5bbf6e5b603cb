"""Flatten the values of an observation into rows: one for each scalar and each blob, with its path as key."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from pycrorm_async.events.blobs import BLOB_KEY
from pycrorm_async.events.types import Observed
from pycrorm_async.projections.fold.row_batch import Row

WHOLE: Final = "value"
"""Key of an observation that is a scalar or a blob itself, and so has no path."""


def value_rows(observed: Observed) -> Iterator[Row]:
    """Yield the columns key to missing of each value, in order.

    >>> [row[:3] for row in value_rows(Observed("force", {"x": 1.5, "of": ["arm"]}))]
    [('x', 1.5, None), ('of.0', None, 'arm')]
    """
    return _rows("", observed.values, observed.missing)


def _rows(path: str, value: Any, missing: dict[str, str]) -> Iterator[Row]:
    if isinstance(value, dict) and BLOB_KEY not in value:
        for key, each in value.items():
            yield from _rows(f"{path}.{key}" if path else key, each, missing)
    elif isinstance(value, list):
        for index, each in enumerate(value):
            yield from _rows(f"{path}.{index}" if path else str(index), each, missing)
    else:
        yield (path or WHOLE, *_columns(value), missing.get(path))


def _columns(value: Any) -> Row:
    """Return number, text, truth, blob, media_type and size."""
    if isinstance(value, bool):
        return None, None, value, None, None, None
    if isinstance(value, str):
        return None, value, None, None, None, None
    if isinstance(value, dict):
        return None, None, None, value[BLOB_KEY], value.get("media_type"), value.get("size")
    return float(value) if value is not None else None, None, None, None, None, None
