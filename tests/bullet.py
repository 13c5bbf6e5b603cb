"""The functions of the installed Bullet, which tests call directly: their oracle for frames, joints and boxes."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from importlib.metadata import distributions
from typing import Any, Final

import pytest

from pycrorm_async.world import BulletWorld, Object
from pycrorm_async.world.engines import bullet as bullet_engine
from pycrorm_async.world.engines import engine_class
from pycrorm_async.world.engines.bullet import Bullet, library

_FREE_MAX: Final = 8
"""Bounds the clients that wait for the next world."""

INSTALLED_ENGINES = tuple(
    name for name in ("pybullet", "pycram-bullet", "pybullet-arm64", "mujoco-core") if any(distributions(name=name))
)
"""The installed packages that contain an engine."""
ENGINE: Final = engine_class().title() if INSTALLED_ENGINES else ""
"""Name and version of the engine of worlds in the tests; of another one with PYCRORM_ENGINE."""


def __getattr__(name: str) -> Any:
    if name.startswith(("__", "pytest")):  # asked for by the import system and by pytest
        raise AttributeError(name)
    return getattr(library(), name)


def link_number(obj: Object, link: str) -> int:
    """Return Bullet's number of a link."""
    return _engine(obj.world).link_number(obj.body.number, link)


def client_of(world: BulletWorld) -> int:
    """Return Bullet's number of a world; skip the test in a world of another engine."""
    return _engine(world).client


def _engine(world: BulletWorld) -> Bullet:
    if not isinstance(world.engine, Bullet):
        pytest.skip("Bullet itself is asked")
    return world.engine


def reuse_clients() -> None:
    """Let the next world have the client of a closed one, emptied: Bullet makes a client in 20 ms of CPU time."""

    def loaded(name: str) -> Any:
        module: Any = import_module(name)
        connect, disconnect, free = module.connect, module.disconnect, list[int]()

        def reused(mode: int) -> int:
            with suppress(IndexError):
                if mode == module.DIRECT:
                    client = free.pop()
                    module.resetSimulation(physicsClientId=client)
                    return client
            return int(connect(mode))

        def kept(*, physicsClientId: int) -> None:  # noqa: N803  Bullet's own name
            if module.getConnectionInfo(physicsClientId)["connectionMethod"] == module.DIRECT and len(free) < _FREE_MAX:
                free.append(physicsClientId)
            else:
                disconnect(physicsClientId=physicsClientId)

        module.connect, module.disconnect = reused, kept
        return module

    vars(bullet_engine)["import_module"] = loaded
