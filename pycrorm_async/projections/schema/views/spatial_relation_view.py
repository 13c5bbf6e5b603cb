"""Define `spatial_relation`: the objects on, in or next to which each picked up or placed object was.

The moment is the start of a pick-up, and the end of a placing. A relation is computed from the poses at that moment and
from the boxes of the recorded descriptions, link by link. An object of version 0.1.0 has no description; it has the
boxes of the built-in model of its type, and an environment those of its name. A drawer is where its joint had it; links
that turn, such as doors, have no box. A box is turned with its object and then replaced by the box along the axes of
the map around it. With the box A around the picked up or placed object and another object's box B:

    on       the bottom of A is within `ON_M` of the top of B, and the centre of A is above B
    in       the centre of A is in B
    next to  neither, their horizontal gap is at most `NEXT_TO_M`, and their heights overlap; not for environments
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple

from sqlalchemy import (
    ColumnElement,
    Double,
    FromClause,
    Select,
    Subquery,
    Table,
    Text,
    TextualSelect,
    and_,
    case,
    cast,
    exists,
    func,
    literal,
    null,
    select,
    union_all,
)
from sqlalchemy.types import TypeEngine

from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.projections.schema.views.constants import constants
from pycrorm_async.projections.schema.views.joins import present, same_episode
from pycrorm_async.projections.schema.views.portable_expressions import event_of
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.models.catalog import built_in_urdf
from pycrorm_async.world.models.kitchen import kitchen_urdf
from pycrorm_async.world.models.link_boxes import link_boxes

ON_M = 0.02
"""The largest distance between a bottom and a top that counts as contact, m: poses of placings differ by less."""
NEXT_TO_M = 0.1
"""The largest horizontal gap between neighbours, m: about as wide as a hand between them."""

_ENVIRONMENT, _ROBOT = ObjectType.ENVIRONMENT.name, ObjectType.ROBOT.name
_AXES = ("x", "y", "z")
_TEXTS = ("model", "link", "joint")
_NUMBERS = [f"{letter}{axis}" for letter in "cha" for axis in _AXES]
"""A box: its center, half of its edges, and the direction in which its joint slides it."""
_SLOT_BITS = SLOT_MAX.bit_length()
_NUMBER_BITS = SEQUENCE_MAX.bit_length() + _SLOT_BITS


class SpatialTables(NamedTuple):
    """The tables that the view reads."""

    node: Table
    object: Table
    removal: Table
    pose: Table
    joint_change: Table


def spatial_relations(
    tables: SpatialTables, link_box: Table, picked: FromClause, placed: FromClause, *, simulated: bool
) -> Select[Any]:
    """Return the view's query; `picked` and `placed` are the rows of pick-ups and placings."""
    moments = _moments(tables, picked, placed, simulated=simulated)
    boxes = _boxes(link_box)
    # The second select continues the first. PostgreSQL would compute two that are joined by their nodes once a node.
    one = _placed_boxes(tables, moments, _around(boxes), same=True)
    both = _placed_boxes(tables, one, boxes, same=False).c
    gaps = [func.abs(both[f"one_c{axis}"] - both[f"other_c{axis}"]) - both[f"other_h{axis}"] for axis in _AXES]
    within = [gap <= 0 for gap in gaps]
    bottom, top = both.one_cz - both.one_hz, both.other_cz + both.other_hz
    apart = [
        case((gap > both[f"one_h{axis}"], gap - both[f"one_h{axis}"]), else_=0.0)
        for gap, axis in zip(gaps, _AXES, strict=True)
    ]
    gap_squared = apart[0] * apart[0] + apart[1] * apart[1]
    near = and_(gap_squared <= NEXT_TO_M**2, apart[2] <= 0, both.other_obj_type != _ENVIRONMENT)
    relation = case(
        (and_(func.abs(bottom - top) <= ON_M, within[0], within[1]), "on"),
        (and_(*within), "in"),
        (near, "next to"),
    )
    related = select(
        both.node_id,
        both.process_metadata_id,
        both.one_id.label("object_id"),
        both.one_name.label("object"),
        cast(relation, Text()).label("relation"),
        both.other_id,
        both.other_name.label("other"),
        both.other_link.label("link"),
        event_of(both.node_id).label("sequence"),
    ).subquery("related")
    return select(*related.c).where(related.c.relation.is_not(None))


def _moments(tables: SpatialTables, picked: FromClause, placed: FromClause, *, simulated: bool) -> Subquery:
    """Return the nodes with their object's identity, and the id that a row of their moment's event would have."""
    node, target = tables.node, tables.object.alias("target")
    first_id = node.c.id.bitwise_rshift(_NUMBER_BITS).bitwise_lshift(_NUMBER_BITS)
    ended = first_id + node.c.end_sequence.bitwise_lshift(_SLOT_BITS)
    return union_all(
        *(
            select(
                node.c.id.label("node_id"),
                node.c.process_metadata_id,
                target.c.identity_id,
                moment.label("moment"),
            )
            .join_from(rows, node, same_episode(node, rows, node.c.id == rows.c.id))
            .join(target, same_episode(target, rows, target.c.id == rows.c.object_designator_id))
            .where(target.c.identity_id.is_not(None), moment.is_not(None))
            .where(*(() if simulated else (~node.c.simulated,)))
            for rows, moment in ((picked, node.c.id), (placed, ended))
        )
    ).subquery("moment")


