"""Which projections a process knows: those that are named, and those that installed packages offer.

A package offers one as an entry point, in its `pyproject.toml`:

    [project.entry-points."pycrorm.projections"]
    grasp_rate = "lab.projections:GraspRate"
"""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from pycrorm_async.errors import CallerError
from pycrorm_async.projections.custom.projection import Projection, columns_of

__all__ = ["GROUP", "checked", "named", "installed_besides"]

GROUP = "pycrorm.projections"

_log = logging.getLogger("pycrorm_async.projections")


def checked(projections: Sequence[Projection]) -> tuple[Projection, ...]:
    """The same. Raises `CallerError` for one that cannot be, and for two of one name."""
    names: set[str] = set()
    for each in projections:
        if not isinstance(each, Projection):
            raise CallerError(f"{each!r} is no projection: give an object of a class that derives from Projection")
        columns_of(each)
        if each.name in names:
            raise CallerError(f"two projections are called {each.name!r}: rename one")
        names.add(each.name)
    return tuple(projections)


def named(references: Sequence[str]) -> tuple[Projection, ...]:
    """The projections of these `module:Class`, also of modules in the working directory. Raises `CallerError`."""
    if references and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    return checked([_named(each) for each in references])


def _named(reference: str) -> Projection:
    module_name, _, class_name = reference.partition(":")
    if not module_name or not class_name:
        raise CallerError(f"{reference!r} names no projection: write module:Class")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise CallerError(f"{module_name} does not import: {type(error).__name__}: {error}") from error
    if not hasattr(module, class_name):
        raise CallerError(f"{module_name} has no {class_name!r}")
    return _made(getattr(module, class_name), reference)


def _made(kind: Any, reference: str) -> Projection:
    """One of this class."""
    if not isinstance(kind, type) or not issubclass(kind, Projection):
        raise CallerError(f"{reference} is no projection: derive from pycrorm_async.Projection")
    try:
        made = kind()
    except Exception as error:
        raise CallerError(f"{reference} cannot be made: {type(error).__name__}: {error}") from error
    columns_of(made)
    return made


def installed_besides(projections: Sequence[Projection]) -> tuple[Projection, ...]:
    """Those that packages offer, without those of the same names. What is wrong with one is told in the log."""
    there = {each.name for each in projections}
    found: list[Projection] = []
    for entry in sorted(entry_points(group=GROUP), key=lambda each: (each.name, each.value)):
        try:
            made = _made(entry.load(), entry.value)
        except Exception as error:  # noqa: BLE001 - somebody else's package; the others go on
            reason = error if isinstance(error, CallerError) else f"{type(error).__name__}: {error}"
            _log.warning("the projection %s of an installed package is left out: %s", entry.name, reason)
            continue
        if made.name not in there:
            there.add(made.name)
            found.append(made)
    return tuple(found)
