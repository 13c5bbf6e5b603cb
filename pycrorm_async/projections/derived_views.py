"""Define the views that compute: pick-ups with context, root failures, spatial relations, concepts.

**Spatial relation view.** Define `spatial_relation`: the objects on, in or next to which each picked up or placed
object was.

The moment is the start of a pick-up, and the end of a placing. A relation is computed from the poses at that moment and
from the boxes of the recorded descriptions, link by link. An object of version 0.1.0 has no description; it has the
boxes of the built-in model of its type, and an environment those of its name. A drawer is where its joint had it; links
that turn, such as doors, have no box. A box is turned with its object and then replaced by the box along the axes of
the map around it. With the box A around the picked up or placed object and another object's box B:

    on       the bottom of A is within `ON_M` of the top of B, and the centre of A is above B
    in       the centre of A is in B
    next to  neither, their horizontal gap is at most `NEXT_TO_M`, and their heights overlap; not for environments
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Final, Protocol, Self, TypeVar

import sqlalchemy as sa
from sqlalchemy import text
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.sql.selectable import NamedFromClause
from sqlalchemy.types import TypeEngine

from pycrorm_async.events.concepts import CONCEPT_OF_OBJECT_TYPE, CONCEPTS, ancestors
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.projections.columns import EPISODE, LINK_BOX
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import ObjectType

#
# Define `PickUpWithContextView`: every pick-up with the poses of robot and object, which the thesis learns from (5.2).
#
# The view selects from the tables and not from the public views, because each of those excludes simulations separately;
# here the node is checked once. PostgreSQL cannot estimate how many rows such a check leaves, and with one for each
# table it read all pick-ups where the latest 2,000 were wanted.
#
# Poses and objects are joined as outer joins (see the section "joins").

_POSE = "x y z qx qy qz qw"
_SLOT_BITS: Final = SLOT_MAX.bit_length()
_NUMBER_BITS: Final = SEQUENCE_MAX.bit_length() + _SLOT_BITS


def _planner_hint(fact: sa.ColumnElement[bool]) -> sa.ColumnElement[bool]:
    """Return a condition that always holds, rendered for PostgreSQL only: the dtypes of the nodes with such a row.

    Without it PostgreSQL read all succeeded nodes, ten times as many, to find the succeeded pick-ups; with it, it uses
    the index on the dtype (50,000 pick-ups in a good half of the time). It then underestimates the pick-ups by a factor
    of ten, and reads and sorts all of them for the latest few. SQLite starts with the rows of the type anyway.
    """
    return PerDatabase(sa.literal_column("1", sa.Boolean()), postgresql=fact)


class TablesByName(Protocol):
    """Protocol of the tables behind the views (`views.Tables`)."""

    def __getitem__(self, name: str) -> sa.Table: ...


def pick_ups_with_context(
    tables: TablesByName, picked: sa.FromClause, dtypes: Sequence[str]
) -> sa.Select[*tuple[Any, ...]]:
    """Return the view's query. A node, its designator and its leaf row have the same id, so they join without a key
    column. `dtypes` are all dtypes that a node with a row in `picked` may have."""
    node, object_, episode = tables["task_tree_node"], tables["object"], tables["process_metadata"]
    robot, place = tables["pose"].alias("robot"), tables["pose"].alias("there")
    stands, lies = numbers(robot, _POSE), numbers(place, _POSE)

    def of_episode(value: sa.ColumnElement[Any]) -> sa.ScalarSelect[Any]:
        # A subquery, which costs nothing where the column is not selected.
        return sa.select(value).where(episode.c.id == node.c.process_metadata_id).scalar_subquery()

    seen = dict(zip(_POSE.split(), _seen_from(lies, stands), strict=True))
    in_world = world_line(tables, episode.c.id)  # of an episode that has not ended, or was LOST
    world = sa.func.coalesce(episode.c.world, episode.c.entered_world, in_world)

    return (
        sa.select(
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
            *(each.label(f"object_{name}") for name, each in seen.items()),  # the names until the next release
            (lies.z - stands.z - node.c.torso_height).label("height_over_torso"),
            node.c.robot,
            of_episode(episode.c.description).label("description"),
            of_episode(world).label("scene"),
            _policy(node).label("policy"),
            event_of(node.c.id).label("sequence"),
            *(each.label(f"robot_in_object_{name}") for name, each in seen.items()),
        )
        .select_from(picked)
        .join(node, same_episode(node, picked, node.c.id == picked.c.id))
        .outerjoin(robot, same_episode(robot, node, robot.c.id == node.c.robot_pose_id))
        .outerjoin(object_, same_episode(object_, picked, object_.c.id == picked.c.object_designator_id))
        .outerjoin(place, same_episode(place, object_, place.c.id == object_.c.pose_id))
        .where(_planner_hint(node.c.dtype.in_(dtypes)), present(robot), present(place))
    )


def _policy(node: sa.Table) -> sa.ScalarSelect[Any]:
    """Return the policy that the node around the pick-up names, or else the node around that.

    These are a `MoveAndPickUpAction`, and a `BatchRolloutAction`, which alone names it in episodes of version 0.1.0.
    """
    tried, batch = node.alias("tried"), node.alias("batch")
    named = [member(parameters_of(each), "policy") for each in (tried, batch)]
    return (
        sa.select(sa.func.coalesce(*named))
        .select_from(tried)
        .outerjoin(batch, same_episode(batch, tried, batch.c.id == tried.c.parent_id))
        .where(same_episode(tried, node, tried.c.id == node.c.parent_id))
        .scalar_subquery()
    )


def _seen_from(place: Any, robot: Any) -> Iterator[sa.ColumnElement[Any]]:
    """Yield position (m) and orientation of the robot in the object's frame, in arithmetic that every database has."""
    dx, dy, dz = robot.x - place.x, robot.y - place.y, robot.z - place.z
    x, y, z, w = place.qx, place.qy, place.qz, place.qw
    # The rows of the transposed rotation matrix.
    yield (1 - 2 * (y * y + z * z)) * dx + 2 * (x * y + z * w) * dy + 2 * (x * z - y * w) * dz
    yield 2 * (x * y - z * w) * dx + (1 - 2 * (x * x + z * z)) * dy + 2 * (y * z + x * w) * dz
    yield 2 * (x * z + y * w) * dx + 2 * (y * z - x * w) * dy + (1 - 2 * (x * x + y * y)) * dz
    # The conjugate of the object's quaternion times the robot's.
    yield w * robot.qx - x * robot.qw - y * robot.qz + z * robot.qy
    yield w * robot.qy + x * robot.qz - y * robot.qw - z * robot.qx
    yield w * robot.qz - x * robot.qy + y * robot.qx - z * robot.qw
    yield w * robot.qw + x * robot.qx + y * robot.qy + z * robot.qz


