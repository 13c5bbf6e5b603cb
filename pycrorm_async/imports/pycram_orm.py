"""Import databases of PyCRAM's own ORM, as the thesis describes it: SQLite, or a dump of MariaDB turned into SQLite.

Each row of `ProcessMetaData` is an episode; its rows of `TaskTreeNode` are the nodes, with the parameters of their
designators, the poses and objects that these name, and the state of the robot. A node without a designator (the root of
PyCRAM's tree, `NoOperation`) gives its place to the root of the episode.

| there | here |
|---|---|
| `CREATED`, `RUNNING` | UNKNOWN: a crashed node looks like one that never ran |
| `end_time` null | an end without a time |
| `reason` | the class of the failure |
| `pose_id`, `object_id` of an action | the first field of the type pose, or object, of our type of that name |
| an object | a value with the pose that was stored: that after the plan, not that before the action |
| start and end without a time zone | in the time zone `timezone` of the map file; UTC by default |

An import takes 75 MB for 100,000 nodes of one row of `ProcessMetaData`, because they are given in the order of time.

Facts: PyCRAM at 2024-07, `src/pycram/orm`.
"""

import re
import sqlite3
import sys
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Final
from zoneinfo import ZoneInfo

from pycrorm_async.clock import microseconds_of
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import NodeStatus, ObjectValue, PoseValue, RobotValue
from pycrorm_async.imports import intake as intakes
from pycrorm_async.imports.intake import Intake, IntakeEpisode
from pycrorm_async.imports.spans import NodeSpan, give_spans
from pycrorm_async.record.plan_types import built_in_declaration

_NEEDED: Final = frozenset(
    {"ProcessMetaData", "TaskTreeNode", "Designator", "Pose", "Position", "Quaternion", "Object"}
)
_STATUSES: Final[Mapping[str, NodeStatus]] = {
    "SUCCEEDED": "SUCCEEDED",
    "FAILED": "FAILED",
    "INTERRUPTED": "INTERRUPTED",
}
_DTYPES: Final[Mapping[str, str]] = {"Release": "ReleaseAction"}
"""The types of tables that have another name here."""
_TABLES: Final = {dtype: table for table, dtype in _DTYPES.items()}
_OF_THE_TABLES: Final = frozenset(
    {"id", "process_metadata_id", "dtype", "action_dtype", "motion_dtype", "robot_state_id"}
)
_CLASS: Final = re.compile(r"(\w+)(?:'>)?\W*$")
_PROGRESS_NODES: Final = 1_000


