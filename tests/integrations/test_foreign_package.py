"""A package that is not installed, or of an unknown version, is refused with the command that installs it."""

from __future__ import annotations

import re

import pytest

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.integrations.foreign_package import ForeignPackage

ENGINE = ForeignPackage("Engine", extra="engine", versions=["1.4.2", "2.*"])
INSTALL = re.escape("pip install 'pycrorm-async[engine]'")


def test_a_module_that_cannot_be_imported_is_a_missing_extra() -> None:
    with (
        pytest.raises(
            MissingExtra, match=rf"Engine cannot be imported \(No module named 'no_such_engine'\): {INSTALL}"
        ),
        ENGINE.importing(),
    ):
        import no_such_engine  # type: ignore[import-not-found]  # noqa: F401
    with pytest.raises(MissingExtra, match=rf"cannot import name 'no_such_name' .*: {INSTALL}"), ENGINE.importing():
        from json import no_such_name  # type: ignore[attr-defined]  # noqa: F401


def test_another_exception_of_an_import_reaches_the_program() -> None:
    with pytest.raises(OSError, match="its library is broken"), ENGINE.importing():
        raise OSError("its library is broken")


@pytest.mark.parametrize("version", ["1.4.2", "2.0", "2.6.0"])
def test_a_known_version_is_accepted(version: str) -> None:
    ENGINE.check_version(version)


@pytest.mark.parametrize("version", ["1.4.20", "1.4.3", "20.1", "3.0.0", ""])
def test_an_unknown_version_is_refused(version: str) -> None:
    message = re.escape(f"Engine {version} is unknown, only 1.4.2 or 2.* can be recorded: ")
    with pytest.raises(CallerError, match=message + INSTALL):
        ENGINE.check_version(version)


def test_the_version_of_a_distribution_is_read_without_importing_it() -> None:
    assert ENGINE.installed_version("msgspec")[0].isdigit()
    expected = rf"Engine \(no-such-engine 1\.4\.2 or 2\.\*\) is not installed: {INSTALL}"
    with pytest.raises(MissingExtra, match=expected):
        ENGINE.installed_version("no-such-engine")


def test_without_versions_any_version_is_accepted() -> None:
    engine = ForeignPackage("Engine", extra="engine")
    engine.check_version("0.0.1")
    with pytest.raises(MissingExtra, match=rf"Engine \(no-such-engine\) is not installed: {INSTALL}"):
        engine.installed_version("no-such-engine")