# === joins ====================================================================================================
#
# Join the rows of one episode by id.
#
# All tables have the episode's column in common, so from inner joins PostgreSQL concludes that it can join a row with
# all rows of its episode before the row that names one of them. Without statistics it does, and 100 pick-ups took half
# a minute. An outer join follows the rows that its condition names, unless a filter on one of its columns makes it an
# inner join.


def same_episode(one: sa.FromClause, other: sa.FromClause, condition: sa.ColumnElement[bool]) -> sa.ColumnElement[bool]:
    """Return the condition of a join within an episode."""
    return sa.and_(condition, one.c[EPISODE] == other.c[EPISODE])


def failure_part(tables: TablesByName, name: str) -> sa.ColumnElement[Any]:
    """Return `failure_message` or `failure_arguments` of a node, which the row of another node may have."""
    nodes = tables["task_tree_node"]
    whole = nodes.alias("whole")
    of_other = sa.select(whole.c[name]).where(same_episode(whole, nodes, whole.c.id == nodes.c.failure_node_id))
    return sa.case((nodes.c.failure_node_id.is_(None), nodes.c[name]), else_=of_other.scalar_subquery()).label(name)


def present(row: sa.FromClause) -> sa.ColumnElement[bool]:
    """Return the condition that an outer join has a row. From IS NOT NULL PostgreSQL would make it an inner join."""
    return sa.func.coalesce(row.c.id, 0) > 0


def numbers(row: sa.FromClause, names: str) -> Any:
    """Return columns of an outer join's row that is `present`, as attributes.

    On PostgreSQL a filter on one of them does not make the join an inner join.
    """
    columns = {name: row.c[name] for name in names.split()}
    return SimpleNamespace(
        **{name: PerDatabase(each, postgresql=sa.func.coalesce(each, 0.0)) for name, each in columns.items()}
    )


# === portable expressions =====================================================================================
#
# Define expressions that each database writes in its own way.

T = TypeVar("T")


class PerDatabase(sa.ColumnElement[T]):
    """An expression with a form of its own on PostgreSQL."""

    inherit_cache = False

    def __init__(self, sqlite: sa.ColumnElement[T], postgresql: sa.ColumnElement[T]) -> None:
        self.type = sqlite.type
        self.sqlite = sqlite
        self.postgresql = postgresql

    def self_group(self, against: Any = None) -> Self:  # noqa: ARG002  SQLAlchemy's signature
        return self


@compiles(PerDatabase)
def _on_sqlite(element: PerDatabase[Any], compiler: Any, **options: Any) -> str:
    return str(compiler.process(element.sqlite, **options))


@compiles(PerDatabase, "postgresql")
def _on_postgresql(element: PerDatabase[Any], compiler: Any, **options: Any) -> str:
    return str(compiler.process(element.postgresql, **options))


def sql_of(type_: Any, sqlite: str, postgresql: str) -> PerDatabase[Any]:
    """Return an expression of this type that is given as SQL for each database."""
    return PerDatabase(sa.literal_column(sqlite, type_), sa.literal_column(postgresql, type_))


class _Member(FunctionElement[str]):
    """A member of a JSON object stored as text: a string as text, an object or a list as JSON."""

    name = "json_member"
    type = sa.Text()
    inherit_cache = True


@compiles(_Member)
def _of_text(element: _Member, compiler: Any, **options: Any) -> str:
    document, name = (compiler.process(each, **options) for each in element.clauses)
    return f"CAST(json_extract({document}, {name}) AS text)"  # a number would stay one


@compiles(_Member, "postgresql")
def _of_json(element: _Member, compiler: Any, **options: Any) -> str:
    document, path = (compiler.process(each, **options) for each in element.clauses)
    return f"({document}::json ->> {path.replace('$.', '')})"


def member(document: sa.ColumnElement[Any], name: str) -> sa.ColumnElement[str]:
    """Return the member of this name of a document of JSON, as text; NULL if the document has none."""
    assert name.isidentifier(), name
    return _Member(document, sa.literal_column(f"'$.{name}'"))


