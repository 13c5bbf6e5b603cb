"""The experience of a memory: `DatabaseCostmapLocation` and `RecalledPickUp` find ways to pick an object up in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Self

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import PickUpAction
from pycrorm_async.plan.experience import PastSuccess
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.library import CaseLibrary
from pycrorm_async.recall.past_pick_ups import best_first, tries_of
from pycrorm_async.recall.reading.case_reader import CaseReader
from pycrorm_async.recall.reading.database_source import DatabaseSource
from pycrorm_async.world.enums import Arms, ObjectType


class PickUpExperience:
    """The pick-ups of one memory that succeeded or failed, without simulations. Implements `Experience`.

    A pick-up of this process counts as soon as it has ended; one of another process, when it is visible in the tables.
    """

    def __init__(self, reading: Reading, reader: Callable[[], CaseReader]) -> None:
        self._reading = reading
        self._reader = reader
        self._pick_up_types = {"PickUpAction": True}
        self.is_closed = False
        """True once the memory is closed."""

    @classmethod
    def of(cls, reading: Reading) -> Self:
        """Return the experience of a memory that is open for reading."""
        reader = CaseReader(DatabaseSource(reading))
        return cls(reading, lambda: reader)

    async def successes(
        self, object_type: ObjectType, *, arm: Arms | None, height: float | None = None, torso: float | None = None
    ) -> Sequence[PastSuccess]:
        """Return the ways in which objects of this type were picked up; see `Experience` and `past_pick_ups`.

        Raises `CallerError` once the memory is closed.
        """
        if self.is_closed:
            raise CallerError("the memory is closed, so its experience cannot be read: ask while it is open")
        library = await self._reader().library()
        tries = tries_of(library, await self._pick_ups(library), object_type, arm)
        return best_first(tries, height=height, torso=torso)

    async def _pick_ups(self, library: CaseLibrary) -> list[str]:
        """Return `PickUpAction` and the types derived from it, also of a program's own once they are stored."""
        unknown = library.types.keys() - self._pick_up_types.keys()
        if unknown:
            await self._reading.refresh()
            for dtype in unknown:
                with suppress(CallerError):  # a type of this process that is not stored yet
                    self._pick_up_types[dtype] = issubclass(self._reading.mapped(dtype), PickUpAction)
        return [dtype for dtype, is_pick_up in self._pick_up_types.items() if is_pick_up]
