"""Which declarations of a log share the tables, and which are refused: one answer for the fold and for mapped classes.

Declarations unite in the order they first arrived, so every process finds the same answer, and one that was accepted
stays so. The first of two that contradict each other is kept, the nodes of the other cannot be folded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from pycrorm_async.events.codec import UnknownShape, declaration_of, fingerprint
from pycrorm_async.events.happenings import DesignatorTypeDeclared
from pycrorm_async.projections.layout import Contradictory, Layout

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
        try:
            declared = declaration_of(payload)
            layout = layout.with_declaration(declared)
            accepted[name] = declared
        except Contradictory as reason:
            refused[name] = str(reason)
        except (UnknownShape, msgspec.DecodeError) as error:  # a newer version's, or damaged
            refused[name] = f"this version cannot read the declaration of its type: {error}"
    return Union(layout, accepted, refused)