_STARTED_BY: Final = (
    f"event.episode = ({{row}}.id >> {_NUMBER_BITS}) AND event.sequence = ({{row}}.id >> {_SLOT_BITS}) & {SEQUENCE_MAX}"
)
_POSE_OF: Final = '"pose_of":'
_PARAMETERS_SQLITE: Final = f"""(SELECT CASE WHEN json_valid(payload) AND instr(payload, '{_POSE_OF}') THEN (
 SELECT json_group_object(part.key, json(coalesce((
   SELECT CASE WHEN json_valid(named.payload)
     THEN named.payload -> ('$.parameters."' || json_extract(part.value, '$.field') || '"') END FROM event AS named
   WHERE named.episode = event.episode
    AND named.sequence = CASE WHEN part.type = 'object' THEN json_extract(part.value, '$.pose_of') END),
  CASE WHEN part.type = 'object' THEN part.value ELSE event.payload -> part.fullkey END)))
  FROM json_each(event.payload, '$.parameters') AS part)
 WHEN json_valid(payload) THEN json_extract(payload, '$.parameters') END
 FROM event WHERE {_STARTED_BY})"""  # noqa: S608
_PARAMETERS_POSTGRESQL: Final = f"""(SELECT CASE WHEN payload NOT LIKE '{{{{%}}}}' THEN NULL
 WHEN strpos(payload, '{_POSE_OF}') > 0 THEN (
  SELECT '{{{{' || string_agg(CAST(to_json(part.key) AS text) || ':' || CAST(coalesce((
    SELECT CAST(named.payload AS json) -> 'parameters' -> (part.value ->> 'field') FROM event AS named
    WHERE named.episode = event.episode AND named.sequence =
     CASE WHEN (part.value ->> 'pose_of') ~ '^[0-9]{{{{1,9}}}}$' THEN CAST(part.value ->> 'pose_of' AS bigint) END),
   part.value) AS text), ',') || '}}}}' FROM json_each(CAST(event.payload AS json) -> 'parameters') AS part
   WHERE part.key || '' = part.key)
 ELSE CAST(CAST(payload AS json) -> 'parameters' AS text) END
 FROM event WHERE {_STARTED_BY})"""  # noqa: S608
"""The parameters of the node in `row`, as recorded, with the poses that they name in other events; null where the event
is damaged. Their key has one place in all versions of the event.

The last condition always holds. Without it PostgreSQL expects 100 parameters a node, so that next to their lookups the
scan of a whole table costs nothing: it read all nodes of 4,000 episodes to find the failures of one.
"""


def parameters_of(nodes: NamedFromClause) -> sa.ColumnElement[str]:
    """Return the recorded parameters of nodes as JSON, read from the log by one lookup a node.

    A table of the nodes would repeat what the log and the tables of their types have: a seventh of a memory's size.
    """
    recorded = sql_of(
        sa.Text(), *(each.format(row=nodes.name) for each in (_PARAMETERS_SQLITE, _PARAMETERS_POSTGRESQL))
    )
    return sa.func.coalesce(recorded, "{}")


def event_of(row: sa.ColumnElement[int]) -> sa.ColumnElement[int]:
    """Return the sequence of the event in the id of a row."""
    return row.bitwise_rshift(SLOT_MAX.bit_length()).bitwise_and(SEQUENCE_MAX)


def absent(number: sa.ColumnElement[int], key: sa.ColumnElement[int]) -> sa.ColumnElement[bool]:
    """Return the condition that a number is not in a table of keys, evaluated by one index lookup for each row.

    With 20,000 simulations in the table, a query for one episode and a query for all pick-ups take as long as without
    any. PostgreSQL evaluates NOT IN by listing all simulations first, which takes 10 to 80 ms, and NOT EXISTS by one
    more join for each view in a query. SQLite uses the index for NOT IN and is slower with any other form.
    """
    looked_up = sa.select(key).where(key == number).scalar_subquery()
    return PerDatabase(sqlite=number.not_in(sa.select(key)), postgresql=looked_up.is_(None))


# === world line ===============================================================================================
#
# Compose the line that describes the world of an episode whose end did not describe it.
#
# `EpisodeEnded` describes the world that was entered inside an episode. An episode that runs, that is LOST, or that
# version 0.1.0 recorded has no such description, but its log has the objects. An event at the entry could only describe
# an empty world, because objects are added afterwards.

OBJECTS_MAX = 1_000
"""Bounds the objects in the line, because an episode may add any number."""


def world_line(tables: TablesByName, episode: sa.ColumnElement[int]) -> sa.ColumnElement[str]:
    """Return name and type of the objects in the world of the episode, such as `pr2 (ROBOT), milk (MILK)`.

    If the world was left, of those that were in it; null if there were none.
    """
    objects, removals = tables["object"], tables["object_removal"]
    removed = sa.exists().where(
        removals.c.identity_id == objects.c.id, removals.c.process_metadata_id == objects.c.process_metadata_id
    )
    first, present = sa.func.min(objects.c.id), sa.func.min(sa.case((removed, 1), else_=0)) == 0
    listed = (
        sa.select((objects.c.name + " (" + objects.c.obj_type + ")").label("object"), present.label("present"))
        .where(objects.c.process_metadata_id == episode, objects.c.identity_id == objects.c.id)
        .group_by(objects.c.name, objects.c.obj_type)
        .order_by(present.desc(), first)
        .limit(OBJECTS_MAX)
        .correlate(episode.table)
        .subquery("listed")
    )
    names = sa.func.aggregate_strings(listed.c.object, ", ")
    line = sa.func.coalesce(names.filter(listed.c.present), names)
    return sa.select(line).select_from(listed).correlate(episode.table).scalar_subquery()


