"""Old events read as new ones: for each shape that was changed, how its JSON becomes that of the next version.

The log is never rewritten. Who changes a shape in `happenings.py` raises its `version` and adds here what turns an
object of the old shape into one of the new: a pure function of the old one alone, which it may change and give back.

    def _object_added_1(old: dict[str, Any]) -> dict[str, Any]:
        return old | {"mass_kg": None}

    UPCASTERS = {("ObjectAdded", 1): _object_added_1}

A field with a default that means what its absence meant before is no change of shape, and needs none of this.

Read without a shape, by key, and so kept where they are, also in a new version: `parameters` and `designator` of
NodeStarted, `simulated` of EpisodeStarted, all of DesignatorTypeDeclared that the view `designator_type` shows. The log
keeps nothing of a declaration but its bytes: one of a version above 1 says so in them, under the key `version`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, TypeAlias

__all__ = ["Upcaster", "UPCASTERS"]

Upcaster: TypeAlias = Callable[[dict[str, Any]], dict[str, Any]]

UPCASTERS: Final[Mapping[tuple[str, int], Upcaster]] = {}
"""By type and old version. Every shape is of version 1 today."""
