"""Check the arguments with which a program opens an episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import NotEncodable, encoded_bytes
from pycrorm_async.events.tags import checked_tags
from pycrorm_async.recording.values.event_fitting import EPISODE_TEXT_MAX
from pycrorm_async.recording.values.observed_values import ObservedReader
from pycrorm_async.recording.values.value_snapshot import NO_REFERENCES
from pycrorm_async.recording.writing.emitter import BlobRefused, Emitter

_METADATA_BYTES_MAX: Final = 64 * 2**10
"""Bounds the metadata of an episode, which is one column: a page of settings, not data."""


class Labels(NamedTuple):
    """The tags of an episode, and its metadata as JSON values."""

    tags: tuple[str, ...] = ()
    metadata: Mapping[str, Any] = {}


NO_LABELS: Final = Labels()


def check_arguments(*, description: object, plan: object, seed: object, strict: bool) -> None:
    """Check that an episode's arguments fit its columns. Raises `CallerError` naming the argument.

    In strict mode a text that is too long is refused; otherwise it is cut later.
    """
    for name, text in (("plan", plan), ("description", description)):
        if text is not None and not (isinstance(text, str) and (len(text) <= EPISODE_TEXT_MAX or not strict)):
            raise CallerError(f"the {name} of an episode must be a str of at most {EPISODE_TEXT_MAX:,} characters")
    if seed is not None and not (isinstance(seed, int) and -(2**63) <= seed < 2**63):
        raise CallerError(f"the seed of an episode must be an int of at most 64 bits, not {seed!r:.100}")


def read_labels(tags: Iterable[str], metadata: object, emitter: Emitter) -> Labels:
    """Check tags and copy metadata. A value that cannot be recorded is null, and counted as missing.

    Raises `CallerError` if the tags are not a list of short texts, and for metadata without text keys.
    """
    checked = checked_tags(tags)
    if not isinstance(metadata, Mapping) or not all(isinstance(key, str) for key in metadata):
        raise CallerError(f"the metadata of an episode must be a dict with text keys, not {metadata!r:.100}")
    reader = ObservedReader(NO_REFERENCES, _refuse_blob)
    values = reader.read(dict(metadata)) or {}
    for path, reason in reader.missing.items():
        emitter.missing.note("Episode.metadata", path or "metadata", reason)
    try:
        size = encoded_bytes(values)
    except NotEncodable:
        size = _METADATA_BYTES_MAX + 1
    if size > min(_METADATA_BYTES_MAX, emitter.settings.record_bytes_max // 4):
        emitter.missing.note("Episode", "metadata", f"it takes {size:,} bytes, {_METADATA_BYTES_MAX:,} are allowed")
        values = {}
    return Labels(checked, values)


def _refuse_blob(_content: bytes, _media_type: str) -> Any:
    raise BlobRefused("metadata holds no blobs and no large arrays: record them with `memory.observe`")
