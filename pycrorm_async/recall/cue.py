"""A cue describes the cases to recall: features that they share, as far as possible, and conditions that they fulfil.

`has` and `near` make cases similar; a case without some of them has a lower score. Type, `lacks`, times, episodes and
`prohibit` are conditions: a case that does not fulfil them is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from numbers import Real
from typing import Any

from pycrorm_async.errors import CallerError
from pycrorm_async.query.suggestions import nearest
from pycrorm_async.recall.blocks import WORDS_MAX
from pycrorm_async.recall.case import FEATURES_MAX, TEXT_MAX
from pycrorm_async.recall.library import CaseLibrary

K_MAX = 10_000
"""Bounds the cases of one answer."""
_LISTED = 12
"""Bounds the names that an error lists."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A wanted number; tolerance None means the standard deviation of this number among the cases of the type."""

    feature: str
    value: float
    tolerance: float | None = None


@dataclass(frozen=True, kw_only=True)
class Cue:
    """The cases to recall. Times are µs since 1970, nodes and episodes as in this database.

    Attributes:
        type: a dtype; None for cases of every type.
        has: pairs of feature and word. A feature with several values may occur several times.
        near: the wanted numbers.
        lacks, requires: pairs of feature and word that a case must not have, and that it must have.
        before_us, after_us: a case starts before the one, and at or after the other.
        during_us: start and end of an interval in which a case starts and ends.
        as_of_us: a case has ended by then; word frequencies count only cases that had ended by then.
        episodes: numbers of episodes; None for all.
        prohibit: ids of nodes whose cases are left out.
        simulated: whether simulations are answers too.
        k: the number of cases of the answer.
        minimum: the lowest score of an answer, 0 to 1. Cases with score 0 are left out.
        left_out: the number of features of the original case that the cue does not have, for a cue made from a case.
    """

    type: str | None = None
    has: tuple[tuple[str, str], ...] = ()
    near: tuple[Wanted, ...] = ()
    lacks: tuple[tuple[str, str], ...] = ()
    requires: tuple[tuple[str, str], ...] = ()
    before_us: int | None = None
    after_us: int | None = None
    during_us: tuple[int, int] | None = None
    as_of_us: int | None = None
    episodes: frozenset[int] | None = None
    prohibit: frozenset[int] = frozenset()
    simulated: bool = False
    k: int = 20
    minimum: float = 0.0
    left_out: int = 0

    def __str__(self) -> str:
        """Return the cue as `pycrorm recall` takes it."""
        numbers = [
            f"{each.feature}~{each.value:g}{f'±{each.tolerance:g}' if each.tolerance else ''}" for each in self.near
        ]
        pairs = [f"{name}={value}" for name, value in self.has]
        absent = [f"not:{name}={value}" for name, value in self.lacks]
        return " ".join([*([self.type] if self.type else []), *pairs, *numbers, *absent])


