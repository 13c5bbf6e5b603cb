"""List the leaf tables of the mapped classes, so that a query of any class on a new memory returns no rows.

A built-in class has the dtype of its name. A class that a user declared (`class ORMSaying(Action)`) has only a table
until a designator is declared for it. Classes that exist in one memory only are derived from its declarations.

The tables of the built-in classes are listed here once more, because mapping the classes takes 0.3 s: a process that
queries none of them, such as the daemon or a fold worker, never imports them.

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
from typing import TYPE_CHECKING, Any, Final

from sqlalchemy import Boolean, Column, Dialect, Double, Float, Integer, Select, Table, TableClause, column, table
from sqlalchemy.types import TypeEngine

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import is_reserved, table_name
from pycrorm_async.projections.columns import EPISODE, Layout, Leaf, MaterialisedView, Storage

if TYPE_CHECKING:
    from pycrorm_async.orm import Designator


_Columns = dict[str, Storage]
_ARM: Final[_Columns] = {"arm": "text"}
_GRIPPER: Final[_Columns] = {"gripper": "text"}
_OBJECT: Final[_Columns] = {"object_designator_id": "object"}
_TARGET: Final[_Columns] = {"target_id": "pose"}
_LOCATION: Final[_Columns] = {"target_location_id": "pose"}
_UNCHECKED: Final[_Columns] = {"allow_gripper_collision": "boolean"}
_BUILT_IN: Final[dict[str, dict[str, _Columns]]] = {
    "action": {
        "NavigateAction": _LOCATION,
        "ParkArmsAction": _ARM,
        "MoveTorsoAction": {"position": "real"},
        "SetGripperAction": {**_GRIPPER, "motion": "text"},
        "ReleaseAction": {**_GRIPPER, **_OBJECT},
        "GripAction": {**_GRIPPER, **_OBJECT, "effort": "real"},
        "PickUpAction": {**_OBJECT, **_ARM, "grasp": "text"},
        "PlaceAction": {**_OBJECT, **_ARM, **_LOCATION},
        "TransportAction": {**_OBJECT, **_ARM, **_LOCATION},
        "LookAtAction": _TARGET,
        "DetectAction": _OBJECT,
        "OpenAction": {**_OBJECT, **_ARM},
        "CloseAction": {**_OBJECT, **_ARM},
        "GraspingAction": {**_ARM, "object_desig_id": "object"},
        "FaceAtAction": {"pose_id": "pose"},
        "MoveAndPickUpAction": {"standing_position_id": "pose", **_OBJECT, **_ARM, "grasp": "text", "policy": "text"},
        "BatchRolloutAction": {
            "policy": "text",
            "scene": "text",
            "seed": "integer",
            "first": "integer",
            "count": "integer",
        },
        "LearnPolicyAction": {
            "policy": "text",
            "successes": "integer",
            "min_samples_leaf": "integer",
            "rollouts": "integer",
            "scene": "text",
            "episode_count": "integer",
        },
    },
    "motion": {
        "MoveMotion": _TARGET,
        "MoveTCPMotion": {**_TARGET, **_ARM, **_UNCHECKED},
        "LookingMotion": _TARGET,
        "MoveGripperMotion": {"motion": "text", **_GRIPPER, **_UNCHECKED},
        "MoveArmJointsMotion": {},
        "MoveJointsMotion": {},
        "DetectingMotion": {"object_type": "text"},
        "OpeningMotion": {"object_part_id": "object", **_ARM},
        "ClosingMotion": {"object_part_id": "object", **_ARM},
        "WorldStateDetectingMotion": {"object_type": "text"},
        "AccessingMotion": {
            "part_of_id": "object",
            **_ARM,
            **_GRIPPER,
            "drawer_joint": "text",
            "drawer_handle": "text",
            "distance": "real",
        },
    },
    "language": {
        "Sequential": {},
        "TryInOrder": {},
        "Parallel": {},
        "TryAll": {},
        "Repeat": {"times": "integer"},
        "Monitor": {"condition": "text", "interval_s": "real"},
        "Code": {"function": "text"},
        "Retry": {"max_tries": "integer"},
    },
}
"""The columns of the built-in classes below `Designator`, by kind and class."""


def mapped_leaves() -> list[Leaf]:
    """Return the tables of all classes below `Designator` that every memory of this process shares."""
    orm = sys.modules.get("pycrorm_async.orm")
    declared = [] if orm is None else [each for each in leaves_of(orm.Designator) if each.dtype is None]
    return [*built_in_leaves(), *declared]


def built_in_leaves() -> list[Leaf]:
    """Return the tables of the built-in classes, without importing them."""
    return [
        Leaf(table_name(name), columns, name, kind)
        for kind, classes in _BUILT_IN.items()
        for name, columns in classes.items()
    ]


def leaves_of(root: type[Designator]) -> Iterator[Leaf]:
    """Yield the tables of the classes below `root` and of itself, built-in or declared by a user."""
    from pycrorm_async.orm import Action, Designator, Language, Motion

    kinds = {Action: "action", Motion: "motion", Language: "language"}
    roots = (Designator, *kinds)
    for mapper in root.__mapper__.self_and_descendants:
        table = mapper.local_table
        if mapper.class_ in roots or mapper.class_.metadata is not root.metadata or not isinstance(table, Table):
            continue
        if table.metadata is not root.metadata:
            continue
        columns = {str(each.name): _storage(each) for each in table.columns if each.name not in ("id", EPISODE)}
        built_in = mapper.class_.__module__.startswith("pycrorm_async.orm.")
        kind = next((kind for root, kind in kinds.items() if issubclass(mapper.class_, root)), None)
        yield Leaf(str(table.name), columns, mapper.class_.__name__ if built_in else None, kind if built_in else None)


def _storage(column: Column[object]) -> Storage:
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