# === concept views ============================================================================================
#
# Define the views of the ontology: `concept`, `concept_ancestor` and `object_concept`.
#
# Their rows are facts of `events.concepts` and the same in every memory, so they are constants of the views and need no
# table, fold or rebuild.


def _concepts() -> sa.TextualSelect:
    parents = (
        (name, parent, each.source) for name, each in sorted(CONCEPTS.items()) for parent in each.parents or (None,)
    )
    return constants({"name": sa.Text(), "parent": sa.Text(), "source": sa.Text()}, parents)


def _ancestors() -> sa.TextualSelect:
    pairs = ((name, ancestor) for name in sorted(CONCEPTS) for ancestor in ancestors(name))
    return constants({"concept": sa.Text(), "ancestor": sa.Text()}, pairs)


def _of_objects() -> sa.TextualSelect:
    return constants({"obj_type": sa.Text(), "concept": sa.Text()}, sorted(CONCEPT_OF_OBJECT_TYPE.items()))


CONCEPT_VIEWS: Final[dict[str, Callable[[], sa.TextualSelect]]] = {
    "concept": _concepts,
    "concept_ancestor": _ancestors,
    "object_concept": _of_objects,
}
"""The functions that make the selects, by name of the view."""


# === constants ================================================================================================
#
# Write rows of constants as a select, for views that join facts of the program with the tables.
#
# It is text, because composing hundreds of constants would take a tenth of a second in each process.


def constants(columns: Mapping[str, TypeEngine[Any]], rows: Iterable[Iterable[str | float | None]]) -> sa.TextualSelect:
    """Return a select of these rows; texts must be plain words, all other columns are numbers."""
    values = ", ".join(f"({', '.join(map(_literal, row))})" for row in rows)
    shown = ", ".join(  # both databases call the columns of VALUES column1, column2 …
        f"CAST(column{place} AS {'TEXT' if isinstance(kind, sa.Text) else 'DOUBLE PRECISION'}) AS {name}"
        for place, (name, kind) in enumerate(columns.items(), 1)
    )
    selected = text(f"SELECT {shown} FROM (VALUES {values}) AS facts")  # noqa: S608  constants of the program
    return selected.columns(*(sa.column(name, kind) for name, kind in columns.items()))


def _literal(value: str | float | None) -> str:
    if isinstance(value, str):
        assert not {"'", ":", "\\"} & {*value}, value
        return f"'{value}'"
    return "NULL" if value is None else repr(value)


# === root failure view ========================================================================================
#
# Define `root_failure`: every failed node without a failed child, which is where a failure began.
#
# Path, object, arm and outcome are found by climbing from the failed node to the root, one lookup by primary key
# for each ancestor. A query that does not select them does not climb: both databases compute only the columns they
# need. The object and the arm are those of the nearest node that has such a parameter, because a motion that failed
# often has neither while the action around it has both. They are read from the recorded parameters of these nodes in
# the log, since a lookup in the leaf tables would need one subquery for every type of a memory.

_FAILED = (TaskStatus.FAILED.name, TaskStatus.ERROR.name)

_CLIMB = """WITH RECURSIVE up(id, parent_id, path, status, depth) AS (
 SELECT {node}.id, {node}.parent_id, coalesce({node}.dtype, {node}.kind), {node}.status, 0
 UNION ALL
 SELECT above.id, above.parent_id, coalesce(above.dtype, above.kind) || ' > ' || up.path, above.status, up.depth + 1
 FROM up {above})"""
_PATH = f"({_CLIMB} SELECT path FROM up ORDER BY depth DESC LIMIT 1)"  # noqa: S608  constants only, also below
_STARTED = """WITH RECURSIVE up(id, parent_id, parameters, depth) AS (
 SELECT {node}.id, {node}.parent_id, {of_node}, 0
 UNION ALL
 SELECT above.id, above.parent_id, {of_above}, up.depth + 1 FROM up {above})
 SELECT {value} FROM up"""
_NEAREST = "ORDER BY up.depth LIMIT 1"
_ABOVE_SQLITE = "JOIN {node} AS above ON above.id = up.parent_id"
"""The id alone. For a second condition on `above`, SQLite would first read all nodes of the memory into a filter."""
_ABOVE_POSTGRESQL = f"""CROSS JOIN LATERAL (
 SELECT * FROM {{node}} AS one WHERE one.id = up.parent_id AND one.{EPISODE} = {{node}}.{EPISODE} OFFSET 0) AS above"""  # noqa: S608
"""OFFSET 0 keeps the lookup of each step apart. Without statistics PostgreSQL would join the steps with all nodes of
the episode, and 4,500 failures took minutes instead of a second."""
_FIRST_ID = f"((up.id >> {_NUMBER_BITS}) << {_NUMBER_BITS})"
"""The id of the episode's row 0; an object's row has this id plus its sequence in the place of a sequence."""
_OBJECT_ROW = f"""SELECT name FROM {{object}} AS moved
 WHERE moved.{EPISODE} = {{node}}.{EPISODE} AND moved.id = {_FIRST_ID}"""  # noqa: S608

