"""Shorten events that cannot be encoded: too long, or with values that JSON cannot hold."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec.structs import replace

from pycrorm_async.events.codec import NotEncodable, encode
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    Happening,
    LocationResolved,
    NodeEnded,
    ObjectDetected,
)
from pycrorm_async.events.values import FailureValue, MissingValue, PoseValue
from pycrorm_async.recording.values.texts import clean, cut

EPISODE_TEXT_MAX = 10_000
"""Bounds the characters of an episode's description, plan and world, so that their columns stay readable."""

_BYTES_PER_CHARACTER_MAX = 7
"""Bounds the encoded size: a control character takes six bytes in JSON; the seventh covers the keys and quotes."""
_CUT_LENGTHS = (1_000, 100, 10)
"""Characters to shorten a text to, tried in turn until the event fits."""
_NAME_MAX = 1_000
"""Bounds the characters of a name, far above real names."""


def fit_episode_start(started: EpisodeStarted, bytes_max: int) -> tuple[EpisodeStarted, list[str]]:
    """Shorten the long texts of an episode's start; return the event and the names of the shortened fields."""
    texts = {
        name: text
        for name in ("description", "plan", "world", "created_by", "host", "software")
        if (text := getattr(started, name)) is not None
    }
    if (
        max(map(len, texts.values())) <= EPISODE_TEXT_MAX
        and _BYTES_PER_CHARACTER_MAX * sum(map(len, texts.values())) < bytes_max
    ):
        return started, []
    for characters_max in (EPISODE_TEXT_MAX, *_CUT_LENGTHS):
        shortened = [name for name, text in texts.items() if len(text) > characters_max]
        if shortened:
            started = replace(started, **{name: cut(texts[name], characters_max) for name in shortened})
        if fits(started, bytes_max):
            break
    return started, shortened


def episode_text_of(text: str) -> str:
    """Clean and shorten a text for a column of an episode."""
    return cut(clean(text), EPISODE_TEXT_MAX)


def fit_node_end(ended: NodeEnded, bytes_max: int) -> NodeEnded:
    """Replace a result that cannot be encoded by a `MissingValue`, then shorten the failure until the event fits."""
    if ended.result is not None:
        try:
            encode(ended, bytes_max=bytes_max)
        except NotEncodable as error:
            ended = replace(ended, result=MissingValue(error.reason))
    for failure in _shortened_failures(ended.failure):
        if fits(ended, bytes_max):
            break
        ended = replace(ended, failure=failure)
    return ended


def fit_episode_end(ended: EpisodeEnded, bytes_max: int) -> EpisodeEnded:
    """Shorten the world and then the failure of an episode's end until the event fits."""
    for characters_max in _CUT_LENGTHS:
        if ended.world is None or fits(ended, bytes_max):
            break
        ended = replace(ended, world=cut(ended.world, characters_max))
    for failure in _shortened_failures(ended.failure):
        if fits(ended, bytes_max):
            break
        ended = replace(ended, failure=failure)
    return ended


def _shortened_failures(failure: FailureValue | None) -> Iterator[FailureValue]:
    """Yield ever shorter versions of a failure: first without its arguments, then with a shortened message."""
    if failure is not None:
        for characters_max in (len(failure.message), *_CUT_LENGTHS):
            yield FailureValue(cut(failure.type, _NAME_MAX), cut(failure.message, characters_max))


def fit_resolution(resolved: LocationResolved, bytes_max: int) -> LocationResolved:
    """Drop places until the event fits: first those with non-finite numbers, then the last refused, then candidates.

    The candidate that was taken is kept, unless it holds a non-finite number; then `taken` becomes None.
    """
    refused = tuple(each for each in resolved.refused if _is_finite(each.pose))
    taken = resolved.offered[resolved.taken] if resolved.taken is not None else None
    others = [
        each
        for index, each in enumerate(resolved.offered)
        if index != resolved.taken and _is_finite(each.pose, each.torso_height)
    ]
    last = (taken,) if taken is not None and _is_finite(taken.pose, taken.torso_height) else ()
    while True:
        offered = (*others, *last)
        shorter = replace(
            resolved,
            offered=offered,
            taken=len(offered) - 1 if last else None,
            refused=refused,
            offered_beyond=resolved.offered_beyond + len(resolved.offered) - len(offered),
        )
        if not (others or refused) or fits(shorter, bytes_max):
            return shorter
        if refused:
            refused = refused[: len(refused) // 2]
        else:
            others = others[: len(others) // 2]


def fit_detection(detected: ObjectDetected, bytes_max: int) -> ObjectDetected:
    """Fit a detection: shorten its texts and drop non-finite numbers, then drop the last percepts until it fits.

    A percept with a non-finite pose is dropped.
    """
    shorter = clean_texts(detected)
    assert isinstance(shorter, ObjectDetected)
    shorter = replace(
        shorter,
        seen=tuple(
            replace(each, visible=_finite(each.visible), confidence=_finite(each.confidence))
            for each in shorter.seen
            if _is_finite(each.pose)
        ),
    )
    while shorter.seen and not fits(shorter, bytes_max):
        shorter = replace(shorter, seen=shorter.seen[: len(shorter.seen) // 2])
    return shorter


def _finite(number: float | None) -> float | None:
    return number if number is not None and math.isfinite(number) else None


def _is_finite(pose: PoseValue, height: float | None = None) -> bool:
    numbers = (*pose.position, *pose.orientation, height if height is not None else 0.0)
    return all(map(math.isfinite, numbers))


def clean_texts(event: Happening) -> Happening:
    """Clean and shorten every text of an event, and drop dict entries whose number is not finite."""
    cleaned: Happening = _cleaned(event)
    return cleaned


def _cleaned(value: Any) -> Any:
    if isinstance(value, str):
        return cut(clean(value), _NAME_MAX)
    if isinstance(value, msgspec.Struct):
        return replace(value, **{name: _cleaned(getattr(value, name)) for name in value.__struct_fields__})
    if isinstance(value, tuple):
        return tuple(map(_cleaned, value))
    if isinstance(value, dict):
        finite = {key: each for key, each in value.items() if not isinstance(each, float) or math.isfinite(each)}
        return {_cleaned(key): _cleaned(each) for key, each in finite.items()}
    return value


def fits(event: Happening, bytes_max: int) -> bool:
    """Return whether the event can be encoded in `bytes_max` bytes."""
    try:
        encode(event, bytes_max=bytes_max)
    except NotEncodable:
        return False
    return True
