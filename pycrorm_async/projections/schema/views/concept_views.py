"""Define the views of the ontology: `concept`, `concept_ancestor` and `object_concept`.

Their rows are facts of `events.concepts` and the same in every memory, so they are constants of the views and need no
table, fold or rebuild.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sqlalchemy import CompoundSelect, Text, cast, literal, null, select, union_all

from pycrorm_async.events.concepts import CONCEPT_OF_OBJECT_TYPE, CONCEPTS, ancestors

__all__ = ["concept_views"]


def concept_views() -> dict[str, CompoundSelect[Any]]:
    """Return name and select of each view."""
    parents = (
        (name, parent, each.source) for name, each in sorted(CONCEPTS.items()) for parent in each.parents or (None,)
    )
    pairs = ((name, ancestor) for name in sorted(CONCEPTS) for ancestor in ancestors(name))
    return {
        "concept": _rows(("name", "parent", "source"), parents),
        "concept_ancestor": _rows(("concept", "ancestor"), pairs),
        "object_concept": _rows(("obj_type", "concept"), sorted(CONCEPT_OF_OBJECT_TYPE.items())),
    }


def _rows(columns: tuple[str, ...], rows: Iterable[tuple[str | None, ...]]) -> CompoundSelect[Any]:
    return union_all(
        *(
            select(
                *(
                    cast(literal(value) if value is not None else null(), Text()).label(name)
                    for name, value in zip(columns, row, strict=True)
                )
            )
            for row in rows
        )
    )
