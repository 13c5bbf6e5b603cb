"""Seams around another library's methods, without that library, and `remember` without PyCRAM."""

from __future__ import annotations

import re
from typing import Any

import pytest

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.integrations.foreign_package import ForeignPackage
from pycrorm_async.integrations.pycram import Seams, guarded, remember

# === seams ====================================================================================================
#
# Seams around another library's methods, without that library; and `remember` where PyCRAM is not installed.


class Counter:
    def __init__(self) -> None:
        self.faults: list[str] = []

    def note_fault(self, where: str, error: BaseException) -> None:
        self.faults.append(f"{where}: {error}")


class Robot:
    def move(self, metres: float) -> float:
        return metres


class Observer:
    def __init__(self, seams: Seams) -> None:
        self.seams = seams
        self.moved: list[float] = []

    @guarded
    def note(self, _robot: Robot, metres: float) -> None:
        self.moved.append(metres)
        if metres < 0:
            raise ValueError("backwards")


@pytest.fixture
def counter() -> Counter:
    return Counter()


@pytest.fixture
def seams(counter: Counter) -> Seams:
    made = Seams(counter)  # type: ignore[arg-type]  # it needs no more of a recording
    made.is_on = True
    return made


def test_a_fault_of_an_observer_is_counted_and_does_not_reach_the_method(seams: Seams, counter: Counter) -> None:
    observer, original = Observer(seams), Robot.move
    seams.after(Robot, "move", observer.note)
    assert [Robot().move(1.0), Robot().move(-1.0)] == [1.0, -1.0]
    seams.remove()
    assert Robot.move is original
    assert Robot().move(2.0) == 2.0
    assert observer.moved == [1.0, -1.0]
    assert counter.faults == ["Observer.note: backwards"]


def test_a_seam_below_that_of_another_library_stays_and_does_nothing_after_the_end(seams: Seams) -> None:
    observer, original = Observer(seams), Robot.move
    seams.after(Robot, "move", observer.note)
    ours = Robot.move
    Robot.move = lambda self, metres: ours(self, metres) + 1  # type: ignore[method-assign]  # another library's
    theirs = Robot.move
    try:
        assert Robot().move(1.0) == 2.0
        seams.remove()
        assert Robot.move is theirs
        assert Robot().move(5.0) == 6.0
        assert observer.moved == [1.0]
    finally:
        Robot.move = original  # type: ignore[method-assign]


def test_a_callback_that_another_library_removed_does_not_keep_the_others(seams: Seams) -> None:
    callbacks: list[Any] = []
    seams.callback(callbacks.append, callbacks.remove, "first")  # type: ignore[arg-type]
    seams.callback(callbacks.append, callbacks.remove, "second")  # type: ignore[arg-type]
    callbacks.remove("second")
    seams.remove()
    assert callbacks == []


def test_without_pycram_remember_names_the_extra_to_install() -> None:
    with pytest.raises(MissingExtra, match=r"pip install 'pycrorm-async\[pycram\]'"), remember("sqlite://"):
        pass


# === foreign package ==========================================================================================
#
# A package that is not installed, or of an unknown version, is refused with the command that installs it.

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
