"""Selects about actions: durations, arms, pick-ups, and the experience at a place."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Select, func, select

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Designator, Object, PickUpAction, Pose, TaskTreeNode
from pycrorm_async.orm.base import same_row
from pycrorm_async.query.asking.columns import (
    FAILED,
    EpisodeNumber,
    checked_metres,
    containing,
    json_text,
    limited,
    member_of,
    of_episode,
    share_succeeded,
    times_with,
)
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp, ObjectType

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


def durations(
    episode: EpisodeNumber | None, dtype: str | None, kind: str, limit: int | None
) -> Select[*tuple[Any, ...]]:
    node = TaskTreeNode
    if kind not in ("action", "motion", "language"):
        raise CallerError(f"kind must be action, motion or language, got {kind!r}")
    statement = select(
        node.dtype,
        func.count().label("times"),
        times_with(node.status == TaskStatus.SUCCEEDED).label("succeeded"),
        times_with(node.status.in_(FAILED)).label("failed"),
        func.sum(node.duration).label("total_s"),
        func.avg(node.duration).label("mean_s"),
        func.min(node.duration).label("shortest_s"),
        func.max(node.duration).label("longest_s"),
    ).where(node.kind == kind)
    if episode is not None:
        statement = statement.where(of_episode(node.process_metadata_id, episode))
    if dtype is not None:
        statement = statement.where(node.dtype == dtype)
    return limited(statement.group_by(node.dtype).order_by(func.sum(node.duration).desc(), node.dtype), limit)


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
            share_succeeded(node.status).label("share"),
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
