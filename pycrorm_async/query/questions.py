"""The questions that every memory answers: `memory.ask`, `reading.ask`, `pycrorm ask`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from functools import partial, wraps
from inspect import signature
from typing import TYPE_CHECKING, Any, Generic, Literal, NoReturn, TypeVar

from sqlalchemy import (
    CTE,
    BigInteger,
    ColumnElement,
    Float,
    Select,
    Text,
    and_,
    case,
    cast,
    func,
    literal,
    literal_column,
    null,
    or_,
    select,
    tuple_,
    union_all,
)
from sqlalchemy.orm import aliased

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.orm import (
    Attachment,
    Designator,
    Detection,
    JointChange,
    Object,
    ObjectRemoval,
    PickUpAction,
    Pose,
    RootFailure,
    TaskTreeNode,
)
from pycrorm_async.orm.base import same_row
from pycrorm_async.projections.derived_views import OUTCOMES, RECOVERED, sql_of
from pycrorm_async.query import named_queries
from pycrorm_async.query.frames import (
    FAILED,
    TRIED,
    EpisodeNumber,
    check_texts,
    checked_count,
    checked_metres,
    containing,
    is_named,
    json_text,
    limited,
    member_of,
    of_episode,
    success_rate,
    times_with,
)
from pycrorm_async.query.question import CHECKED, AskedEpisode, QuestionPlan, classes_meant_by
from pycrorm_async.query.text import nearest
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType

# === actions ==================================================================================================
#
# Selects about actions: durations, arms, pick-ups, and the experience at a place.

_NODE, _DESIGNATOR = TaskTreeNode.__table__, Designator.__table__


def longest_actions(
    episode: EpisodeNumber | None, dtype: str | None, status: str | None, limit: int | None
) -> Select[*tuple[Any, ...]]:
    node = TaskTreeNode
    statement = select(
        node.process_metadata_id.label("episode"),
        node.sequence.label("sequence"),
        node.dtype,
        node.duration.label("duration_s"),
        node.status,
        node.reason,
        node.start_time.label("time"),
        node.id.label("node_id"),
    ).where(node.kind == "action", node.end_ns.is_not(None))
    if episode is not None:
        statement = statement.where(of_episode(node.process_metadata_id, episode))
    if dtype is not None:
        statement = statement.where(node.dtype == dtype)
    if status is not None:
        statement = statement.where(node.status == member_of(TaskStatus, status, "status"))
    return limited(statement.order_by((node.end_ns - node.start_ns).desc(), node.id), limit)


def success_rates(episode: EpisodeNumber | None, *, limit: int | None, **types: Any) -> Select[*tuple[Any, ...]]:
    node = TaskTreeNode
    episodes = func.count(node.process_metadata_id.distinct()).label("episodes")
    statement = _by_type(episode, (*success_rate(node.status, node.status.in_(TRIED)), episodes), **types)
    return limited(statement.order_by(func.count().desc(), node.dtype), limit)


def durations(episode: EpisodeNumber | None, *, limit: int | None, **types: Any) -> Select[*tuple[Any, ...]]:
    node = TaskTreeNode
    sums: dict[str, Any] = {"total_s": func.sum, "mean_s": func.avg, "shortest_s": func.min, "longest_s": func.max}
    statement = _by_type(episode, [each(node.duration).label(name) for name, each in sums.items()], **types)
    return limited(statement.order_by(func.sum(node.duration).desc(), node.dtype), limit)


def _by_type(
    episode: EpisodeNumber | None, columns: Iterable[Any], *, dtype: str | None, kind: str
) -> Select[*tuple[Any, ...]]:
    """Count the nodes of each type, with their successes and failures and further columns."""
    node = TaskTreeNode
    if kind not in ("action", "motion", "language"):
        raise CallerError(f"kind must be action, motion or language, got {kind!r}")
    statement = select(
        node.dtype,
        func.count().label("times"),
        times_with(node.status == TaskStatus.SUCCEEDED).label("succeeded"),
        times_with(node.status.in_(FAILED)).label("failed"),
        *columns,
    ).where(node.kind == kind)
    if episode is not None:
        statement = statement.where(of_episode(node.process_metadata_id, episode))
    if dtype is not None:
        statement = statement.where(node.dtype == dtype)
    return statement.group_by(node.dtype)


def arms_used(episode: EpisodeNumber | None, dtype: str | None, limit: int | None) -> Select[*tuple[Any, ...]]:
    node, parameters = TaskTreeNode, _DESIGNATOR.c.parameters
    arm = func.coalesce(json_text(parameters, "arm"), json_text(parameters, "gripper")).label("arm")
    statement = (
        select(
            arm,
            node.dtype,
            func.count().label("times"),
            times_with(node.status == TaskStatus.SUCCEEDED).label("succeeded"),
            times_with(node.status.in_(FAILED)).label("failed"),
        )
        .join(_DESIGNATOR, same_row(_DESIGNATOR, _NODE))
        .where(node.kind == "action", arm.is_not(None))
    )
    if episode is not None:
        statement = statement.where(of_episode(node.process_metadata_id, episode))
    if dtype is not None:
        statement = statement.where(node.dtype == dtype)
    return limited(statement.group_by(arm, node.dtype).order_by(arm, func.count().desc(), node.dtype), limit)


def successful_pick_ups(
    episode: EpisodeNumber | None,
    object_: str | None,
    object_type: ObjectType | str | None,
    arm: str | None,
    grasp: Grasp | str | None,
    robot: str | None,
    limit: int | None,
) -> Select[*tuple[Any, ...]]:
    node, taken, pick_up = TaskTreeNode, Object.__table__, PickUpAction.__table__
    pose = Pose.__table__
    statement = (
        select(
            node.process_metadata_id.label("episode"),
            node.sequence.label("sequence"),
            taken.c.name.label("object"),
            taken.c.obj_type.label("object_type"),
            pick_up.c.arm,
            pick_up.c.grasp,
            node.duration.label("duration_s"),
            pose.c.x.label("robot_x"),
            pose.c.y.label("robot_y"),
            node.torso_height,
            node.robot,
            node.start_time.label("time"),
            node.id.label("node_id"),
        )
        .join(pick_up, same_row(pick_up, _NODE))
        .outerjoin(
            taken,
            (taken.c.id == pick_up.c.object_designator_id)
            & (taken.c.process_metadata_id == pick_up.c.process_metadata_id),
        )
        .outerjoin(pose, (pose.c.id == node.robot_pose_id) & (pose.c.process_metadata_id == node.process_metadata_id))
        .where(node.status == TaskStatus.SUCCEEDED)
        .order_by(node.id)
    )
    if episode is not None:
        statement = statement.where(of_episode(node.process_metadata_id, episode))
        if not isinstance(episode, Sequence):  # a range of ids, because the pick-ups have no index of episodes
            statement = statement.where(pick_up.c.id.between(_first_id(episode), _first_id(episode + 1)))
    if object_ is not None:
        statement = statement.where(containing(object_, taken.c.name))
    if object_type is not None:
        statement = statement.where(taken.c.obj_type == member_of(ObjectType, object_type, "object_type"))
    if arm is not None:
        statement = statement.where(pick_up.c.arm == member_of(Arms, arm, "arm"))
    if grasp is not None:
        statement = statement.where(pick_up.c.grasp == member_of(Grasp, grasp, "grasp"))
    if robot is not None:
        statement = statement.where(node.robot == robot)
    return limited(statement, limit)


def experience_at(
    episode: EpisodeNumber | None, x: float, y: float, radius_m: float, dtype: str | None, limit: int | None
) -> Select[*tuple[Any, ...]]:
    x, y, radius_m = (checked_metres(*each) for each in (("x", x), ("y", y), ("radius_m", radius_m)))
    if radius_m <= 0:
        raise CallerError(f"radius_m must be > 0, got {radius_m}")
    node, pose = TaskTreeNode, Pose
    arm = json_text(_DESIGNATOR.c.parameters, "arm").label("arm")
    east, north = pose.x - x, pose.y - y
    statement = (
        select(
            node.dtype,
            arm,
            func.count().label("times"),
            times_with(node.status == TaskStatus.SUCCEEDED).label("succeeded"),
            times_with(node.status.in_(FAILED)).label("failed"),
            *success_rate(node.status, node.status.in_(TRIED)),
            func.avg(node.duration).label("mean_s"),
            func.max(node.start_time).label("last_time"),
        )
        .join(_DESIGNATOR, same_row(_DESIGNATOR, _NODE))
        .join(pose, (pose.id == node.robot_pose_id) & (pose.process_metadata_id == node.process_metadata_id))
        .where(
            node.kind == "action",
            node.end_sequence.is_not(None),
            pose.x.between(x - radius_m, x + radius_m),
            east * east + north * north <= radius_m * radius_m,
        )
        .group_by(node.dtype, arm)
        .order_by(func.count().desc(), node.dtype, arm)
    )
    if episode is not None:
        statement = statement.where(of_episode(node.process_metadata_id, episode))
    if dtype is not None:
        statement = statement.where(node.dtype == dtype)
    return limited(statement, limit)


# === failures =================================================================================================
#
# Selects about failures: their nodes, their causes, and the actions before them.

_NUMBER_BITS = SEQUENCE_MAX.bit_length() + SLOT_MAX.bit_length()
"""The bits of an id below the episode's number."""
_WORDS_MAX = 30
"""Bounds the words of a search: each is a condition on four columns, and SQLite takes a thousand."""


