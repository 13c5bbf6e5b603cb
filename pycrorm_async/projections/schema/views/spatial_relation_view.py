"""Define `spatial_relation`: what each picked up or placed object was on, in or next to.

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
    TextClause,
    TextualSelect,
    and_,
    case,
    cast,
    column,
    exists,
    func,
    literal,
    null,
    select,
    union_all,
)
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.types import TypeEngine

from pycrorm_async.events.codec import DESCRIPTION_PREFIX
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.projections.schema.tables import EPISODE
from pycrorm_async.projections.schema.views.constants import constants
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.models.catalog import built_in_urdf
from pycrorm_async.world.models.kitchen import kitchen_urdf
from pycrorm_async.world.models.link_boxes import link_boxes

__all__ = ["SpatialTables", "spatial_relations", "ON_M", "NEXT_TO_M"]

ON_M = 0.02
"""The largest distance between a bottom and a top that counts as contact, m: poses of placings differ by less."""
NEXT_TO_M = 0.1
"""The largest horizontal gap between neighbours, m: about as wide as a hand between them."""

_ENVIRONMENT, _ROBOT = ObjectType.ENVIRONMENT.name, ObjectType.ROBOT.name
_AXES = ("x", "y", "z")
_TEXTS = ("model", "link", "joint")
_NUMBERS = [f"{letter}{axis}" for letter in "cha" for axis in _AXES]
"""A box: its center, half of its edges, and the direction in which its joint slides it."""
_IS_DESCRIPTION = f"substr(declaration.fingerprint, 1, {len(DESCRIPTION_PREFIX)}) = '{DESCRIPTION_PREFIX}'"
_SLOT_BITS = SLOT_MAX.bit_length()
_NUMBER_BITS = SEQUENCE_MAX.bit_length() + _SLOT_BITS


class SpatialTables(NamedTuple):
    """The tables that the view reads."""

    node: Table
    object: Table
    removal: Table
    pose: Table
    joint_change: Table


def spatial_relations(tables: SpatialTables, picked: FromClause, placed: FromClause, *, simulated: bool) -> Select[Any]:
    """Return the view's query; `picked` and `placed` are the rows of pick-ups and placings."""
    moments = _moments(tables, picked, placed, simulated=simulated)
    boxes = _boxes()
    one = _placed_boxes(tables, moments, _around(boxes), same=True)
    other = _placed_boxes(tables, moments, boxes, same=False)
    gaps = [func.abs(one.c[f"c{axis}"] - other.c[f"c{axis}"]) - other.c[f"h{axis}"] for axis in _AXES]
    within = [gap <= 0 for gap in gaps]
    bottom, top = one.c.cz - one.c.hz, other.c.cz + other.c.hz
    apart = [
        case((gap > one.c[f"h{axis}"], gap - one.c[f"h{axis}"]), else_=0.0)
        for gap, axis in zip(gaps, _AXES, strict=True)
    ]
    gap_squared = apart[0] * apart[0] + apart[1] * apart[1]
    near = and_(gap_squared <= NEXT_TO_M**2, apart[2] <= 0, other.c.obj_type != _ENVIRONMENT)
    relation = case(
        (and_(func.abs(bottom - top) <= ON_M, within[0], within[1]), "on"),
        (and_(*within), "in"),
        (near, "next to"),
    )
    found = (
        select(
            one.c.node_id,
            one.c.process_metadata_id,
            one.c.row_id.label("object_id"),
            one.c.name.label("object"),
            cast(relation, Text()).label("relation"),
            other.c.row_id.label("other_id"),
            other.c.name.label("other"),
            other.c.link,
        )
        .join_from(one, other, _same(one, other, one.c.node_id == other.c.node_id))
        .subquery("related")
    )
    return select(*found.c).where(found.c.relation.is_not(None))


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
            .join_from(rows, node, _same(node, rows, node.c.id == rows.c.id))
            .join(target, _same(target, rows, target.c.id == rows.c.object_designator_id))
            .where(target.c.identity_id.is_not(None), moment.is_not(None))
            .where(*(() if simulated else (~node.c.simulated,)))
            for rows, moment in ((picked, node.c.id), (placed, ended))
        )
    ).subquery("moment")


