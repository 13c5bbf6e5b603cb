"""Give values an HTML form in notebooks. They do not import the views that draw them: `notebook.views` registers these.

`query.reading` imports `notebook.views`, so that every value which a memory returns has its view.
"""

from __future__ import annotations

import html
from functools import singledispatch


@singledispatch
def value_html(value: object) -> str:
    """Return the view that is registered for the value's class; without one, the value's text."""
    return f"<pre>{html.escape(repr(value))}</pre>"


class NotebookValue:
    """Base of the values that a notebook draws."""

    def _repr_html_(self) -> str:
        return value_html(self)
