"""List the leaf tables of the mapped classes, so that a query of any class on a new memory returns no rows.

A built-in class has the dtype of its name. A class that a user declared (`class ORMSaying(Action)`) has only a table
until a designator is declared for it. Classes that exist in one memory only are derived from its declarations.

**User views.** Define views that users register: a name and a `select`, created and rebuilt together with the tables.

>>> successes = UserView("successful_grasps", select(PickUpWithContextView.grasp, PickUpWithContextView.status))
>>> select(successes.table).where(successes.table.c.grasp == Grasp.TOP)
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from sqlalchemy import Boolean, Column, Dialect, Double, Float, Integer, Select, Table, TableClause, column, table
from sqlalchemy.types import TypeEngine

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import is_reserved
from pycrorm_async.projections.columns import EPISODE, SCHEMA, Layout, LeafTable, MaterialisedView, Storage

if TYPE_CHECKING:
    from pycrorm_async.orm import Designator


def mapped_leaves() -> list[LeafTable]:
    """Return the tables of all classes below `Designator` that every memory of this process shares."""
    rows = sys.modules.get("pycrorm_async.orm.rows")
    declared = [] if rows is None else [each for each in leaves_of(rows.Designator) if each.dtype is None]
    return [*SCHEMA.leaves, *declared]


def leaves_of(root: type[Designator]) -> Iterator[LeafTable]:
    """Yield the tables of the classes below `root` and of itself, built-in or declared by a user."""
    from pycrorm_async.orm import Action, Designator, Language, Motion
    from pycrorm_async.orm.base import is_built_in

    roots = (Designator, Action, Motion, Language)
    for mapper in root.__mapper__.self_and_descendants:
        table = mapper.local_table
        if mapper.class_ in roots or mapper.class_.metadata is not root.metadata or not isinstance(table, Table):
            continue
        if table.metadata is not root.metadata:
            continue
        columns = {str(each.name): column_storage(each) for each in table.columns if each.name not in ("id", EPISODE)}
        named = (mapper.class_.__name__, mapper.class_.__root__.lower()) if is_built_in(mapper.class_) else ()
        yield LeafTable(str(table.name), columns, *named)


def column_storage(column: Column[Any]) -> Storage:
    """Return the storage of a mapped parameter."""
    for key in column.foreign_keys:
        target = key.target_fullname
        if target in ("pose.id", "object.id"):
            return "pose" if target == "pose.id" else "object"
    return storage_of(column.type)


def storage_of(type_: TypeEngine[Any]) -> Storage:
    """Return the storage of a SQLAlchemy type."""
    own: Storage | None = getattr(type_, "storage", None)  # of `orm.base`, which need not be imported
    if own is not None:
        return own
    kinds: tuple[tuple[type, Storage], ...] = (
        (Boolean, "boolean"),
        (Integer, "integer"),
        (Float, "real"),
        (Double, "real"),
    )
    return next((storage for kind, storage in kinds if isinstance(type_, kind)), "text")


# === user views ===============================================================================================


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