def matching(
    episode: EpisodeNumber | None,
    *,
    object: str | None,  # noqa: A002  the column's name
    arm: str | None,
    reason: str | None,
    message: str | None,
    text: str | None,
    recovered: bool | None,
) -> list[ColumnElement[bool]]:
    """Return the conditions on `RootFailure`."""
    failure = RootFailure
    conditions: list[ColumnElement[bool]] = []
    if episode is not None:
        conditions.append(of_episode(failure.process_metadata_id, episode))
    if object is not None:
        conditions.append(containing(object, failure.object))
    if arm is not None:
        conditions.append(is_named(failure.arm, arm))
    if reason is not None:
        conditions.append(_is_reason(reason))
    if message is not None:
        conditions.append(containing(message, failure.message))
    if text is not None:
        columns = failure.object, failure.arm, failure.message, failure.dtype
        # Words that mean a class together, as in "out of reach", count together.
        words = [text] if classes_meant_by(text) else text.split()
        if len(words) > _WORDS_MAX:
            raise CallerError(f"text has {len(words)} words, and at most {_WORDS_MAX} are searched for")
        conditions += [or_(containing(each, *columns), _is_reason(each)) for each in words]
    if recovered is not None:
        conditions.append(failure.recovered == recovered)
    return conditions


def _is_reason(words: str) -> ColumnElement[bool]:
    classes = classes_meant_by(words)
    named = containing(words, RootFailure.reason)
    return or_(named, RootFailure.reason.in_(classes)) if classes else named


