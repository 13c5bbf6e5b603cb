"""Define the public views: the selects over a generation's tables that queries and mapped classes read.

Most views select their table unchanged. `designator`, `action`, `motion`, `language` and `robot_state` select from
`task_tree_node`, `position` and `quaternion` from `pose`; a leaf's view unites the tables of its descendants.

The views exclude simulations, so that every reader sees only real episodes. `generations.with_views` replaces them, for
one connection, by views of the same names that include simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import sqlalchemy as sa
from sqlalchemy import column, select, table
from sqlalchemy.sql.selectable import CompoundSelect

from pycrorm_async.events.codec import DESCRIPTION_PREFIX
from pycrorm_async.events.fields import table_name
from pycrorm_async.projections import columns as table_columns
from pycrorm_async.projections import derived_views
from pycrorm_async.world.pose import ObjectType

View: TypeAlias = sa.Select[Any] | CompoundSelect[Any] | sa.TextualSelect
_Columns: TypeAlias = tuple[tuple[str, table_columns.Storage], ...]

_UNITED_MAX = 400
"""Bounds the selects in one UNION, because SQLite allows 500. More are united in groups."""

_FAILURE_PARTS = ("failure_message", "failure_arguments")
_PICKED = "pick_up_action"
_PLACED = "place_action"

_declaration = table("pycrorm_declaration", column("fingerprint"), column("payload"))
_is_description = sa.func.substr(_declaration.c.fingerprint, 1, len(DESCRIPTION_PREFIX)) == DESCRIPTION_PREFIX


@dataclass(frozen=True)
class Tables:
    """The tables behind the views.

    Attributes:
        generation: their number.
        stored: maps a column to its name in this database.
        simulated: the views include simulations.
    """

    generation: int
    stored: Callable[[str], str]
    simulated: bool = False

    def __getitem__(self, name: str) -> sa.Table:
        """Return a table that every memory has."""
        return table_columns.make_table(
            name, table_columns.CORE.get(name) or table_columns.OF_NO_EPISODE[name], self.generation, self.stored
        )

    def leaf(self, name: str, columns: _Columns) -> sa.Table:
        return table_columns.make_table(name, table_columns.leaf_columns(dict(columns)), self.generation, self.stored)

    def shown(self, view: sa.Select[Any], rows: sa.Table) -> sa.Select[Any]:
        """Return the view without the rows of simulations, unless these views include them."""
        return view if self.simulated else view.where(_happened(rows, self["simulated_episode"]))


class _Leaf(NamedTuple):
    """The facts of a layout that a leaf's view depends on: its columns, and the tables it unites with theirs."""

    columns: _Columns
    members: tuple[tuple[str, _Columns], ...]

    @classmethod
    def of(cls, name: str, layout: table_columns.Layout) -> _Leaf:
        members = ((each, tuple(layout.leaves[each].items())) for each in layout.members(name))
        return cls(tuple(layout.columns(name).items()), tuple(members))


class ViewDefinition(NamedTuple):
    """The function that makes a view's select, and all the facts of a layout that it depends on.

    Two layouts with the same facts have the same view, so its text is compiled once (`generations`).
    """

    function: Callable[..., View]
    facts: tuple[Hashable, ...] = ()

    def select(self, tables: Tables) -> View:
        return self.function(tables, *self.facts)


def public_views(layout: table_columns.Layout) -> dict[str, ViewDefinition]:
    """Return name and definition of every view of this layout, except users' views."""
    views = {name: ViewDefinition(_whole, (name,)) for name in table_columns.CORE if name != "simulated_episode"}
    views |= {name: ViewDefinition(_cut, (name,)) for name in _CUT}
    views["designator"] = ViewDefinition(_designator, (_unusual_lineages(layout),))
    leaves = {name: _Leaf.of(name, layout) for name in layout.leaves}
    views |= {name: ViewDefinition(_united_rows, (leaf,)) for name, leaf in leaves.items()}
    if _PICKED in leaves:
        dtypes = layout.dtypes(_PICKED)
        views["PickUpWithContextView"] = ViewDefinition(_pick_ups_with_context, (leaves[_PICKED], dtypes))
        if _PLACED in leaves:
            views["spatial_relation"] = ViewDefinition(_spatial_relations, (leaves[_PICKED], leaves[_PLACED]))
    views["designator_type"] = ViewDefinition(_designator_type, (layout.unreadable,))
    views["object_description"] = ViewDefinition(_object_description)
    return {**views, **{name: ViewDefinition(_of_concepts, (name,)) for name in derived_views.CONCEPT_VIEWS}}