def _placed_boxes(tables: SpatialTables, moments: Subquery, boxes: Subquery, *, same: bool) -> Subquery:
    """Return for each moment the boxes in the map: of the picked up or placed object itself, or of all others."""
    name = "one" if same else "another"
    added, then = tables.object.alias(f"{name}_added"), tables.object.alias(f"{name}_then")
    later, removal, pose = tables.object.alias(f"{name}_later"), tables.removal.alias(), tables.pose.alias()
    box = boxes.alias(f"{name}_box")
    last = (
        select(func.max(later.c.id))
        .where(_same(later, added, later.c.identity_id == added.c.id))
        .where(later.c.dtype == "Object", later.c.id <= moments.c.moment)
        .scalar_subquery()
    )
    removed = exists(
        select(literal(1))
        .where(_same(removal, added, removal.c.identity_id == added.c.id))
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
        columns += [(pose.c[axis] + along).label(f"c{axis}"), half.label(f"h{axis}")]
    built_in = case((added.c.obj_type == _ENVIRONMENT, added.c.name), else_=added.c.obj_type)
    is_one = added.c.id == moments.c.identity_id
    return (
        select(
            moments.c.node_id,
            moments.c.process_metadata_id,
            then.c.id.label("row_id"),
            then.c.name,
            then.c.obj_type,
            func.coalesce(box.c.link, then.c.name).label("link"),
            *columns,
        )
        .select_from(moments)
        .join(added, _same(added, moments, is_one if same else ~is_one))
        .join(then, _same(then, moments, then.c.id == last))
        .join(pose, _same(pose, then, pose.c.id == then.c.pose_id))
        .join(box, box.c.model == func.coalesce(added.c.description_fingerprint, built_in))
        .outerjoin(slid, _same(slid, moments, and_(slid.c.joint == box.c.joint, slid.c.id == last_change)))
        .where(added.c.id == added.c.identity_id, added.c.id <= moments.c.moment, ~removed)
        .where(added.c.obj_type != _ROBOT)
        .subquery(name)
    )


def _last_change(tables: SpatialTables, added: FromClause, box: FromClause, moments: Subquery) -> ColumnElement[int]:
    """Return the id of the last change of the joint that slides a box."""
    change, moved = tables.joint_change.alias(), tables.object.alias()
    return (
        select(func.max(change.c.id))
        .join_from(change, moved, _same(moved, change, moved.c.id == change.c.object_id))
        .where(_same(moved, added, moved.c.identity_id == added.c.id))
        .where(change.c.joint == box.c.joint, change.c.id <= moments.c.moment)
        .scalar_subquery()
    )


def _same(one: FromClause, other: FromClause, condition: ColumnElement[bool]) -> ColumnElement[bool]:
    """Return the condition of a join within an episode."""
    return and_(condition, one.c[EPISODE] == other.c[EPISODE])


def _rotation(pose: FromClause) -> list[list[ColumnElement[float]]]:
    x, y, z, w = (pose.c[f"q{axis}"] for axis in "xyzw")
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def _boxes() -> Subquery:
    """Return the boxes of all links, with their model: the fingerprint of a description, or a built-in one."""
    built_in, described = _built_in().subquery("built_in"), _described().subquery("described")
    return union_all(select(*built_in.c), select(*described.c)).subquery("box")


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


class _SqlText(TextClause):
    """A select given as SQL for each database."""

    inherit_cache = False

    def __init__(self, sqlite: str, postgresql: str) -> None:
        super().__init__(sqlite)
        self.sqlite = sqlite
        self.postgresql = postgresql


@compiles(_SqlText)
def _of_sqlite(element: _SqlText, _compiler: Any, **_options: Any) -> str:
    return element.sqlite


@compiles(_SqlText, "postgresql")
def _of_postgresql(element: _SqlText, _compiler: Any, **_options: Any) -> str:
    return element.postgresql


def _described() -> TextualSelect:
    """Return the boxes of the recorded descriptions, from `DescriptionDeclared.link_boxes`.

    The only link of a description has no name here, as that of a built-in model.
    """
    parts = [f"{name}[{at}]" for name in ("center", "half", "axis") for at in range(3)]
    sqlite = ", ".join(
        f"CAST(coalesce(json_extract(each.value, '$.{part}'), 0) AS REAL) AS {column}"
        for part, column in zip(parts, _NUMBERS, strict=True)
    )
    postgresql = ", ".join(
        f"CAST(coalesce(each.value -> '{part[:-3]}' ->> {part[-2]}, '0') AS double precision) AS {column}"
        for part, column in zip(parts, _NUMBERS, strict=True)
    )
    text = _SqlText(
        f"""SELECT declaration.fingerprint AS model,
 CASE WHEN json_array_length(declaration.payload, '$.link_boxes') > 1 THEN json_extract(each.value, '$.link') END
 AS link, json_extract(each.value, '$.joint') AS joint, {sqlite}
 FROM pycrorm_declaration AS declaration, json_each(declaration.payload, '$.link_boxes') AS each
 WHERE {_IS_DESCRIPTION} AND json_extract(each.value, '$.link') NOT LIKE '%_handle'""",  # noqa: S608  constants
        f"""SELECT declaration.fingerprint AS model,
 CASE WHEN json_array_length(CAST(declaration.payload AS json) -> 'link_boxes') > 1 THEN each.value ->> 'link' END
 AS link, each.value ->> 'joint' AS joint, {postgresql}
 FROM pycrorm_declaration AS declaration,
 json_array_elements(CAST(declaration.payload AS json) -> 'link_boxes') AS each (value)
 WHERE {_IS_DESCRIPTION} AND each.value ->> 'link' NOT LIKE '%_handle'""",  # noqa: S608  constants
    )
    return text.columns(*(column(name, Text()) for name in _TEXTS), *(column(name, Double()) for name in _NUMBERS))
