"""Views that users register: a name and a `select`, made beside the tables and made again with them.

>>> successes = UserView("successful_grasps", select(PickUpWithContextView.grasp, PickUpWithContextView.status))
>>> select(successes.table).where(successes.table.c.grasp == Grasp.TOP)
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sqlalchemy import ColumnElement, Dialect, Select, TableClause, column, select, table

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import is_reserved
from pycrorm_async.orm import Object, PickUpAction, Pose, TaskTreeNode
from pycrorm_async.projections.classes import storage_of
from pycrorm_async.projections.layout import Kept, Layout
from pycrorm_async.projections.materialised import EPISODE

__all__ = ["UserView", "BUILT_IN_VIEWS", "with_user_views", "view_texts", "view_text"]


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
        if lowered in taken or (is_reserved(view.name) and view not in BUILT_IN_VIEWS):
            raise CallerError(f"a view cannot be called {view.name!r}: the name is taken (choose another)")
        taken.add(lowered)
        texts[view.name] = view_text(view.meaning, dialect)
    return texts


def _pick_up_with_context() -> Select[*tuple[Any, ...]]:
    # Joined at the ids themselves: a node, its designator and its leaf row have the same one. Of tables and not of
    # classes, which would all be configured when this is imported (0.2 s).
    picked, node, thing = PickUpAction.__table__, TaskTreeNode.__table__, Object.__table__
    robot, there = Pose.__table__.alias("robot"), Pose.__table__.alias("there")
    return (
        select(
            picked.c.id,
            picked.c.arm,
            picked.c.grasp,
            node.c.torso_height,
            (robot.c.x - there.c.x).label("relative_x"),
            (robot.c.y - there.c.y).label("relative_y"),
            robot.c.qx.label("quaternion_x"),
            robot.c.qy.label("quaternion_y"),
            robot.c.qz.label("quaternion_z"),
            robot.c.qw.label("quaternion_w"),
            thing.c.obj_type,
            node.c.status,
            node.c.process_metadata_id,
            node.c.id.label("node_id"),
            *_seen_from(there.c, robot.c),
            (there.c.z - robot.c.z - node.c.torso_height).label("height_over_torso"),
        )
        .select_from(picked)
        .join(node, node.c.id == picked.c.id)
        .join(robot, robot.c.id == node.c.robot_pose_id)
        .join(thing, thing.c.id == picked.c.object_designator_id)
        .join(there, there.c.id == thing.c.pose_id)
    )


def _seen_from(thing: Any, robot: Any) -> Iterator[ColumnElement[Any]]:
    """Position (m) and orientation of the robot in the thing's own frame; plain arithmetic, for every database."""
    dx, dy, dz = robot.x - thing.x, robot.y - thing.y, robot.z - thing.z
    x, y, z, w = thing.qx, thing.qy, thing.qz, thing.qw
    # The rows of the transposed rotation matrix.
    yield ((1 - 2 * (y * y + z * z)) * dx + 2 * (x * y + z * w) * dy + 2 * (x * z - y * w) * dz).label("object_x")
    yield (2 * (x * y - z * w) * dx + (1 - 2 * (x * x + z * z)) * dy + 2 * (y * z + x * w) * dz).label("object_y")
    yield (2 * (x * z + y * w) * dx + 2 * (y * z - x * w) * dy + (1 - 2 * (x * x + y * y)) * dz).label("object_z")
    # The conjugate of the thing's quaternion times the robot's.
    yield (w * robot.qx - x * robot.qw - y * robot.qz + z * robot.qy).label("object_qx")
    yield (w * robot.qy + x * robot.qz - y * robot.qw - z * robot.qx).label("object_qy")
    yield (w * robot.qz - x * robot.qy + y * robot.qx - z * robot.qw).label("object_qz")
    yield (w * robot.qw + x * robot.qx + y * robot.qy + z * robot.qz).label("object_qw")


BUILT_IN_VIEWS = (UserView("PickUpWithContextView", _pick_up_with_context()),)