def projection_views(layout: table_columns.Layout, number: int, tables: Tables) -> dict[str, View]:
    """Return the views of a custom projection. `number` is the generation of its tables, `tables` are the built-in."""
    views: dict[str, View] = {}
    for name, columns in layout.leaves.items():
        rows = table_columns.make_table(name, table_columns.leaf_columns(columns), number, tables.stored)
        views[name.removeprefix(table_columns.OWN)] = tables.shown(
            select(*map(_labelled, table_columns.columns_in_order(rows))), rows
        )
    return views


def _whole(tables: Tables, name: str) -> View:
    """Return the view that shows a table unchanged."""
    rows = tables[name]
    return tables.shown(select(*table_columns.columns_in_order(rows), *_sequence(rows)), rows)


def _cut(tables: Tables, name: str) -> View:
    home, function = _CUT[name]
    return tables.shown(function(tables), tables[home])


def _pick_ups_with_context(tables: Tables, picked: _Leaf, dtypes: tuple[str, ...]) -> View:
    rows = _with_simulations(tables, picked).subquery("picked")
    return tables.shown(derived_views.pick_ups_with_context(tables, rows, dtypes), tables["task_tree_node"])


def _spatial_relations(tables: Tables, picked: _Leaf, placed: _Leaf) -> View:
    rows = [_with_simulations(tables, each).subquery(name) for each, name in ((picked, "picked"), (placed, "placed"))]
    return derived_views.spatial_relations(tables, *rows, simulated=tables.simulated)


def _with_simulations(tables: Tables, leaf: _Leaf) -> View:
    return _united_rows(replace(tables, simulated=True), leaf)


def _object_description(_tables: Tables) -> View:
    return select(_declaration).where(_is_description)


def _of_concepts(_tables: Tables, name: str) -> View:
    return derived_views.CONCEPT_VIEWS[name]()


def _happened(rows: sa.Table, simulations: sa.Table) -> sa.ColumnElement[bool]:
    """Return the condition that a row does not belong to a simulation."""
    if rows.info[table_columns.MARKED]:
        return ~rows.c.simulated
    return derived_views.absent(rows.c[table_columns.EPISODE], simulations.c.id)


def _process_metadata(tables: Tables) -> sa.Select[Any]:
    episodes = tables["process_metadata"]
    world = sa.func.coalesce(
        episodes.c.world, episodes.c.entered_world, derived_views.world_line(tables, episodes.c.id)
    ).label("world")
    columns = table_columns.columns_in_order(episodes)
    first, *others = (world if each.name == "world" else each for each in columns if each.name != "entered_world")
    return select(first, *others, _end(episodes.c.created_at, episodes).label("ended_at"), _duration_s(episodes))


def _episode_tag(tables: Tables) -> sa.Select[Any]:
    """Return the tags that episodes have now: those whose last change added them."""
    changes = tables["episode_tagging"]
    later = changes.alias("later")
    is_later = sa.and_(
        later.c.process_metadata_id == changes.c.process_metadata_id,
        later.c.tag == changes.c.tag,
        sa.or_(later.c.id > changes.c.id, sa.and_(later.c.id == changes.c.id, later.c.position > changes.c.position)),
    )
    columns = changes.c.id, changes.c.process_metadata_id, changes.c.tag, changes.c.time
    return select(*columns, *_sequence(changes)).where(
        changes.c.added, sa.not_(select(later.c.id).where(is_later).exists())
    )


def _episode_robot(tables: Tables) -> sa.Select[Any]:
    """Return the robots of episodes, each once, however often it was added: with the row of the first time."""
    rows = tables["object"]
    robot = rows.c.process_metadata_id, rows.c.name, rows.c.model, rows.c.serial, rows.c.description_fingerprint
    first = sa.func.min(rows.c.id)
    robots = select(first.label("id"), *robot, derived_views.event_of(first).label("sequence")).group_by(*robot)
    return robots.where(rows.c.obj_type == ObjectType.ROBOT.name, rows.c.id == rows.c.identity_id)