def root_failures(episode: EpisodeNumber | None, limit: int | None, **search: Any) -> Select[*tuple[Any, ...]]:
    failure = RootFailure
    statement = select(
        failure.process_metadata_id.label("episode"),
        failure.sequence.label("sequence"),
        failure.dtype,
        failure.object,
        failure.arm,
        failure.reason,
        failure.message,
        failure.recovered,
        failure.path,
        failure.start_time.label("time"),
        failure.id.label("node_id"),
        failure.outcome,
    )
    # Not `order_by(failure.id)`, for which SQLite reads all nodes in order instead of the failed ones by an index.
    return limited(statement.where(*matching(episode, **search)).order_by(failure.id + 0), limit)


def failures_by_cause(episode: EpisodeNumber | None, limit: int | None, **search: Any) -> Select[*tuple[Any, ...]]:
    names = "reason dtype object process_metadata_id start_time message outcome".split()
    chosen = select(*(getattr(RootFailure, each) for each in names)).where(*matching(episode, **search))
    # With a limit no database replaces the columns by their expressions, and computes an outcome for each of them. For
    # one with a number PostgreSQL would rather have the first row early than read fewer nodes, and read all of them.
    failed = chosen.limit(sql_of(BigInteger(), "-1", "ALL")).subquery("failed").c
    causes = failed.reason, failed.dtype, failed.object
    statement = (
        select(
            *causes,
            func.count().label("times"),
            times_with(failed.outcome == RECOVERED).label(RECOVERED),
            func.count(failed.process_metadata_id.distinct()).label("episodes"),
            func.max(failed.start_time).label("last_time"),
            func.min(failed.message).label("a_message"),
            *(times_with(failed.outcome == each).label(each) for each in OUTCOMES if each != RECOVERED),
        )
        .group_by(*causes)
        .order_by(func.count().desc(), *causes)
    )
    return limited(statement, limit)


