"""Importing the plan layer."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


def test_importing_plans_loads_neither_bullet_nor_a_database() -> None:
    code = (
        "import sys, pycrorm_async.plan as plan; assert all(hasattr(plan, name) for name in plan.__all__);"
        "unwanted = {'pybullet', 'pycram_bullet', 'optik', 'sqlalchemy', 'pycrorm_async.events'};"
        "unwanted.add('pycrorm_async.record');"
        "print(sorted(unwanted & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"
