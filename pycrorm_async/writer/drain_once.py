"""Drain every source to its end, then fold once, for `pycrorm writer --once`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from pycrorm_async.errors import DatabaseError, InternalError, PycrormError
from pycrorm_async.events.envelope import Record
from pycrorm_async.settings import Settings
from pycrorm_async.writer.drain import Drain, DrainState
from pycrorm_async.writer.ports import Destination, Source
from pycrorm_async.writer.retry import BRIEF, retry


@dataclass(frozen=True, kw_only=True)
class DrainSummary:
    """The result of `drain_once`.

    Attributes:
        drained: one state per source, in the order of draining.
        failed: by source name, the reason why it could not be drained to its end, or its refused records not be kept.
        folded: number of folded events.
        stopped: by episode id, the reason why it is refused or parked; includes episodes refused whole, without a row.
    """

    drained: tuple[DrainState, ...]
    failed: Mapping[str, PycrormError]
    folded: int
    stopped: Mapping[str, str]


async def drain_once(
    sources: Iterable[Source],
    destination: Destination,
    *,
    settings: Settings,
    on_append: Callable[[Source, Sequence[Record]], None] = lambda _source, _batch: None,
) -> DrainSummary:
    """Drain each source to its end, then fold. A damaged source does not prevent draining the others.

    Calls `on_append` with each acknowledged batch. Raises `DatabaseUnavailable` if the database stays unavailable for
    five attempts; stored events stay stored.
    """
    drained: list[DrainState] = []
    failed: dict[str, PycrormError] = {}
    for source in sources:
        drain = Drain(
            source, destination.append, settings=settings, backoff=BRIEF, on_append=partial(on_append, source)
        )
        try:
            await drain.run()
        except DatabaseError:
            raise
        except PycrormError as error:
            failed[source.name] = error
        except Exception as error:  # noqa: BLE001 - reported for this source; must not stop the next
            failed[source.name] = InternalError(f"recorder {source.name} cannot be drained: {error!r}")
        if drain.stuck is not None:
            failed[source.name] = drain.stuck
        drained.append(drain.state)
    await retry(destination.confirm, backoff=BRIEF)
    folded = await retry(destination.fold, backoff=BRIEF)
    stopped = await retry(destination.stopped, backoff=BRIEF)
    refused = {episode: reason for each in drained for episode, reason in each.refused.items()}
    return DrainSummary(drained=tuple(drained), failed=failed, folded=folded, stopped={**refused, **stopped})