def _designator_type(_tables: Tables, unreadable_declarations: tuple[str, ...]) -> View:
    """Return the view of declarations. It never parses one that is not JSON, whichever column a query reads."""
    payload: sa.ColumnElement[Any] = _declaration.c.payload
    if unreadable_declarations:
        unreadable = _declaration.c.fingerprint.in_(unreadable_declarations)
        payload = sa.case((unreadable, "{}"), else_=payload)

    def of_payload(name: str) -> sa.ColumnElement[Any]:
        return derived_views.member(payload, name)

    view = select(
        _declaration.c.fingerprint,
        of_payload("dtype").label("dtype"),
        of_payload("kind").label("kind"),
        of_payload("table").label("leaf"),
        of_payload("concept").label("concept"),
        sa.func.coalesce(of_payload("fields"), "[]").label("fields"),
    )
    view = view.where(~_is_description)
    return view.where(~unreadable) if unreadable_declarations else view


def _task_tree_node(tables: Tables) -> sa.Select[Any]:
    nodes = tables["task_tree_node"]
    action_id = sa.case((nodes.c.dtype.is_not(None), nodes.c.id), else_=sa.null())
    outcome = derived_views.outcome_of(nodes).label("outcome")
    columns = (
        derived_views.failure_part(tables, each.key) if each.key in _FAILURE_PARTS else each
        for each in table_columns.columns_in_order(nodes)
        if each.key != "failure_node_id"
    )
    return select(*columns, *_sequence(nodes), action_id.label("action_id"), *_end_and_durations(nodes), outcome)


def _sequence(rows: sa.Table) -> tuple[sa.ColumnElement[Any], ...]:
    """Return the column `sequence` of rows: the sequence of the event in the id that their key begins with."""
    first, *_ = rows.primary_key.columns
    return (derived_views.event_of(first).label("sequence"),)


def _duration_s(rows: sa.Table) -> sa.ColumnElement[Any]:
    """Return the column `duration_s` by the monotonic clock; null without an end: while it runs, and of a LOST node."""
    return (sa.cast(rows.c.end_ns - rows.c.start_ns, sa.Double()) / 1e9).label("duration_s")


def _end(start: sa.ColumnElement[int], rows: sa.Table) -> sa.ColumnElement[int]:
    """Return the end in µs: the start and the duration, because the wall clock may be set between the two."""
    return start + (rows.c.end_ns - rows.c.start_ns) // 1000


def _end_and_durations(nodes: sa.Table) -> tuple[sa.ColumnElement[Any], ...]:
    """Return the columns of the end of a node; `duration` is the former name of `duration_s`."""
    duration = _duration_s(nodes)
    return _end(nodes.c.start_time, nodes).label("end_time"), duration, duration.element.label("duration")


def _course(tables: Tables) -> tuple[sa.ColumnElement[Any], ...]:
    """Return the columns of a node's course: start and end by time and by event, robot, parent, and outcome."""
    nodes = tables["task_tree_node"]
    times = nodes.c.start_time, *_end_and_durations(nodes)
    ended = nodes.c.reason, derived_views.failure_part(tables, "failure_message"), nodes.c.result
    return nodes.c.status, *times, *ended, *_sequence(nodes), nodes.c.end_sequence, nodes.c.robot, nodes.c.parent_id


def _designator(tables: Tables, unusual_lineages: tuple[tuple[str, str], ...]) -> View:
    nodes = tables["task_tree_node"]
    robot_state_id = sa.case((nodes.c.robot_pose_id.is_not(None), nodes.c.id), else_=sa.null())
    kind = sa.case({"action": " Action", "motion": " Motion", "language": " Language"}, value=nodes.c.kind)
    lineage: sa.ColumnElement[str] = nodes.c.dtype.concat(kind)
    if unusual_lineages:
        lineage = sa.case(dict(unusual_lineages), value=nodes.c.dtype, else_=lineage)
    view = select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.dtype,
        nodes.c.kind,
        robot_state_id.label("robot_state_id"),
        derived_views.parameters_of(nodes).label("parameters"),
        lineage.label("lineage"),
        *_course(tables),
    ).where(nodes.c.dtype.is_not(None))
    return tables.shown(view, nodes)


