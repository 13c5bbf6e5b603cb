"""Which declarations of a log share the tables, and which are refused: one answer for the fold and for mapped classes.

Declarations unite in the order they first arrived, so every process finds the same answer, and one that was accepted
stays so. The first of two that contradict each other is kept, the nodes of the other cannot be folded. Nor can those of
a type whose tables the database refused to make; the layout remembers it, and why.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from pycrorm_async.events.codec import UnknownShape, declaration_of, fingerprint
from pycrorm_async.events.fields import mapped_declaration
from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.projections.schema.layout import Contradictory, Layout

__all__ = ["Union", "unite"]


class Union(NamedTuple):
    """The layout with all that was accepted; by fingerprint, what was accepted and why the others were refused."""

    layout: Layout
    accepted: dict[str, DesignatorTypeDeclared]
    refused: dict[str, str]


def unite(layout: Layout, payloads: Sequence[bytes]) -> Union:
    """The layout with these declarations, as far as they can share the tables."""
    accepted: dict[str, DesignatorTypeDeclared] = {}
    refused: dict[str, str] = {}
    for payload in payloads:
        name = fingerprint(payload)
        if name in layout.unmade:
            refused[name] = layout.unmade[name]
            continue
        try:
            declared = mapped_declaration(declaration_of(payload))
            layout = layout.with_declaration(declared)
            accepted[name] = declared
        except Contradictory as reason:
            refused[name] = str(reason)
        except (UnknownShape, msgspec.DecodeError) as error:  # a newer version's, or damaged
            refused[name] = f"this version cannot read the declaration of its type: {error}"
    unreadable = [fingerprint(each) for each in payloads if not _is_readable(each)]
    return Union(layout.with_unreadable(unreadable) if unreadable else layout, accepted, refused)


def _is_readable(payload: bytes) -> bool:
    """Whether a database can take a member out of it: it is JSON without U+0000, which PostgreSQL has in no text."""
    if b"\\u0000" in payload:
        return False
    try:
        msgspec.json.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return True
