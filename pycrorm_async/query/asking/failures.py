"""Selects about failures: their nodes, their causes, and the actions before them."""

from __future__ import annotations

from typing import Any

from sqlalchemy import BigInteger, ColumnElement, Select, and_, cast, func, literal_column, or_, select
from sqlalchemy.orm import aliased

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.orm import RootFailure, TaskTreeNode
from pycrorm_async.query.asking.columns import (
    EpisodeNumber,
    checked_count,
    containing,
    is_named,
    limited,
    of_episode,
    times_with,
)
from pycrorm_async.query.asking.failure_words import classes_meant_by

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
    )
    # Not `order_by(failure.id)`, for which SQLite reads all nodes in order instead of the failed ones by an index.
    return limited(statement.where(*matching(episode, **search)).order_by(failure.id + 0), limit)


def failures_by_cause(episode: EpisodeNumber | None, limit: int | None, **search: Any) -> Select[*tuple[Any, ...]]:
    failure = RootFailure
    causes = failure.reason, failure.dtype, failure.object
    statement = (
        select(
            *causes,
            func.count().label("times"),
            times_with(failure.recovered).label("recovered"),
            func.count(failure.process_metadata_id.distinct()).label("episodes"),
            func.max(failure.start_time).label("last_time"),
            func.min(failure.message).label("a_message"),
        )
        .where(*matching(episode, **search))
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