_ARM_SQLITE = "CAST(coalesce(json_extract(up.parameters, '$.arm'), json_extract(up.parameters, '$.gripper')) AS text)"
_ARM_POSTGRESQL = "coalesce(CAST(up.parameters AS json) ->> 'arm', CAST(up.parameters AS json) ->> 'gripper')"
_OBJECT_SQLITE = f"""CASE WHEN json_extract(field.value, '$.object') IS NULL
 THEN CAST(json_extract(field.value, '$.name') AS text)
 ELSE ({_OBJECT_ROW} + (json_extract(field.value, '$.row') << {_SLOT_BITS})) END"""
_OBJECT_POSTGRESQL = f"""CASE WHEN field.value ->> 'object' IS NULL THEN field.value ->> 'name'
 ELSE ({_OBJECT_ROW} + (CAST(field.value ->> 'row' AS bigint) << {_SLOT_BITS})) END"""
_FIELDS_SQLITE = """json_each(up.parameters) AS field WHERE field.type = 'object' AND (
 (json_extract(field.value, '$.object') IS NOT NULL AND json_type(field.value, '$.row') = 'integer')
 OR (json_extract(field.value, '$.dtype') IS NOT NULL AND json_extract(field.value, '$.name') IS NOT NULL))"""
_FIELDS_POSTGRESQL = """json_each(CAST(up.parameters AS json)) AS field WHERE
 json_typeof(field.value) = 'object' AND (
 (field.value ->> 'object' IS NOT NULL AND field.value ->> 'row' ~ '^[0-9]+$')
 OR (field.value ->> 'dtype' IS NOT NULL AND field.value ->> 'name' IS NOT NULL))"""


def root_failures(tables: TablesByName) -> sa.Select[*tuple[Any, ...]]:
    """Return the view's query."""
    nodes, objects = tables["task_tree_node"], tables["object"]
    child = nodes.alias("child")
    failed_child = sa.exists(
        sa.select(sa.literal_column("1")).where(
            child.c.parent_id == nodes.c.id,
            child.c[EPISODE] == nodes.c[EPISODE],
            child.c.status.in_(_FAILED),
        )
    )

    def sql(text: str, above: str = "", **named: str) -> str:
        return text.format(node=nodes.name, object=objects.name, above=above.format(node=nodes.name), **named)

    def climbing(text: str) -> tuple[str, str]:
        return sql(text, _ABOVE_SQLITE), sql(text, _ABOVE_POSTGRESQL)

    def nearest(value: str, condition: str, above: str, parameters: str) -> str:
        of = {"of_node": parameters.format(row=nodes.name), "of_above": parameters.format(row="above")}
        return f"({sql(_STARTED, above, value=sql(value), **of)} {condition} {_NEAREST})"

    def nearest_on_each(sqlite: tuple[str, str], postgresql: tuple[str, str]) -> sa.ColumnElement[str]:
        return sql_of(
            sa.Text(),
            nearest(*sqlite, _ABOVE_SQLITE, _PARAMETERS_SQLITE),
            nearest(*postgresql, _ABOVE_POSTGRESQL, _PARAMETERS_POSTGRESQL),
        )

    object_ = nearest_on_each((_OBJECT_SQLITE, f", {_FIELDS_SQLITE}"), (_OBJECT_POSTGRESQL, f", {_FIELDS_POSTGRESQL}"))
    arm = nearest_on_each(
        (_ARM_SQLITE, f"WHERE {_ARM_SQLITE} IS NOT NULL"), (_ARM_POSTGRESQL, f"WHERE {_ARM_POSTGRESQL} IS NOT NULL")
    )
    return sa.select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.dtype,
        nodes.c.status,
        sql_of(sa.Text(), *climbing(_PATH)).label("path"),
        object_.label("object"),
        arm.label("arm"),
        nodes.c.reason,
        failure_part(tables, "failure_message").label("message"),
        (outcome_of(nodes) == RECOVERED).label("recovered"),
        nodes.c.start_time,
        event_of(nodes.c.id).label("sequence"),
        outcome_of(nodes).label("outcome"),
    ).where(nodes.c.status.in_(_FAILED), ~failed_child)


# === failure outcomes =========================================================================================
#
# Decide how a plan went on after a node had failed. Every reader takes the answer from here, by the column `outcome` of
# `root_failure` and `task_tree_node`.
#
# From the failed node up to the first node around it that succeeded, the first of these that holds is the outcome:
#
#     recovered   a later node of the same type, with the same object, succeeded below the same parent; or the node that
#                 succeeded is a retry, a fallback or a choice of alternatives of the plan language
#     tolerated   it is another expression of the plan language, whose rule lets a part of it fail
#     ignored     it is an action or the plan itself: nothing was tried again
#     open        no node has succeeded yet, and one still runs
#     failed      no node around it succeeded
#
# A node without an object must have the same parameters, except arms and grasps. Below an expression that failed, a
# later success recovers nothing: a `Repeat` of which one round failed has failed because of it.

