"""Copy exceptions into values of events."""

from __future__ import annotations

from typing import Any

from pycrorm_async.events.values import FailureValue, MissingValue
from pycrorm_async.recording.values.texts import clean, cut, message_of, reading_fault
from pycrorm_async.recording.values.value_snapshot import (
    DEPTH_MAX,
    REASON_MAX,
    References,
    encode_or_missing,
    missing_value,
)

_TEXT_MAX = 2_000
"""Bounds the characters of a failure's message."""
_NAME_MAX = 500
"""Bounds the characters of an exception's qualified class name."""
_GROUP_MAX = 100
"""Bounds the recorded exceptions of one exception group."""


def failure_value(failure: BaseException, references: References) -> FailureValue:
    """Copy class, message and arguments of an exception. Raises no `Exception`."""
    return FailureValue(
        type=cut(_path_of(type(failure)), _NAME_MAX),
        message=cut(clean(message_of(failure)), _TEXT_MAX),
        arguments=_arguments_or_missing(failure, references),
    )


def _path_of(kind: type) -> str:
    try:
        return clean(f"{kind.__module__}.{kind.__qualname__}")
    except Exception as error:  # noqa: BLE001  a metaclass may raise anything
        return f"<an exception whose class has no name: {type(error).__name__}>"


def _arguments_or_missing(failure: BaseException, references: References) -> list[Any]:
    try:
        return _arguments(failure, references, 0)
    except Exception as error:  # noqa: BLE001  `args` may be a property that raises anything
        return [MissingValue(reading_fault(error))]


def _arguments(failure: BaseException, references: References, depth: int) -> list[Any]:
    """Encode the arguments of an exception; for a group, its message and the encoded exceptions inside it."""
    if not isinstance(failure, BaseExceptionGroup):
        return [encode_or_missing(each, references) for each in failure.args]
    if depth > DEPTH_MAX:
        return [missing_value(f"it is nested more than {DEPTH_MAX} deep", failure)]
    inside = [
        {
            "type": cut(_path_of(type(each)).rpartition(".")[2], _NAME_MAX),
            "message": cut(clean(message_of(each)), REASON_MAX),
            "arguments": _arguments(each, references, depth + 1),
        }
        for each in failure.exceptions[:_GROUP_MAX]
    ]
    return [cut(clean(str(failure.message)), _TEXT_MAX), inside]
