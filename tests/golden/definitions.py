"""Write down the definition of every built-in table and view, so that a change of one is noticed.

    python -m tests.golden.definitions

A line of `definitions.txt` has the kind, the name and a digest of the SQL of both databases. Its first line is the
version of the fold, which must be raised when a table changes, because tables of an older version have other columns. A
changed view replaces the one before as soon as a process opens the memory.
"""

import hashlib
import re
from pathlib import Path

from sqlalchemy.dialects import postgresql, sqlite

from pycrorm_async.projections.columns import CORE, OF_NO_EPISODE, SCHEMA, Layout, leaf_columns
from pycrorm_async.projections.generations import PROJECTION_VERSION, built_in_texts, table_texts
from pycrorm_async.projections.views import Tables

FILE = Path(__file__).with_suffix(".txt")


def definitions() -> list[str]:
    """Return the lines of the definitions of today."""
    layout = Layout().with_leaves(SCHEMA.leaves)
    tables = CORE | OF_NO_EPISODE | {name: leaf_columns(columns) for name, columns in layout.leaves.items()}
    dialects = (sqlite.dialect(), postgresql.dialect(paramstyle="named"))  # type: ignore[no-untyped-call]  # of SQLAlchemy
    texts = {
        f"table {name}": "".join(text for each in dialects for text in table_texts({name: columns}, 1, str, each))
        for name, columns in tables.items()
    }
    for each in dialects:
        for name, text in built_in_texts(layout, Tables(1, str), each).items():
            texts[f"view {name}"] = texts.get(f"view {name}", "") + text
    return [f"version {PROJECTION_VERSION}", *sorted(f"{name} {_digest(text)}" for name, text in texts.items())]


def _digest(text: str) -> str:
    """Return the digest of a text, in which the last digits of decimal numbers do not count."""
    rounded = re.sub(r"\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]):.6f}", text)
    return hashlib.sha256(rounded.encode()).hexdigest()[:16]


def changed(before: list[str]) -> set[str]:
    """Return kind and name of the definitions that differ from those before."""
    return {line.rpartition(" ")[0] for line in {*definitions()} ^ {*before}}


if __name__ == "__main__":
    FILE.write_text("\n".join(definitions()) + "\n")
