"""The codec encodes each event as one JSON object in UTF-8 and decodes it again.

The payload bytes are the same in the queue, in the log and in an export. `encode` refuses every value that JSON cannot
hold without changing its meaning, and names the path to it: NaN and infinities (msgspec alone would write null), lone
surrogates and U+0000 (PostgreSQL text refuses it). It also refuses a payload above the limit. Bytes and sets must not
occur in an event, because msgspec writes them as a text and a list. `decode` reads the payloads of this and all earlier
versions (see the section "upcasters").

**Upcasters.** Upcasters convert the JSON of an event of an older version to that of the next version.

The log is never rewritten. A change of a shape in `types.py` raises the class' `version` and adds an upcaster here: a
pure function of the old object, which it may modify and return.

    def _object_added_1(old: dict[str, Any]) -> dict[str, Any]:
        return old | {"mass_kg": None}

    UPCASTERS = {("ObjectAdded", 1): _object_added_1}

A new field whose default means the same as its absence did before does not change the shape and needs no upcaster.

Some code reads fields by key, without the shape, so these keep their place in every version: `parameters` and
`designator` of NodeStarted (a fingerprint, from version 3 on its `short_name`), `simulated` of EpisodeStarted, and all
fields of DesignatorTypeDeclared that the view `designator_type` shows. The log stores only the bytes of a declaration,
so a declaration of a version above 1 carries its version in them, under the key `version`.
"""

import hashlib
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, TypeAlias, get_args

import msgspec

from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import EVENT_TYPES, DescriptionDeclared, DesignatorTypeDeclared, Happening, NodeKind

# === upcasters ================================================================================================

Upcaster: TypeAlias = Callable[[dict[str, Any]], dict[str, Any]]


