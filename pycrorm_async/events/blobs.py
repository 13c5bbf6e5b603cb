"""Find the blobs that an event refers to in its payload, without decoding it.

The bytes of a `BlobReference` are unmistakable: inside a JSON text every quotation mark is escaped, and `observe`
accepts no key that begins with `$`. The encoder writes its fields in the order of their declaration, without spaces.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

import msgspec

from pycrorm_async.events.values import BlobReference

__all__ = ["BLOB_KEY", "REFERRING", "Blob", "references_in"]

BLOB_KEY: Final = "$blob"
"""Key of a reference's hash; marks a JSON object as a reference."""
REFERRING: Final = frozenset({"Observed", "DescriptionDeclared"})
"""The event types that may refer to blobs. Payloads of other types are not searched, because a plan's own parameters
may contain the key."""
_REFERENCE: Final = re.compile(
    rb'\{"\$blob":"([0-9a-f]{64})","media_type":("(?:[^"\\]|\\.)*"),"size":([0-9]{1,18})[,}]'
)


class Blob(NamedTuple):
    """A content that is stored beside the log, with its media type: an image, a point cloud, a sound."""

    content: bytes
    media_type: str = "application/octet-stream"


def references_in(type_name: str, payload: bytes) -> list[BlobReference]:
    """Return the references in an event's payload, in order, without `dtype` and `shape` of arrays.

    >>> [each.size for each in references_in("Observed", b'{"$blob":"%s","media_type":"a/b","size":3}' % (b"0" * 64))]
    [3]
    """
    if type_name not in REFERRING or b'"$blob"' not in payload:
        return []
    return [
        BlobReference(sha256.decode(), msgspec.json.decode(media_type, type=str), int(size))
        for sha256, media_type, size in _REFERENCE.findall(payload)
    ]