def steps_before_failures(
    episode: EpisodeNumber | None, steps: int, limit: int | None, **search: Any
) -> Select[*tuple[Any, ...]]:
    failure, step, count = RootFailure, TaskTreeNode, checked_count("steps", steps, 100)
    latest = (
        select(
            failure.process_metadata_id.label("episode"),
            failure.sequence.label("failure_sequence"),
            failure.dtype.label("failed"),
            failure.reason,
            cast(literal_column("1"), BigInteger).label("steps_before"),
            _ended_before(failure.id, failure.process_metadata_id, failure.sequence).label("node_id"),
            failure.id.label("failure_id"),
        )
        .where(*matching(episode, **search))
        .cte("latest", recursive=True)
    )
    named = () if episode is None else (of_episode(step.process_metadata_id, episode),)
    # One step after the other is looked up by its id, as a plan by any other way depends on statistics.
    same = "episode", "failure_sequence", "failed", "reason"
    latest = latest.union_all(
        select(
            *(latest.c[each] for each in same),
            latest.c.steps_before + 1,
            _ended_before(latest.c.node_id, latest.c.episode, latest.c.failure_sequence),
            latest.c.failure_id,
        ).where(latest.c.steps_before < count, latest.c.node_id.is_not(None))
    )
    statement = (
        select(
            *(latest.c[each] for each in same),
            latest.c.steps_before,
            step.sequence.label("sequence"),
            step.dtype,
            step.kind,
            step.status,
            step.duration.label("duration_s"),
            step.id.label("node_id"),
        )
        .join(step, and_(step.id == latest.c.node_id, step.process_metadata_id == latest.c.episode, *named))
        # Both hold of every step. PostgreSQL expects ten times as many steps as there are, and would read all nodes to
        # join them; with each range it expects a two-hundredth of that, and looks the steps up by their ids.
        .where(
            latest.c.steps_before.between(literal_column("1"), literal_column(str(count))),
            latest.c.node_id.between(_first_id(latest.c.episode), _first_id(latest.c.episode + 1)),
        )
        .order_by(latest.c.failure_id, latest.c.steps_before)
    )
    return limited(statement, limit)


def _ended_before(node_id: Any, episode: Any, sequence: Any) -> Any:
    """Return the last action or motion before this node that had ended when the event of this sequence happened.

    It reads the episode's nodes backwards by their ids. All of them are above the episode's first id. This condition is
    for PostgreSQL, which without statistics estimates one row with it, and otherwise reads and sorts all nodes of the
    episode for each failure.
    """
    earlier = aliased(TaskTreeNode)
    return (
        select(earlier.id)
        .where(earlier.process_metadata_id == episode, earlier.id > _first_id(episode), earlier.id < node_id)
        .where(earlier.kind.in_(("action", "motion")), earlier.end_sequence < sequence)
        .order_by(earlier.id.desc())
        .limit(literal_column("1"))
        .scalar_subquery()
    )


def _first_id(episode: Any) -> Any:
    """Return the number below all ids of the episode, which is above all those of the one before."""
    return cast(episode, BigInteger).bitwise_lshift(literal_column(str(_NUMBER_BITS)))


# === object courses ===========================================================================================
#
# Selects about one object: the events of its history, and the actions that moved it.

_OBJECT, _POSE, _TREE_NODE = Object.__table__, Pose.__table__, TaskTreeNode.__table__


def _course(
    table: Any,
    sequence: Any,
    happening: Any,
    *,
    other: Any = None,
    detail: Any = None,
    value: Any = None,
    place: Any = None,
    node_id: Any = None,
    time: Any = None,
) -> Select[*tuple[Any, ...]]:
    return select(
        table.c.process_metadata_id.label("episode"),
        sequence.label("sequence"),
        (table.c.time if time is None else time).label("time"),
        (literal(happening, Text) if isinstance(happening, str) else happening).label("what"),
        cast(null() if other is None else other, Text).label("other"),
        cast(null() if detail is None else detail, Text).label("detail"),
        cast(null() if value is None else value, Float).label("value"),
        *(cast(null() if place is None else place.c[axis], Float).label(axis) for axis in "xyz"),
        (table.c.node_id if node_id is None else node_id).label("node_id"),
    )


