"""The views in front of a generation's tables: what people and the mapped classes read under a table's own name.

Most show their table as it is. `designator`, `action`, `motion`, `language` and `robot_state` are cut from
`task_tree_node`, `position` and `quaternion` from `pose`; a leaf's view unites the tables of its descendants.

They show what really happened, whoever reads them and with whatever; what was only thought through is left out. Who
asks for that too (`query.thoughts`) gets views of the same names that leave out nothing, for one connection.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self, TypeAlias

from sqlalchemy import (
    Boolean,
    Column,
    ColumnElement,
    Select,
    Table,
    Text,
    case,
    cast,
    column,
    func,
    literal_column,
    null,
    select,
    table,
    union_all,
)
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.sql.selectable import CompoundSelect

from pycrorm_async.events.fields import table_name
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.projections.schema.pick_up_view import pick_ups_with_context
from pycrorm_async.projections.schema.tables import CORE, OWN, column_type, make_table

__all__ = ["public_views", "own_views", "View"]

View: TypeAlias = Select[Any] | CompoundSelect[Any]
_Cut: TypeAlias = Callable[[dict[str, Table], Layout], Select[Any]]

_NUMBER_BITS = SEQUENCE_MAX.bit_length() + SLOT_MAX.bit_length()
"""So many bits of a row's id are below the episode's number."""

_UNITED_MAX = 400
"""Selects in one UNION: SQLite takes 500. More are united in groups, which both databases read as one UNION."""

_PICKED = "pick_up_action"

_event = table("event", column("episode"), column("sequence"), column("payload"))
_episode = table("episode", column("number"), column("id"))
_declaration = table("pycrorm_declaration", column("fingerprint"), column("payload"))


class _Member(FunctionElement[str]):
    """A member of a JSON object that is kept as text, as text itself; an object or a list as JSON."""

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
    """Whether a number is not among those of a table that is nothing but a key: one look into it for each row.

    Measured beside 20,000 thoughts, a question for one episode takes as long as without them, and all pick-ups are read
    no slower. To list the thoughts first, which is what PostgreSQL makes of NOT IN, takes it 10 to 80 ms; it is no
    better off with NOT EXISTS, which is one join more for every view a question stands on. SQLite looks into the key by
    itself, and is slower with any other form.
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
    """Name and meaning of every view in front of this generation; users' views not among them.

    Args:
        layout, generation: of the tables behind them.
        stored: gives the names of the tables' columns in this database.
        simulated: they also show what was only thought through.
    """
    core = {name: make_table(name, columns, generation, stored) for name, columns in CORE.items()}
    thoughts = core.pop("simulated_episode")

    def shown(view: Select[Any], rows: Table) -> Select[Any]:
        return view if simulated else view.where(_happened(rows, thoughts))

    views: dict[str, View] = {name: shown(select(each), each) for name, each in core.items()}
    views |= {name: shown(make(core, layout), core[home]) for name, (home, make) in _CUT.items()}
    leaves = {
        name: make_table(name, {"id": "key", **columns}, generation, stored) for name, columns in layout.leaves.items()
    }
    views |= {name: _leaf(name, layout, leaves, shown) for name in layout.leaves}
    if _PICKED in layout.leaves:
        node, thing, pose = (core[name] for name in ("task_tree_node", "object", "pose"))
        picked = _leaf(_PICKED, layout, leaves, lambda view, _: view).subquery("picked")
        view = pick_ups_with_context(picked, node, thing, pose, layout.dtypes(_PICKED))
        views["PickUpWithContextView"] = shown(view, node)
    views["designator_type"] = _designator_type(layout)
    return views


def own_views(
    layout: Layout, number: int, generation: int, stored: Callable[[str], str], *, simulated: bool = False
) -> dict[str, View]:
    """The same for the tables of a projection of its generation `number`; `generation` is that of our tables."""
    thoughts = make_table("simulated_episode", CORE["simulated_episode"], generation, stored)
    views: dict[str, View] = {}
    for name, columns in layout.leaves.items():
        rows = make_table(name, {"id": "key", **columns}, number, stored)
        view = select(*map(_shown, rows.c))
        views[name.removeprefix(OWN)] = view if simulated else view.where(_happened(rows, thoughts))
    return views


def _happened(rows: Table, thoughts: Table) -> ColumnElement[bool]:
    """Whether a row is not of an episode that was only thought through."""
    if "simulated" in rows.c:
        return ~rows.c.simulated
    number = rows.c.process_metadata_id if "process_metadata_id" in rows.c else rows.c.id.bitwise_rshift(_NUMBER_BITS)
    return _Absent(number, thoughts.c.id)


