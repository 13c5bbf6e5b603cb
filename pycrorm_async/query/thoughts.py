"""What a connection sees that also sees what was only thought through, while everybody else sees what happened."""

from __future__ import annotations

from sqlalchemy import Dialect

from pycrorm_async.projections.generations import Generation
from pycrorm_async.projections.public import public_views
from pycrorm_async.projections.views import view_text

__all__ = ["all_views"]


def all_views(generation: Generation, dialect: Dialect) -> dict[str, str]:
    """Name and SQL of every view there is, as it is without anything left out; a view stands on those before it."""
    meanings = public_views(generation.layout, generation.number, simulated=True)
    return {name: view_text(each, dialect) for name, each in meanings.items()} | generation.layout.user_views
