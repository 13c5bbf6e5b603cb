"""Write the observations that a program makes itself, for an episode of any executive.

An observation never waits: where the spool has no room beside its reserve, it is counted as missing, as the samples of
the robot's state are left out.
"""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from pycrorm_async.errors import SpoolFull, SpoolStuck, Unrecordable
from pycrorm_async.events.codec import NotEncodable, encoded_bytes
from pycrorm_async.events.types import Observed
from pycrorm_async.recording.values.observed_values import ObservedReader
from pycrorm_async.recording.values.texts import clean, clean_repr, cut
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter

_NAME_MAX = 1_000
"""Bounds the characters of a name, far above real names."""
_PATH_BYTES_MAX = 8_192
"""Bounds the bytes of paths and reasons in an event whose values did not fit."""


def put_observation(
    emitter: Emitter, episode: EpisodeWriter[Any], name: object, values: object, node: int, *, may_refuse: bool
) -> int:
    """Write values under this name, observed by the node with this sequence; return the sequence of the event.

    Returns 0 if the spool has no room; the observation is counted as missing then. Raises `Unrecordable` only if
    `may_refuse` and with `on_unrecordable="refuse"`.
    """
    name = name_of(name)
    reader = ObservedReader(episode, emitter.put_blob)
    event = Observed(name, reader.read(values), node, reader.missing)
    try:
        if reader.missing:
            _note_missing(emitter, name, reader.missing, may_refuse=may_refuse)
        return _put(emitter, episode, event, may_refuse=may_refuse)
    except (SpoolFull, SpoolStuck) as refusal:
        emitter.missing.note("observation", name, str(refusal))
        return 0
    finally:
        for reference in reader.blobs:
            emitter.release_blob(reference)


def _put(emitter: Emitter, episode: EpisodeWriter[Any], event: Observed, *, may_refuse: bool) -> int:
    try:
        return emitter.offer(episode.id, event)
    except NotEncodable as error:
        fitted = _fit(event, error, emitter.settings.record_bytes_max)
        new = {path: why for path, why in fitted.missing.items() if path not in event.missing}
        _note_missing(emitter, event.name, new, may_refuse=may_refuse)
        return emitter.offer(episode.id, fitted)


def _note_missing(emitter: Emitter, name: str, missing: dict[str, str], *, may_refuse: bool) -> None:
    if may_refuse and emitter.settings.on_unrecordable == "refuse":
        path, reason = next(iter(missing.items()))
        raise Unrecordable(f"observation {name!r}", path or "values", reason)
    for path, reason in missing.items():
        emitter.missing.note(f"observation {name}", path or "values", reason)


def name_of(name: object) -> str:
    """Return the text under which an observation of this name is recorded."""
    return cut(clean(name if isinstance(name, str) else clean_repr(name)), _NAME_MAX)


def _fit(event: Observed, error: NotEncodable, bytes_max: int) -> Observed:
    """Replace the largest values of a dict by null until the event fits; without a dict, the whole value."""
    values = event.values
    if not isinstance(values, dict) or len(event.missing) > len(values):
        return replace(event, values=None, missing={"": error.reason})
    sizes = {key: len(key) + encoded_bytes(each) for key, each in values.items()}
    room = bytes_max - _PATH_BYTES_MAX - len(event.name) * 6
    left, missing = dict(values), dict(event.missing)
    for key in sorted(sizes, key=sizes.__getitem__, reverse=True):
        if sum(sizes.values()) <= room:
            break
        reason = f"it takes {sizes.pop(key):,} bytes; {error.reason}"
        left[key], missing[key] = None, reason
    if encoded_bytes(left) + encoded_bytes(missing) > room:
        return replace(event, values=None, missing={"": error.reason})
    return replace(event, values=left, missing=missing)
