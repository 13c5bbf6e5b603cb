"""Reads the parameters of a designator when it is performed, and makes the event fit where it cannot be encoded.

Each parameter is read on its own: what is wrong with one costs no other its value.
"""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from pycrorm_async.events.codec import NotEncodable, encoded_bytes
from pycrorm_async.events.types import MissingValue, NodeStarted
from pycrorm_async.hooks.declaration import DeclaredType
from pycrorm_async.hooks.values.event_fitting import fits
from pycrorm_async.hooks.values.texts import reading_fault
from pycrorm_async.hooks.values.value_snapshot import References, Unwritable, missing_value, written
from pycrorm_async.plan.designator import Designator

__all__ = ["ROBOT", "parameters_of", "start_that_fits"]

ROBOT = "robot state"
"""The name under which the robot's state is missing; no field has a blank in its name."""
_MISSING_BYTES = 400
"""About what a `MissingValue` takes: what is smaller saves nothing by being left out."""


def parameters_of(
    designator: Designator, declared: DeclaredType, references: References, missing: dict[str, str]
) -> dict[str, Any]:
    """Its parameters as JSON, by field; for each that is a `MissingValue`, `missing` is given the reason."""
    parameters: dict[str, Any] = {}
    for field, path, enum in declared.fields:
        value: Any = designator
        try:
            for name in path:
                value = getattr(value, name, None)
            if value is not None:
                parameters[field.name] = written(field, enum, value, references)
        except Unwritable as reason:
            parameters[field.name] = missing_value(str(reason), value)
            missing[field.name] = str(reason)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001  a property or a __float__ of the user's may raise anything
            missing[field.name] = fault = reading_fault(error)
            parameters[field.name] = missing_value(fault, value)
    if declared.undeclared:
        _read_undeclared(designator, declared, parameters, missing)
    return parameters


def _read_undeclared(
    designator: Designator, declared: DeclaredType, parameters: dict[str, Any], missing: dict[str, str]
) -> None:
    for field, path, undeclared in declared.undeclared:
        value: Any = designator
        reason: str = undeclared
        try:
            for name in path:
                value = getattr(value, name, None)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001  a property of the user's may raise anything
            reason = reading_fault(error)
        if value is not None:
            parameters[field] = missing_value(reason, value)
            missing[field] = reason


def start_that_fits(event: NodeStarted, bytes_max: int, missing: dict[str, str]) -> NodeStarted:
    """The start without what JSON cannot hold, and without its largest parameters as far as it is too large.

    For each part left out, `missing` is given the reason.
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
            missing[name] = f"takes {sizes[name]:,} bytes, {bytes_max:,} are allowed for all (record_bytes_max)"
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
