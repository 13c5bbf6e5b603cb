"""Define views that users register: a name and a `select`, created and rebuilt together with the tables.

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
from pycrorm_async.projections.schema.core_columns import EPISODE
from pycrorm_async.projections.schema.layout import Layout, MaterialisedView
from pycrorm_async.projections.schema.mapped_tables import storage_of


@dataclass(frozen=True)
class UserView:
    """A named query.

    Attributes:
        name: of the view in the database; a table of the memory must not have it.
        meaning: a select over the mapped classes, or over any other table in this database.
        materialised: the rows are stored, for expensive queries. Each row must come from one episode only, which a
            column `process_metadata_id` names: the rows of a changed episode are computed again at every flush.
    """

    name: str
    meaning: Select[*tuple[Any, ...]]
    materialised: bool = False

    @cached_property
    def table(self) -> TableClause:
        """The view as a table to select from; `table.c` has its columns with their types."""
        return table(self.name, *(column(name, each.type) for name, each in self.meaning.subquery().c.items()))


def view_text(meaning: Any, dialect: Dialect) -> str:
    """Return the SQL of a select, with its parameters as literals."""
    return str(meaning.compile(dialect=dialect, compile_kwargs={"literal_binds": True}))


def with_user_views(layout: Layout, views: Sequence[UserView], dialect: Dialect) -> Layout:
    """Return the layout with these views. Raises `CallerError` for a taken name, or a missing episode column."""
    texts = view_texts(views, layout, dialect)
    return layout.with_views(texts, {each.name: _kept(each, texts[each.name]) for each in views if each.materialised})


def _kept(view: UserView, sql: str) -> MaterialisedView:
    columns = {name: storage_of(each.type) for name, each in view.meaning.subquery().c.items()}
    if EPISODE not in columns:
        raise CallerError(f"the view {view.name} cannot be materialised: its rows name no episode (select {EPISODE})")
    # The digest gives a changed query another table, so that it never shows rows of the query before.
    digest = hashlib.blake2b(f"{view.name}{sql}{columns}".encode(), digest_size=6).hexdigest()
    return MaterialisedView(columns, f"pycrorm_view_{digest}", f"pycrorm_view_{digest}_progress")


def view_texts(views: Sequence[UserView], layout: Layout, dialect: Dialect) -> dict[str, str]:
    """Return name and SQL of these views. Raises `CallerError` for a name that is taken."""
    taken = {name.lower() for name in layout.leaves}
    texts: dict[str, str] = {}
    for view in views:
        lowered = view.name.lower()
        if lowered in taken or is_reserved(view.name):
            raise CallerError(f"the view name {view.name!r} is taken: choose another")
        taken.add(lowered)
        texts[view.name] = view_text(view.meaning, dialect)
    return texts
