"""Episodic memory for robots: plans remembered as events, asked about as tables.

>>> async with Memory.open("sqlite:///memory.db") as memory:
...     async with memory.episode(description="Tutorial"):
...         await plan()
...     await memory.flush()
...     async with memory.session() as session:
...         actions = (await session.scalars(select(Action))).all()

The parts a user meets: `pycrorm_async.plan` (designators), `pycrorm_async.world` (where they act), `pycrorm_async.orm`
(the classes to ask for). Importing this loads nothing else.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pycrorm_async.errors import PycrormError
    from pycrorm_async.memory import Memory, MemoryStatus
    from pycrorm_async.operations.recovery import recover
    from pycrorm_async.projections.custom.projection import Projection
    from pycrorm_async.projections.schema.user_views import UserView
    from pycrorm_async.query.reading import Reading
    from pycrorm_async.settings import Settings

__version__ = "0.1.0"

__all__ = ["Memory", "MemoryStatus", "Projection", "PycrormError", "Reading", "Settings", "UserView", "recover"]

_HOMES = {
    "Memory": "memory",
    "MemoryStatus": "memory",
    "Projection": "projections.custom.projection",
    "PycrormError": "errors",
    "Reading": "query.reading",
    "Settings": "settings",
    "UserView": "projections.schema.user_views",
    "recover": "operations.recovery",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