RECOVERED: Final = "recovered"
OUTCOMES: Final = (RECOVERED, "tolerated", "ignored", "failed", "open")
"""The outcomes of a failure."""
_LATER_MAX = 50
"""Bounds the later successes of its type that are compared with a failed node, because a plan may have any number."""
_OFFERS = ("retry", "fallback", "selector", "alternative")
"""Parts of the names of expressions that try something else; as is one whose name begins with `try`."""
_OFFERS_SQLITE = " OR ".join(
    ["lower(substr(up.dtype, 1, 3)) = 'try'", *(f"instr(lower(up.dtype), '{each}') > 0" for each in _OFFERS)]
)
_OFFERS_POSTGRESQL = f"up.dtype ~* '^try|{'|'.join(_OFFERS)}'"
_ABOUT_SQLITE = f"""coalesce(CASE WHEN instr(substr(up.parameters, 2), '{{') THEN (SELECT
  group_concat(coalesce(json_extract(field.value, '$.object'), json_extract(field.value, '$.name')))
  FROM {_FIELDS_SQLITE}) END,
 CASE WHEN instr(up.parameters, '"object') THEN coalesce(json_extract(up.parameters, '$.object'),
  json_extract(up.parameters, '$.object_'), json_extract(up.parameters, '$.object_name')) END,
 CASE WHEN instr(up.parameters, '"time_ns"') THEN (
  SELECT group_concat(part.fullkey || part.atom) FROM json_tree(up.parameters) AS part
  WHERE part.atom IS NOT NULL AND part.key NOT IN ('arm', 'gripper', 'grasp', 'time_ns'))
 ELSE json_remove(up.parameters, '$.arm', '$.gripper', '$.grasp') END, '')"""  # noqa: S608
_ABOUT_POSTGRESQL = f"""coalesce(CASE WHEN strpos(substr(up.parameters, 2), '{{') > 0 THEN (
  SELECT string_agg(coalesce(field.value ->> 'object', field.value ->> 'name'), ',') FROM {_FIELDS_POSTGRESQL}) END,
 CASE WHEN strpos(up.parameters, '"object') > 0 THEN coalesce(CAST(up.parameters AS json) ->> 'object',
  CAST(up.parameters AS json) ->> 'object_', CAST(up.parameters AS json) ->> 'object_name') END,
 regexp_replace(up.parameters, '"(arm|gripper|grasp|time_ns)":("[^"]*"|[0-9-]+),?', '', 'g'), '')"""  # noqa: S608
"""The objects of a node, or else its parameters without those by which a second try may differ."""
_SUCCEEDED = TaskStatus.SUCCEEDED.name
_FAILED_SQL = ", ".join(f"'{each}'" for each in _FAILED)
_AGAIN = f"""up.status IN ({_FAILED_SQL}) AND up.kind <> 'language' AND EXISTS (SELECT 1 FROM (
 SELECT later.id, later.parent_id, {{of_later}} AS parameters FROM {{node}} AS later
 WHERE later.{EPISODE} = {{node}}.{EPISODE} AND {{later_dtype}} = up.dtype AND later.status = '{_SUCCEEDED}'
  AND later.id > {_FIRST_ID} + (CAST(up.end_sequence AS bigint) << {_SLOT_BITS}) AND later.id < (
   SELECT CASE WHEN within.kind <> 'language' OR within.status NOT IN ({_FAILED_SQL})
    THEN {_FIRST_ID} + (CAST(coalesce(within.end_sequence, {SEQUENCE_MAX}) AS bigint) << {_SLOT_BITS}) END
   FROM {{node}} AS within WHERE within.id = up.parent_id AND within.{EPISODE} = {{node}}.{EPISODE})
 ORDER BY later.id LIMIT {_LATER_MAX}) AS later
 WHERE {{later_about}} = up.about AND up.parent_id IN (WITH RECURSIVE around(id, parent_id) AS (
  SELECT later.id, later.parent_id UNION ALL SELECT above.id, above.parent_id FROM around {{around}})
  SELECT around.parent_id FROM around))"""  # noqa: S608
_UP = "id, parent_id, kind, dtype, status, end_sequence"
_COMPARED = f"CASE WHEN {{row}}.status IN ({_FAILED_SQL}) AND {{row}}.kind <> 'language' THEN {{parameters}} END"
"""The parameters of the nodes that a later one is compared with; those of others are not read."""
_OUTCOME = f"""CASE WHEN {{node}}.status IN ({_FAILED_SQL}) THEN coalesce((
 WITH RECURSIVE up({_UP}, parameters, depth) AS (
  SELECT {", ".join(f"{{node}}.{each}" for each in _UP.split(", "))}, {{of_node}}, 0 UNION ALL
  SELECT {", ".join(f"above.{each}" for each in _UP.split(", "))}, {{of_above}}, up.depth + 1 FROM up {{above}}
  WHERE up.status <> '{_SUCCEEDED}')
 SELECT judged.outcome FROM (SELECT up.depth, CASE
   WHEN up.status = '{_SUCCEEDED}' AND up.kind <> 'language' THEN 'ignored'
   WHEN up.status = '{_SUCCEEDED}' AND ({{offers}}) THEN '{RECOVERED}'
   WHEN up.status = '{_SUCCEEDED}' THEN 'tolerated' WHEN up.status = '{TaskStatus.RUNNING.name}' THEN 'open'
   WHEN {_AGAIN} THEN '{RECOVERED}' END AS outcome
  FROM (SELECT up.*, {{about}} AS about FROM (SELECT * FROM up ORDER BY depth) AS up) AS up) AS judged
 WHERE judged.outcome IS NOT NULL ORDER BY judged.depth LIMIT 1), 'failed') END"""  # noqa: S608


