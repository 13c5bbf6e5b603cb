"""Keeps the arguments with which a designator was built whose class has an `__init__` of its own.

A dataclass shows its fields, any other class only what its `__init__` does with the arguments. So those are kept as
they were given, under `ARGUMENTS` in the instance, for a memory to record. Of `*rest` and `**options` nothing is kept
where none were given.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

__all__ = ["ARGUMENTS", "keeping_arguments"]

ARGUMENTS = "_constructed_with"
"""The attribute of the instance; its attributes are the arguments by name."""


def keeping_arguments(initialise: Callable[..., None]) -> Callable[..., None]:
    """The same `__init__`, which keeps what it was called with; that of a subclass comes after its base's."""
    signature = inspect.signature(initialise)
    _, *parameters = signature.parameters.values()
    if not parameters:
        return initialise
    gathered = {each.name for each in parameters if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}

    @functools.wraps(initialise)
    def initialised(self: Any, *arguments: Any, **options: Any) -> None:
        initialise(self, *arguments, **options)
        bound = signature.bind(self, *arguments, **options)
        bound.apply_defaults()
        kept = self.__dict__.setdefault(ARGUMENTS, SimpleNamespace()).__dict__
        _, *values = bound.arguments.items()
        kept.update((name, value if value or name not in gathered else None) for name, value in values)

    return initialised
