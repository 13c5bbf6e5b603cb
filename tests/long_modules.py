"""Run modules whose tests take long in the first half of each test process, so that none is left with one at the end.

They are not run one after the other, because many of their tests wait: processes that all wait leave the cores idle.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final

import pytest

LONGEST: Final = """
    integrations/pycram/test_unusual_plans integrations/pycram/test_plans promises/test_pages crash/test_crash_points
    crash/test_daemon crash/test_cancelled promises/test_defects_of_storage crash/test_many_machines
    promises/test_without_bullet crash/test_rebuild_kill crash/test_killed promises/test_one_bad_episode
    promises/test_every_format promises/test_clock_steps recall/test_prediction
""".split()
"""The modules with a test of 5 s or more, the longest first. Most tests of a run take less than 0.1 s."""

_TESTS: Final = Path(__file__).parent


def long_modules_first(items: Sequence[pytest.Item], processes: int) -> list[pytest.Item]:
    """Return the tests in equal shares, one for each process, with the long modules among the first half of each.

    pytest-xdist assigns each process a share at once, and a process that has finished its own the end of another's.
    """
    modules: dict[str, list[pytest.Item]] = {}
    for item in items:
        modules.setdefault(_name(item.path), []).append(item)
    long = [modules.pop(name) for name in LONGEST if name in modules]
    rest = iter([item for module in modules.values() for item in module])
    ordered: list[pytest.Item] = []
    for share in range(processes):
        start, own = len(ordered), long[share::processes]
        size = (len(items) - start) // (processes - share)
        between = max(size - sum(map(len, own)), 0) // max(2 * len(own), 1)
        for module in own:
            ordered += [*module, *islice(rest, between)]
        ordered += islice(rest, max(start + size - len(ordered), 0))
    ordered += rest
    assert len({*map(id, ordered)}) == len(items) == len(ordered), "no test is lost or doubled"
    return ordered


def _name(path: Path) -> str:
    return path.relative_to(_TESTS).with_suffix("").as_posix() if path.is_relative_to(_TESTS) else str(path)