def outcome_of(nodes: sa.Table) -> sa.ColumnElement[str]:
    """Return the outcome of a node that FAILED or ended in ERROR, one of `OUTCOMES`; null for any other node.

    On PostgreSQL no index fits the expression of a later node's type, so that later nodes are read in their order by
    id up to the limit. By the index on the type it would sort all of them for each failure. The ancestors are in order
    before one is judged, so that it judges none above the decisive one and does not estimate the outcome so costly that
    reading all nodes would not count beside it.
    """

    def sql(above: str, about: str, offers: str, later_dtype: str, parameters: str) -> str:
        joined = above.format(node=nodes.name)
        rows = {"of_node": nodes.name, "of_above": "above"}
        of = {name: _COMPARED.format(row=row, parameters=parameters.format(row=row)) for name, row in rows.items()}
        later = {"later_about": about.replace("up.", "later."), "later_dtype": later_dtype}
        later["of_later"] = parameters.format(row="later")
        ways = {"above": joined, "around": joined.replace("up.", "around."), "offers": offers}
        return _OUTCOME.format(node=nodes.name, about=about, **later, **of, **ways)

    return sql_of(
        sa.Text(),
        sql(_ABOVE_SQLITE, _ABOUT_SQLITE, _OFFERS_SQLITE, "later.dtype", _PARAMETERS_SQLITE),
        sql(_ABOVE_POSTGRESQL, _ABOUT_POSTGRESQL, _OFFERS_POSTGRESQL, "later.dtype || ''", _PARAMETERS_POSTGRESQL),
    )


# === spatial relation view ====================================================================================

ON_M = 0.02
"""The largest distance between a bottom and a top that counts as contact, m: poses of placings differ by less."""
NEXT_TO_M = 0.1
"""The largest horizontal gap between neighbours, m: about as wide as a hand between them."""

_ENVIRONMENT, _ROBOT = ObjectType.ENVIRONMENT.name, ObjectType.ROBOT.name
_AXES = ("x", "y", "z")
_TEXTS = ("model", "link", "joint")
_NUMBERS = [f"{letter}{axis}" for letter in "cha" for axis in _AXES]
"""A box: its center, half of its edges, and the direction in which its joint slides it."""


def spatial_relations(
    tables: TablesByName, picked: sa.FromClause, placed: sa.FromClause, *, simulated: bool
) -> sa.Select[Any]:
    """Return the view's query; `picked` and `placed` are the rows of pick-ups and placings."""
    moments = _moments(tables, picked, placed, simulated=simulated)
    boxes = _boxes(tables[LINK_BOX])
    # The second select continues the first. PostgreSQL would compute two that are joined by their nodes once a node.
    one = _placed_boxes(tables, moments, _around(boxes), same=True)
    both = _placed_boxes(tables, one, boxes, same=False).c
    gaps = [sa.func.abs(both[f"one_c{axis}"] - both[f"other_c{axis}"]) - both[f"other_h{axis}"] for axis in _AXES]
    within = [gap <= 0 for gap in gaps]
    bottom, top = both.one_cz - both.one_hz, both.other_cz + both.other_hz
    apart = [
        sa.case((gap > both[f"one_h{axis}"], gap - both[f"one_h{axis}"]), else_=0.0)
        for gap, axis in zip(gaps, _AXES, strict=True)
    ]
    gap_squared = apart[0] * apart[0] + apart[1] * apart[1]
    near = sa.and_(gap_squared <= NEXT_TO_M**2, apart[2] <= 0, both.other_obj_type != _ENVIRONMENT)
    relation = sa.case(
        (sa.and_(sa.func.abs(bottom - top) <= ON_M, within[0], within[1]), "on"),
        (sa.and_(*within), "in"),
        (near, "next to"),
    )
    related = sa.select(
        both.node_id,
        both.process_metadata_id,
        both.one_id.label("object_id"),
        both.one_name.label("object"),
        sa.cast(relation, sa.Text()).label("relation"),
        both.other_id,
        both.other_name.label("other"),
        both.other_link.label("link"),
        event_of(both.node_id).label("sequence"),
    ).subquery("related")
    return sa.select(*related.c).where(related.c.relation.is_not(None))