def _joined(episode: EpisodeNumber | None, id_: Any, row: Any, other: Any) -> ColumnElement[bool]:
    """Return the condition that `row` has this id, which a row of `other` names.

    With `episode` it names the episode itself, so that one part of a divided table is read wherever the row is joined.
    """
    same = and_(row.c.id == id_, row.c.process_metadata_id == other.c.process_metadata_id)
    return same if episode is None else and_(same, of_episode(row.c.process_metadata_id, episode))


def object_history(episode: EpisodeNumber | None, *, name: str, limit: int | None) -> Select[*tuple[Any, ...]]:
    """Select the history of the objects of this name, in the order of the events."""
    attached, removed, joints = Attachment.__table__, ObjectRemoval.__table__, JointChange.__table__
    seen, other = Detection.__table__, _OBJECT.alias("other")
    is_added = _OBJECT.c.id == _OBJECT.c.identity_id
    begins = Attachment.kind == "attached"
    named = select(_OBJECT.c.id, _OBJECT.c.process_metadata_id).where(is_named(_OBJECT.c.name, name))
    if episode is not None:
        named = named.where(of_episode(_OBJECT.c.process_metadata_id, episode))

    joined = partial(_joined, episode)

    def is_one(table: Any, id_: Any) -> ColumnElement[bool]:
        return tuple_(id_, table.c.process_metadata_id).in_(named)

    failed = _failures(episode)
    # IN chooses the rows, and what is joined to them is joined outside: of inner joins that share the episode
    # PostgreSQL, where it has no statistics, begins with one that joins all objects of an episode with each other.
    courses = [
        _course(_OBJECT, Object.sequence, case((is_added, "added"), else_="moved"), place=_POSE)
        .outerjoin(_POSE, joined(_OBJECT.c.pose_id, _POSE, _OBJECT))
        .where(is_named(_OBJECT.c.name, name), _OBJECT.c.identity_id.is_not(None), _OBJECT.c.dtype == "Object"),
        _course(attached, Attachment.sequence, attached.c.kind, other=other.c.name, detail=attached.c.link)
        .outerjoin(other, joined(attached.c.parent_id, other, attached))
        .where(is_one(attached, attached.c.child_id)),
        _course(
            attached,
            Attachment.sequence,
            case((begins, "holds"), else_="releases"),
            other=other.c.name,
            detail=attached.c.link,
        )
        .outerjoin(other, joined(attached.c.child_id, other, attached))
        .where(is_one(attached, attached.c.parent_id)),
        _course(removed, ObjectRemoval.sequence, "removed").where(is_one(removed, removed.c.object_id)),
        _course(joints, JointChange.sequence, "joint moved", detail=joints.c.joint, value=joints.c.position).where(
            is_one(joints, joints.c.object_id)
        ),
        _course(seen, Detection.sequence, "detected", detail=seen.c.source, value=seen.c.confidence, place=seen).where(
            is_named(seen.c.name, name)
        ),
        _course(
            failed,
            failed.c.sequence,
            "an action failed",
            detail=failed.c.reason,
            node_id=failed.c.id,
            time=failed.c.start_time,
        ).where(is_named(failed.c.object, name)),
    ]
    if episode is not None:
        courses = [each.where(of_episode(each.selected_columns.episode, episode)) for each in courses]
    course = union_all(*courses).subquery("course")
    of_course = _TREE_NODE.c.process_metadata_id == course.c.episode
    if episode is not None:
        of_course = and_(of_course, of_episode(_TREE_NODE.c.process_metadata_id, episode))
    statement = (
        select(*course.c[:-1], _TREE_NODE.c.dtype.label("by"), _TREE_NODE.c.status.label("status"), course.c.node_id)
        .outerjoin(_TREE_NODE, and_(_TREE_NODE.c.id == course.c.node_id, of_course))
        .order_by(course.c.episode, course.c.sequence, course.c.what, course.c.detail)
    )
    return limited(statement, limit)


def _failures(episode: EpisodeNumber | None) -> CTE:
    """Return the failures as a subquery that is evaluated before they are filtered by object.

    Without statistics PostgreSQL expects one failure of an object, and would read all nodes of the episode to find out
    whether a node below it failed.
    """
    failed = RootFailure.__table__
    columns = failed.c.id, failed.c.process_metadata_id, failed.c.start_time, failed.c.reason, failed.c.object
    statement = select(*columns, RootFailure.sequence.label("sequence"))
    if episode is not None:
        statement = statement.where(of_episode(failed.c.process_metadata_id, episode))
    return statement.cte("failed").prefix_with("MATERIALIZED", dialect="postgresql")