def _unusual_lineages(layout: table_columns.Layout) -> tuple[tuple[str, str], ...]:
    """Return the lineages of the types with bases or with another table name, and of former names."""
    unusual = (dtype for dtype, each in layout.types.items() if each.bases or each.tables != (table_name(dtype),))
    return tuple((dtype, layout.lineage(dtype)) for dtype in dict.fromkeys((*unusual, *layout.renamed)))


def _of_kind(kind: str) -> Callable[[Tables], sa.Select[Any]]:
    def view(tables: Tables) -> sa.Select[Any]:
        nodes = tables["task_tree_node"]
        columns = (
            nodes.c.id,
            nodes.c.process_metadata_id,
            nodes.c.dtype,
            *_course(tables),
            derived_views.parameters_of(nodes).label("parameters"),
        )
        return select(*columns).where(nodes.c.kind == kind, nodes.c.dtype.is_not(None))

    return view


def _robot_state(tables: Tables) -> sa.Select[Any]:
    nodes = tables["task_tree_node"]
    return select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.torso_height,
        nodes.c.robot_type.label("type"),
        nodes.c.robot_pose_id.label("pose_id"),
        *_sequence(nodes),
    ).where(nodes.c.robot_pose_id.is_not(None))


def _root_failure(tables: Tables) -> sa.Select[Any]:
    nodes = tables["task_tree_node"]
    return derived_views.root_failures(tables).add_columns(
        _end(nodes.c.start_time, nodes).label("end_time"), _duration_s(nodes)
    )


def _pose(tables: Tables) -> sa.Select[Any]:
    poses = tables["pose"]
    return select(
        *table_columns.columns_in_order(poses),
        *_sequence(poses),
        poses.c.id.label("position_id"),
        poses.c.id.label("orientation_id"),
    )


def _position(tables: Tables) -> sa.Select[Any]:
    poses = tables["pose"]
    return select(poses.c.id, poses.c.process_metadata_id, poses.c.x, poses.c.y, poses.c.z)


def _quaternion(tables: Tables) -> sa.Select[Any]:
    poses = tables["pose"]
    parts = (poses.c[f"q{axis}"].label(axis) for axis in "xyzw")
    return select(poses.c.id, poses.c.process_metadata_id, *parts)


_CUT: dict[str, tuple[str, Callable[[Tables], sa.Select[Any]]]] = {
    "process_metadata": ("process_metadata", _process_metadata),
    "episode_tag": ("episode_tagging", _episode_tag),
    "episode_robot": ("object", _episode_robot),
    "task_tree_node": ("task_tree_node", _task_tree_node),
    "action": ("task_tree_node", _of_kind("action")),
    "motion": ("task_tree_node", _of_kind("motion")),
    "language": ("task_tree_node", _of_kind("language")),
    "robot_state": ("task_tree_node", _robot_state),
    "root_failure": ("task_tree_node", _root_failure),
    "pose": ("pose", _pose),
    "position": ("pose", _position),
    "quaternion": ("pose", _quaternion),
}
"""Views that differ from their table: by name, the table their rows come from and the function that selects them."""


def _united_rows(tables: Tables, leaf: _Leaf) -> View:
    """Return the rows of a leaf table and of its members; a column that a member lacks is null."""
    parts = []
    for member_name, member_columns in leaf.members:
        rows, own = tables.leaf(member_name, member_columns), dict(member_columns)
        columns: list[sa.ColumnElement[Any]] = [rows.c.id]
        for each, storage in leaf.columns:
            same = own.get(each) == storage
            columns.append(
                _labelled(rows.c[each]) if same else sa.cast(sa.null(), table_columns.column_type(storage)).label(each)
            )
        columns += [rows.c[table_columns.EPISODE]]
        if all(name != "sequence" for name, _ in leaf.columns):
            columns += _sequence(rows)
        parts.append(tables.shown(select(*columns), rows))
    return _united(parts)


def _united(parts: Sequence[sa.Select[Any]]) -> View:
    """Return the union of these selects, which have the same columns."""
    while len(parts) > _UNITED_MAX:
        groups = [parts[first : first + _UNITED_MAX] for first in range(0, len(parts), _UNITED_MAX)]
        parts = [select(sa.union_all(*each).subquery()) for each in groups]
    return parts[0] if len(parts) == 1 else sa.union_all(*parts)


def _labelled(column: sa.Column[Any]) -> sa.ColumnElement[Any]:
    """Return the column under its name in the view."""
    return column if column.name == column.key else column.label(column.key)
