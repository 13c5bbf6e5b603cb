"""Selects about one object: the events of its history, and the actions that moved it."""

from __future__ import annotations

from functools import partial
from typing import Any

from sqlalchemy import (
    CTE,
    ColumnElement,
    Float,
    Select,
    Text,
    and_,
    case,
    cast,
    literal,
    null,
    select,
    tuple_,
    union_all,
)

from pycrorm_async.orm import Attachment, Detection, JointChange, Object, ObjectRemoval, Pose, RootFailure, TaskTreeNode
from pycrorm_async.query.asking.columns import EpisodeNumber, is_named, limited, of_episode

_OBJECT, _POSE, _NODE = Object.__table__, Pose.__table__, TaskTreeNode.__table__


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
    of_course = _NODE.c.process_metadata_id == course.c.episode
    if episode is not None:
        of_course = and_(of_course, of_episode(_NODE.c.process_metadata_id, episode))
    statement = (
        select(*course.c[:-1], _NODE.c.dtype.label("by"), _NODE.c.status.label("status"), course.c.node_id)
        .outerjoin(_NODE, and_(_NODE.c.id == course.c.node_id, of_course))
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
    by, joined = _NODE.alias("by"), partial(_joined, episode)
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
    above = _NODE.alias("above")
    up = up.union_all(
        select(up.c.move, *(above.c[each] for each in columns)).where(
            up.c.kind != "action",
            joined(up.c.parent_id, above, up),
        )
    )
    mover = _NODE.alias("mover")
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
