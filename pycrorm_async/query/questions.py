"""The questions that every memory answers: `memory.ask`, `reading.ask`, `pycrorm ask`, the tools of `pycrorm mcp`.

A question is a function of `Ask` that returns a select. Its signature and its docstring are all there is to it: the
command makes options of its arguments, an agent's tool a schema, and `memory.ask` checks them. An argument's help, and
what its values are, is in its annotation.

`episode` is any `AskedEpisode` for a caller; the function gets an `EpisodeNumber`, or None for all episodes.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from enum import Enum
from functools import cached_property, partial, wraps
from inspect import Parameter, Signature, signature, unwrap
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, NamedTuple, TypedDict, TypeVar

import sqlalchemy as sa
from sqlalchemy.orm import aliased

from pycrorm_async import orm
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SEQUENCE_MAX, SLOT_MAX
from pycrorm_async.orm import Object
from pycrorm_async.orm.base import same_row
from pycrorm_async.projections.derived_views import OUTCOMES, RECOVERED, sql_of
from pycrorm_async.query import frames
from pycrorm_async.query.named_queries import EpisodeChoice, episode_list
from pycrorm_async.query.question import CHECKED, AskedEpisode, QuestionPlan, classes_meant_by
from pycrorm_async.query.text import nearest
from pycrorm_async.record.values import SAMPLES
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType

Rows: typing.TypeAlias = "sa.Select[*tuple[Any, ...]]"

# === arguments ================================================================================================
#
# Describe the arguments of questions: each has a type and a help, which the command and agents show.

Arm = Annotated[Arms | str | None, "Name of the arm, such as LEFT."]
Dtype = Annotated[str | None, "Only this type, such as PickUpAction."]
Of = Annotated[AskedEpisode | None, "Only this episode: its number, its id or first digits of the id, or `last`."]
Kind = Annotated[Literal["action", "motion", "language"], "Kind of the nodes."]
Limit = Annotated[int | None, "Rows at most."]
Message = Annotated[str | None, "A part of the failure's message."]
Name = Annotated[str, "Name of the object."]
Named = Annotated[str | None, "Name of the object, or a part of it."]
Reason = Annotated[str | None, "Class of the failure or a part of it, or words for it, such as unreachable."]
Recovered = Annotated[bool | None, "Only failures after which the same, or an alternative, succeeded; or only others."]
Robot = Annotated[str | None, "Name of the robot; for episodes also its model."]
Status = Annotated[TaskStatus | str | None, "Status, such as SUCCEEDED or FAILED."]
Words = Annotated[str | None, "Words that are all there, as in 'milk unreachable'."]


class Argument(NamedTuple):
    """An argument of a question.

    Attributes:
        type: of its values as a command line or an agent writes them: bool, int, float, str, datetime or a `Literal`.
        default: `Parameter.empty` if a value is required.
        choices: the names that are valid; empty if others are too, as those of arms.
    """

    name: str
    type: Any
    help: str
    default: Any
    choices: tuple[str, ...] = ()

    @property
    def is_required(self) -> bool:
        """True if it has no default."""
        return self.default is Parameter.empty


def _simple(annotation: Any) -> Any:
    """Return the type as which texts name a value: that of a member of an enum or an episode is str."""
    if typing.get_origin(annotation) not in (typing.Union, UnionType):
        return annotation
    types = typing.get_args(annotation)
    return str if str in types else next(each for each in types if each is not type(None))


def _choices(annotation: Any) -> tuple[str, ...]:
    enum = next((each for each in typing.get_args(annotation) if each in (TaskStatus, ObjectType, Grasp)), None)
    return tuple(enum.__members__) if enum is not None else ()


P = typing.ParamSpec("P")
Q = TypeVar("Q")


class _Question(Generic[P]):
    """A question in the class `Ask`; as an attribute of an instance, the function that asks it."""

    name: str

    def __init__(self, select_of: Callable[P, Rows]) -> None:
        self.select_of = unwrap(select_of)  # of the staticmethod
        self.__doc__ = select_of.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @cached_property
    def _described(self) -> Mapping[str, tuple[Any, str]]:
        """Type and help by argument. An `Episode` counts as a text."""
        hints_of = partial(typing.get_type_hints, localns={"Episode": str}, include_extras=True)
        hints = {**hints_of(self.select_of), **hints_of(FailureSearch)}
        return {name: typing.get_args(each) for name, each in hints.items() if name != "return"}

    @cached_property
    def arguments(self) -> Mapping[str, Argument]:
        """The arguments by name, in the order of the signature."""
        return {
            name: Argument(name, _simple(type_), words, each.default, _choices(type_))
            for name, each in self._parameters()
            for type_, words in [self._described[name]]
        }

    @cached_property
    def signature(self) -> Signature:
        """The signature, with types in place of the names of annotations."""
        return Signature([each.replace(annotation=self._described[name][0]) for name, each in self._parameters()])

    def _parameters(self) -> Iterable[tuple[str, Parameter]]:
        """Yield the parameters by name, those of a `FailureSearch` among them."""
        for name, each in signature(self.select_of).parameters.items():
            if each.kind is not Parameter.VAR_KEYWORD:
                yield name, each
                continue
            for argument in FailureSearch.__annotations__:
                yield argument, Parameter(argument, Parameter.KEYWORD_ONLY, default=None)

    @typing.overload
    def __get__(self, ask: None, owner: Any) -> typing.Self: ...
    @typing.overload
    def __get__(self, ask: Ask[Q], owner: Any) -> Callable[P, Q]: ...
    def __get__(self, ask: Ask[Q] | None, owner: Any) -> Any:
        if ask is None:
            return self
        make = ask._make

        @wraps(self.select_of)
        def asked(*values: P.args, **options: P.kwargs) -> Q:
            for each in options.keys() - self.arguments.keys():
                raise CallerError(f"{self.name} has no argument {each}{nearest(each, sorted(self.arguments))}")
            return make(self._plan(self.signature.bind(*values, **options).arguments))

        asked.__signature__ = self.signature  # type: ignore[attr-defined]  # help() prints it
        return asked

    def _plan(self, values: Mapping[str, Any]) -> QuestionPlan:
        """Check the values of arguments and return the plan of the question about them. Raises `CallerError`."""
        arguments = {name: each.name if isinstance(each, Enum) else each for name, each in values.items()}
        episode = arguments.pop("episode", None)
        frames.check_texts(
            {name: each for name, each in arguments.items() if self.arguments[name].type not in _NO_TEXTS}
        )
        for name, each in arguments.items():
            if self.arguments[name].type is bool and not isinstance(each, bool | None):
                raise CallerError(f"{name} must be True or False, got {each!r}")
        select_of = partial[Rows](self.select_of, **arguments)
        select_of()  # so that a wrong argument is refused at once
        names = {name: each for name, each in arguments.items() if isinstance(each, str) and name in CHECKED}
        return QuestionPlan(self.name, episode, select_of, names)


_NO_TEXTS = (bool, int, float, datetime)
"""The types of arguments that are checked where they are used."""

# === actions ==================================================================================================

_NODE, _DESIGNATOR = orm.TaskTreeNode.__table__, orm.Designator.__table__


def _by_type(episode: Any, columns: Iterable[Any], *, dtype: str | None, kind: str) -> Rows:
    """Count the nodes of each type, with their successes and failures and further columns."""
    node = orm.TaskTreeNode
    if kind not in ("action", "motion", "language"):
        raise CallerError(f"kind must be action, motion or language, got {kind!r}")
    conditions = (
        node.kind == kind,
        frames.of_episode(node.process_metadata_id, episode),
        frames.equal(node.dtype, dtype),
    )
    return sa.select(node.dtype, *_counts(node.status), *columns).where(*conditions).group_by(node.dtype)


def _counts(status: Any) -> tuple[sa.ColumnElement[int], ...]:
    """Return the numbers of rows, of successes and of failures in a group."""
    succeeded, failed = frames.times_with(status == TaskStatus.SUCCEEDED), frames.times_with(status.in_(frames.FAILED))
    return sa.func.count().label("times"), succeeded.label("succeeded"), failed.label("failed")


# === failures =================================================================================================

_NUMBER_BITS = SEQUENCE_MAX.bit_length() + SLOT_MAX.bit_length()
"""The bits of an id below the episode's number."""
_WORDS_MAX = 30
"""Bounds the words of a search: each is a condition on four columns, and SQLite takes a thousand."""


