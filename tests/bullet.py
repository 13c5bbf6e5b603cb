"""The functions of the installed Bullet, which tests call directly: their oracle for frames, joints and boxes."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from importlib.metadata import distributions
from typing import Any, Final

from pycrorm_async.world import bullet_body
from pycrorm_async.world.bullet_body import engine

_FREE_MAX: Final = 8
"""Bounds the clients that wait for the next world."""

INSTALLED_BULLETS = tuple(
    name for name in ("pybullet", "pycram-bullet", "pybullet-arm64") if any(distributions(name=name))
)
"""The installed packages that contain Bullet."""


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # asked for by the import system
        raise AttributeError(name)
    return getattr(engine(), name)


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

    vars(bullet_body)["import_module"] = loaded
