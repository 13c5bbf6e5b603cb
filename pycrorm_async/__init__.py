"""pycrorm-async records robot plans as events and offers them as relational tables.

>>> async with Memory.open("sqlite:///memory.db") as memory:
...     async with memory.episode(description="Tutorial"):
...         await plan()
...     await memory.flush()
...     async with memory.session() as session:
...         actions = (await session.scalars(select(Action))).all()

Users also import from `pycrorm_async.plan` (designators), `pycrorm_async.world` (the simulated world) and
`pycrorm_async.orm` (the mapped classes to query). Importing this package loads none of its parts; each public name
loads its module on first use.
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names
from pycrorm_async.moved_modules import keep_former_paths

if TYPE_CHECKING:
    from pycrorm_async.errors import PycrormError
    from pycrorm_async.events.types import Blob
    from pycrorm_async.memory import Memory
    from pycrorm_async.memory_parts import MemoryStatus
    from pycrorm_async.operations.copy import read_archived
    from pycrorm_async.operations.recovery import recover
    from pycrorm_async.projections.custom import EpisodeProjection, Projection
    from pycrorm_async.projections.mapped_tables import UserView
    from pycrorm_async.query.again import performable_of, world_of
    from pycrorm_async.query.reading import Reading
    from pycrorm_async.record.event_feed import RecordedEvent
    from pycrorm_async.record.plan_recorder import with_tree
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
    "read_archived",
    "recover",
    "with_tree",
    "world_of",
]

__getattr__ = lazy_names(
    __name__,
    {
        "errors": "PycrormError",
        "events.types": "Blob",
        "memory": "Memory",
        "memory_parts": "MemoryStatus",
        "operations.copy": "read_archived",
        "operations.recovery": "recover",
        "projections.custom": "EpisodeProjection Projection",
        "projections.mapped_tables": "UserView",
        "query.again": "performable_of world_of",
        "query.reading": "Reading",
        "record.event_feed": "RecordedEvent",
        "record.plan_recorder": "with_tree",
        "settings": "Settings",
    },
)

keep_former_paths()


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
