"""`pycrorm writer --once`: append and fold all there is, then say what it was."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pycrorm_async.config import Settings
from pycrorm_async.errors import DamageError, FilesError, PycrormError
from pycrorm_async.writer.asking import answer_of
from pycrorm_async.writer.backoff import BRIEF
from pycrorm_async.writer.drain import Drain, DrainState
from pycrorm_async.writer.ports import Destination, Source

__all__ = ["Recovered", "drain_once"]


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """What one round moved.

    Attributes:
        drained: one state for each source, in the order they were drained.
        failed: by the source's name, why it could not be drained to its end.
        folded: events folded.
        stopped: by episode id, why it is refused or parked.
    """

    drained: tuple[DrainState, ...]
    failed: Mapping[str, PycrormError]
    folded: int
    stopped: Mapping[str, str]


async def drain_once(sources: Iterable[Source], destination: Destination, *, settings: Settings) -> Recovered:
    """Drains each source to its end, then folds. One that is damaged does not keep the others from being drained.

    Raises `DatabaseUnavailable` if the database stays away for some attempts at any of this; what was stored stays.
    """
    drained: list[DrainState] = []
    failed: dict[str, PycrormError] = {}
    for source in sources:
        drain = Drain(source, destination, settings=settings, backoff=BRIEF)
        try:
            await drain.run()
        except (DamageError, FilesError) as error:
            failed[source.name] = error
        drained.append(drain.state)
    folded = await answer_of(destination.fold, backoff=BRIEF)
    stopped = await answer_of(destination.stopped, backoff=BRIEF)
    return Recovered(drained=tuple(drained), failed=failed, folded=folded, stopped=dict(stopped))
