"""Events to bytes and back: JSON, UTF-8, one object, the same bytes in the queue, the log and an export.

`encode` is the border. What JSON cannot hold without changing its meaning is refused with the path to it: NaN and
infinities (which the encoder alone would turn into null), lone surrogates, U+0000 (which PostgreSQL text refuses),
and a payload above the limit. `decode` reads what any version wrote up to the present one (`upcasters`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Any

import msgspec

from pycrorm_async.events.types import EVENT_TYPES, DesignatorTypeDeclared, Happening
from pycrorm_async.events.upcasters import UPCASTERS, Upcaster

__all__ = [
    "NotEncodable",
    "UnknownShape",
    "Decoder",
    "encode",
    "encoded_bytes",
    "decode",
    "fingerprint",
    "declaration_of",
    "unwritable",
]


class NotEncodable(ValueError):
    """`path` inside the event holds what JSON cannot; `reason` says what."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(f"{path}: {reason}" if path else reason)
        self.path = path
        self.reason = reason


class UnknownShape(ValueError):
    """This version knows no such event, or not in this version of it; most likely a newer one wrote it."""


class Decoder:
    """Reads payloads of these event types, those of older versions through their upcasters.

    Args:
        types: event types by name, in their present shape.
        upcasters: for each older version of each of them, what makes it the next one.
    """

    def __init__(self, types: Mapping[str, type[Happening]], upcasters: Mapping[tuple[str, int], Upcaster]) -> None:
        self._present = {name: (kind.version, msgspec.json.Decoder(kind).decode) for name, kind in types.items()}
        self._upcasters = dict(upcasters)
        older = {(name, each) for name, (version, _) in self._present.items() for each in range(1, version)}
        assert self._upcasters.keys() == older, self._upcasters.keys() ^ older

    def decode(self, type_name: str, payload: bytes, version: int | None = None) -> Happening:
        """The event in these bytes, which are of this version (None: the present one), in its present shape.

        Raises `UnknownShape`; `msgspec.DecodeError` for bytes that are not of that shape. Both are a `ValueError`.
        """
        known = self._present.get(type_name)
        if known is None:
            raise UnknownShape(f"{type_name} is not an event this version knows")
        present, read = known
        try:
            if version != present and version is not None:
                if not 1 <= version < present:
                    raise UnknownShape(f"{type_name} has version {version}, this version knows {present}")
                payload = self._upcast(type_name, payload, version, present)
            return read(payload)
        except (UnicodeDecodeError, RecursionError) as error:  # no UTF-8, or nested too deep
            raise msgspec.DecodeError(str(error)) from None

    def declaration_of(self, payload: bytes) -> DesignatorTypeDeclared:
        """The declaration in these bytes. Raises as `decode` does."""
        try:
            version = msgspec.json.decode(payload, type=_Versioned).version
        except (UnicodeDecodeError, RecursionError) as error:
            raise msgspec.DecodeError(str(error)) from None
        event = self.decode("DesignatorTypeDeclared", payload, version)
        assert isinstance(event, DesignatorTypeDeclared)
        return event

    def _upcast(self, type_name: str, payload: bytes, version: int, present: int) -> bytes:
        document = msgspec.json.decode(payload, type=dict[str, Any])
        for old in range(version, present):
            try:
                document = self._upcasters[type_name, old](document)
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                raise msgspec.DecodeError(f"not of version {old}: {error!r}") from error
        return msgspec.json.encode(document)


class _Versioned(msgspec.Struct):
    version: int = 1


_encoder = msgspec.json.Encoder()
_present = Decoder(EVENT_TYPES, UPCASTERS)
decode = _present.decode
declaration_of = _present.declaration_of


def encode(event: Happening, *, bytes_max: int = 2**20) -> bytes:
    """The event's payload. Raises `NotEncodable`; the bytes of one event never differ between processes."""
    try:
        payload = _encoder.encode(event)
    except UnicodeEncodeError:
        raise _first_fault(event) or NotEncodable("", "holds a lone surrogate") from None
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise _first_fault(event) or NotEncodable("", str(error)) from None
    # The encoder writes NaN as null and U+0000 as an escape: only payloads that hold one of these are looked at.
    if b"null" in payload or b"\\u0000" in payload:
        fault = _first_fault(event)
        if fault is not None:
            raise fault
    if len(payload) > bytes_max:
        raise NotEncodable("", f"takes {len(payload):,} bytes, {bytes_max:,} are allowed (record_bytes_max)")
    return payload


def encoded_bytes(value: Any) -> int:
    """How many bytes a part of an event takes. Raises `NotEncodable`."""
    fault = _first_fault(value)
    if fault is not None:
        raise fault
    try:
        return len(_encoder.encode(value))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise NotEncodable("", str(error)) from None


def fingerprint(declaration: bytes) -> str:
    """The name of a declaration: 128 bits of BLAKE2b over its payload, as 32 hexadecimal digits."""
    return hashlib.blake2b(declaration, digest_size=16).hexdigest()


def unwritable(value: Any) -> str | None:
    """Why JSON cannot hold this scalar as it is; None if it can."""
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
    reason = unwritable(value)
    if reason is not None:
        return NotEncodable(path, reason)
    children: list[tuple[str, Any]]
    if isinstance(value, msgspec.Struct):
        children = [(name, getattr(value, name)) for name in value.__struct_fields__]
    elif isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                return NotEncodable(path, f"has a key of type {type(key).__name__}")
            if unwritable(key):
                return NotEncodable(path, f"has a key of which {unwritable(key)}")
        children = list(value.items())
    elif isinstance(value, list | tuple):
        children = [(str(index), child) for index, child in enumerate(value)]
    elif value is None or isinstance(value, str | int | float):
        return None
    else:
        return NotEncodable(path, f"a {type(value).__name__} is not JSON")
    for name, child in children:
        fault = _first_fault(child, f"{path}.{name}" if path else name)
        if fault is not None:
            return fault
    return None