class FailureSearch(TypedDict, total=False):
    """The failures that a question is about: the arguments that three questions share."""

    episode: Of
    object: Named
    arm: Arm
    reason: Reason
    message: Message
    text: Words
    recovered: Recovered
    limit: Limit


def _matching(search: FailureSearch) -> list[sa.ColumnElement[bool]]:
    """Return the conditions on `RootFailure`.

    A failure is searched by its columns, not by one bag of words: the milk's failure must not answer to `cereal`
    because the episode's description names both.
    """
    failure, columns = orm.RootFailure, orm.RootFailure.__table__.c
    given: dict[str, Any] = {name: each for name, each in search.items() if each is not None}
    conditions = [frames.of_episode(failure.process_metadata_id, given.get("episode"))]
    conditions += [frames.containing(given[each], columns[each]) for each in ("object", "message") if each in given]
    if "arm" in given:
        conditions.append(frames.is_named(failure.arm, given["arm"]))
    if "reason" in given:
        conditions.append(_is_reason(given["reason"]))
    if "text" in given:
        # Words that mean a class together, as in "out of reach", count together.
        words = [given["text"]] if classes_meant_by(given["text"]) else given["text"].split()
        if len(words) > _WORDS_MAX:
            raise CallerError(f"text has {len(words)} words, and at most {_WORDS_MAX} are searched for")
        searched = failure.object, failure.arm, failure.message, failure.dtype
        conditions += [sa.or_(frames.containing(each, *searched), _is_reason(each)) for each in words]
    return frames.needed(*conditions, frames.equal(failure.recovered, given.get("recovered")))


