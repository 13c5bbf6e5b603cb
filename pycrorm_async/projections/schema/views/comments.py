"""Load the comments on views and columns, which PostgreSQL keeps.

`python -m pycrorm_async.orm.documentation` writes the file from the docstrings of the mapped classes. It exists because
a process that makes tables, such as a daemon, does not load these classes.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import msgspec

FILE = Path(__file__).with_name("comments.json")


@cache
def comments() -> dict[str, dict[str, str]]:
    """Return the texts by view and column; the text under the empty name is the view's own."""
    return msgspec.json.decode(FILE.read_bytes(), type=dict[str, dict[str, str]])
