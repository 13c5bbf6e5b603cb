"""`PickUpWithContextView`: every pick-up with where the robot and the object were, what the thesis learns from (5.2).

It stands on the tables and not on the views in front of them, each of which looks for itself whether a row really
happened. Here that is asked once, of the node. PostgreSQL cannot tell how many rows such a look leaves, and read all
pick-ups where the latest 2,000 were wanted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Self

from sqlalchemy import Boolean, ColumnElement, FromClause, Select, Table, select
from sqlalchemy.ext.compiler import compiles

__all__ = ["pick_ups_with_context"]


class _Said(ColumnElement[bool]):
    """What is so anyway, said for PostgreSQL: of what types a node is that has such a row.

    To find the pick-ups that succeeded it read all nodes that did, ten times as many, and now finds them in the index
    of types (of 50,000 in a good half of the time). But it takes the pick-ups for a tenth of what they are: who wants
    the latest of them says so (`Dialect.in_order`). SQLite begins with the rows of the type anyway.
    """

    inherit_cache = False
    type = Boolean()

    def __init__(self, fact: ColumnElement[bool]) -> None:
        self.fact = fact

    def self_group(self, against: Any = None) -> Self:  # noqa: ARG002  SQLAlchemy's signature
        return self


@compiles(_Said)
def _nothing(_element: _Said, _compiler: Any, **_options: Any) -> str:
    return "1"


@compiles(_Said, "postgresql")
def _fact(element: _Said, compiler: Any, **options: Any) -> str:
    return str(compiler.process(element.fact, **options))


def pick_ups_with_context(
    picked: FromClause, node: Table, thing: Table, pose: Table, dtypes: Sequence[str]
) -> Select[*tuple[Any, ...]]:
    """Joined at the ids themselves: a node, its designator and its leaf row have the same one. `dtypes` are all that a
    node with a row in `picked` may have."""
    robot, there = pose.alias("robot"), pose.alias("there")
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
        .where(_Said(node.c.dtype.in_(dtypes)))
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
