"""Define `PickUpWithContextView`: every pick-up with the poses of robot and object, which the thesis learns from (5.2).

The view selects from the tables and not from the public views, because each of those excludes simulations separately;
here the node is checked once. PostgreSQL cannot estimate how many rows such a check leaves, and with one for each table
it read all pick-ups where the latest 2,000 were wanted.

Poses and objects are joined as outer joins (see `joins`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import Boolean, ColumnElement, FromClause, ScalarSelect, Select, Table, func, literal_column, select

from pycrorm_async.projections.schema.views.joins import numbers, present, same_episode
from pycrorm_async.projections.schema.views.portable_expressions import PerDatabase, event_of, member
from pycrorm_async.projections.schema.views.world_line import world_line

_POSE = "x y z qx qy qz qw"


def _planner_hint(fact: ColumnElement[bool]) -> ColumnElement[bool]:
    """Return a condition that always holds, rendered for PostgreSQL only: the dtypes of the nodes with such a row.

    Without it PostgreSQL read all succeeded nodes, ten times as many, to find the succeeded pick-ups; with it, it uses
    the index on the dtype (50,000 pick-ups in a good half of the time). It then underestimates the pick-ups by a factor
    of ten, and reads and sorts all of them for the latest few. SQLite starts with the rows of the type anyway.
    """
    return PerDatabase(literal_column("1", Boolean()), postgresql=fact)


def pick_ups_with_context(
    picked: FromClause,
    node: Table,
    object_: Table,
    removal: Table,
    pose: Table,
    episode: Table,
    dtypes: Sequence[str],
) -> Select[*tuple[Any, ...]]:
    """Return the view's query. A node, its designator and its leaf row have the same id, so they join without a key
    column. `dtypes` are all dtypes that a node with a row in `picked` may have."""
    robot, place = pose.alias("robot"), pose.alias("there")
    stands, lies = numbers(robot, _POSE), numbers(place, _POSE)

    def of_episode(value: ColumnElement[Any]) -> ScalarSelect[Any]:
        # A subquery, which costs nothing where the column is not selected.
        return select(value).where(episode.c.id == node.c.process_metadata_id).scalar_subquery()

    in_world = world_line(object_, removal, episode.c.id)  # of an episode that has not ended, or was LOST
    world = func.coalesce(episode.c.world, episode.c.entered_world, in_world)

    return (
        select(
            picked.c.id,
            picked.c.arm,
            picked.c.grasp,
            node.c.torso_height,
            (stands.x - lies.x).label("relative_x"),
            (stands.y - lies.y).label("relative_y"),
            stands.qx.label("quaternion_x"),
            stands.qy.label("quaternion_y"),
            stands.qz.label("quaternion_z"),
            stands.qw.label("quaternion_w"),
            object_.c.obj_type,
            node.c.status,
            node.c.process_metadata_id,
            node.c.id.label("node_id"),
            *_seen_from(lies, stands),
            (lies.z - stands.z - node.c.torso_height).label("height_over_torso"),
            node.c.robot,
            of_episode(episode.c.description).label("description"),
            of_episode(world).label("scene"),
            _policy(node).label("policy"),
            event_of(node.c.id).label("sequence"),
        )
        .select_from(picked)
        .join(node, same_episode(node, picked, node.c.id == picked.c.id))
        .outerjoin(robot, same_episode(robot, node, robot.c.id == node.c.robot_pose_id))
        .outerjoin(object_, same_episode(object_, picked, object_.c.id == picked.c.object_designator_id))
        .outerjoin(place, same_episode(place, object_, place.c.id == object_.c.pose_id))
        .where(_planner_hint(node.c.dtype.in_(dtypes)), present(robot), present(place))
    )


def _policy(node: Table) -> ScalarSelect[Any]:
    """Return the policy that the node around the pick-up names, or else the node around that.

    These are a `MoveAndPickUpAction`, and a `BatchRolloutAction`, which alone names it in episodes of version 0.1.0.
    """
    tried, batch = node.alias("tried"), node.alias("batch")
    named = [member(each.c.parameters, "policy") for each in (tried, batch)]
    return (
        select(func.coalesce(*named))
        .select_from(tried)
        .outerjoin(batch, same_episode(batch, tried, batch.c.id == tried.c.parent_id))
        .where(same_episode(tried, node, tried.c.id == node.c.parent_id))
        .scalar_subquery()
    )


def _seen_from(place: Any, robot: Any) -> Iterator[ColumnElement[Any]]:
    """Yield position (m) and orientation of the robot in the object's frame, in arithmetic that every database has."""
    dx, dy, dz = robot.x - place.x, robot.y - place.y, robot.z - place.z
    x, y, z, w = place.qx, place.qy, place.qz, place.qw
    # The rows of the transposed rotation matrix.
    yield ((1 - 2 * (y * y + z * z)) * dx + 2 * (x * y + z * w) * dy + 2 * (x * z - y * w) * dz).label("object_x")
    yield (2 * (x * y - z * w) * dx + (1 - 2 * (x * x + z * z)) * dy + 2 * (y * z + x * w) * dz).label("object_y")
    yield (2 * (x * z + y * w) * dx + 2 * (y * z - x * w) * dy + (1 - 2 * (x * x + y * y)) * dz).label("object_z")
    # The conjugate of the object's quaternion times the robot's.
    yield (w * robot.qx - x * robot.qw - y * robot.qz + z * robot.qy).label("object_qx")
    yield (w * robot.qy + x * robot.qz - y * robot.qw - z * robot.qx).label("object_qy")
    yield (w * robot.qz - x * robot.qy + y * robot.qx - z * robot.qw).label("object_qz")
    yield (w * robot.qw + x * robot.qx + y * robot.qy + z * robot.qz).label("object_qw")
