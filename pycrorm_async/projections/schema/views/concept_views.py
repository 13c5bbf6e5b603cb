"""Define the views of the ontology: `concept`, `concept_ancestor` and `object_concept`.

Their rows are facts of `events.concepts` and the same in every memory, so they are constants of the views and need no
table, fold or rebuild.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from sqlalchemy import Text, TextualSelect

from pycrorm_async.events.concepts import CONCEPT_OF_OBJECT_TYPE, CONCEPTS, ancestors
from pycrorm_async.projections.schema.views.constants import constants


def _concepts() -> TextualSelect:
    parents = (
        (name, parent, each.source) for name, each in sorted(CONCEPTS.items()) for parent in each.parents or (None,)
    )
    return constants({"name": Text(), "parent": Text(), "source": Text()}, parents)


def _ancestors() -> TextualSelect:
    pairs = ((name, ancestor) for name in sorted(CONCEPTS) for ancestor in ancestors(name))
    return constants({"concept": Text(), "ancestor": Text()}, pairs)


def _of_objects() -> TextualSelect:
    return constants({"obj_type": Text(), "concept": Text()}, sorted(CONCEPT_OF_OBJECT_TYPE.items()))


CONCEPT_VIEWS: Final[dict[str, Callable[[], TextualSelect]]] = {
    "concept": _concepts,
    "concept_ancestor": _ancestors,
    "object_concept": _of_objects,
}
"""The functions that make the selects, by name of the view."""
