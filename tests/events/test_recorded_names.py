"""A class is recorded under the same name and declaration after it has moved within the package."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import pycrorm_async
from pycrorm_async.plan.language import Designator
from pycrorm_async.record.declarations import declared_type
from pycrorm_async.recorded_names import recorded_name

GOLDEN = Path(__file__).parent.parent / "golden"
NAMES = (GOLDEN / "recorded_names.txt").read_text().split()
FINGERPRINTS = dict(line.split() for line in (GOLDEN / "built_in_declarations.txt").read_text().splitlines())


def classes_of_the_package() -> set[type]:
    modules = pkgutil.walk_packages(pycrorm_async.__path__, "pycrorm_async.")
    imported = [importlib.import_module(each.name) for each in modules if not each.name.endswith("__main__")]
    classes = {each for module in imported for each in vars(module).values() if isinstance(each, type)}
    return {each for each in classes if each.__module__.startswith("pycrorm_async.")}


def descendants(root: Any) -> Iterator[type[Designator]]:
    for each in root.__subclasses__():
        yield each
        yield from descendants(each)


def test_every_enum_and_failure_of_an_earlier_version_is_recorded_under_its_first_name() -> None:
    recorded = {recorded_name(each) for each in classes_of_the_package() if issubclass(each, Enum | BaseException)}
    assert len(NAMES) == 145
    assert set(NAMES) - recorded == set()


def test_no_two_classes_are_recorded_under_one_name() -> None:
    classes = classes_of_the_package()
    by_name = {recorded_name(each): each for each in classes}
    assert sorted(map(str, classes - set(by_name.values()))) == []


def test_the_built_in_designators_have_the_declarations_of_earlier_versions() -> None:
    """Recorders of two versions then write the same declaration, which a log stores once."""
    classes_of_the_package()  # imports every module
    built_in = [each for each in descendants(Designator) if each.__module__.startswith("pycrorm_async.")]
    declared = [declared_type(each) for each in built_in if not inspect.isabstract(each)]
    fingerprints = {each.declaration.dtype: each.fingerprint for each in declared if each.fingerprint}
    assert len(FINGERPRINTS) == 38
    assert {each: fingerprints.get(each) for each in FINGERPRINTS} == FINGERPRINTS
