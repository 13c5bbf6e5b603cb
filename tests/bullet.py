"""The functions of the installed Bullet, which tests call directly: their oracle for frames, joints and boxes."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from pycrorm_async.world.bullet_body import engine

INSTALLED_BULLETS = tuple(name for name in ("pybullet", "pycram-bullet") if find_spec(name.replace("-", "_")))
"""The installed packages that contain Bullet."""


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # asked for by the import system
        raise AttributeError(name)
    return getattr(engine(), name)
