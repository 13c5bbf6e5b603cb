"""Discover custom projections: those given by the caller, those installed as entry points, and those of this package.

A package declares a projection in its `pyproject.toml`:

    [project.entry-points."pycrorm.projections"]
    grasp_rate = "lab.projections:GraspRate"
"""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from pycrorm_async.errors import CallerError
from pycrorm_async.projections.custom.projection import Projection, columns_of

GROUP = "pycrorm.projections"
_OF_THIS_PACKAGE = ("pycrorm_async.recall.cases.case_projection:CaseProjection",)
"""The projections of every memory. They are loaded by name, because their folders are above this one."""

_log = logging.getLogger("pycrorm_async.projections")


def validate_projections(projections: Sequence[Projection]) -> tuple[Projection, ...]:
    """Validate projections and return them. Raises `CallerError` for an invalid one, and for two of one name."""
    names: set[str] = set()
    for each in projections:
        if not isinstance(each, Projection):
            raise CallerError(f"{each!r} is not a projection: pass an instance of a class that derives from Projection")
        columns_of(each)
        if each.name in names:
            raise CallerError(f"two projections have the name {each.name!r}: rename one")
        names.add(each.name)
    return tuple(projections)


def load_projections(references: Sequence[str]) -> tuple[Projection, ...]:
    """Import projections by `module:Class`, also from the working directory. Raises `CallerError`."""
    if references and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    return validate_projections([_load_projection(each) for each in references])


def _load_projection(reference: str) -> Projection:
    module_name, _, class_name = reference.partition(":")
    if not module_name or not class_name:
        raise CallerError(f"{reference!r} does not name a projection: write module:Class")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise CallerError(f"{module_name} cannot be imported: {type(error).__name__}: {error}") from error
    if not hasattr(module, class_name):
        raise CallerError(f"{module_name} has no {class_name!r}")
    return _instance(getattr(module, class_name), reference)


def _instance(kind: Any, reference: str) -> Projection:
    """Create and validate an instance of this class. Raises `CallerError`."""
    if not isinstance(kind, type) or not issubclass(kind, Projection):
        raise CallerError(f"{reference} is not a projection: derive from pycrorm_async.Projection")
    try:
        projection = kind()
    except Exception as error:
        raise CallerError(f"{reference} cannot be instantiated: {type(error).__name__}: {error}") from error
    columns_of(projection)
    return projection


def installed_projections(projections: Sequence[Projection], *, own: bool = True) -> tuple[Projection, ...]:
    """Return the installed projections whose names these do not have, with those of this package if `own` is true.

    A faulty one is logged and left out. A package that is installed while the process runs is not found.
    """
    names = {each.name for each in projections}
    installed = [each for each in own_projections() if own and each.name not in names]
    names.update(each.name for each in installed)
    for entry in _entries():
        try:
            projection = _instance(entry.load(), entry.value)
        except Exception as error:  # noqa: BLE001 - a fault in one package must not disable the others
            reason = error if isinstance(error, CallerError) else f"{type(error).__name__}: {error}"
            _log.warning("the projection %s of an installed package is left out: %s", entry.name, reason)
            continue
        if projection.name not in names:
            names.add(projection.name)
            installed.append(projection)
    return tuple(installed)


@cache
def own_projections() -> tuple[Projection, ...]:
    """Return the projections of this package, which every memory has."""
    return tuple(map(_load_projection, _OF_THIS_PACKAGE))


@cache
def _entries() -> tuple[EntryPoint, ...]:
    """Return the entry points. Each memory that is opened needs them; those of a hundred packages take 3 ms to read."""
    return tuple(sorted(entry_points(group=GROUP), key=lambda each: (each.name, each.value)))
