"""Define the public views: the selects over a generation's tables that queries and mapped classes read.

Most views select their table unchanged. `designator`, `action`, `motion`, `language` and `robot_state` select from
`task_tree_node`, `position` and `quaternion` from `pose`; a leaf's view unites the tables of its descendants.

The views exclude simulations, so that every reader sees only real episodes. `session_views` replaces them, for
one connection, by views of the same names that include simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self, TypeAlias

from sqlalchemy import (
    Boolean,
    Column,
    ColumnElement,
    Double,
    Select,
    Table,
    Text,
    TextualSelect,
    and_,
    case,
    cast,
    column,
    func,
    literal_column,
    not_,
    null,
    or_,
    select,
    table,
    union_all,
)
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.sql.selectable import CompoundSelect

from pycrorm_async.events.codec import DESCRIPTION_PREFIX
from pycrorm_async.events.fields import table_name
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.projections.schema.core_columns import CORE, EPISODE, LINK_BOX, OF_NO_EPISODE, OWN
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.projections.schema.tables import column_type, columns_in_order, leaf_columns, make_table
from pycrorm_async.projections.schema.views.concept_views import concept_views
from pycrorm_async.projections.schema.views.pick_up_view import pick_ups_with_context
from pycrorm_async.projections.schema.views.root_failure_view import root_failures
from pycrorm_async.projections.schema.views.spatial_relation_view import SpatialTables, spatial_relations
from pycrorm_async.projections.schema.views.world_line import world_line
from pycrorm_async.world.enums import ObjectType

__all__ = ["public_views", "projection_views", "View"]

View: TypeAlias = Select[Any] | CompoundSelect[Any] | TextualSelect
_Cut: TypeAlias = Callable[[dict[str, Table], Layout], Select[Any]]

_UNITED_MAX = 400
"""Bounds the selects in one UNION, because SQLite allows 500. More are united in groups."""

_PICKED = "pick_up_action"
_PLACED = "place_action"
_OF_PICK_UPS = ("task_tree_node", "object", "object_removal", "pose", "process_metadata")
_OF_RELATIONS = ("task_tree_node", "object", "object_removal", "pose", "joint_change")
"""The tables of `PickUpWithContextView` and of `spatial_relation`."""

_declaration = table("pycrorm_declaration", column("fingerprint"), column("payload"))
_is_description = func.substr(_declaration.c.fingerprint, 1, len(DESCRIPTION_PREFIX)) == DESCRIPTION_PREFIX


class _Member(FunctionElement[str]):
    """A member of a JSON object stored as text: a string as text, an object or a list as JSON."""

    name = "json_member"
    type = Text()
    inherit_cache = True


@compiles(_Member)
def _of_text(element: _Member, compiler: Any, **options: Any) -> str:
    document, name = (compiler.process(each, **options) for each in element.clauses)
    return f"json_extract({document}, {name})"


@compiles(_Member, "postgresql")
def _of_json(element: _Member, compiler: Any, **options: Any) -> str:
    document, path = (compiler.process(each, **options) for each in element.clauses)
    return f"({document}::json ->> {path.replace('$.', '')})"


def _member(document: ColumnElement[Any], name: str) -> ColumnElement[str]:
    return _Member(document, literal_column(f"'$.{name}'"))


class _Absent(ColumnElement[bool]):
    """The condition that a number is not in a table of keys, evaluated by one index lookup for each row.

    With 20,000 simulations in the table, a query for one episode and a query for all pick-ups take as long as without
    any. PostgreSQL evaluates NOT IN by listing all simulations first, which takes 10 to 80 ms, and NOT EXISTS by one
    more join for each view in a query. SQLite uses the index for NOT IN and is slower with any other form.
    """

    inherit_cache = False
    type = Boolean()

    def __init__(self, number: ColumnElement[int], key: ColumnElement[int]) -> None:
        self.listed = number.not_in(select(key))
        self.looked_up = select(key).where(key == number).scalar_subquery().is_(None)

    def self_group(self, against: Any = None) -> Self:  # noqa: ARG002  SQLAlchemy's signature
        return self


@compiles(_Absent)
def _not_in(element: _Absent, compiler: Any, **options: Any) -> str:
    return str(compiler.process(element.listed, **options))


@compiles(_Absent, "postgresql")
def _is_null(element: _Absent, compiler: Any, **options: Any) -> str:
    return str(compiler.process(element.looked_up, **options))


def public_views(
    layout: Layout, generation: int, stored: Callable[[str], str], *, simulated: bool = False
) -> dict[str, View]:
    """Return name and select of every view in front of this generation, except users' views.

    Args:
        layout, generation: of the tables behind the views.
        stored: maps a column to its name in this database.
        simulated: the views include simulations.
    """
    core = {name: make_table(name, columns, generation, stored) for name, columns in CORE.items()}
    simulations = core.pop("simulated_episode")

    def shown(view: Select[Any], rows: Table) -> Select[Any]:
        return view if simulated else view.where(_happened(rows, simulations))

    views: dict[str, View] = {
        name: shown(select(*columns_in_order(each), *_sequence(each)), each) for name, each in core.items()
    }
    views |= {name: shown(make(core, layout), core[home]) for name, (home, make) in _CUT.items()}
    leaves = {
        name: make_table(name, leaf_columns(columns), generation, stored) for name, columns in layout.leaves.items()
    }
    views |= {name: _leaf(name, layout, leaves, shown) for name in layout.leaves}
    if _PICKED in layout.leaves:
        node, object_, removal, pose, episode = (core[name] for name in _OF_PICK_UPS)
        picked = _leaf(_PICKED, layout, leaves, lambda view, _: view).subquery("picked")
        view = pick_ups_with_context(picked, node, object_, removal, pose, episode, layout.dtypes(_PICKED))
        views["PickUpWithContextView"] = shown(view, node)
        if _PLACED in layout.leaves:
            placed = _leaf(_PLACED, layout, leaves, lambda view, _: view).subquery("placed")
            link_box = make_table(LINK_BOX, OF_NO_EPISODE[LINK_BOX], generation, stored)
            tables = SpatialTables(*(core[name] for name in _OF_RELATIONS))
            views["spatial_relation"] = spatial_relations(tables, link_box, picked, placed, simulated=simulated)
    views["designator_type"] = _designator_type(layout)
    views["object_description"] = select(_declaration).where(_is_description)
    return {**views, **concept_views()}


def projection_views(
    layout: Layout, number: int, generation: int, stored: Callable[[str], str], *, simulated: bool = False
) -> dict[str, View]:
    """Return the views of a custom projection.

    `number` is the generation of its own tables, `generation` that of the built-in tables.
    """
    simulations = make_table("simulated_episode", CORE["simulated_episode"], generation, stored)
    views: dict[str, View] = {}
    for name, columns in layout.leaves.items():
        rows = make_table(name, leaf_columns(columns), number, stored)
        view = select(*map(_labelled, columns_in_order(rows)))
        views[name.removeprefix(OWN)] = view if simulated else view.where(_happened(rows, simulations))
    return views


def _happened(rows: Table, simulations: Table) -> ColumnElement[bool]:
    """Return the condition that a row does not belong to a simulation."""
    if "simulated" in rows.c:
        return ~rows.c.simulated
    return _Absent(rows.c[EPISODE], simulations.c.id)


def _process_metadata(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    episodes = core["process_metadata"]
    line = world_line(core["object"], core["object_removal"], episodes.c.id)
    world = func.coalesce(episodes.c.world, episodes.c.entered_world, line).label("world")
    columns = columns_in_order(episodes)
    first, *others = (world if each.name == "world" else each for each in columns if each.name != "entered_world")
    return select(first, *others)


def _episode_tag(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    """Return the tags that episodes have now: those whose last change added them."""
    changes = core["episode_tagging"]
    later = changes.alias("later")
    is_later = and_(
        later.c.process_metadata_id == changes.c.process_metadata_id,
        later.c.tag == changes.c.tag,
        or_(later.c.id > changes.c.id, and_(later.c.id == changes.c.id, later.c.position > changes.c.position)),
    )
    columns = changes.c.id, changes.c.process_metadata_id, changes.c.tag, changes.c.time
    return select(*columns).where(changes.c.added, not_(select(later.c.id).where(is_later).exists()))


def _episode_robot(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    """Return the robots of episodes, each once, however often it was added: with the row of the first time."""
    rows = core["object"]
    robot = rows.c.process_metadata_id, rows.c.name, rows.c.model, rows.c.serial, rows.c.description_fingerprint
    first = func.min(rows.c.id)
    robots = select(first.label("id"), *robot, _event_of(first).label("sequence")).group_by(*robot)
    return robots.where(rows.c.obj_type == ObjectType.ROBOT.name, rows.c.id == rows.c.identity_id)


def _designator_type(layout: Layout) -> View:
    """Return the view of declarations. It never parses one that is not JSON, whichever column a query reads."""
    payload: ColumnElement[Any] = _declaration.c.payload
    if layout.unreadable:
        unreadable = _declaration.c.fingerprint.in_(layout.unreadable)
        payload = case((unreadable, "{}"), else_=payload)

    def member(name: str) -> ColumnElement[Any]:
        return _member(payload, name)

    view = select(
        _declaration.c.fingerprint,
        member("dtype").label("dtype"),
        member("kind").label("kind"),
        member("table").label("leaf"),
        member("concept").label("concept"),
        func.coalesce(member("fields"), "[]").label("fields"),
    )
    view = view.where(~_is_description)
    return view.where(~unreadable) if layout.unreadable else view


def _task_tree_node(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    nodes = core["task_tree_node"]
    action_id = case((nodes.c.dtype.is_not(None), nodes.c.id), else_=null())
    columns = (each for each in columns_in_order(nodes) if each.key != "parameters")
    return select(*columns, *_sequence(nodes), action_id.label("action_id"), _duration(nodes))


def _sequence(rows: Table) -> tuple[ColumnElement[Any], ...]:
    """Return the column `sequence` of rows that have an id: the sequence of their event."""
    return (_event_of(rows.c.id).label("sequence"),) if "id" in rows.c else ()


def _event_of(row: ColumnElement[int]) -> ColumnElement[int]:
    return row.bitwise_rshift(SLOT_MAX.bit_length()).bitwise_and(SEQUENCE_MAX)


def _duration(nodes: Table) -> ColumnElement[Any]:
    """Return the column `duration` (s); null while the node runs, and if it is LOST."""
    return (cast(nodes.c.end_ns - nodes.c.start_ns, Double()) / 1e9).label("duration")


def _course(nodes: Table) -> tuple[ColumnElement[Any], ...]:
    """Return the columns that say when a node was performed, by time and by event, by which robot, for which node, and
    how it ended."""
    times = nodes.c.start_time, nodes.c.end_time, _duration(nodes)
    ended = nodes.c.reason, nodes.c.failure_message, nodes.c.result
    return nodes.c.status, *times, *ended, *_sequence(nodes), nodes.c.end_sequence, nodes.c.robot, nodes.c.parent_id


def _designator(core: dict[str, Table], layout: Layout) -> Select[Any]:
    nodes = core["task_tree_node"]
    robot_state_id = case((nodes.c.robot_pose_id.is_not(None), nodes.c.id), else_=null())
    return select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.dtype,
        nodes.c.kind,
        robot_state_id.label("robot_state_id"),
        func.coalesce(nodes.c.parameters, "{}").label("parameters"),
        _lineage(nodes, layout).label("lineage"),
        *_course(nodes),
    ).where(nodes.c.dtype.is_not(None))


def _lineage(nodes: Table, layout: Layout) -> ColumnElement[str]:
    """Return the lineage of a node's type. Only types with bases or with another table name need their own case."""
    kind = case({"action": " Action", "motion": " Motion", "language": " Language"}, value=nodes.c.kind)
    ordinary: ColumnElement[str] = nodes.c.dtype.concat(kind)
    exceptions = {
        dtype: layout.lineage(dtype)
        for dtype, each in layout.types.items()
        if each.bases or each.tables != (table_name(dtype),)
    } | {dtype: layout.lineage(dtype) for dtype in layout.renamed}
    return case(exceptions, value=nodes.c.dtype, else_=ordinary) if exceptions else ordinary