def _process_metadata(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    episodes = core["process_metadata"]
    first, *others = episodes.c
    return select(first, _episode.c.id.label("uuid"), *others).join_from(
        episodes, _episode, _episode.c.number == episodes.c.id
    )


def _designator_type(layout: Layout) -> View:
    """Without what cannot be read as JSON, whichever part of it is asked for."""
    declared: ColumnElement[Any] = _declaration.c.payload
    if layout.unreadable:
        unreadable = _declaration.c.fingerprint.in_(layout.unreadable)
        declared = case((unreadable, "{}"), else_=declared)

    def member(name: str) -> ColumnElement[Any]:
        return _member(declared, name)

    view = select(
        _declaration.c.fingerprint,
        member("dtype").label("dtype"),
        member("kind").label("kind"),
        member("table").label("leaf"),
        member("concept").label("concept"),
        func.coalesce(member("fields"), "[]").label("fields"),
    )
    return view.where(~unreadable) if layout.unreadable else view


def _task_tree_node(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    nodes = core["task_tree_node"]
    action_id = case((nodes.c.dtype.is_not(None), nodes.c.id), else_=null())
    return select(*nodes.c, action_id.label("action_id"))


def _designator(core: dict[str, Table], layout: Layout) -> Select[Any]:
    nodes = core["task_tree_node"]
    started = (
        select(_member(_event.c.payload, "parameters"))
        .where(_event.c.episode == nodes.c.process_metadata_id)
        .where(_event.c.sequence == nodes.c.id.bitwise_rshift(5).bitwise_and(SEQUENCE_MAX))
        .scalar_subquery()
    )
    robot_state_id = case((nodes.c.robot_pose_id.is_not(None), nodes.c.id), else_=null())
    return select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.dtype,
        nodes.c.kind,
        robot_state_id.label("robot_state_id"),
        func.coalesce(started, "{}").label("parameters"),
        _lineage(nodes, layout).label("lineage"),
    ).where(nodes.c.dtype.is_not(None))


def _lineage(nodes: Table, layout: Layout) -> ColumnElement[str]:
    """Only types that descend from recorded ones, or have a table of another name, need an entry of their own."""
    kind = case({"action": " Action", "motion": " Motion", "language": " Language"}, value=nodes.c.kind)
    ordinary: ColumnElement[str] = nodes.c.dtype.concat(kind)
    special = {
        dtype: layout.lineage(dtype)
        for dtype, each in layout.types.items()
        if each.bases or each.tables != (table_name(dtype),)
    } | {dtype: layout.lineage(dtype) for dtype in layout.renamed}
    return case(special, value=nodes.c.dtype, else_=ordinary) if special else ordinary


def _of_kind(kind: str) -> _Cut:
    def view(core: dict[str, Table], _layout: Layout) -> Select[Any]:
        nodes = core["task_tree_node"]
        return select(nodes.c.id).where(nodes.c.kind == kind, nodes.c.dtype.is_not(None))

    return view


def _robot_state(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    nodes = core["task_tree_node"]
    return select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.torso_height,
        nodes.c.robot_type.label("type"),
        nodes.c.robot_pose_id.label("pose_id"),
    ).where(nodes.c.robot_pose_id.is_not(None))


def _pose(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    poses = core["pose"]
    return select(*poses.c, poses.c.id.label("position_id"), poses.c.id.label("orientation_id"))


def _position(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    poses = core["pose"]
    return select(poses.c.id, poses.c.process_metadata_id, poses.c.x, poses.c.y, poses.c.z)


def _quaternion(core: dict[str, Table], _layout: Layout) -> Select[Any]:
    poses = core["pose"]
    parts = (poses.c[f"q{axis}"].label(axis) for axis in "xyzw")
    return select(poses.c.id, poses.c.process_metadata_id, *parts)


_CUT: dict[str, tuple[str, _Cut]] = {
    "process_metadata": ("process_metadata", _process_metadata),
    "task_tree_node": ("task_tree_node", _task_tree_node),
    "designator": ("task_tree_node", _designator),
    "action": ("task_tree_node", _of_kind("action")),
    "motion": ("task_tree_node", _of_kind("motion")),
    "language": ("task_tree_node", _of_kind("language")),
    "robot_state": ("task_tree_node", _robot_state),
    "pose": ("pose", _pose),
    "position": ("pose", _position),
    "quaternion": ("pose", _quaternion),
}
"""Name, the table its rows are from, and how they are cut."""


def _leaf(
    name: str,
    layout: Layout,
    leaves: Mapping[str, Table],
    shown: Callable[[Select[Any], Table], Select[Any]],
) -> View:
    """The rows of a leaf table and of its members, with the columns of its type; what a member lacks is null."""
    parts = []
    together = layout.columns(name)
    for member in layout.members(name):
        rows = leaves[member]
        columns: list[ColumnElement[Any]] = [rows.c.id]
        for each, storage in together.items():
            same = layout.leaves[member].get(each) == storage
            columns.append(_shown(rows.c[each]) if same else cast(null(), column_type(storage)).label(each))
        parts.append(shown(select(*columns), rows))
    return _united(parts)


def _united(parts: Sequence[Select[Any]]) -> View:
    """All rows of these, which have the same columns."""
    while len(parts) > _UNITED_MAX:
        groups = [parts[first : first + _UNITED_MAX] for first in range(0, len(parts), _UNITED_MAX)]
        parts = [select(union_all(*each).subquery()) for each in groups]
    return parts[0] if len(parts) == 1 else union_all(*parts)


def _shown(column: Column[Any]) -> ColumnElement[Any]:
    """A column under the name it has in the view."""
    return column if column.name == column.key else column.label(column.key)