def unchanged(old: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON of a shape that the next version reads as it is, because it only allows more."""
    return old


UPCASTERS: Final[dict[tuple[str, int], Upcaster]] = {
    # Version 2 omits frame and orientation of a pose where they are the default, in NodeStarted the robot's pose where
    # its object's row has it, and in NodeEnded the content of a failure where the end of another node has it.
    **{(name, 1): unchanged for name in "ObjectAdded ObjectMoved LocationResolved ObjectDetected".split()},
    **{(name, 1): unchanged for name in ("NodeStarted", "NodeEnded")},
    # Version 3 omits the kind of an action and the status SUCCEEDED, and shortens the fingerprint of a designator type.
    ("NodeStarted", 2): lambda old: old | {"designator": short_name(old.get("designator") or "") or None},
    ("NodeEnded", 2): unchanged,
}
"""Upcasters by event type and old version."""


# === codec ====================================================================================================

DESCRIPTION_PREFIX: Final = "urdf-"
"""The prefix of the fingerprints of descriptions; those of designator types are hexadecimal digits alone."""

DECLARATION_TYPES: Final[Mapping[str, str]] = {"DesignatorTypeDeclared": "", "DescriptionDeclared": DESCRIPTION_PREFIX}
"""The event types that belong to a recorder and not to an episode, with the prefix of their fingerprints."""


class NotEncodable(ValueError):
    """JSON cannot hold the value at `path` inside the event; `reason` states why."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(f"{path}: {reason}" if path else reason)
        self.path = path
        self.reason = reason


class UnknownShape(ValueError):
    """This software has no such event type, or not in that version; most likely newer software wrote it."""


class Decoder:
    """Decodes payloads of the given event types; payloads of older versions pass through their upcasters first.

    Args:
        types: event types by name, in their current shape.
        upcasters: for each older version of each type, the function that converts its JSON to the next version.
    """

    def __init__(self, types: Mapping[str, type[Happening]], upcasters: Mapping[tuple[str, int], Upcaster]) -> None:
        self._current = {name: (kind.version, msgspec.json.Decoder(kind).decode) for name, kind in types.items()}
        self._upcasters = dict(upcasters)
        older = {(name, each) for name, (version, _) in self._current.items() for each in range(1, version)}
        assert self._upcasters.keys() == older, self._upcasters.keys() ^ older
        self._readable = dict.fromkeys(self._current, 1)
        for name, version in older:
            if self._upcasters[name, version] is not unchanged:
                self._readable[name] = max(self._readable[name], version + 1)
        """By event type, the first version from which no upcaster changes anything, so that it is decoded as it is."""

    def decode(self, type_name: str, payload: bytes, version: int | None = None) -> Happening:
        """Decode a payload of `version` (None: the current version) into the current shape of its type.

        Raises `UnknownShape` for an unknown type or version, and `msgspec.DecodeError` for bytes of another shape.
        Both are subclasses of `ValueError`.
        """
        current_shape = self._current.get(type_name)
        if current_shape is None:
            raise UnknownShape(f"{type_name} is not an event type of this version")
        current, decode_current = current_shape
        try:
            if version != current and version is not None:
                if not 1 <= version < current:
                    raise UnknownShape(f"{type_name} has version {version}, this version reads {current}")
                if version < self._readable[type_name]:
                    payload = self._upcast(type_name, payload, version, current)
            try:
                return decode_current(payload)
            except msgspec.ValidationError:
                return decode_current(_described_by_class(type_name, payload))
        except (UnicodeDecodeError, RecursionError) as error:  # invalid UTF-8, or nesting too deep
            raise msgspec.DecodeError(str(error)) from None

    def declaration_of(self, payload: bytes) -> DesignatorTypeDeclared:
        """Decode a designator type of the version that its payload names, or 1. Raises what `decode` raises."""
        event = self._declaration("DesignatorTypeDeclared", payload)
        assert isinstance(event, DesignatorTypeDeclared)
        return event

    def description_of(self, payload: bytes) -> DescriptionDeclared:
        """Decode a description of the version that its payload names, or 1. Raises what `decode` raises."""
        event = self._declaration("DescriptionDeclared", payload)
        assert isinstance(event, DescriptionDeclared)
        return event

    def _declaration(self, type_name: str, payload: bytes) -> Happening:
        try:
            version = msgspec.json.decode(payload, type=_Versioned).version
        except (UnicodeDecodeError, RecursionError) as error:
            raise msgspec.DecodeError(str(error)) from None
        return self.decode(type_name, payload, version)

    def _upcast(self, type_name: str, payload: bytes, version: int, current: int) -> bytes:
        document = msgspec.json.decode(payload, type=dict[str, Any])
        for old in range(version, current):
            try:
                document = self._upcasters[type_name, old](document)
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                raise msgspec.DecodeError(f"the payload is not of version {old}: {error!r}") from error
        return msgspec.json.encode(document)


def _described_by_class(type_name: str, payload: bytes) -> bytes:
    """Return a node's start with a valid kind, and a designator type with a valid concept.

    Earlier versions wrote the value of the designator's own field `kind` or `concept`, whatever its type. The fold has
    the kind from the declaration; a node without a declaration is an action.
    """
    document = msgspec.json.decode(payload)
    if isinstance(document, dict):
        if type_name == "NodeStarted" and document.get("kind", "root") not in get_args(NodeKind):
            document["kind"] = "action"
        if type_name == "DesignatorTypeDeclared" and not isinstance(document.get("concept"), str):
            document.pop("concept", None)
    return msgspec.json.encode(document)


class _Versioned(msgspec.Struct):
    version: int = 1


_BACKSLASH: Final = ord("\\")
_encoder = msgspec.json.Encoder()
_decoder = Decoder(EVENT_TYPES, UPCASTERS)
decode = _decoder.decode
declaration_of = _decoder.declaration_of
description_of = _decoder.description_of


def encode(event: Any, *, bytes_max: int = 2**20) -> bytes:
    """Encode an event as its payload, or a part of one; the same event has the same bytes in every process.

    Raises `NotEncodable`, also for a payload of more than `bytes_max` bytes.
    """
    try:
        payload = _encoder.encode(event)
    except UnicodeEncodeError:
        raise _first_fault(event) or NotEncodable("", "holds a lone surrogate") from None
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise _first_fault(event) or NotEncodable("", str(error)) from None
    # The encoder writes NaN as null and U+0000 as an escape, so only payloads that hold one of these need a search.
    # `in` with bytes tries first whether they are a number; a number is found soonest, and few payloads hold an escape.
    if payload.find(b"null") >= 0 or (_BACKSLASH in payload and b"\\u0000" in payload):
        fault = _first_fault(event)
        if fault is not None:
            raise fault
    if len(payload) > bytes_max:
        raise NotEncodable("", f"the record takes {len(payload):,} bytes, {bytes_max:,} are allowed (record_bytes_max)")
    return payload


def encoded(value: Any) -> msgspec.Raw:
    """Encode one part of several events once, to be put into each of them. Raises `NotEncodable`."""
    return msgspec.Raw(encode(value, bytes_max=sys.maxsize))


def encoded_bytes(value: Any) -> int:
    """Return the size in bytes of a value once encoded. Raises `NotEncodable`, also for what the encoder would convert.

    So a key that is not a str and a datetime, which a caller gave for a part of an event, are refused.
    """
    fault = _first_fault(value)
    if fault is not None:
        raise fault
    return len(encode(value, bytes_max=sys.maxsize))


class _DtypeOnly(msgspec.Struct):
    """The part of a DesignatorTypeDeclared that every version has."""

    dtype: str


def declared_dtype(declaration: bytes) -> str | None:
    """Return the dtype in a DesignatorTypeDeclared of any version; None if it cannot be read."""
    try:
        return msgspec.json.decode(declaration, type=_DtypeOnly).dtype
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def fingerprint(declaration: bytes, type_name: str = "DesignatorTypeDeclared") -> str:
    """Compute the content address of a declaration: 128 bits of BLAKE2b over its payload, as 32 hexadecimal digits.

    That of a description follows a prefix, by which the log distinguishes the two types.
    """
    return DECLARATION_TYPES[type_name] + hashlib.blake2b(declaration, digest_size=16).hexdigest()


def short_name(fingerprint: str) -> str:
    """Return the name that nodes have for the designator type with this fingerprint: its first 64 bits."""
    return fingerprint[:16]


def declaration_type(fingerprint: str) -> str:
    """Return the event type of the declaration that has this fingerprint."""
    return "DescriptionDeclared" if fingerprint.startswith(DESCRIPTION_PREFIX) else "DesignatorTypeDeclared"


def clean(text: str) -> str:
    """Replace U+0000 and lone surrogates, which no event can hold, with escapes."""
    return str.replace(text, "\x00", "\\x00").encode("utf-8", "backslashreplace").decode()


def unwritable(value: Any) -> str | None:
    """Return the reason why JSON cannot hold this scalar unchanged; None if it can."""
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value} is not a finite number"
    if isinstance(value, str):
        if "\x00" in value:
            return "the text holds U+0000"
        try:
            value.encode()
        except UnicodeEncodeError:
            return "the text holds a lone surrogate"
    return None


