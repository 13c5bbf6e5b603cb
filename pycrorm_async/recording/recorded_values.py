"""Copy the values of an executive, through its own conversion, into values of events."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any, Protocol

import msgspec

from pycrorm_async.errors import CallerError
from pycrorm_async.events.values import FailureValue, ObjectReference, ObjectValue, PoseValue
from pycrorm_async.recording.checked_arguments import pose_of, struct_of
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.values.failure_values import failure_value
from pycrorm_async.recording.values.texts import clean, clean_repr, message_of, reading_fault
from pycrorm_async.recording.values.value_snapshot import (
    References,
    RefusedValue,
    UnrecordableValue,
    encode_or_missing,
    encode_parameter,
    missing_value,
)

Convert = Callable[[Any], Any]


class _Objects(Protocol):
    def reference(self, key: Hashable) -> ObjectReference | None: ...

    def holds(self, reference: ObjectReference | None) -> bool: ...


class RecordedValues:
    """Converts values for one episode. `convert` is the executive's; it is called with each value and each item."""

    def __init__(self, convert: Convert | None, objects: Callable[[], _Objects], references: References) -> None:
        self._convert = convert
        self._objects = objects
        self._references = references

    def parameters(self, declared: DeclaredType, values: Mapping[Any, Any], missing: dict[str, str]) -> dict[str, Any]:
        """Return the parameters by field name; add to `missing` the reason for each that becomes a `MissingValue`."""
        parameters: dict[str, Any] = {}
        undeclared = dict(values)
        for field, path, enum in declared.fields:
            value = undeclared.pop(path[0], None)
            if value is None:
                continue
            try:
                converted = self.converted(value, as_object="object" in (field.type, field.item))
                if converted is not None:
                    parameters[field.name] = encode_parameter(field, enum, converted, self._references)
            except UnrecordableValue as refusal:
                missing[field.name] = str(refusal)
                parameters[field.name] = missing_value(str(refusal), value)
            except Exception as error:  # noqa: BLE001  a __float__ of the user's may raise anything
                missing[field.name] = fault = reading_fault(error)
                parameters[field.name] = missing_value(fault, value)
        for name, value in undeclared.items():
            if value is not None:
                reasons = {each.path[0]: each.reason for each in declared.undeclared}
                text = clean(name) if isinstance(name, str) else clean_repr(name)
                missing[text] = reason = reasons.get(name, f"{declared.dtype} was declared without this field")
                parameters[text] = missing_value(reason, value)
        return parameters

    def any(self, value: Any) -> Any:
        """Return a JSON value, or a `MissingValue`. Never raises."""
        return encode_or_missing(self.converted(value), self._references)

    def converted(self, value: Any, *, as_object: bool = False) -> Any:
        """Return the value as the executive converts it; a `RefusedValue` with the reason if it cannot convert it.

        With `as_object` the key of an object becomes a reference to its row.
        """
        value = self._item(value, as_object)
        kind = type(value)
        if kind is list or kind is tuple:
            return [self._item(each, as_object) for each in value]
        if kind is dict:
            return {key: self._item(each, as_object) for key, each in value.items()}
        return value

    def _item(self, value: Any, as_object: bool) -> Any:  # noqa: FBT001  a keyword would cost each item of a list
        """Convert a value, but not the items inside it."""
        if as_object and (reference := self._known_object(value)) is not None:
            return reference
        if self._convert is not None:
            try:
                value = self._convert(value)
            except Exception as error:  # noqa: BLE001  an executive's conversion may raise anything
                return RefusedValue(message_of(error) if isinstance(error, ValueError) else reading_fault(error))
            if as_object and (reference := self._known_object(value)) is not None:
                return reference
        return self._checked(value) if isinstance(value, msgspec.Struct) else value

    def failure(self, failure: object) -> FailureValue:
        """Copy a failure: an exception, a `FailureValue`, or a text. Raises `CallerError` for anything else."""
        if isinstance(failure, BaseException):
            return failure_value(failure, self._references)
        return FailureValue("Failure", clean(failure)) if isinstance(failure, str) else struct_of(failure, FailureValue)

    def _checked(self, value: msgspec.Struct) -> Any:
        """Return a value of an event if it is whole, and its rows are those of this episode."""
        try:
            if isinstance(value, PoseValue):
                return pose_of(value)
            whole = struct_of(value, type(value))
        except CallerError as error:
            return RefusedValue(message_of(error))
        reference = whole.part_of if isinstance(whole, ObjectValue) else whole
        if isinstance(reference, ObjectReference) and not self._objects().holds(reference):
            return RefusedValue("it refers to a row that this episode does not have")
        if isinstance(whole, ObjectValue) and whole.pose is not None:
            return self._checked(whole.pose) if isinstance(self._checked(whole.pose), RefusedValue) else whole
        return whole

    def _known_object(self, value: Any) -> ObjectReference | None:
        try:
            return self._objects().reference(value)
        except TypeError:  # it is not hashable, so it is no key
            return None
