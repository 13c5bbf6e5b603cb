"""Define the views of the ontology: `concept`, `concept_ancestor` and `object_concept`.

Their rows are facts of `events.concepts` and the same in every memory, so they are constants of the views and need no
table, fold or rebuild.
"""

from __future__ import annotations

from sqlalchemy import Text, TextualSelect

from pycrorm_async.events.concepts import CONCEPT_OF_OBJECT_TYPE, CONCEPTS, ancestors
from pycrorm_async.projections.schema.views.constants import constants

__all__ = ["concept_views"]


def concept_views() -> dict[str, TextualSelect]:
    """Return name and select of each view."""
    parents = (
        (name, parent, each.source) for name, each in sorted(CONCEPTS.items()) for parent in each.parents or (None,)
    )
    pairs = ((name, ancestor) for name in sorted(CONCEPTS) for ancestor in ancestors(name))
    return {
        "concept": constants({"name": Text(), "parent": Text(), "source": Text()}, parents),
        "concept_ancestor": constants({"concept": Text(), "ancestor": Text()}, pairs),
        "object_concept": constants({"obj_type": Text(), "concept": Text()}, sorted(CONCEPT_OF_OBJECT_TYPE.items())),
    }
