"""A `DeclaredType` is the declaration of one designator type, encoded, with the paths to read its parameters."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from pycrorm_async.events.types import DesignatorTypeDeclared
from pycrorm_async.events.values import FieldDeclared


class Field(NamedTuple):
    """A declared field, the attribute path to its value, and its enum class if it is an enum."""

    declared: FieldDeclared
    path: tuple[str, ...]
    enum: type[Enum] | None


class Undeclared(NamedTuple):
    """A field without a column, the attribute path to its value, and the reason."""

    name: str
    path: tuple[str, ...]
    reason: str


class DeclaredType(NamedTuple):
    """The declaration of a designator class, encoded, with the paths to read its parameters.

    Attributes:
        payload: the encoded declaration; empty if the class cannot be declared.
        fingerprint: fingerprint of the payload; empty if the class cannot be declared.
        undeclared: fields whose values are recorded as missing.
        fault: reason why the class, or one of its aliases, cannot be declared.
    """

    dtype: str
    payload: bytes
    fingerprint: str
    fields: tuple[Field, ...]
    declaration: DesignatorTypeDeclared
    undeclared: tuple[Undeclared, ...] = ()
    fault: str | None = None
