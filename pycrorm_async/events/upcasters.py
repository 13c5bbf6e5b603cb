"""Upcasters convert the JSON of an event of an older version to that of the next version.

The log is never rewritten. A change of a shape in `types.py` raises the class' `version` and adds an upcaster here: a
pure function of the old object, which it may modify and return.

    def _object_added_1(old: dict[str, Any]) -> dict[str, Any]:
        return old | {"mass_kg": None}

    UPCASTERS = {("ObjectAdded", 1): _object_added_1}

A new field whose default means the same as its absence did before does not change the shape and needs no upcaster.

Some code reads fields by key, without the shape, so these keep their place in every version: `parameters` and
`designator` of NodeStarted, `simulated` of EpisodeStarted, and all fields of DesignatorTypeDeclared that the view
`designator_type` shows. The log stores only the bytes of a declaration, so a declaration of a version above 1 carries
its version in them, under the key `version`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, TypeAlias

__all__ = ["Upcaster", "UPCASTERS"]

Upcaster: TypeAlias = Callable[[dict[str, Any]], dict[str, Any]]

UPCASTERS: Final[Mapping[tuple[str, int], Upcaster]] = {}
"""Upcasters by event type and old version; empty while every shape is at version 1."""
