"""Shortens events that cannot be encoded as they are: too long, or with a number or a text that JSON cannot hold."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec.structs import replace

from pycrorm_async.events.codec import NotEncodable, encode
from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    Happening,
    LocationResolved,
    MissingValue,
    NodeEnded,
    ObjectDetected,
)
from pycrorm_async.hooks.values.texts import clean, cut

__all__ = [
    "EPISODE_TEXT_MAX",
    "fits",
    "detection_that_fits",
    "node_end_that_fits",
    "episode_end_that_fits",
    "episode_that_fits",
    "resolution_that_fits",
    "with_plain_texts",
]

EPISODE_TEXT_MAX = 10_000
"""Characters of an episode's description, plan and world. Each is a column that people read."""

_BYTES_A_CHARACTER = 7
"""In JSON a control character takes six; the seventh is for what stands around the texts."""
_CUT_TO = (1_000, 100, 10)
_NAME_MAX = 1_000


def episode_that_fits(started: EpisodeStarted, bytes_max: int) -> tuple[EpisodeStarted, list[str]]:
    """The start with its long texts cut and marked, and the names of those."""
    texts = {
        name: text
        for name in ("description", "plan", "world", "created_by", "host", "software")
        if (text := getattr(started, name)) is not None
    }
    if (
        max(map(len, texts.values())) <= EPISODE_TEXT_MAX
        and _BYTES_A_CHARACTER * sum(map(len, texts.values())) < bytes_max
    ):
        return started, []
    for characters_max in (EPISODE_TEXT_MAX, *_CUT_TO):
        shortened = [name for name, text in texts.items() if len(text) > characters_max]
        if shortened:
            started = replace(started, **{name: cut(texts[name], characters_max) for name in shortened})
        if fits(started, bytes_max):
            break
    return started, shortened


def node_end_that_fits(ended: NodeEnded, bytes_max: int) -> NodeEnded:
    """The end without what it cannot hold of its result, or of its failure."""
    if ended.result is not None:
        try:
            encode(ended, bytes_max=bytes_max)
        except NotEncodable as error:
            ended = replace(ended, result=MissingValue(error.reason))
    for failure in _shorter(ended.failure):
        if fits(ended, bytes_max):
            break
        ended = replace(ended, failure=failure)
    return ended


def episode_end_that_fits(ended: EpisodeEnded, bytes_max: int) -> EpisodeEnded:
    """The end without what it cannot hold of its failure."""
    for failure in _shorter(ended.failure):
        if fits(ended, bytes_max):
            break
        ended = replace(ended, failure=failure)
    return ended


def _shorter(failure: FailureValue | None) -> Iterator[FailureValue]:
    """Without arguments, then with its message cut more and more."""
    if failure is not None:
        for characters_max in (len(failure.message), *_CUT_TO):
            yield FailureValue(cut(failure.type, _NAME_MAX), cut(failure.message, characters_max))


def resolution_that_fits(resolved: LocationResolved, bytes_max: int) -> LocationResolved:
    """Without the places that JSON cannot hold, and with as many of the others as fit; the one taken stays."""
    taken = resolved.offered[resolved.taken] if resolved.taken is not None else None
    others = [each for index, each in enumerate(resolved.offered) if index != resolved.taken and _is_finite(each)]
    last = (taken,) if taken is not None and _is_finite(taken) else ()
    while True:
        offered = (*others, *last)
        shorter = replace(resolved, offered=offered, taken=len(offered) - 1 if last else None)
        if not others or fits(shorter, bytes_max):
            return shorter
        others = others[: len(others) // 2]


def detection_that_fits(detected: ObjectDetected, bytes_max: int) -> ObjectDetected:
    """With its texts cut, and with as many of what was seen as fit, the best first."""
    shorter = with_plain_texts(detected)
    assert isinstance(shorter, ObjectDetected)
    while shorter.seen and not fits(shorter, bytes_max):
        shorter = replace(shorter, seen=shorter.seen[: len(shorter.seen) // 2])
    return shorter


def _is_finite(candidate: CandidateValue) -> bool:
    pose, height = candidate.pose, candidate.torso_height
    numbers = (*pose.position, *pose.orientation, height if height is not None else 0.0)
    return all(map(math.isfinite, numbers))


def with_plain_texts(event: Happening) -> Happening:
    """The event with every text in it cleaned and cut, and without entries of dicts that are no finite number."""
    plain: Happening = _plain(event)
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return cut(clean(value), _NAME_MAX)
    if isinstance(value, msgspec.Struct):
        return replace(value, **{name: _plain(getattr(value, name)) for name in value.__struct_fields__})
    if isinstance(value, tuple):
        return tuple(map(_plain, value))
    if isinstance(value, dict):
        finite = {key: each for key, each in value.items() if not isinstance(each, float) or math.isfinite(each)}
        return {_plain(key): _plain(each) for key, each in finite.items()}
    return value


def fits(event: Happening, bytes_max: int) -> bool:
    """Whether the event can be encoded."""
    try:
        encode(event, bytes_max=bytes_max)
    except NotEncodable:
        return False
    return True
