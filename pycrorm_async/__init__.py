"""pycrorm-async records robot plans as events and offers them as relational tables.

>>> async with Memory.open("sqlite:///memory.db") as memory:
...     async with memory.episode(description="Tutorial"):
...         await plan()
...     await memory.flush()
...     async with memory.session() as session:
...         actions = (await session.scalars(select(Action))).all()

Users also import from `pycrorm_async.plan` (designators), `pycrorm_async.world` (the simulated world) and
`pycrorm_async.orm` (the mapped classes to query). Importing this package loads no other module; each public name loads
its module on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pycrorm_async.errors import PycrormError
    from pycrorm_async.events.blobs import Blob
    from pycrorm_async.memory import Memory, MemoryStatus
    from pycrorm_async.operations.recovery import recover
    from pycrorm_async.projections.custom.projection import EpisodeProjection, Projection
    from pycrorm_async.projections.schema.user_views import UserView
    from pycrorm_async.query.reading import Reading
    from pycrorm_async.query.recorded_designator import performable_of
    from pycrorm_async.query.recorded_world import world_of
    from pycrorm_async.recording.writing.event_feed import RecordedEvent
    from pycrorm_async.settings import Settings

__version__ = "0.2.0.dev0"

__all__ = [
    "Blob",
    "EpisodeProjection",
    "Memory",
    "MemoryStatus",
    "Projection",
    "PycrormError",
    "Reading",
    "RecordedEvent",
    "Settings",
    "UserView",
    "performable_of",
    "recover",
    "world_of",
]

_MODULES = {
    "Blob": "events.blobs",
    "EpisodeProjection": "projections.custom.projection",
    "Memory": "memory",
    "MemoryStatus": "memory",
    "Projection": "projections.custom.projection",
    "PycrormError": "errors",
    "Reading": "query.reading",
    "RecordedEvent": "recording.writing.event_feed",
    "Settings": "settings",
    "UserView": "projections.schema.user_views",
    "performable_of": "query.recorded_designator",
    "recover": "operations.recovery",
    "world_of": "query.recorded_world",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
