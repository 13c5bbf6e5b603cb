"""Seams around another library's methods, without that library; and `remember` where PyCRAM is not installed."""

from __future__ import annotations

from typing import Any

import pytest

from pycrorm_async.errors import MissingExtra
from pycrorm_async.integrations.pycram import Seams, guarded, remember


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