def _first_fault(value: Any, path: str = "") -> NotEncodable | None:
    """Return the error for the first part of a value that JSON cannot hold, with its path; None if there is none."""
    reason = unwritable(value)
    if reason is not None:
        return NotEncodable(path, reason)
    children: list[tuple[str, Any]]
    if isinstance(value, msgspec.Struct):
        children = [(name, getattr(value, name)) for name in value.__struct_fields__]
    elif isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                return NotEncodable(path, f"a key is a {type(key).__name__}, not a str")
            if (fault_in_key := unwritable(key)) is not None:
                return NotEncodable(path, f"in a key, {fault_in_key}")
        children = list(value.items())
    elif isinstance(value, list | tuple):
        children = [(str(index), child) for index, child in enumerate(value)]
    elif value is None or isinstance(value, str | int | float | msgspec.Raw):  # JSON that `encoded` has checked
        return None
    else:
        return NotEncodable(path, f"JSON cannot hold a {type(value).__name__}")
    for name, child in children:
        fault = _first_fault(child, f"{path}.{name}" if path else name)
        if fault is not None:
            return fault
    return None


# === envelope =================================================================================================
#
# An envelope carries an event from a hook to the log: first as a `Heading`, then as a `Record`.
#
# The caller of the queue passes a `Heading` and the payload's bytes. The queue, under its lock, adds position, sequence
# and both times, which makes them a `Record`. Queue files, writer batches and database hold the same payload bytes.

LOST: Final = b'{"status":"LOST"}'
"""Payload of the `EpisodeEnded` that recovery computes for an episode left open.

It stays at version 1 of `EpisodeEnded`, so that recovering a folder twice yields the same bytes.
"""


class Heading(NamedTuple):
    """The envelope without position, sequence and times.

    `episode` is None for a recorder-level record (a declaration).
    """

    episode: EpisodeId | None
    type: str
    version: int


class Record(NamedTuple):
    """One event with its complete envelope. A recorder-level record has no episode and sequence 0.

    Attributes:
        position: 1, 2, 3 … over all records of one recorder.
        episode: 16 bytes of a UUID, or None.
        sequence: 1, 2, 3 … inside the episode, without gaps; 0 without an episode.
        type: name of the event type, as in `pycrorm_async.events.types`.
        version: version of that type's shape.
        wall_ns: UTC, ns since 1970.
        monotonic_ns: ns, comparable inside one process life only.
        payload: the event as JSON, UTF-8.
    """

    position: int
    episode: EpisodeId | None
    sequence: int
    type: str
    version: int
    wall_ns: int
    monotonic_ns: int
    payload: bytes


def is_computed_end(record: Record) -> bool:
    """Return whether recovery computed this end.

    Such an end marks the last record kept in one folder; later events of the episode may exist elsewhere.
    """
    return record.type == "EpisodeEnded" and record.payload == LOST
