"""Make a folder once for all test processes; each gets a copy, in which its tests may write."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

__all__ = ["made_once", "shared_place"]


def shared_place(factory: pytest.TempPathFactory) -> Path:
    """Return the folder for temporary files of all test processes of this run."""
    own = factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a copy of the folder that `make` fills; the first process calls it, and the others wait for that."""
    shared = shared_place(factory) / f"shared_{name}"
    with shared.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not shared.exists():
            making = factory.mktemp(f"making_{name}")
            make(making)
            making.rename(shared)
    return Path(shutil.copytree(shared, factory.mktemp(name), dirs_exist_ok=True))