def moves_of(episode: EpisodeNumber | None, *, name: str, limit: int | None) -> Select[*tuple[Any, ...]]:
    """Return each move of the objects of this name, the node that moved it, and the nearest action around that."""
    by, joined = _TREE_NODE.alias("by"), partial(_joined, episode)
    moved = select(
        _OBJECT.c.id,
        _OBJECT.c.process_metadata_id,
        Object.sequence.label("sequence"),
        _OBJECT.c.time,
        _OBJECT.c.name,
        _OBJECT.c.pose_id,
        _OBJECT.c.node_id,
    ).where(
        is_named(_OBJECT.c.name, name),
        _OBJECT.c.id != _OBJECT.c.identity_id,
        _OBJECT.c.dtype == "Object",
    )
    if episode is not None:
        moved = moved.where(of_episode(_OBJECT.c.process_metadata_id, episode))
    moves = moved.cte("moves")
    columns = ("id", "parent_id", "process_metadata_id", "kind", "dtype", "status")
    up = (
        select(moves.c.id.label("move"), *(by.c[each] for each in columns))
        .join(by, joined(moves.c.node_id, by, moves))
        .cte("up", recursive=True)
    )
    above = _TREE_NODE.alias("above")
    up = up.union_all(
        select(up.c.move, *(above.c[each] for each in columns)).where(
            up.c.kind != "action",
            joined(up.c.parent_id, above, up),
        )
    )
    mover = _TREE_NODE.alias("mover")
    statement = (
        select(
            moves.c.process_metadata_id.label("episode"),
            moves.c.sequence,
            moves.c.time,
            moves.c.name.label("object"),
            *(_POSE.c[axis] for axis in "xyz"),
            mover.c.dtype.label("moved_by"),
            up.c.dtype.label("action"),
            up.c.status.label("action_status"),
            up.c.id.label("action_id"),
        )
        .outerjoin(up, and_(up.c.move == moves.c.id, up.c.kind == "action"))
        .outerjoin(mover, joined(moves.c.node_id, mover, moves))
        .outerjoin(_POSE, joined(moves.c.pose_id, _POSE, moves))
        .order_by(moves.c.id)
    )
    return limited(statement, limit)


# === ask ======================================================================================================

Q = TypeVar("Q")
_TEXTS = frozenset(("arm", "dtype", "kind", "message", "name", "object", "object_", "reason", "robot", "text"))
"""The arguments that are texts; others are checked where they are used."""


