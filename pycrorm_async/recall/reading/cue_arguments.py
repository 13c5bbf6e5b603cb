"""Make a cue from a caller's arguments: designator classes, enums, datetimes, cases, names of episodes and tags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple, TypeAlias

from sqlalchemy import select

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import row_key
from pycrorm_async.orm import EpisodeRobot, EpisodeTag
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.answer import RecalledCase
from pycrorm_async.recall.case import FEATURES_MAX, RESERVED, Case
from pycrorm_async.recall.cue import Cue, Wanted, closest, shortened, symbols_of, word
from pycrorm_async.recall.library import CaseLibrary
from pycrorm_async.recall.search import weights_of
from pycrorm_async.store.episode_lookup import episode_named

AnyCase: TypeAlias = "Case | RecalledCase | int"
"""A case, or the id of its task-tree node."""
TimeReference: TypeAlias = "datetime | str | AnyCase"
"""A moment: an aware datetime, or a text in ISO 8601, UTC where it has no zone; or a case, for its start or its end."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_OF_EACH_CASE = frozenset({"object_name"})
"""The texts of a case that `cue_like` leaves out: they name one object of many alike."""


class Conditions(NamedTuple):
    """The conditions of a cue, as `Recall` takes them."""

    before: TimeReference | None = None
    after: TimeReference | None = None
    during: AnyCase | tuple[TimeReference, TimeReference] | None = None
    as_of: TimeReference | None = None
    prohibit: Iterable[AnyCase] = ()
    only: Mapping[str, Any] | None = None
    episode: AnyEpisode | Iterable[AnyEpisode] | None = None
    robot: str | None = None
    tag: str | None = None
    simulated: bool = False
    k: int = 20
    minimum: float = 0.0


