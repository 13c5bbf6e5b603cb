"""Make the rows of a query in SQL values of JSON, alike for both databases and for the command and agents.

Numbers are numbers with all their digits, also PostgreSQL's `numeric`, which `avg` and `sum` return, if the encoder has
`decimal_format="number"`. JSON has no bytes and no infinity: bytes are hexadecimal digits, and NaN and infinities are
the texts "NaN", "Infinity" and "-Infinity".
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from decimal import Decimal
from typing import Any


def json_rows(rows: Iterable[Iterable[Any]]) -> list[list[Any]]:
    """Return the rows with the values that JSON has."""
    return [[_value(each) for each in row] for row in rows]


def _value(value: Any) -> Any:
    match value:
        case bytes() | memoryview():
            return value.hex()
        case float() | Decimal() if not math.isfinite(value):
            return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
        case list() | tuple():
            return [_value(each) for each in value]
    return value