def symbols_of(pairs: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of feature and word of `has` or `lacks`; a list has several words. Raises `CallerError`."""
    return tuple(dict.fromkeys(_symbols(pairs)))


def numbers_of(near: Mapping[str, Any]) -> tuple[Wanted, ...]:
    """Return the wanted numbers of `near`: numbers, or pairs of number and tolerance. Raises `CallerError`."""
    return tuple(_wanted(feature, value) for feature, value in _mapping(near).items())


def word(value: object) -> str:
    """Return a value as cases have it: the name of an enum's member or of a class, or its text.

    >>> word(Arms.LEFT), word(True), word("MILK")
    ('LEFT', 'True', 'MILK')
    """
    match value:
        case Enum():
            return value.name
        case type():
            return value.__name__
    return str(value)


def closest(name: str, valid: Iterable[str]) -> str:
    """Return the end of an error's line: the names most like this one, or else some of the valid ones.

    >>> closest("graps", ["arm", "grasp", "height"])
    '; did you mean grasp?'
    """
    names = sorted(valid)
    question = nearest(name[:TEXT_MAX], names)
    listed = f"; there are {', '.join(names[:_LISTED])}{', ...' if len(names) > _LISTED else ''}" if names else ""
    return question or listed


# --- invalid cues ---------------------------------------------------------------------------------------------


def check_cue(cue: Cue, library: CaseLibrary) -> None:
    """Raise `CallerError` for a cue that no memory, or not this one, can answer; the message is one line.

    A type or a word that never occurred is no error: `Answer.never_seen` lists it.
    """
    if cue.type is None and not (cue.has or cue.near or cue.lacks):
        raise CallerError("the cue is empty: give a type, or features in `has`, `near` or `lacks`")
    k: object = cue.k
    minimum: object = cue.minimum
    if not isinstance(k, int) or not 1 <= k <= K_MAX:
        raise CallerError(f"k must be 1 to {K_MAX:,}, got {shortened(k)}")
    if not isinstance(minimum, int | float) or not 0 <= minimum <= 1:
        raise CallerError(f"minimum must be a score from 0 to 1, got {shortened(minimum)}")
    if len(cue.has) + len(cue.near) + len(cue.lacks) > FEATURES_MAX:
        count = len(cue.has) + len(cue.near) + len(cue.lacks)
        raise CallerError(f"the cue has {count:,} features, and at most {FEATURES_MAX} are compared")
    contradiction = next((each for each in cue.lacks if each in cue.has), None)
    if contradiction is not None:
        raise CallerError(f"{'='.join(contradiction)} is both in `has` and in `lacks`, so no case can be an answer")
    if cue.before_us is not None and cue.after_us is not None and cue.before_us <= cue.after_us:
        raise CallerError("`before` is not later than `after`, so no case can be an answer")
    if cue.during_us is not None and cue.during_us[1] < cue.during_us[0]:
        raise CallerError("`during` ends before it starts, so no case can be an answer")
    if library.size(cue.type):
        _check_features(cue, library)


def _check_features(cue: Cue, library: CaseLibrary) -> None:
    texts, numbers = library.texts(cue.type), library.numbers(cue.type)
    owner = f"no case of {cue.type}" if cue.type else "no case"
    for feature, value in (*cue.has, *cue.lacks, *cue.requires):
        if feature in texts:
            continue
        if feature in library.left_out:
            raise CallerError(f"{feature} has more than {WORDS_MAX:,} different values, so it is not compared")
        if feature in numbers:
            raise CallerError(f"{feature} is a number: ask for it with `near` (FEATURE~NUMBER), got the text {value!r}")
        raise CallerError(f"{owner} has a feature {shortened(feature)}{closest(feature, texts)}")
    for each in cue.near:
        if each.feature in numbers:
            continue
        if each.feature in texts:
            raise CallerError(
                f"{each.feature} is a text: ask for it with `has` (FEATURE=TEXT), got the number {each.value:g}"
            )
        raise CallerError(f"{owner} has a number {shortened(each.feature)}{closest(each.feature, numbers)}")


def _symbols(pairs: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for feature, value in _mapping(pairs).items():
        for each in value if isinstance(value, list | tuple | set | frozenset) else [value]:
            if isinstance(each, Real) and not isinstance(each, bool | Enum):
                raise CallerError(f"{feature} is given as the number {each}: ask for numbers with `near`")
            if each is None:
                raise CallerError(
                    f"{feature} is given as None: leave it out, or give the values that it must not have in `lacks`"
                )
            symbol = word(each)
            if len(symbol) > TEXT_MAX:
                raise CallerError(f"{feature} is a text of {len(symbol):,} characters; cases have at most {TEXT_MAX}")
            if not symbol:
                raise CallerError(f"{feature} is an empty text, which no case has")
            yield feature, symbol


def _mapping(features: object) -> Mapping[str, Any]:
    if isinstance(features, Mapping):
        return features
    raise CallerError(f"features are given as {shortened(features)}: give a dictionary, as in {{'arm': 'LEFT'}}")


def _wanted(feature: str, value: Any) -> Wanted:
    pair = value if isinstance(value, tuple | list) else (value,)
    if len(pair) not in (1, 2):
        raise CallerError(f"{feature} is given as {len(pair)} values: give a number, or a number and its tolerance")
    wanted, *tolerances = (_number(feature, each) for each in pair)
    if tolerances and tolerances[0] <= 0:
        raise CallerError(f"the tolerance of {feature} must be greater than 0, got {tolerances[0]:g}")
    return Wanted(feature, wanted, *tolerances)


def _number(feature: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise CallerError(f"{feature} is given as {shortened(value)}, which is not a number: ask for texts with `has`")
    number = float(value)
    if not math.isfinite(number):
        raise CallerError(f"{feature} must be a finite number, got {number}")
    return number


def shortened(value: object) -> str:
    """Return a value as it is written in an error's line."""
    text = repr(value)
    return text if len(text) <= TEXT_MAX else f"{text[:40]}... ({len(text):,} characters)"