def _of_kind(kind: str) -> _Cut:
    def view(core: dict[str, Table], _layout: Layout) -> Select[Any]:
        nodes = core["task_tree_node"]
        parameters = func.coalesce(nodes.c.parameters, "{}").label("parameters")
        columns = nodes.c.id, nodes.c.process_metadata_id, nodes.c.dtype, *_course(nodes), parameters
        return select(*columns).where(nodes.c.kind == kind, nodes.c.dtype.is_not(None))

    return view


def _robot_state(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    nodes = core["task_tree_node"]
    return select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.torso_height,
        nodes.c.robot_type.label("type"),
        nodes.c.robot_pose_id.label("pose_id"),
        *_sequence(nodes),
    ).where(nodes.c.robot_pose_id.is_not(None))


def _root_failure(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    return root_failures(core["task_tree_node"], core["object"])


def _pose(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    poses = core["pose"]
    return select(
        *columns_in_order(poses), *_sequence(poses), poses.c.id.label("position_id"), poses.c.id.label("orientation_id")
    )


def _position(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    poses = core["pose"]
    return select(poses.c.id, poses.c.process_metadata_id, poses.c.x, poses.c.y, poses.c.z)


def _quaternion(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    poses = core["pose"]
    parts = (poses.c[f"q{axis}"].label(axis) for axis in "xyzw")
    return select(poses.c.id, poses.c.process_metadata_id, *parts)


_CUT: dict[str, tuple[str, _Cut]] = {
    "process_metadata": ("process_metadata", _process_metadata),
    "episode_tag": ("episode_tagging", _episode_tag),
    "episode_robot": ("object", _episode_robot),
    "task_tree_node": ("task_tree_node", _task_tree_node),
    "designator": ("task_tree_node", _designator),
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


def _leaf(
    name: str,
    layout: Layout,
    leaves: Mapping[str, Table],
    shown: Callable[[Select[Any], Table], Select[Any]],
) -> View:
    """Return the rows of a leaf table and of its members; a column that a member lacks is null."""
    parts = []
    united_columns = layout.columns(name)
    for member in layout.members(name):
        rows = leaves[member]
        columns: list[ColumnElement[Any]] = [rows.c.id]
        for each, storage in united_columns.items():
            same = layout.leaves[member].get(each) == storage
            columns.append(_labelled(rows.c[each]) if same else cast(null(), column_type(storage)).label(each))
        parts.append(shown(select(*columns, rows.c[EPISODE]), rows))
    return _united(parts)


def _united(parts: Sequence[Select[Any]]) -> View:
    """Return the union of these selects, which have the same columns."""
    while len(parts) > _UNITED_MAX:
        groups = [parts[first : first + _UNITED_MAX] for first in range(0, len(parts), _UNITED_MAX)]
        parts = [select(union_all(*each).subquery()) for each in groups]
    return parts[0] if len(parts) == 1 else union_all(*parts)


def _labelled(column: Column[Any]) -> ColumnElement[Any]:
    """Return the column under its name in the view."""
    return column if column.name == column.key else column.label(column.key)
