"""Read the events of an episode from the log and return the document that its page shows."""

from __future__ import annotations

from collections.abc import AsyncIterable, Mapping, Sequence
from typing import Any

from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.events.codec import description_of
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.query.as_of import unreadable
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.scene.object_model import assumed_model, point_model
from pycrorm_async.report.episode_fold import EpisodeFold, model_name
from pycrorm_async.report.mesh_data import Meshes
from pycrorm_async.store.episode_lookup import episode_named
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import StoredEvent


async def episode_document(
    reading: Reading, episode: str | int, *, first: int | None = None, last: int | None = None
) -> dict[str, Any]:
    """Return the document of an episode, of all its events or of those from `first` to `last`.

    It ends with the 100,000th node, or after 200,000 moves, if there are more; `document["episode"]` has its `last`.

    Raises `UnknownEpisode`; `CallerError` for a window that holds no event; `LogDamaged` or `DatabaseForeign` for an
    event that cannot be read.
    """
    log = await reading.log()
    row = await episode_named(log, str(episode))
    if row.head == 0:
        raise UnknownEpisode(f"the log has no event of episode {row.number}")
    begin, end = first or 1, min(last or row.head, row.head)
    if begin > end:
        raise CallerError(f"episode {row.number} has {row.head} events, and none from event {begin} to {last or end}")
    fold = EpisodeFold(row, begin)
    await read_into(fold, log, log.pages(row._replace(head=end)))
    return await document_behind(fold, log)


async def read_into(fold: EpisodeFold, log: EventLog, pages: AsyncIterable[Sequence[StoredEvent]]) -> None:
    """Fold these events, up to the one at which the page is full.

    Raises `LogDamaged` or `DatabaseForeign` for an event that cannot be read.
    """
    designators = await log.dtypes()
    async for page in pages:
        for event in page:
            if fold.is_full:
                return
            try:
                fold.read(event, designators)
            except CannotFold as reason:
                raise unreadable(fold.row.id, event, str(reason), log) from None


async def document_behind(fold: EpisodeFold, log: EventLog, after: int = 0) -> dict[str, Any]:
    """Return the document of the events that were folded, or the part of those behind event `after`."""
    return fold.document(await _models(log, fold, after), after=after)


async def _models(log: EventLog, fold: EpisodeFold, after: int) -> Mapping[str, Any]:
    """Return the models of the objects that were added behind event `after`."""
    added = [each for identity, each in fold.world.objects.items() if identity > after]
    names = {each.added.description for each in added} - {None}
    payloads = await log.descriptions([name for name in names if name is not None])
    meshes = Meshes(log)
    models: dict[str, Any] = {"": point_model("its description is not in the log")} if added or not after else {}
    for name, payload in payloads.items():
        try:
            models[name] = await meshes.model(description_of(payload))
        except ValueError as error:
            models[name] = point_model(f"its description cannot be read: {error}")
    for each in added:
        name = model_name(each.added)
        if each.added.description is None and name not in models:
            models[name] = assumed_model(each.added.name, each.added.object_type, set(each.joints))
    return models