def _is_reason(words: str) -> sa.ColumnElement[bool]:
    classes = classes_meant_by(words)
    named = frames.containing(words, orm.RootFailure.reason)
    return sa.or_(named, orm.RootFailure.reason.in_(classes)) if classes else named


def _ended_before(node_id: Any, episode: Any, sequence: Any) -> Any:
    """Return the last action or motion before this node that had ended when the event of this sequence happened.

    It reads the episode's nodes backwards by their ids. All of them are above the episode's first id. This condition is
    for PostgreSQL, which without statistics estimates one row with it, and otherwise reads and sorts all nodes of the
    episode for each failure.
    """
    earlier = aliased(orm.TaskTreeNode)
    return (
        sa.select(earlier.id)
        .where(earlier.process_metadata_id == episode, earlier.id > _first_id(episode), earlier.id < node_id)
        .where(earlier.kind.in_(("action", "motion")), earlier.end_sequence < sequence)
        .order_by(earlier.id.desc())
        .limit(sa.literal_column("1"))
        .scalar_subquery()
    )


def _first_id(episode: Any) -> Any:
    """Return the number below all ids of the episode, which is above all those of the one before."""
    return sa.cast(episode, sa.BigInteger).bitwise_lshift(sa.literal_column(str(_NUMBER_BITS)))


# === object courses ===========================================================================================

_OBJECT, _POSE = Object.__table__, orm.Pose.__table__


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
) -> Rows:
    """Select one kind of event of an object's history: its columns, in the order of the answer."""
    return sa.select(
        table.c.process_metadata_id.label("episode"),
        sequence.label("sequence"),
        (table.c.time if time is None else time).label("time"),
        (sa.literal(happening, sa.Text) if isinstance(happening, str) else happening).label("what"),
        sa.cast(sa.null() if other is None else other, sa.Text).label("other"),
        sa.cast(sa.null() if detail is None else detail, sa.Text).label("detail"),
        sa.cast(sa.null() if value is None else value, sa.Float).label("value"),
        *(sa.cast(sa.null() if place is None else place.c[axis], sa.Float).label(axis) for axis in "xyz"),
        (table.c.node_id if node_id is None else node_id).label("node_id"),
    )