class EpisodeNames:
    """The episodes of a memory by name and by tag, and the robots that took part in them."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading

    async def numbers_of(self, episode: AnyEpisode | Iterable[AnyEpisode]) -> frozenset[int]:
        """Return the numbers of one episode or several. Raises `UnknownEpisode`."""
        several = [episode] if isinstance(episode, int | str | EpisodeSummary) or not _is_iterable(episode) else episode
        log = await self._reading.log()
        names = [str(each.number if isinstance(each, EpisodeSummary) else each) for each in several]  # type: ignore[union-attr]
        return frozenset([(await episode_named(log, name)).number for name in names])

    async def tagged(self, tag: str) -> frozenset[int]:
        """Return the numbers of the episodes with a tag. Raises `CallerError` if no episode has it."""
        async with self._reading.session(simulated=True) as session:
            rows = (await session.execute(select(EpisodeTag.process_metadata_id, EpisodeTag.tag))).all()
        numbers = frozenset(number for number, each in rows if each == tag)
        if not numbers:
            raise CallerError(f"no episode has the tag {tag!r}{closest(tag, {each for _, each in rows})}")
        return numbers

    async def check_robot(self, robot: str) -> None:
        """Raise `CallerError` if no robot of this name took part in any episode."""
        async with self._reading.session(simulated=True) as session:
            names = set((await session.scalars(select(EpisodeRobot.name).distinct())).all())
        if robot not in names:
            raise CallerError(f"no episode has the robot {robot!r}{closest(robot, names)}")


async def make_cue(
    library: CaseLibrary,
    episodes: EpisodeNames,
    dtype: str | None,
    has: tuple[tuple[str, str], ...],
    near: tuple[Wanted, ...],
    lacks: tuple[tuple[str, str], ...],
    conditions: Conditions,
) -> Cue:
    """Return the cue. Raises `CallerError` for a moment without a zone or an unknown node, `UnknownEpisode`."""
    numbers = await _numbers(episodes, conditions)
    during = None
    if isinstance(conditions.during, tuple) and not isinstance(conditions.during, Case):
        if len(conditions.during) != 2:
            raise CallerError(f"`during` takes a case, or two moments, got {len(conditions.during)}")
        first, last = conditions.during
        during = _start(first, library), _end(last, library)
    elif conditions.during is not None:
        case = case_of(conditions.during, library)
        if case.duration_s is None:
            raise CallerError(f"{case.type} in episode {case.episode} has no end, so nothing happened during it")
        during = case.started_us, _end(case, library)
        numbers = frozenset({case.episode}) & (numbers if numbers is not None else {case.episode})
    only = dict(conditions.only or {})
    if conditions.robot is not None:
        only["robot"] = conditions.robot
    return Cue(
        type=dtype,
        has=has,
        near=near,
        lacks=lacks,
        requires=symbols_of(only),
        before_us=None if conditions.before is None else _start(conditions.before, library),
        after_us=None if conditions.after is None else _end(conditions.after, library),
        during_us=during,
        as_of_us=None if conditions.as_of is None else _start(conditions.as_of, library),
        episodes=numbers,
        prohibit=_nodes(conditions.prohibit),
        simulated=conditions.simulated,
        k=conditions.k,
        minimum=conditions.minimum,
    )


def cue_like(case: Case, library: CaseLibrary) -> Cue:
    """Return the situation of a case as a cue, without its outcome and without the name of its object.

    If there are more features than a cue can have, those with the lowest weights are left out, and counted.
    """
    unused = RESERVED | _OF_EACH_CASE | library.left_out
    has = symbols_of({name: value for name, value in case.symbols.items() if name not in unused})
    near = tuple(Wanted(name, value) for name, value in sorted(case.numbers.items()))
    cue = Cue(type=case.type, has=has, near=near, simulated=case.simulated)
    features = [*has, *near]
    if len(features) <= FEATURES_MAX:
        return cue
    weights = [*weights_of(cue, library).words, *(1.0 for _ in near)]
    heaviest = sorted(range(len(features)), key=lambda index: -weights[index])[:FEATURES_MAX]
    kept = {features[index] for index in heaviest}
    return replace(
        cue,
        has=tuple(each for each in has if each in kept),
        near=tuple(each for each in near if each in kept),
        left_out=len(features) - FEATURES_MAX,
    )


def dtype_of(designator: str | type | None) -> str | None:
    """Return the type of a designator class, of a mapped class, or by its name.

    >>> dtype_of(PickUpAction), dtype_of("PickUpAction")
    ('PickUpAction', 'PickUpAction')
    """
    if designator is None or isinstance(designator, str):
        return designator
    dtype = getattr(designator, "dtype", None)
    if isinstance(dtype, str):
        return dtype
    if not isinstance(designator, type):
        raise CallerError(f"{shortened(designator)} is not a type: give a designator class, or the name of one")
    return word(designator).removeprefix("ORM")


def aliases_of(designator: str | type | None) -> tuple[str, ...]:
    """Return the former names that a designator class declares."""
    aliases = vars(designator).get("aliases", ()) if isinstance(designator, type) else ()
    return tuple(aliases) if isinstance(aliases, tuple | list) else ()


def node_of(case: AnyCase) -> int:
    """Return the id of the node of a case. Raises `CallerError` for anything else."""
    if not isinstance(case, int | Case | RecalledCase):
        raise CallerError(f"{shortened(case)} is not a case: give one of an answer, or the id of its node")
    return case if isinstance(case, int) else case.node


def _nodes(cases: object) -> frozenset[int]:
    if not isinstance(cases, Iterable) or isinstance(cases, Case | str):
        raise CallerError("`prohibit` takes a list of cases")
    return frozenset(map(node_of, cases))


async def _numbers(episodes: EpisodeNames, conditions: Conditions) -> frozenset[int] | None:
    numbers = None if conditions.episode is None else await episodes.numbers_of(conditions.episode)
    if conditions.tag is None:
        return numbers
    tagged = await episodes.tagged(conditions.tag)
    return tagged if numbers is None else numbers & tagged


def _is_iterable(value: object) -> bool:
    return isinstance(value, list | tuple | set | frozenset)


def case_of(case: AnyCase, library: CaseLibrary) -> Case:
    """Return a case, by its node too. Raises `CallerError` for a node without one."""
    if isinstance(case, Case):
        return case
    if isinstance(case, RecalledCase):
        return case.case
    case = node_of(case)
    stored = library.find(case)
    if stored is None:
        key = row_key(case) if 0 < case < 2**53 else None
        place = f"event {key.sequence} of episode {key.number}" if key is not None else f"{case}"
        raise CallerError(f"there is no case of {place}: it does not exist, is not an action, or has not ended")
    return stored


def _start(when: TimeReference, library: CaseLibrary) -> int:
    return _moment_us(when) if isinstance(when, datetime | str) else case_of(when, library).started_us


def _end(when: TimeReference, library: CaseLibrary) -> int:
    """Return the end of a case, rounded up; of a lost one, which has none, its start."""
    if isinstance(when, datetime | str):
        return _moment_us(when)
    case = case_of(when, library)
    return case.started_us + int(-(-(case.duration_s or 0.0) * 1e6 // 1))


def _moment_us(when: datetime | str) -> int:
    if isinstance(when, str):
        try:
            moment = datetime.fromisoformat(when)
        except ValueError:
            raise CallerError(
                f"{when[:40]!r} is not a moment: give one as in 2026-11-20 or 2026-11-20T14:30+01:00"
            ) from None
        when = moment if moment.utcoffset() is not None else moment.replace(tzinfo=UTC)
    if when.utcoffset() is None:
        raise CallerError(f"{when!r} has no time zone: add one, for example .replace(tzinfo=UTC)")
    return (when - _EPOCH) // timedelta(microseconds=1)