class Ask(Generic[Q]):
    """The questions by name. Each method returns a `Question`: await it for a frame, print it for its SQL.

    >>> frame = await memory.ask.root_failures(object="milk", reason="unreachable")
    >>> print(memory.ask.durations(episode="last").sql)

    `episode` is a number, an id or its first digits, `last`, an `Episode` or an `EpisodeSummary`; by default all
    episodes except simulations. `limit` bounds the rows. Durations are in s, places in m in the map, `time` is when
    the node started or the change happened, in UTC.

    An empty answer to a question about a name that is nowhere in the memory, such as `object="mlik"`, is a warning with
    the nearest name that is. Without `episode`, `success_rates`, `longest_actions`, `durations`, `arms_used`,
    `successful_pick_ups`, `experience_at` and `episodes` read all nodes, pick-ups or episodes of the memory, because
    they are about all of them; the others find what they are about by an index, but that names of objects are compared
    one by one.
    """

    def __init__(self, make: Callable[[QuestionPlan], Q]) -> None:
        self._make = make

    def __repr__(self) -> str:
        """Name the questions, for an interpreter."""
        return f"<Ask: {', '.join(QUESTIONS)}; help(memory.ask.NAME) describes one>"

    # --- failures ---------------------------------------------------------------------------------------------

    def root_failures(
        self,
        *,
        episode: AskedEpisode | None = None,
        object: str | None = None,  # noqa: A002  the column's name
        arm: Arms | str | None = None,
        reason: str | None = None,
        message: str | None = None,
        text: str | None = None,
        recovered: bool | None = None,
        limit: int | None = None,
    ) -> Q:
        """List the nodes at which failures began.

        `outcome` says how the plan went on: recovered, tolerated, ignored, failed or open (`RootFailure.outcome`).

        Args:
            episode: only of this episode.
            object: its name, or a part of it.
            arm: its name.
            reason: the class of the failure or a part of it, or words for it: `unreachable` also finds `IKError`.
            message: a part of the message.
            text: words that are all in the object, arm, type, message or reason, as in `milk unreachable`.
            recovered: whether the same was tried again and succeeded, or an alternative did.
            limit: of rows.
        """
        search = _search(object, arm, reason, message, text, recovered)
        return self._ask("root_failures", episode, partial(root_failures, limit=limit, **search))

    def failures_by_cause(
        self,
        *,
        episode: AskedEpisode | None = None,
        object: str | None = None,  # noqa: A002  the column's name
        arm: Arms | str | None = None,
        reason: str | None = None,
        message: str | None = None,
        text: str | None = None,
        recovered: bool | None = None,
        limit: int | None = None,
    ) -> Q:
        """Count failures by reason, type of the failed node and object, the most frequent first.

        The arguments are those of `root_failures`. A failure counts once, where it began, and in the column of its
        outcome.
        """
        search = _search(object, arm, reason, message, text, recovered)
        return self._ask("failures_by_cause", episode, partial(failures_by_cause, limit=limit, **search))

    def steps_before_failures(
        self,
        *,
        steps: int = 5,
        episode: AskedEpisode | None = None,
        object: str | None = None,  # noqa: A002  the column's name
        arm: Arms | str | None = None,
        reason: str | None = None,
        message: str | None = None,
        text: str | None = None,
        recovered: bool | None = None,
        limit: int | None = None,
    ) -> Q:
        """List the last actions and motions that had ended before each failed node started, the latest first.

        `steps` is their number for each failure, 1 to 100; the other arguments are those of `root_failures`.
        """
        search = _search(object, arm, reason, message, text, recovered)
        make = partial(steps_before_failures, steps=steps, limit=limit, **search)
        return self._ask("steps_before_failures", episode, make)

    # --- actions ----------------------------------------------------------------------------------------------

    def success_rates(
        self,
        *,
        episode: AskedEpisode | None = None,
        dtype: str | None = None,
        kind: Literal["action", "motion", "language"] = "action",
        limit: int | None = None,
    ) -> Q:
        """Count successes and failures of each type, with the share of successes and its 95 % interval, low to high.

        A share counts what succeeded, failed or ended in an error; not what was cancelled, interrupted or lost.
        """
        return self._ask("success_rates", episode, partial(success_rates, dtype=dtype, kind=kind, limit=limit))

    def longest_actions(
        self,
        *,
        episode: AskedEpisode | None = None,
        dtype: str | None = None,
        status: TaskStatus | str | None = None,
        limit: int | None = 10,
    ) -> Q:
        """List the ended actions that took longest, also only those of one type (`dtype`) or status."""
        state = status.name if isinstance(status, TaskStatus) else status
        make = partial(longest_actions, dtype=dtype, status=state, limit=limit)
        return self._ask("longest_actions", episode, make)

    def durations(
        self,
        *,
        episode: AskedEpisode | None = None,
        dtype: str | None = None,
        kind: Literal["action", "motion", "language"] = "action",
        limit: int | None = None,
    ) -> Q:
        """Sum up the durations of each type: number, successes, failures, total, mean, shortest, longest."""
        return self._ask("durations", episode, partial(durations, dtype=dtype, kind=kind, limit=limit))

    def arms_used(
        self, *, episode: AskedEpisode | None = None, dtype: str | None = None, limit: int | None = None
    ) -> Q:
        """Count the actions of each arm and type, with their successes and failures."""
        return self._ask("arms_used", episode, partial(arms_used, dtype=dtype, limit=limit))

    def successful_pick_ups(
        self,
        *,
        episode: AskedEpisode | None = None,
        object: str | None = None,  # noqa: A002  the column's name
        object_type: ObjectType | str | None = None,
        arm: Arms | str | None = None,
        grasp: Grasp | str | None = None,
        robot: str | None = None,
        limit: int | None = None,
    ) -> Q:
        """List the pick-ups that succeeded: object, arm, grasp, and the robot's base pose."""
        make = partial(
            successful_pick_ups,
            object_=object,
            object_type=object_type,
            arm=arm.name if isinstance(arm, Arms) else arm,
            grasp=grasp,
            robot=robot,
            limit=limit,
        )
        return self._ask("successful_pick_ups", episode, make)

    def experience_at(
        self, x: float, y: float, *, radius_m: float = 0.5, dtype: str | None = None, limit: int | None = None
    ) -> Q:
        """Sum up the actions that a robot started within `radius_m` of a place: by type and arm, with successes.

        A share counts what `success_rates` counts.
        """
        make = partial(experience_at, x=x, y=y, radius_m=radius_m, dtype=dtype, limit=limit)
        return self._ask("experience_at", None, make)

    # --- objects ----------------------------------------------------------------------------------------------

    def object_history(self, name: str, *, episode: AskedEpisode | None = None, limit: int | None = None) -> Q:
        """List all that happened to the object of this name: added, moved, attached, seen, failed with, removed."""
        return self._ask("object_history", episode, partial(object_history, name=name, limit=limit))

    def moves_of(self, name: str, *, episode: AskedEpisode | None = None, limit: int | None = None) -> Q:
        """List each move of an object with the node that moved it and the nearest action around that node."""
        return self._ask("moves_of", episode, partial(moves_of, name=name, limit=limit))

    # --- episodes ---------------------------------------------------------------------------------------------

    def episodes(
        self,
        *,
        status: TaskStatus | str | None = None,
        since: datetime | None = None,
        tag: str | None = None,
        robot: str | None = None,
        text: str | None = None,
        limit: int | None = None,
    ) -> Q:
        """List the episodes, the newest first; also only some of them.

        Args:
            status: RUNNING, SUCCEEDED, FAILED …
            since: the earliest start, with a time zone.
            tag: that they have now.
            robot: name or model of a robot that took part.
            text: a part of the description, the plan's name or a tag.
            limit: of rows.
        """
        state = status.name if isinstance(status, TaskStatus) else status
        choice = named_queries.EpisodeChoice(state, since, () if tag is None else (tag,), robot, text, limit)
        select_of = partial(named_queries.episode_list, choice=choice)
        return self._make(QuestionPlan("episodes", None, select_of, _names({"tag": tag, "robot": robot})))

    def _ask(self, name: str, episode: AskedEpisode | None, select_of: partial[Select[*tuple[Any, ...]]]) -> Q:
        check_texts({key: value for key, value in select_of.keywords.items() if key in _TEXTS})
        recovered = select_of.keywords.get("recovered")
        if recovered is not None and not isinstance(recovered, bool):
            raise CallerError(f"recovered must be True or False, got {recovered!r}")
        select_of(episode=None)  # so that a wrong argument is refused at once
        return self._make(QuestionPlan(name, episode, select_of, _names(select_of.keywords)))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> NoReturn:
            raise AttributeError(f"there is no question {name}{nearest(name, QUESTIONS)}")


