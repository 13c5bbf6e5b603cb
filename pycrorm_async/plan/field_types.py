"""Check the fields of a designator against their annotations when a motion or a built-in action is built.

Classes, unions and None in a union are checked, and the items of lists and dicts. An int is accepted where a float is
declared. An annotation that cannot be evaluated, such as a class local to a function, is not checked.
"""

import functools
import inspect
import numbers
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from pycrorm_async.plan.failures import ResolutionError

Check = Callable[[Any], bool]


def check_properties(designator: object) -> None:
    """Raise `ResolutionError` that names the missing fields and the fields of a wrong type."""
    missing: list[str] = []
    wrong: list[str] = []
    kind: Any = type(designator)  # mypy takes a bare type for unhashable
    for name, expected, optional, fits in _checks(kind):
        value = getattr(designator, name)
        if value is None:
            if not optional:
                missing.append(name)
        elif not fits(value):
            wrong.append(f"{name}: expected {expected}, got {_short(value)}{_advice(value)}")
    if missing or wrong:
        raise ResolutionError(kind.__name__, missing=missing, wrong=wrong)


@functools.lru_cache(maxsize=1024)
def _checks(designator: type) -> tuple[tuple[str, str, bool, Check], ...]:
    """Return for each field its name, its type's name, whether None is allowed, and the check."""
    try:
        hints = typing.get_type_hints(designator)
    except NameError:
        return ()
    checks = []
    for field in fields(designator):
        hint = hints[field.name]
        optional = hint is Any or type(None) in (hint, *typing.get_args(hint))
        checks.append((field.name, _type_name(hint), optional, _check(hint)))
    return tuple(checks)


def _check(hint: Any) -> Check:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        checks = [_check(argument) for argument in arguments]
        return lambda value: any(check(value) for check in checks)
    if origin in (list, tuple, set, frozenset) and arguments:
        item = _check(arguments[0])
        return lambda value: isinstance(value, origin) and all(map(item, value))
    if isinstance(origin, type) and issubclass(origin, Mapping) and arguments:
        key, item = map(_check, arguments)
        return lambda value: isinstance(value, origin) and all(map(key, value)) and all(map(item, value.values()))
    if getattr(hint, "_is_protocol", False):  # structural: a missing method shows when it is called
        return lambda _: True
    if hint is float:
        return lambda value: isinstance(value, numbers.Real) and not isinstance(value, bool)
    kind = origin or hint
    return (lambda value: isinstance(value, kind)) if isinstance(kind, type) else (lambda _: True)


def _type_name(hint: Any) -> str:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " | ".join("None" if each is type(None) else _type_name(each) for each in typing.get_args(hint))
    return hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)


def _advice(value: Any) -> str:
    """Return a hint for values that can be converted to the expected one."""
    if hasattr(value, "pose"):
        return " (its pose is `.pose`)"
    return " (call its .resolve() first)" if hasattr(value, "resolve") else ""


def _short(value: Any) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"


# === constructor arguments ====================================================================================
#
# Keep the constructor arguments of designators whose class defines its own `__init__`, for a memory to record.
#
# A dataclass exposes its fields; any other class exposes only what its `__init__` stores. Therefore the arguments are
# kept unchanged under `ARGUMENTS` in the instance. Empty `*rest` and `**options` are kept as None.

ARGUMENTS = "_constructed_with"
"""Name of the instance's attribute that holds the arguments, a namespace with one attribute per argument."""


def record_arguments(initialise: Callable[..., None]) -> Callable[..., None]:
    """Wrap `__init__` so that it keeps its arguments; a subclass's arguments replace those of its base."""
    signature = inspect.signature(initialise)
    _, *parameters = signature.parameters.values()
    if not parameters:
        return initialise
    variadic = {each.name for each in parameters if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}

    @functools.wraps(initialise)
    def wrapper(self: Any, *arguments: Any, **options: Any) -> None:
        initialise(self, *arguments, **options)
        bound = signature.bind(self, *arguments, **options)
        bound.apply_defaults()
        namespace = self.__dict__.setdefault(ARGUMENTS, types.SimpleNamespace()).__dict__
        _, *values = bound.arguments.items()
        namespace.update((name, value if value or name not in variadic else None) for name, value in values)

    return wrapper
