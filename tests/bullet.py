"""The functions of the installed Bullet, which tests call directly: their oracle for frames, joints and boxes."""

from __future__ import annotations

from importlib.metadata import distributions
from typing import Any

from pycrorm_async.world.bullet_body import engine

INSTALLED_BULLETS = tuple(
    name for name in ("pybullet", "pycram-bullet", "pybullet-arm64") if any(distributions(name=name))
)
"""The installed packages that contain Bullet."""


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # asked for by the import system
        raise AttributeError(name)
    return getattr(engine(), name)
