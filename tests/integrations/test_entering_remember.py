"""`remember` of PyCRAM is entered again after Ctrl-C came while it was entered. This needs no PyCRAM."""

from __future__ import annotations

import inspect
import sys
from types import FrameType
from typing import Any

import pytest

from pycrorm_async.integrations import pycram
from pycrorm_async.memory import Memory


class Entered(Exception):
    """Raised in place of opening the memory."""


class AnyVersion:
    """Takes the place of the installed PyCRAM."""

    def installed_version(self, _distribution: str) -> str:
        return "1.0.4"

    def check_version(self, _version: str) -> None:
        """Accept it."""


def test_ctrl_c_at_any_call_of_entering_it_leaves_none_active(monkeypatch: pytest.MonkeyPatch) -> None:
    def sync(*_arguments: Any, **_options: Any) -> None:
        raise Entered

    code = inspect.unwrap(pycram.remember).__code__
    left = 0

    def interrupt(frame: FrameType, what: str, _argument: object) -> None:
        nonlocal left
        if frame.f_code is code and what == "c_return":
            left -= 1
            if not left:
                raise KeyboardInterrupt

    def enter() -> None:
        with pycram.remember("sqlite:///memory.db"):
            pytest.fail("the block was entered")

    monkeypatch.setattr(pycram, "_PYCRAM", AnyVersion())
    monkeypatch.setattr(Memory, "sync", sync)
    points = 0
    while True:
        left = points + 1
        sys.setprofile(interrupt)
        try:
            enter()
        except KeyboardInterrupt:
            points += 1
        except Entered:
            break
        finally:
            sys.setprofile(None)
        with pytest.raises(Entered):
            enter()
    assert points > 1
