"""Views that users register: a name and a `select`, made beside the tables and made again with them.

>>> successes = UserView("successful_grasps", select(PickUpWithContextView.grasp, PickUpWithContextView.status))
>>> select(successes.table).where(successes.table.c.grasp == Grasp.TOP)
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sqlalchemy import Dialect, Select, TableClause, column, table

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import is_reserved
from pycrorm_async.projections.schema.layout import Kept, Layout
from pycrorm_async.projections.schema.mapped_tables import storage_of
from pycrorm_async.projections.schema.materialised_views import EPISODE

__all__ = ["UserView", "with_user_views", "view_texts", "view_text"]


@dataclass(frozen=True)
class UserView:
    """A question with a name.

    Attributes:
        name: of the view in the database; not that of a table of the memory.
        meaning: a select over the mapped classes, or over anything else in this database.
        materialised: its rows are kept, for questions that cost much. Each row must come from one episode alone, which
            a column `process_metadata_id` names: an episode that has changed has its rows made anew, at every flush.
    """

    name: str
    meaning: Select[*tuple[Any, ...]]
    materialised: bool = False

    @cached_property
    def table(self) -> TableClause:
        """What to select from; `table.c` has its columns with their types."""
        return table(self.name, *(column(name, each.type) for name, each in self.meaning.subquery().c.items()))


def view_text(meaning: Any, dialect: Dialect) -> str:
    """The SQL of a select, its parameters written in."""
    return str(meaning.compile(dialect=dialect, compile_kwargs={"literal_binds": True}))


def with_user_views(layout: Layout, views: Sequence[UserView], dialect: Dialect) -> Layout:
    """The layout with these views. Raises `CallerError` for a name that is taken, or rows that name no episode."""
    texts = view_texts(views, layout, dialect)
    return layout.with_views(texts, {each.name: _kept(each, texts[each.name]) for each in views if each.materialised})


def _kept(view: UserView, meaning: str) -> Kept:
    columns = {name: storage_of(each.type) for name, each in view.meaning.subquery().c.items()}
    if EPISODE not in columns:
        raise CallerError(f"the view {view.name} cannot be materialised: its rows name no episode (select {EPISODE})")
    # Of another meaning it is another table: what there was cannot be shown under the new one.
    digest = hashlib.blake2b(f"{view.name}{meaning}{columns}".encode(), digest_size=6).hexdigest()
    return Kept(columns, f"pycrorm_view_{digest}", f"pycrorm_view_{digest}_progress")


def view_texts(views: Sequence[UserView], layout: Layout, dialect: Dialect) -> dict[str, str]:
    """Name and SQL of these views. Raises `CallerError` for a name that is taken."""
    taken = {name.lower() for name in layout.leaves}
    texts: dict[str, str] = {}
    for view in views:
        lowered = view.name.lower()
        if lowered in taken or is_reserved(view.name):
            raise CallerError(f"a view cannot be called {view.name!r}: the name is taken (choose another)")
        taken.add(lowered)
        texts[view.name] = view_text(view.meaning, dialect)
    return texts
