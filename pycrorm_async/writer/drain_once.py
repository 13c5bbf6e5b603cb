"""`pycrorm writer --once`: append and fold all there is, then say what it was."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pycrorm_async.errors import DatabaseError, InternalError, PycrormError
from pycrorm_async.settings import Settings
from pycrorm_async.writer.drain import Drain, DrainState
from pycrorm_async.writer.ports import Destination, Source
from pycrorm_async.writer.retry import BRIEF, retry

__all__ = ["DrainSummary", "drain_once"]


@dataclass(frozen=True, kw_only=True)
class DrainSummary:
    """What one round moved.

    Attributes:
        drained: one state for each source, in the order they were drained.
        failed: by the source's name, why it could not be drained to its end or its refused records not be set aside.
        folded: events folded.
        stopped: by episode id, why it is refused or parked; also one that was refused whole and has no row.
    """

    drained: tuple[DrainState, ...]
    failed: Mapping[str, PycrormError]
    folded: int
    stopped: Mapping[str, str]


async def drain_once(sources: Iterable[Source], destination: Destination, *, settings: Settings) -> DrainSummary:
    """Drains each source to its end, then folds. One that is damaged does not keep the others from being drained.

    Raises `DatabaseUnavailable` if the database stays away for some attempts at any of this; what was stored stays.
    """
    drained: list[DrainState] = []
    failed: dict[str, PycrormError] = {}
    for source in sources:
        drain = Drain(source, destination, settings=settings, backoff=BRIEF)
        try:
            await drain.run()
        except DatabaseError:
            raise
        except PycrormError as error:
            failed[source.name] = error
        except Exception as error:  # noqa: BLE001 - reported of this source; the next may be in order
            failed[source.name] = InternalError(f"recorder {source.name} cannot be drained: {error!r}")
        if drain.stuck is not None:
            failed[source.name] = drain.stuck
        drained.append(drain.state)
    await retry(destination.confirm, backoff=BRIEF)
    folded = await retry(destination.fold, backoff=BRIEF)
    stopped = await retry(destination.stopped, backoff=BRIEF)
    refused = {episode: reason for each in drained for episode, reason in each.refused.items()}
    return DrainSummary(drained=tuple(drained), failed=failed, folded=folded, stopped={**refused, **stopped})