def _placed_boxes(tables: SpatialTables, moments: Subquery, boxes: Subquery, *, same: bool) -> Subquery:
    """Return the moments with the boxes in the map: of the picked up or placed object itself, or of all others."""
    name = "one" if same else "other"
    added, then = tables.object.alias(f"{name}_added"), tables.object.alias(f"{name}_then")
    later, removal, pose = tables.object.alias(f"{name}_later"), tables.removal.alias(), tables.pose.alias()
    box = boxes.alias(f"{name}_box")
    last = (
        select(func.max(later.c.id))
        .where(same_episode(later, added, later.c.identity_id == added.c.id))
        .where(later.c.dtype == "Object", later.c.id <= moments.c.moment)
        .scalar_subquery()
    )
    removed = exists(
        select(literal(1))
        .where(same_episode(removal, added, removal.c.identity_id == added.c.id))
        .where(removal.c.id <= moments.c.moment)
    )
    # Joined, because SQLite would compute a subquery in the columns once for each use of a column.
    slid = tables.joint_change.alias(f"{name}_slid")
    last_change = _last_change(tables, added, box, moments)
    centre = [box.c[f"c{axis}"] + box.c[f"a{axis}"] * func.coalesce(slid.c.position, 0.0) for axis in _AXES]
    rotation = _rotation(pose)
    columns: list[ColumnElement[Any]] = []
    for axis, row in zip(_AXES, rotation, strict=True):
        along = row[0] * centre[0] + row[1] * centre[1] + row[2] * centre[2]
        half = sum((func.abs(row[each]) * box.c[f"h{_AXES[each]}"] for each in (1, 2)), func.abs(row[0]) * box.c.hx)
        columns += [(pose.c[axis] + along).label(f"{name}_c{axis}"), half.label(f"{name}_h{axis}")]
    built_in = case((added.c.obj_type == _ENVIRONMENT, added.c.name), else_=added.c.obj_type)
    is_one = added.c.id == moments.c.identity_id
    return (
        select(
            *moments.c,
            then.c.id.label(f"{name}_id"),
            then.c.name.label(f"{name}_name"),
            then.c.obj_type.label(f"{name}_obj_type"),
            func.coalesce(box.c.link, then.c.name).label(f"{name}_link"),
            *columns,
        )
        .select_from(moments)
        .join(added, same_episode(added, moments, is_one if same else ~is_one))
        .outerjoin(then, same_episode(then, moments, then.c.id == last))
        .outerjoin(pose, same_episode(pose, then, pose.c.id == then.c.pose_id))
        .join(box, box.c.model == func.coalesce(added.c.description_fingerprint, built_in))
        .outerjoin(slid, same_episode(slid, moments, and_(slid.c.joint == box.c.joint, slid.c.id == last_change)))
        .where(added.c.id == added.c.identity_id, added.c.id <= moments.c.moment, ~removed)
        .where(added.c.obj_type != _ROBOT, present(pose))
        .subquery(name)
    )


def _last_change(tables: SpatialTables, added: FromClause, box: FromClause, moments: Subquery) -> ColumnElement[int]:
    """Return the id of the last change of the joint that slides a box."""
    change, moved = tables.joint_change.alias(), tables.object.alias()
    return (
        select(func.max(change.c.id))
        .join_from(change, moved, same_episode(moved, change, moved.c.id == change.c.object_id))
        .where(same_episode(moved, added, moved.c.identity_id == added.c.id))
        .where(change.c.joint == box.c.joint, change.c.id <= moments.c.moment)
        .scalar_subquery()
    )


def _rotation(pose: FromClause) -> list[list[ColumnElement[float]]]:
    x, y, z, w = (pose.c[f"q{axis}"] for axis in "xyzw")
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def _boxes(described: Table) -> Subquery:
    """Return the boxes of all links, with their model: the fingerprint of a description, or a built-in one."""
    built_in = _built_in().subquery("built_in")
    return union_all(select(*built_in.c), select(*(described.c[each.name] for each in built_in.c))).subquery("box")


def _around(boxes: Subquery) -> Subquery:
    """Return one box for each model, around those of its links."""
    low = {axis: func.min(boxes.c[f"c{axis}"] - boxes.c[f"h{axis}"]) for axis in _AXES}
    high = {axis: func.max(boxes.c[f"c{axis}"] + boxes.c[f"h{axis}"]) for axis in _AXES}
    columns: list[ColumnElement[Any]] = [((low[axis] + high[axis]) / 2).label(f"c{axis}") for axis in _AXES]
    columns += [((high[axis] - low[axis]) / 2).label(f"h{axis}") for axis in _AXES]
    columns += [literal(0.0).label(f"a{axis}") for axis in _AXES]
    nothing = cast(null(), Text())
    around = select(boxes.c.model, nothing.label("link"), nothing.label("joint"), *columns).group_by(boxes.c.model)
    return around.subquery("around")


@lru_cache(maxsize=1)
def _built_in() -> TextualSelect:
    kinds: dict[str, TypeEngine[Any]] = {name: Text() for name in _TEXTS} | {name: Double() for name in _NUMBERS}
    return constants(kinds, _built_in_rows())


def _built_in_rows() -> Iterator[tuple[str | float | None, ...]]:
    for kind in ObjectType:
        if kind not in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
            for box in link_boxes(built_in_urdf("any", kind)):
                yield kind.name, None, None, *box.center, *box.half, *box.axis
    for box in link_boxes(kitchen_urdf()):
        if not box.link.endswith("_handle"):
            yield "kitchen", box.link, box.joint, *box.center, *box.half, *box.axis
