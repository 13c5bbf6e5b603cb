"""Define `root_failure`: every failed node without a failed child, which is where a failure began.

Path, object, arm and `recovered` are found by climbing from the failed node to the root, one lookup by primary key for
each ancestor. A query that does not select them does not climb: both databases compute only the columns they need. The
object and the arm are those of the nearest node that has such a parameter, because a motion that failed often has
neither while the action around it has both. They are read from the recorded parameters of these nodes, since a lookup
in the leaf tables would need one subquery for every type of a memory.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Boolean, Select, Table, Text, exists, literal_column, select

from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.projections.schema.core_columns import EPISODE
from pycrorm_async.projections.schema.views.portable_expressions import event_of, sql_of
from pycrorm_async.task_status import TaskStatus

_FAILED = (TaskStatus.FAILED.name, TaskStatus.ERROR.name)
_SLOT_BITS = SLOT_MAX.bit_length()
_NUMBER_BITS = SEQUENCE_MAX.bit_length() + _SLOT_BITS

_CLIMB = """WITH RECURSIVE up(id, parent_id, path, status, depth) AS (
 SELECT {node}.id, {node}.parent_id, coalesce({node}.dtype, {node}.kind), {node}.status, 0
 UNION ALL
 SELECT above.id, above.parent_id, coalesce(above.dtype, above.kind) || ' > ' || up.path, above.status, up.depth + 1
 FROM up {above})"""
_PATH = f"({_CLIMB} SELECT path FROM up ORDER BY depth DESC LIMIT 1)"  # noqa: S608  constants only, also below
_RECOVERED = f"EXISTS ({_CLIMB} SELECT 1 FROM up WHERE status = '{TaskStatus.SUCCEEDED.name}')"  # noqa: S608
_STARTED = """WITH RECURSIVE up(id, parent_id, parameters, depth) AS (
 SELECT {node}.id, {node}.parent_id, {node}.parameters, 0
 UNION ALL
 SELECT above.id, above.parent_id, above.parameters, up.depth + 1 FROM up {above})
 SELECT {value} FROM up"""
_NEAREST = "ORDER BY up.depth LIMIT 1"
_ABOVE_SQLITE = f"JOIN {{node}} AS above ON above.id = up.parent_id AND above.{EPISODE} = {{node}}.{EPISODE}"
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
_FIELDS_SQLITE = """, json_each(up.parameters) AS field WHERE field.type = 'object' AND (
 (json_extract(field.value, '$.object') IS NOT NULL AND json_type(field.value, '$.row') = 'integer')
 OR (json_extract(field.value, '$.dtype') IS NOT NULL AND json_extract(field.value, '$.name') IS NOT NULL))"""
_FIELDS_POSTGRESQL = """, json_each(CAST(up.parameters AS json)) AS field WHERE
 json_typeof(field.value) = 'object' AND (
 (field.value ->> 'object' IS NOT NULL AND field.value ->> 'row' ~ '^[0-9]+$')
 OR (field.value ->> 'dtype' IS NOT NULL AND field.value ->> 'name' IS NOT NULL))"""


def root_failures(nodes: Table, objects: Table) -> Select[*tuple[Any, ...]]:
    """Return the view's query."""
    child = nodes.alias("child")
    failed_child = exists(
        select(literal_column("1")).where(
            child.c.parent_id == nodes.c.id,
            child.c[EPISODE] == nodes.c[EPISODE],
            child.c.status.in_(_FAILED),
        )
    )

    def sql(text: str, above: str = "", **named: str) -> str:
        return text.format(node=nodes.name, object=objects.name, above=above.format(node=nodes.name), **named)

    def climbing(text: str) -> tuple[str, str]:
        return sql(text, _ABOVE_SQLITE), sql(text, _ABOVE_POSTGRESQL)

    def nearest(value: str, condition: str, above: str) -> str:
        return f"({sql(_STARTED, above, value=sql(value))} {condition} {_NEAREST})"

    object_ = sql_of(
        Text(),
        nearest(_OBJECT_SQLITE, _FIELDS_SQLITE, _ABOVE_SQLITE),
        nearest(_OBJECT_POSTGRESQL, _FIELDS_POSTGRESQL, _ABOVE_POSTGRESQL),
    )
    arm = sql_of(
        Text(),
        nearest(_ARM_SQLITE, f"WHERE {_ARM_SQLITE} IS NOT NULL", _ABOVE_SQLITE),
        nearest(_ARM_POSTGRESQL, f"WHERE {_ARM_POSTGRESQL} IS NOT NULL", _ABOVE_POSTGRESQL),
    )
    return select(
        nodes.c.id,
        nodes.c.process_metadata_id,
        nodes.c.dtype,
        nodes.c.status,
        sql_of(Text(), *climbing(_PATH)).label("path"),
        object_.label("object"),
        arm.label("arm"),
        nodes.c.reason,
        nodes.c.failure_message.label("message"),
        sql_of(Boolean(), *climbing(_RECOVERED)).label("recovered"),
        nodes.c.start_time,
        nodes.c.end_time,
        event_of(nodes.c.id).label("sequence"),
    ).where(nodes.c.status.in_(_FAILED), ~failed_child)
