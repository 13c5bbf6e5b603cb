"""Keep the constructor arguments of designators whose class defines its own `__init__`, for a memory to record.

A dataclass exposes its fields; any other class exposes only what its `__init__` stores. Therefore the arguments are
kept unchanged under `ARGUMENTS` in the instance. Empty `*rest` and `**options` are kept as None.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

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
        namespace = self.__dict__.setdefault(ARGUMENTS, SimpleNamespace()).__dict__
        _, *values = bound.arguments.items()
        namespace.update((name, value if value or name not in variadic else None) for name, value in values)

    return wrapper
