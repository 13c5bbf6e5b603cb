"""Copy models of pydantic, dataclasses and containers of an executive as dicts and lists, or as a text of JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from types import NoneType
from typing import Any

from pycrorm_async.plan.language.outcome import Outcome
from pycrorm_async.recording.values.value_snapshot import OBJECT_TYPES
from pycrorm_async.world.pose import Pose

_SCALARS = frozenset({str, int, float, bool, NoneType})
_RECORDED_AS_THEY_ARE = (Pose, Outcome, *OBJECT_TYPES)
"""Dataclasses, and others, of which events have values of their own."""


def plain_value(value: Any, simplified: Callable[[Any], Any] = lambda each: each) -> Any:
    """Return models and dataclasses as dicts, at any depth.

    `simplified` returns the scalar, dict or list that is recorded for a value that is none; the value itself if all of
    it is copied. A value that cannot be copied is returned as it is, and recorded as missing, with the reason.

    >>> plain_value([Reading(volts=24.0)])
    [{'volts': 24.0}]
    """
    try:
        return _copy(value, simplified)
    except Exception:  # noqa: BLE001  models of a user may raise anything
        return value


def json_text(value: Any, simplified: Callable[[Any], Any] = lambda each: each) -> Any:
    """Return the JSON of a value's copy; the value itself if there is none, which is recorded as missing."""
    try:
        return json.dumps(_copy(value, simplified), default=str)
    except Exception:  # noqa: BLE001  as above
        return value


def _copy(value: Any, simplified: Callable[[Any], Any]) -> Any:
    kind = type(value)
    if kind in _SCALARS:
        return value
    if kind is dict or kind is list or kind is tuple:  # as nearly all others are; the checks below take much longer
        return _copy_items(value, simplified)
    if (simple := simplified(value)) is not value:
        return simple
    if hasattr(kind, "model_dump"):  # a model of pydantic, which this package does not need
        return _copy(value.model_dump(), simplified)
    if is_dataclass(kind) and not isinstance(value, _RECORDED_AS_THEY_ARE):
        return {each.name: _copy(getattr(value, each.name), simplified) for each in fields(kind)}
    return _copy_items(value, simplified) if isinstance(value, Mapping | list | tuple) else value


def _copy_items(items: Any, simplified: Callable[[Any], Any]) -> Any:
    """Copy a container; most of its items are scalars, for which a call of `_copy` would take longer than the check."""
    if isinstance(items, (dict, Mapping)):
        return {str(key): each if type(each) in _SCALARS else _copy(each, simplified) for key, each in items.items()}
    return [each if type(each) in _SCALARS else _copy(each, simplified) for each in items]