def _joined(episode: Any, id_: Any, row: Any, other: Any) -> sa.ColumnElement[bool]:
    """Return the condition that `row` has this id, which a row of `other` names.

    With `episode` it names the episode itself, so that one part of a divided table is read wherever the row is joined.
    """
    same = row.c.id == id_, row.c.process_metadata_id == other.c.process_metadata_id
    return sa.and_(*same, frames.of_episode(row.c.process_metadata_id, episode))


def _failures(episode: Any) -> sa.CTE:
    """Return the failures as a subquery that is evaluated before they are filtered by object.

    Without statistics PostgreSQL expects one failure of an object, and would read all nodes of the episode to find out
    whether a node below it failed.
    """
    failed = orm.RootFailure.__table__
    columns = failed.c.id, failed.c.process_metadata_id, failed.c.start_time, failed.c.reason, failed.c.object
    statement = sa.select(*columns, orm.RootFailure.sequence.label("sequence"))
    statement = statement.where(*frames.needed(frames.of_episode(failed.c.process_metadata_id, episode)))
    return statement.cte("failed").prefix_with("MATERIALIZED", dialect="postgresql")


def _history(name: str, episode: Any) -> Rows:
    """Select the events of the object of this name, in their order."""
    attached, removed, joints = orm.Attachment.__table__, orm.ObjectRemoval.__table__, orm.JointChange.__table__
    seen, other = orm.Detection.__table__, _OBJECT.alias("other")
    is_added = _OBJECT.c.id == _OBJECT.c.identity_id
    begins = orm.Attachment.kind == "attached"
    named = sa.select(_OBJECT.c.id, _OBJECT.c.process_metadata_id).where(
        frames.is_named(_OBJECT.c.name, name), frames.of_episode(_OBJECT.c.process_metadata_id, episode)
    )
    joined = partial(_joined, episode)

    def is_one(table: Any, id_: Any) -> sa.ColumnElement[bool]:
        return sa.tuple_(id_, table.c.process_metadata_id).in_(named)

    failed = _failures(episode)
    # IN chooses the rows, and what is joined to them is joined outside: of inner joins that share the episode
    # PostgreSQL, where it has no statistics, begins with one that joins all objects of an episode with each other.
    courses = [
        _course(_OBJECT, Object.sequence, sa.case((is_added, "added"), else_="moved"), place=_POSE)
        .outerjoin(_POSE, joined(_OBJECT.c.pose_id, _POSE, _OBJECT))
        .where(frames.is_named(_OBJECT.c.name, name), _OBJECT.c.identity_id.is_not(None), _OBJECT.c.dtype == "Object"),
        *(
            _course(attached, orm.Attachment.sequence, happening, other=other.c.name, detail=attached.c.link)
            .outerjoin(other, joined(partner, other, attached))
            .where(is_one(attached, own))
            for happening, own, partner in (
                (attached.c.kind, attached.c.child_id, attached.c.parent_id),
                (sa.case((begins, "holds"), else_="releases"), attached.c.parent_id, attached.c.child_id),
            )
        ),
        _course(removed, orm.ObjectRemoval.sequence, "removed").where(is_one(removed, removed.c.object_id)),
        _course(joints, orm.JointChange.sequence, "joint moved", detail=joints.c.joint, value=joints.c.position).where(
            is_one(joints, joints.c.object_id)
        ),
        _course(
            seen, orm.Detection.sequence, "detected", detail=seen.c.source, value=seen.c.confidence, place=seen
        ).where(frames.is_named(seen.c.name, name)),
        _course(
            failed,
            failed.c.sequence,
            "an action failed",
            detail=failed.c.reason,
            node_id=failed.c.id,
            time=failed.c.start_time,
        ).where(frames.is_named(failed.c.object, name)),
    ]
    courses = [each.where(frames.of_episode(each.selected_columns.episode, episode)) for each in courses]
    course = sa.union_all(*courses).subquery("course")
    of_course = _NODE.c.id == course.c.node_id, _NODE.c.process_metadata_id == course.c.episode
    return (
        sa.select(*course.c[:-1], _NODE.c.dtype.label("by"), _NODE.c.status.label("status"), course.c.node_id)
        .outerjoin(_NODE, sa.and_(*of_course, frames.of_episode(_NODE.c.process_metadata_id, episode)))
        .order_by(course.c.episode, course.c.sequence, course.c.what, course.c.detail.nulls_first())
    )


