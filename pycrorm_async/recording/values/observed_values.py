"""Copy the values of an observation into JSON values; contents too large for an event become blobs.

A part that cannot be recorded becomes null, with its path and the reason in `missing`; the other parts are recorded.
The usual case, a dict of a few numbers, takes about a microsecond.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Collection
from typing import Any, Final, cast

import numpy as np

from pycrorm_async.events.blobs import Blob
from pycrorm_async.events.codec import unwritable
from pycrorm_async.events.values import BlobReference, MissingValue
from pycrorm_async.recording.values.texts import reading_fault
from pycrorm_async.recording.values.value_snapshot import ITEMS_MAX, References, encode_or_missing, missing_in

ARRAY_ITEMS_MAX: Final = 64
"""Bounds the elements of an array that is recorded as JSON, each with a row of its own, as a joint state needs."""
NPY: Final = "application/x-npy"
"""Media type of an array that is stored as a blob: `numpy.load(io.BytesIO(content))`."""
_DEPTH_MAX: Final = 8
"""Bounds the nesting of observed values."""
_INTEGERS: Final = range(-(2**63), 2**63)
_NUMBERS: Final = "biuf"
"""The dtype kinds of arrays whose elements JSON can hold."""
_MEDIA_TYPE_MAX: Final = 255
"""Bounds the characters of a blob's media type."""


class ObservedReader:
    """Reads the values of one observation. `put_blob` takes content and media type.

    Attributes:
        missing: by path, the reason why a value is missing.
        blobs: the references in the values, to be released when the event is put.
    """

    __slots__ = ("_left", "_put_blob", "_references", "blobs", "missing")

    def __init__(self, references: References, put_blob: Callable[[bytes, str], BlobReference]) -> None:
        self._references = references
        self._put_blob = put_blob
        self._left = ITEMS_MAX
        self.missing: dict[str, str] = {}
        self.blobs: list[BlobReference] = []

    def read(self, value: Any, path: str = "", depth: int = 0) -> Any:
        """Return the JSON value of `value`, at this path in the observation."""
        kind = type(value)
        if kind is float:
            return value if math.isfinite(value) else self._note(path, f"{value} is not a finite number")
        if kind is bool or value is None:
            return value
        if kind is int and value in _INTEGERS:
            return value
        if kind is str:
            reason = unwritable(value)
            return value if reason is None else self._note(path, reason)
        self._left -= 1
        if depth > _DEPTH_MAX:
            return self._note(path, f"it is nested more than {_DEPTH_MAX} deep")
        if kind is dict:
            return self._dict(value, path, depth)
        if kind is list or kind is tuple:
            return self._list(value, path, depth)
        if isinstance(value, np.ndarray):
            return self._array(value, path, depth)
        if isinstance(value, Blob):
            return self._blob(value, path)
        return self._other(value, path)

    def _dict(self, value: dict[Any, Any], path: str, depth: int) -> Any:
        if (reason := self._fault_in_keys(value)) is not None:
            return self._note(path, reason)
        prefix = f"{path}." if path else ""
        return {key: self.read(each, f"{prefix}{key}", depth + 1) for key, each in value.items()}

    def _fault_in_keys(self, keys: Collection[Any]) -> str | None:
        for key in keys:
            if type(key) is not str:
                return f"a key of the dict is a {type(key).__name__}, not a str"
            if key[:1] == "$":
                return "a key of the dict begins with $, which marks a blob"
            if (reason := unwritable(key)) is not None:
                return reason
        return self._over_limit(len(keys))

    def _list(self, value: list[Any] | tuple[Any, ...], path: str, depth: int) -> Any:
        if (reason := self._over_limit(len(value))) is not None:
            return self._note(path, reason)
        prefix = f"{path}." if path else ""
        return [self.read(each, f"{prefix}{index}", depth + 1) for index, each in enumerate(value)]

    def _over_limit(self, count: int) -> str | None:
        self._left -= count
        return f"it holds more than {ITEMS_MAX:,} items" if self._left < 0 else None

    def _array(self, value: np.ndarray[Any, Any], path: str, depth: int) -> Any:
        if value.dtype.kind in _NUMBERS and value.size <= ARRAY_ITEMS_MAX:
            return self.read(value.tolist(), path, depth)
        try:
            file = io.BytesIO()
            np.save(file, value, allow_pickle=False)
        except Exception as error:  # noqa: BLE001  an array of objects, or a user's own dtype
            return self._note(path, reading_fault(error))
        reference = self._put(file.getvalue(), NPY, path)
        if reference is None:
            return None
        return BlobReference(reference.hash, NPY, reference.size, str(value.dtype), value.shape)

    def _blob(self, value: Blob, path: str) -> Any:
        content, media_type = cast("tuple[object, object]", value)  # unchecked by the caller
        if not isinstance(content, bytes | bytearray | memoryview):
            return self._note(path, f"the content of a blob must be bytes, not {type(content).__name__}")
        if not isinstance(media_type, str) or len(media_type) > _MEDIA_TYPE_MAX or unwritable(media_type):
            return self._note(path, f"the media type of a blob must be a str of at most {_MEDIA_TYPE_MAX} characters")
        return self._put(bytes(content), media_type, path)

    def _put(self, content: bytes, media_type: str, path: str) -> BlobReference | None:
        try:
            reference = self._put_blob(content, media_type)
        except ValueError as refusal:
            self._note(path, str(refusal))
            return None
        self.blobs.append(reference)
        return reference

    def _other(self, value: Any, path: str) -> Any:
        encoded = encode_or_missing(value, self._references)
        if isinstance(encoded, MissingValue):
            return self._note(path, encoded.missing)
        for each in missing_in(encoded):
            return self._note(path, each.missing)
        return encoded

    def _note(self, path: str, reason: str) -> None:
        self.missing[path] = reason