def _names(arguments: Mapping[str, Any]) -> dict[str, str]:
    texts = {key.removesuffix("_"): value for key, value in arguments.items() if isinstance(value, str)}
    return {key: value for key, value in texts.items() if key in CHECKED}


def _search(
    object_: str | None,
    arm: Arms | str | None,
    reason: str | None,
    message: str | None,
    text: str | None,
    recovered: bool | None,  # noqa: FBT001  passed on only
) -> dict[str, Any]:
    name = arm.name if isinstance(arm, Arms) else arm
    return {"object": object_, "arm": name, "reason": reason, "message": message, "text": text, "recovered": recovered}


QUESTIONS: tuple[str, ...] = tuple(name for name in vars(Ask) if not name.startswith("_"))
"""The names of all questions."""


def _with_suggestions(question: Callable[..., Any]) -> Callable[..., Any]:
    """Return the question so that an unknown argument is refused with the nearest one."""
    arguments = frozenset(signature(question).parameters) - {"self"}

    @wraps(question)
    def ask(*values: Any, **options: Any) -> Any:
        for each in options.keys() - arguments:
            raise CallerError(f"{question.__name__} has no argument {each}{nearest(each, sorted(arguments))}")
        return question(*values, **options)

    return ask


for _name in QUESTIONS:
    setattr(Ask, _name, _with_suggestions(getattr(Ask, _name)))
