"""The lines that refuse a query in SQL, alike on both databases."""

from __future__ import annotations

import re
from collections.abc import Iterable

from pycrorm_async.errors import QueryRefused
from pycrorm_async.query.suggestions import nearest

ONLY_READS = "a query may only read: it is one SELECT, or WITH … SELECT"
NOT_ONE = "a query is one statement: this text has several"
NO_PARAMETERS = "a query has no parameters such as ?, :name or $1: write the values themselves"
_INTERNAL = re.compile(r"^zz_|__\d+$|^sqlite_|^pycrorm_")
"""Names of the tables behind the views, one for each generation, and of the bookkeeping."""


def stopped(seconds: float) -> str:
    return f"the query was stopped after {seconds:g} s: select less, or allow it more time"


def missing_relation(name: str, valid: Iterable[str]) -> QueryRefused:
    """Return the refusal of a query that names a table or view that does not exist."""
    public = sorted({each for each in valid if not _INTERNAL.search(each)})
    hint = nearest(name.rpartition(".")[2], public)
    return QueryRefused(f"there is no table or view {name}{hint or '; `pycrorm schema` lists them'}")