def _moments(tables: TablesByName, picked: sa.FromClause, placed: sa.FromClause, *, simulated: bool) -> sa.Subquery:
    """Return nodes with the identity of their object and the id of a row made from the event at their moment."""
    node, target = tables["task_tree_node"], tables["object"].alias("target")
    first_id = node.c.id.bitwise_rshift(_NUMBER_BITS).bitwise_lshift(_NUMBER_BITS)
    ended = first_id + node.c.end_sequence.bitwise_lshift(_SLOT_BITS)
    return sa.union_all(
        *(
            sa.select(
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


def _placed_boxes(tables: TablesByName, moments: sa.Subquery, boxes: sa.Subquery, *, same: bool) -> sa.Subquery:
    """Return the moments with the boxes in the map: of the picked up or placed object itself, or of all others."""
    name = "one" if same else "other"
    added, then, later = (tables["object"].alias(f"{name}_{each}") for each in ("added", "then", "later"))
    removal, pose = tables["object_removal"].alias(), tables["pose"].alias()
    box = boxes.alias(f"{name}_box")
    last = (
        sa.select(sa.func.max(later.c.id))
        .where(same_episode(later, added, later.c.identity_id == added.c.id))
        .where(later.c.dtype == "Object", later.c.id <= moments.c.moment)
        .scalar_subquery()
    )
    removed = sa.exists(
        sa.select(sa.literal(1))
        .where(same_episode(removal, added, removal.c.identity_id == added.c.id))
        .where(removal.c.id <= moments.c.moment)
    )
    # Joined, because SQLite would compute a subquery in the columns once for each use of a column.
    slid = tables["joint_change"].alias(f"{name}_slid")
    last_change = _last_change(tables, added, box, moments)
    centre = [box.c[f"c{axis}"] + box.c[f"a{axis}"] * sa.func.coalesce(slid.c.position, 0.0) for axis in _AXES]
    rotation = _rotation(pose)
    columns: list[sa.ColumnElement[Any]] = []
    for axis, row in zip(_AXES, rotation, strict=True):
        along = row[0] * centre[0] + row[1] * centre[1] + row[2] * centre[2]
        half = sum(
            (sa.func.abs(row[each]) * box.c[f"h{_AXES[each]}"] for each in (1, 2)), sa.func.abs(row[0]) * box.c.hx
        )
        columns += [(pose.c[axis] + along).label(f"{name}_c{axis}"), half.label(f"{name}_h{axis}")]
    built_in = sa.case((added.c.obj_type == _ENVIRONMENT, added.c.name), else_=added.c.obj_type)
    is_one = added.c.id == moments.c.identity_id
    return (
        sa.select(
            *moments.c,
            then.c.id.label(f"{name}_id"),
            then.c.name.label(f"{name}_name"),
            then.c.obj_type.label(f"{name}_obj_type"),
            sa.func.coalesce(box.c.link, then.c.name).label(f"{name}_link"),
            *columns,
        )
        .select_from(moments)
        .join(added, same_episode(added, moments, is_one if same else ~is_one))
        .outerjoin(then, same_episode(then, moments, then.c.id == last))
        .outerjoin(pose, same_episode(pose, then, pose.c.id == then.c.pose_id))
        .join(box, box.c.model == sa.func.coalesce(added.c.description_fingerprint, built_in))
        .outerjoin(slid, same_episode(slid, moments, sa.and_(slid.c.joint == box.c.joint, slid.c.id == last_change)))
        .where(added.c.id == added.c.identity_id, added.c.id <= moments.c.moment, ~removed)
        .where(added.c.obj_type != _ROBOT, present(pose))
        .subquery(name)
    )


def _last_change(
    tables: TablesByName, added: sa.FromClause, box: sa.FromClause, moments: sa.Subquery
) -> sa.ColumnElement[int]:
    """Return the id of the last change of the joint that slides a box."""
    change, moved = tables["joint_change"].alias(), tables["object"].alias()
    return (
        sa.select(sa.func.max(change.c.id))
        .join_from(change, moved, same_episode(moved, change, moved.c.id == change.c.object_id))
        .where(same_episode(moved, added, moved.c.identity_id == added.c.id))
        .where(change.c.joint == box.c.joint, change.c.id <= moments.c.moment)
        .scalar_subquery()
    )


def _rotation(pose: sa.FromClause) -> list[list[sa.ColumnElement[float]]]:
    x, y, z, w = (pose.c[f"q{axis}"] for axis in "xyzw")
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def _boxes(described: sa.Table) -> sa.Subquery:
    """Return the boxes of all links, with their model: the fingerprint of a description, or a built-in one."""
    built_in = _built_in().subquery("built_in")
    return sa.union_all(sa.select(*built_in.c), sa.select(*(described.c[each.name] for each in built_in.c))).subquery(
        "box"
    )


def _around(boxes: sa.Subquery) -> sa.Subquery:
    """Return one box for each model, around those of its links."""
    low = {axis: sa.func.min(boxes.c[f"c{axis}"] - boxes.c[f"h{axis}"]) for axis in _AXES}
    high = {axis: sa.func.max(boxes.c[f"c{axis}"] + boxes.c[f"h{axis}"]) for axis in _AXES}
    columns: list[sa.ColumnElement[Any]] = [((low[axis] + high[axis]) / 2).label(f"c{axis}") for axis in _AXES]
    columns += [((high[axis] - low[axis]) / 2).label(f"h{axis}") for axis in _AXES]
    columns += [sa.literal(0.0).label(f"a{axis}") for axis in _AXES]
    nothing = sa.cast(sa.null(), sa.Text())
    around = sa.select(boxes.c.model, nothing.label("link"), nothing.label("joint"), *columns).group_by(boxes.c.model)
    return around.subquery("around")


@lru_cache(maxsize=1)
def _built_in() -> sa.TextualSelect:
    kinds: dict[str, TypeEngine[Any]] = {name: sa.Text() for name in _TEXTS} | {name: sa.Double() for name in _NUMBERS}
    return constants(kinds, _built_in_rows())


def _built_in_rows() -> Iterator[tuple[str | float | None, ...]]:
    from pycrorm_async.world.model_boxes import link_boxes  # with numpy, which only the creation of views needs
    from pycrorm_async.world.models import built_in_model, built_in_urdf

    for kind in ObjectType:
        if kind not in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
            for box in link_boxes(built_in_urdf("any", kind)):
                yield kind.name, None, None, *box.center, *box.half, *box.axis
    for box in link_boxes(built_in_model("kitchen")):
        if not box.link.endswith("_handle"):
            yield "kitchen", box.link, box.joint, *box.center, *box.half, *box.axis
