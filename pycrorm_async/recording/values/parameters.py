"""Read a designator's parameters when it is performed, and shorten a node's start that is too long.

Each parameter is read on its own, so a fault in one leaves the values of the others intact.
"""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from pycrorm_async.events.codec import NotEncodable, encoded_bytes
from pycrorm_async.events.types import NodeStarted
from pycrorm_async.events.values import MissingValue
from pycrorm_async.plan.protocols import Performable
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.values.event_fitting import fits
from pycrorm_async.recording.values.texts import reading_fault
from pycrorm_async.recording.values.value_snapshot import References, UnrecordableValue, encode_parameter, missing_value

ROBOT = "robot state"
"""The name under which a missing robot state is counted; the blank keeps it apart from every field's name."""
_MISSING_BYTES = 400
"""Bounds from below the parameters worth dropping: about the encoded size of the `MissingValue` that replaces one."""


def read_parameters(
    designator: Performable, declared: DeclaredType, references: References, missing: dict[str, str]
) -> dict[str, Any]:
    """Read the parameters of a designator as JSON values by field name.

    For each parameter that becomes a `MissingValue`, the function adds the reason to `missing`.
    """
    parameters: dict[str, Any] = {}
    for field, path, enum in declared.fields:
        value: Any = designator
        try:
            for name in path:
                value = getattr(value, name, None)
            if value is not None:
                parameters[field.name] = encode_parameter(field, enum, value, references)
        except UnrecordableValue as reason:
            parameters[field.name] = missing_value(str(reason), value)
            missing[field.name] = str(reason)
        except Exception as error:  # noqa: BLE001  a property or a __float__ of the user's may raise anything
            missing[field.name] = fault = reading_fault(error)
            parameters[field.name] = missing_value(fault, value)
    if declared.undeclared:
        _read_undeclared(designator, declared, parameters, missing)
    return parameters


def _read_undeclared(
    designator: Performable, declared: DeclaredType, parameters: dict[str, Any], missing: dict[str, str]
) -> None:
    for field, path, undeclared in declared.undeclared:
        value: Any = designator
        reason: str = undeclared
        try:
            for name in path:
                value = getattr(value, name, None)
        except Exception as error:  # noqa: BLE001  a property of the user's may raise anything
            reason = reading_fault(error)
        if value is not None:
            parameters[field] = missing_value(reason, value)
            missing[field] = reason


def fit_node_start(event: NodeStarted, bytes_max: int, missing: dict[str, str]) -> NodeStarted:
    """Replace parts of a node's start by `MissingValue` until it can be encoded.

    First the parts that JSON cannot hold, then the largest parameters, then the reprs of the missing values, at last
    all parameters. For each replaced part, the function adds the reason to `missing`.
    """
    sizes: dict[str, int] = {}
    parameters = dict(event.parameters)
    for name, value in event.parameters.items():
        if isinstance(value, MissingValue):
            continue
        try:
            sizes[name] = encoded_bytes(value)
        except NotEncodable as error:
            parameters[name] = missing_value(error.reason, value)
            missing[name] = error.reason
    if event.robot is not None:
        try:
            encoded_bytes(event.robot)
        except NotEncodable as error:
            event = replace(event, robot=None)
            missing[ROBOT] = error.reason
    small = sorted((name for name in sizes if name not in missing), key=lambda name: sizes[name])
    while not fits(replace(event, parameters=parameters), bytes_max):
        if small and sizes[small[-1]] > _MISSING_BYTES:
            name = small.pop()
            missing[name] = f"takes {sizes[name]:,} bytes, {bytes_max:,} are allowed for the record (record_bytes_max)"
            parameters[name] = missing_value(missing[name], parameters[name])
        elif any(isinstance(each, MissingValue) and each.repr for each in parameters.values()):
            parameters = {name: _without_repr(each) for name, each in parameters.items()}
        else:
            reason = f"the record would take more than {bytes_max:,} bytes (record_bytes_max)"
            missing.update((name, reason) for name in parameters if name not in missing)
            return replace(event, parameters={})
    return replace(event, parameters=parameters)


def _without_repr(value: Any) -> Any:
    return MissingValue(value.missing) if isinstance(value, MissingValue) else value