# === ask ======================================================================================================


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

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> typing.NoReturn:
            raise AttributeError(f"there is no question {name}{nearest(name, QUESTIONS)}")

    # --- failures ---------------------------------------------------------------------------------------------

    @_Question
    @staticmethod
    def root_failures(**search: typing.Unpack[FailureSearch]) -> Rows:
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
        failure = orm.RootFailure
        statement = sa.select(
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
        return frames.limited(statement.where(*_matching(search)).order_by(failure.id + 0), search.get("limit"))

    @_Question
    @staticmethod
    def failures_by_cause(**search: typing.Unpack[FailureSearch]) -> Rows:
        """Count failures by reason, type of the failed node and object, the most frequent first.

        The arguments are those of `root_failures`. A failure counts once, where it began, and in the column of its
        outcome.
        """
        names = "reason dtype object process_metadata_id start_time message outcome".split()
        chosen = sa.select(*(getattr(orm.RootFailure, each) for each in names)).where(*_matching(search))
        # With a limit no database replaces the columns by their expressions, and computes an outcome for each of them.
        # For one with a number PostgreSQL would rather have the first row early than read fewer nodes, and read all of
        # them.
        failed = chosen.limit(sql_of(sa.BigInteger(), "-1", "ALL")).subquery("failed").c
        causes = failed.reason, failed.dtype, failed.object
        statement = (
            sa.select(
                *causes,
                sa.func.count().label("times"),
                frames.times_with(failed.outcome == RECOVERED).label(RECOVERED),
                sa.func.count(failed.process_metadata_id.distinct()).label("episodes"),
                sa.func.max(failed.start_time).label("last_time"),
                sa.func.min(failed.message).label("a_message"),
                *(frames.times_with(failed.outcome == each).label(each) for each in OUTCOMES if each != RECOVERED),
            )
            .group_by(*causes)
            .order_by(sa.func.count().desc(), *(each.nulls_first() for each in causes))
        )
        return frames.limited(statement, search.get("limit"))

    @_Question
    @staticmethod
    def steps_before_failures(
        *, steps: Annotated[int, "Steps before each failure."] = 5, **search: typing.Unpack[FailureSearch]
    ) -> Rows:
        """List the last actions and motions that had ended before each failed node started, the latest first.

        `steps` is their number for each failure, 1 to 100; the other arguments are those of `root_failures`.
        """
        failure, step, count = orm.RootFailure, orm.TaskTreeNode, frames.checked_count("steps", steps, 100)
        latest = (
            sa.select(
                failure.process_metadata_id.label("episode"),
                failure.sequence.label("failure_sequence"),
                failure.dtype.label("failed"),
                failure.reason,
                sa.cast(sa.literal_column("1"), sa.BigInteger).label("steps_before"),
                _ended_before(failure.id, failure.process_metadata_id, failure.sequence).label("node_id"),
                failure.id.label("failure_id"),
            )
            .where(*_matching(search))
            .cte("latest", recursive=True)
        )
        # One step after the other is looked up by its id, as a plan by any other way depends on statistics.
        same = "episode", "failure_sequence", "failed", "reason"
        latest = latest.union_all(
            sa.select(
                *(latest.c[each] for each in same),
                latest.c.steps_before + 1,
                _ended_before(latest.c.node_id, latest.c.episode, latest.c.failure_sequence),
                latest.c.failure_id,
            ).where(latest.c.steps_before < count, latest.c.node_id.is_not(None))
        )
        is_step = step.id == latest.c.node_id, step.process_metadata_id == latest.c.episode
        statement = (
            sa.select(
                *(latest.c[each] for each in same),
                latest.c.steps_before,
                step.sequence.label("sequence"),
                step.dtype,
                step.kind,
                step.status,
                step.duration.label("duration_s"),
                step.id.label("node_id"),
            )
            .join(step, sa.and_(*is_step, frames.of_episode(step.process_metadata_id, search.get("episode"))))
            # Both hold of every step. PostgreSQL expects ten times as many steps as there are, and would read all nodes
            # to join them; with each range it expects a two-hundredth of that, and looks the steps up by their ids.
            .where(
                latest.c.steps_before.between(sa.literal_column("1"), sa.literal_column(str(count))),
                latest.c.node_id.between(
                    _first_id(latest.c.episode), _first_id(latest.c.episode) + sa.literal_column(str(1 << _NUMBER_BITS))
                ),
            )
            .order_by(latest.c.failure_id, latest.c.steps_before)
        )
        return frames.limited(statement, search.get("limit"))

    # --- actions ----------------------------------------------------------------------------------------------

    @_Question
    @staticmethod
    def success_rates(*, episode: Of = None, dtype: Dtype = None, kind: Kind = "action", limit: Limit = None) -> Rows:
        """Count successes and failures of each type, with the share of successes and its 95 % interval, low to high.

        A share counts what succeeded, failed or ended in an error; not what was cancelled, interrupted or lost.
        """
        node = orm.TaskTreeNode
        episodes = sa.func.count(node.process_metadata_id.distinct()).label("episodes")
        columns = *frames.success_rate(node.status, node.status.in_(frames.TRIED)), episodes
        statement = _by_type(episode, columns, dtype=dtype, kind=kind)
        return frames.limited(statement.order_by(sa.func.count().desc(), node.dtype), limit)

    @_Question
    @staticmethod
    def longest_actions(*, episode: Of = None, dtype: Dtype = None, status: Status = None, limit: Limit = 10) -> Rows:
        """List the ended actions that took longest, also only those of one type (`dtype`) or status."""
        node = orm.TaskTreeNode
        state = None if status is None else frames.member_of(TaskStatus, status, "status")
        statement = sa.select(
            node.process_metadata_id.label("episode"),
            node.sequence.label("sequence"),
            node.dtype,
            node.duration.label("duration_s"),
            node.status,
            node.reason,
            node.start_time.label("time"),
            node.id.label("node_id"),
        ).where(
            node.kind == "action",
            node.end_ns.is_not(None),
            frames.of_episode(node.process_metadata_id, episode),
            frames.equal(node.dtype, dtype),
            frames.equal(node.status, state),
        )
        return frames.limited(statement.order_by((node.end_ns - node.start_ns).desc(), node.id), limit)

    @_Question
    @staticmethod
    def durations(*, episode: Of = None, dtype: Dtype = None, kind: Kind = "action", limit: Limit = None) -> Rows:
        """Sum up the durations of each type: number, successes, failures, total, mean, shortest, longest."""
        node = orm.TaskTreeNode
        sums: dict[str, Any] = {
            "total_s": sa.func.sum,
            "mean_s": sa.func.avg,
            "shortest_s": sa.func.min,
            "longest_s": sa.func.max,
        }
        columns = [each(node.duration).label(name) for name, each in sums.items()]
        statement = _by_type(episode, columns, dtype=dtype, kind=kind)
        return frames.limited(statement.order_by(sa.func.sum(node.duration).desc().nulls_last(), node.dtype), limit)

    @_Question
    @staticmethod
    def arms_used(*, episode: Of = None, dtype: Dtype = None, limit: Limit = None) -> Rows:
        """Count the actions of each arm and type, with their successes and failures."""
        node, parameters = orm.TaskTreeNode, _DESIGNATOR.c.parameters
        arm = sa.func.coalesce(frames.json_text(parameters, "arm"), frames.json_text(parameters, "gripper")).label(
            "arm"
        )
        statement = (
            sa.select(arm, node.dtype, *_counts(node.status))
            .join(_DESIGNATOR, same_row(_DESIGNATOR, _NODE))
            .where(
                node.kind == "action",
                arm.is_not(None),
                frames.of_episode(node.process_metadata_id, episode),
                frames.equal(node.dtype, dtype),
            )
        )
        return frames.limited(
            statement.group_by(arm, node.dtype).order_by(arm, sa.func.count().desc(), node.dtype), limit
        )

    @_Question
    @staticmethod
    def successful_pick_ups(
        *,
        episode: Of = None,
        object: Named = None,  # noqa: A002  the column's name
        object_type: Annotated[ObjectType | str | None, "Type of the object, such as MILK."] = None,
        arm: Arm = None,
        grasp: Annotated[Grasp | str | None, "Name of the grasp, such as TOP."] = None,
        robot: Robot = None,
        limit: Limit = None,
    ) -> Rows:
        """List the pick-ups that succeeded: object, arm, grasp, and the robot's base pose."""
        node, taken, pick_up, pose = orm.TaskTreeNode, Object.__table__, orm.PickUpAction.__table__, orm.Pose.__table__
        is_taken = taken.c.id == pick_up.c.object_designator_id
        statement = (
            sa.select(
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
            .outerjoin(taken, is_taken & (taken.c.process_metadata_id == pick_up.c.process_metadata_id))
            .outerjoin(
                pose, (pose.c.id == node.robot_pose_id) & (pose.c.process_metadata_id == node.process_metadata_id)
            )
            .where(node.status == TaskStatus.SUCCEEDED, frames.of_episode(node.process_metadata_id, episode))
            .order_by(node.id)
        )
        if episode is not None and not isinstance(episode, Sequence):
            # a range of ids, because the pick-ups have no index of episodes
            numbers: Any = episode
            statement = statement.where(pick_up.c.id.between(_first_id(numbers), _first_id(numbers + 1)))
        if object is not None:
            statement = statement.where(frames.containing(object, taken.c.name))
        members = (
            (taken.c.obj_type, ObjectType, object_type, "object_type"),
            (pick_up.c.arm, Arms, arm, "arm"),
            (pick_up.c.grasp, Grasp, grasp, "grasp"),
        )
        for column, enum, value, argument in members:
            if value is not None:
                statement = statement.where(column == frames.member_of(enum, value, argument))
        return frames.limited(statement.where(frames.equal(node.robot, robot)), limit)

    @_Question
    @staticmethod
    def experience_at(
        x: Annotated[float, "Place in the map, m."],
        y: Annotated[float, "Place in the map, m."],
        *,
        radius_m: Annotated[float, "Distance from the place, m."] = 0.5,
        episode: Of = None,
        dtype: Dtype = None,
        limit: Limit = None,
    ) -> Rows:
        """Sum up the actions that a robot started within `radius_m` of a place: by type and arm, with successes.

        A share counts what `success_rates` counts.
        """
        x, y, radius_m = (frames.checked_metres(*each) for each in (("x", x), ("y", y), ("radius_m", radius_m)))
        if radius_m <= 0:
            raise CallerError(f"radius_m must be > 0, got {radius_m}")
        node, pose = orm.TaskTreeNode, orm.Pose
        arm = frames.json_text(_DESIGNATOR.c.parameters, "arm").label("arm")
        east, north = pose.x - x, pose.y - y
        statement = (
            sa.select(
                node.dtype,
                arm,
                *_counts(node.status),
                *frames.success_rate(node.status, node.status.in_(frames.TRIED)),
                sa.func.avg(node.duration).label("mean_s"),
                sa.func.max(node.start_time).label("last_time"),
            )
            .join(_DESIGNATOR, same_row(_DESIGNATOR, _NODE))
            .join(pose, (pose.id == node.robot_pose_id) & (pose.process_metadata_id == node.process_metadata_id))
            .where(
                node.kind == "action",
                node.end_sequence.is_not(None),
                pose.x.between(x - radius_m, x + radius_m),
                east * east + north * north <= radius_m * radius_m,
                frames.of_episode(node.process_metadata_id, episode),
                frames.equal(node.dtype, dtype),
            )
            .group_by(node.dtype, arm)
            .order_by(sa.func.count().desc(), node.dtype, arm.nulls_first())
        )
        return frames.limited(statement, limit)

    # --- objects ----------------------------------------------------------------------------------------------

    @_Question
    @staticmethod
    def object_history(name: Name, *, episode: Of = None, limit: Limit = None) -> Rows:
        """List all that happened to the object of this name: added, moved, attached, seen, failed with, removed."""
        return frames.limited(_history(name, episode), limit)

    @_Question
    @staticmethod
    def moves_of(name: Name, *, episode: Of = None, limit: Limit = None) -> Rows:
        """List each move of an object with the node that moved it and the nearest action around that node."""
        by, joined = _NODE.alias("by"), partial(_joined, episode)
        moved = "id", "process_metadata_id", "time", "name", "pose_id", "node_id"
        moves = (
            sa.select(*(_OBJECT.c[each] for each in moved), Object.sequence.label("sequence"))
            .where(
                frames.is_named(_OBJECT.c.name, name),
                _OBJECT.c.id != _OBJECT.c.identity_id,
                _OBJECT.c.dtype == "Object",
                frames.of_episode(_OBJECT.c.process_metadata_id, episode),
            )
            .cte("moves")
        )
        columns = ("id", "parent_id", "process_metadata_id", "kind", "dtype", "status")
        up = (
            sa.select(moves.c.id.label("move"), *(by.c[each] for each in columns))
            .join(by, joined(moves.c.node_id, by, moves))
            .cte("up", recursive=True)
        )
        above = _NODE.alias("above")
        up = up.union_all(
            sa.select(up.c.move, *(above.c[each] for each in columns)).where(
                up.c.kind != "action", joined(up.c.parent_id, above, up)
            )
        )
        mover = _NODE.alias("mover")
        statement = (
            sa.select(
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
            .outerjoin(up, sa.and_(up.c.move == moves.c.id, up.c.kind == "action"))
            .outerjoin(mover, joined(moves.c.node_id, mover, moves))
            .outerjoin(_POSE, joined(moves.c.pose_id, _POSE, moves))
            .order_by(moves.c.id)
        )
        return frames.limited(statement, limit)

    # --- episodes ---------------------------------------------------------------------------------------------

    @_Question
    @staticmethod
    def streams(*, episode: Of = None, limit: Limit = None) -> Rows:
        """List the streams of samples, such as joint states, with the numbers of their channels and samples.

        `memory.samples(stream)` returns one as a frame.
        """
        observation, values = orm.Observation.__table__, orm.ObservationValue.__table__
        block, count, channels = (values.alias() for _ in range(3))
        joined = partial(_joined, episode)
        statement = (
            sa.select(
                observation.c.process_metadata_id.label("episode"),
                observation.c.name.label("stream"),
                sa.cast(sa.func.max(channels.c.number), sa.Integer).label("channels"),
                sa.cast(sa.func.sum(count.c.number), sa.Integer).label("samples"),
                sa.func.max(observation.c.time).label("time"),
            )
            .select_from(
                observation
            )  # the condition of a join may have a subquery, so that it does not show the left side
            .join(block, joined(observation.c.id, block, observation) & (block.c.media_type == SAMPLES))
            .join(count, joined(observation.c.id, count, observation) & (count.c.key == "samples"))
            .join(channels, joined(observation.c.id, channels, observation) & (channels.c.key == "channels"))
            .where(frames.of_episode(observation.c.process_metadata_id, episode))
            .group_by(observation.c.process_metadata_id, observation.c.name)
            .order_by(observation.c.process_metadata_id, observation.c.name)
        )
        return frames.limited(statement, limit)

    @_Question
    @staticmethod
    def episodes(
        *,
        status: Status = None,
        since: Annotated[datetime | None, "Started then or later: 2026-11-23, 2026-11-23T14:30, 90min, 7d."] = None,
        tag: Annotated[str | None, "With this tag."] = None,
        robot: Robot = None,
        text: Words = None,
        episode: Of = None,
        limit: Limit = None,
    ) -> Rows:
        """List the episodes, the newest first; also only some of them.

        Args:
            status: RUNNING, SUCCEEDED, FAILED …
            since: the earliest start, with a time zone.
            tag: that they have now.
            robot: name or model of a robot that took part.
            text: a part of the description, the plan's name or a tag.
            episode: only this one.
            limit: of rows.
        """
        state = status.name if isinstance(status, TaskStatus) else status
        return episode_list(episode, EpisodeChoice(state, since, () if tag is None else (tag,), robot, text, limit))


QUESTIONS: tuple[str, ...] = tuple(name for name, each in vars(Ask).items() if isinstance(each, _Question))
"""The names of all questions."""


def arguments_of(question: str) -> Mapping[str, Argument]:
    """Return the arguments of a question by name."""
    arguments: Mapping[str, Argument] = getattr(Ask, question).arguments
    return arguments