class OrmMap(intakes.MapFile, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings of an import of PyCRAM's ORM.

    Attributes:
        timezone: of the starts and ends of nodes, such as `Europe/Berlin`, in which the robot's computer was.
    """

    timezone: str = "UTC"


def read_pycram_orm(path: Path, settings: OrmMap, intake: Intake) -> None:
    """Give the episodes of a database to the intake. Raises `WrongFormat`."""
    try:
        zone = ZoneInfo(settings.timezone)
    except (KeyError, ValueError, OSError):
        raise CallerError(f"timezone {settings.timezone!r} of the map file is none, such as Europe/Berlin") from None
    if path.is_dir():
        raise intakes.WrongFormat(f"{path} is a folder: name the file of the database")
    try:
        with intakes.opened_database(path) as database:
            database.row_factory = sqlite3.Row
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not tables >= _NEEDED:
                missing = ", ".join(sorted(_NEEDED - tables))
                raise intakes.WrongFormat(f"{path} is no database of PyCRAM's ORM: it has no table {missing}")
            for row in database.execute('SELECT * FROM "ProcessMetaData" ORDER BY id').fetchall():
                _PycramEpisode(database, tables, dict(row), zone, intake).give(path)
    except KeyError as error:
        raise intakes.WrongFormat(f"{path} is no database of PyCRAM's ORM: it has no column {error}") from None
    except intakes.DATABASE_ERRORS as error:
        raise intakes.WrongFormat(f"{path} is no database of PyCRAM's ORM in SQLite: {error}") from None


FORMAT = intakes.ImportFormat(read_pycram_orm, "databases of PyCRAM's ORM (SQLite), as in the thesis", OrmMap)


class _PycramEpisode:
    """Gives the nodes of one row of `ProcessMetaData` to the intake."""

    def __init__(
        self, database: sqlite3.Connection, tables: set[str], row: Mapping[str, Any], zone: ZoneInfo, intake: Intake
    ) -> None:
        self._database, self._tables, self._row, self._zone, self._intake = database, tables, row, zone, intake

    def give(self, path: Path) -> None:
        """Give the episode; one without nodes is left out."""
        spans = list(self._spans())
        if not spans:
            self._intake.left_out("ProcessMetaData", "it has no nodes")
            return
        row = self._row
        identity = "/".join(str(row.get(each)) for each in ("id", "created_at", "created_by", "description"))
        version = {"pycram_version": row["pycram_version"]} if row.get("pycram_version") else {}
        episode = self._intake.episode(
            f"{identity}/{spans[0].start}",
            min(each.start for each in spans),
            description=str(row.get("description") or path.name),
            metadata={"file": path.name, "process_metadata": row["id"], **version},
            created_by=str(row["created_by"]) if row.get("created_by") else None,
        )
        with episode:
            give_spans(episode, spans)
            tops = {each.status for each in spans if each.parent is None}
            episode.ended(tops.pop() if len(tops) == 1 else "UNKNOWN", max(each.end or each.start for each in spans))

    def _spans(self) -> Iterator[NodeSpan]:
        own, without = (self._row["id"],), 'FROM "TaskTreeNode" WHERE process_metadata_id = ?'
        [total] = self._database.execute(f"SELECT count(*) {without}", own).fetchone()
        without += " AND action_id IS NULL"
        parents: dict[Any, Any] = dict(map(tuple, self._database.execute(f"SELECT id, parent_id {without}", own)))
        nodes = self._database.execute(
            "SELECT node.id, node.parent_id, node.action_id, node.start_time, node.end_time, node.status, node.reason,"
            ' d.dtype AS designator FROM "TaskTreeNode" AS node LEFT JOIN "Designator" AS d ON d.id = node.action_id'
            " WHERE node.process_metadata_id = ? AND node.action_id IS NOT NULL ORDER BY node.id",
            own,
        )
        late = self._parameters
        for count, node in enumerate(nodes):
            if count % _PROGRESS_NODES == 0:
                self._intake.progress(count, total)
            start, end = self._ns(node["start_time"]), self._ns(node["end_time"])
            if start is None:
                self._intake.left_out("nodes", "they have no start")
                continue
            name = sys.intern(str(node["designator"]))
            dtype = _DTYPES.get(name, name)
            parent = node["parent_id"]
            for _ in parents:  # above nodes without a designator
                if parent not in parents:
                    break
                parent = parents[parent]
            span = NodeSpan(node["id"], dtype, {}, start, None if end is None else max(end, start), parent)
            span.kind = "motion" if self._has("Motion", node["action_id"]) else "action"
            span.status = _STATUSES.get(str(node["status"]), "UNKNOWN")
            if node["reason"]:
                matched = _CLASS.search(str(node["reason"]))
                span.failure = (matched[1] if matched else str(node["reason"])), str(node["reason"])
            span.late = late
            yield span

    def _ns(self, text: Any) -> int | None:
        """Return a time in ns since 1970; None for none."""
        try:
            moment = datetime.fromisoformat(str(text))
        except ValueError:
            return None
        moment = moment.replace(tzinfo=self._zone) if moment.tzinfo is None else moment
        return microseconds_of(moment) * 1_000

    def _one(self, table: str, id_: Any) -> Mapping[str, Any] | None:
        if id_ is None or table not in self._tables:
            return None
        row = self._database.execute(f'SELECT * FROM "{table}" WHERE id = ?', (id_,)).fetchone()  # noqa: S608  a table
        return None if row is None else dict(row)

    def _has(self, table: str, id_: Any) -> bool:
        return self._one(table, id_) is not None

    def _parameters(self, span: NodeSpan, _episode: IntakeEpisode) -> tuple[dict[str, Any], RobotValue | None]:
        """Return the parameters of a designator, under the names that our type of this name has, and the robot."""
        node = self._one("TaskTreeNode", span.key) or {}
        designator = node.get("action_id")
        row = self._one(_TABLES.get(span.dtype, span.dtype), designator)
        declared = built_in_declaration(span.dtype)
        first = {each.type: each.name for each in reversed(declared.fields)} if declared is not None else {}
        values: dict[str, Any] = {}
        for name, value in (row or {}).items():
            if name in _OF_THE_TABLES or value is None:
                continue
            if name == "pose_id":
                values[first.get("pose", "pose")] = self._pose(value)
            elif name in ("object_id", "part_of"):
                values[first.get("object", "object")] = self._object(value)
            else:
                values[name] = bool(value) if name == "allow_gripper_collision" else value
        return values, self._robot(designator)

    def _pose(self, id_: Any) -> PoseValue | None:
        pose = self._one("Pose", id_)
        position = self._one("Position", pose["position_id"]) if pose is not None else None
        turn = self._one("Quaternion", pose["orientation_id"]) if pose is not None else None
        if pose is None or position is None or turn is None:
            return None
        numbers = [position[each] for each in "xyz"], [turn[each] for each in "xyzw"]
        at, frame = self._ns(pose["time"]) or 0, str(pose["frame"] or "map")
        try:
            return intakes.pose_at(*numbers, at, frame)
        except (TypeError, ValueError):
            self._intake.left_out("poses", "a coordinate is no number")
            return None

    def _object(self, id_: Any) -> ObjectValue | None:
        row = self._one("Object", id_)
        if row is None:
            return None
        dtype: Any = row["dtype"] if row["dtype"] in ("BelieveObject", "ObjectPart") else "Object"
        return ObjectValue(dtype, str(row["name"]), row["obj_type"], self._pose(row["pose_id"]))

    def _robot(self, designator: Any) -> RobotValue | None:
        """Return the state of the robot at the start of an action."""
        action = self._one("Action", designator)
        state = self._one("RobotState", action["robot_state_id"]) if action is not None else None
        pose = self._pose(state["pose_id"]) if state is not None else None
        if state is None or pose is None:
            return None
        height = state["torso_height"]
        return RobotValue(pose, str(state["type"] or "ROBOT"), height if isinstance(height, int | float) else None)
