"""The questions that every memory answers: `memory.ask`, `reading.ask`, `pycrorm ask`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from functools import partial, wraps
from inspect import signature
from typing import TYPE_CHECKING, Any, Generic, Literal, NoReturn, TypeVar

from sqlalchemy import Select

from pycrorm_async.errors import CallerError
from pycrorm_async.query.asking import actions, episode_list, failures, object_courses
from pycrorm_async.query.asking.columns import check_texts
from pycrorm_async.query.asking.question import AskedEpisode, QuestionPlan
from pycrorm_async.query.asking.unknown_names import CHECKED
from pycrorm_async.query.suggestions import nearest
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.enums import Arms, Grasp, ObjectType

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
    the nearest name that is. Without `episode`, `longest_actions`, `durations`, `arms_used`, `successful_pick_ups`,
    `experience_at` and `episodes` read all nodes, pick-ups or episodes of the memory, because they are about all of
    them; the others find what they are about by an index, but that names of objects are compared one by one.
    """

    def __init__(self, make: Callable[[QuestionPlan], Q]) -> None:
        self._make = make

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

        Args:
            episode: only of this episode.
            object: its name, or a part of it.
            arm: its name.
            reason: the class of the failure or a part of it, or words for it: `unreachable` also finds `IKError`.
            message: a part of the message.
            text: words that are all in the object, arm, type, message or reason, as in `milk unreachable`.
            recovered: whether a node around it succeeded all the same.
            limit: of rows.
        """
        search = _search(object, arm, reason, message, text, recovered)
        return self._ask("root_failures", episode, partial(failures.root_failures, limit=limit, **search))

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

        The arguments are those of `root_failures`. A failure counts once, where it began.
        """
        search = _search(object, arm, reason, message, text, recovered)
        return self._ask("failures_by_cause", episode, partial(failures.failures_by_cause, limit=limit, **search))

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
        make = partial(failures.steps_before_failures, steps=steps, limit=limit, **search)
        return self._ask("steps_before_failures", episode, make)

    # --- actions ----------------------------------------------------------------------------------------------

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
        make = partial(actions.longest_actions, dtype=dtype, status=state, limit=limit)
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
        return self._ask("durations", episode, partial(actions.durations, dtype=dtype, kind=kind, limit=limit))

    def arms_used(
        self, *, episode: AskedEpisode | None = None, dtype: str | None = None, limit: int | None = None
    ) -> Q:
        """Count the actions of each arm and type, with their successes and failures."""
        return self._ask("arms_used", episode, partial(actions.arms_used, dtype=dtype, limit=limit))

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
            actions.successful_pick_ups,
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
        """Sum up the actions that a robot started within `radius_m` of a place: by type and arm, with successes."""
        make = partial(actions.experience_at, x=x, y=y, radius_m=radius_m, dtype=dtype, limit=limit)
        return self._ask("experience_at", None, make)

    # --- objects ----------------------------------------------------------------------------------------------

    def object_history(self, name: str, *, episode: AskedEpisode | None = None, limit: int | None = None) -> Q:
        """List all that happened to the object of this name: added, moved, attached, seen, failed with, removed."""
        return self._ask("object_history", episode, partial(object_courses.object_history, name=name, limit=limit))

    def moves_of(self, name: str, *, episode: AskedEpisode | None = None, limit: int | None = None) -> Q:
        """List each move of an object with the node that moved it and the nearest action around that node."""
        return self._ask("moves_of", episode, partial(object_courses.moves_of, name=name, limit=limit))

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
        choice = episode_list.EpisodeChoice(state, since, () if tag is None else (tag,), robot, text, limit)
        select_of = partial(episode_list.episode_list, choice=choice)
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
