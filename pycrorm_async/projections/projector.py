"""Keep the visible tables up to date with the log.

projector = Projector(log)
await projector.open()
await projector.catch_up()
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

from sqlalchemy import text

from pycrorm_async.errors import CallerError, DatabaseForeign
from pycrorm_async.projections import generations
from pycrorm_async.projections.columns import next_number
from pycrorm_async.projections.custom import Projection
from pycrorm_async.projections.custom_tables import CustomTables
from pycrorm_async.projections.mapped_tables import UserView, mapped_leaves, with_user_views
from pycrorm_async.projections.pipeline import WHOLE, FoldRunner, LiveTarget, Share, sweep
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog

_log = logging.getLogger("pycrorm_async.projections")

_ANYTHING_FOLDED = text("SELECT 1 FROM episode WHERE folded > 0 LIMIT 1")


class Projector:
    """Folds one log into its tables.

    Args:
        log: open for writing.
        views: users' views to create beside the tables.
        projections: custom projections to fold too.
        installed: custom projections of installed packages; a name conflict in one is logged and not raised.
        batch_events: the most events in one transaction.

    Attributes:
        runner: folds into the built-in tables.
    """

    def __init__(
        self,
        log: EventLog,
        *,
        views: Sequence[UserView] = (),
        projections: Sequence[Projection] = (),
        installed: Sequence[Projection] = (),
        batch_events: int = 10_000,
    ) -> None:
        self._log = log
        self._views = views
        self._custom = CustomTables(log, projections, installed, batch_events=batch_events)
        self._target = LiveTarget(log)
        self._batch_events = batch_events
        self._until_visible = False
        self.runner = FoldRunner(self._target, batch_events=batch_events)

    async def open(self) -> None:
        """Create missing tables and views: those of every memory, of the mapped classes and of the users.

        Raises `DatabaseForeign` for tables of another version, `CallerError` for a view or a projection whose name
        is taken, and for a new view that the database refuses; one that was created before is left out.
        """
        with self._log.translated():
            async with self._log.engine.begin() as connection:
                await dialect_of(connection).lock_log_changes(connection)
                current = await generations.current_generation(connection, hold="change")
                if current is None and (await connection.execute(_ANYTHING_FOLDED)).first() is not None:
                    raise DatabaseForeign(f"{self._log.address}: the tables are missing: run `pycrorm rebuild`")
                generation = current or await generations.make_generation(connection, next_number(()))
                layout = generation.layout.with_leaves(mapped_leaves())
                layout = with_user_views(layout, self._views, connection.dialect).with_failed_views({})
                changed = await self._custom.set_up(connection, layout)
                if current is None or layout != generation.layout or changed:
                    generation = await generations.show(
                        connection, await generations.grow_tables(connection, generation, layout)
                    )
                registered = {} if current is None else current.layout.user_views
                for name, reason in generation.layout.failed_views.items():
                    if registered.get(name) != layout.user_views.get(name):  # new or changed by this caller
                        raise CallerError(f"the database refuses the view {name}: {reason}")
            self.runner = FoldRunner(self._target, batch_events=self._batch_events)
            self.runner.companions = lambda events: self._custom.companions(events, until_visible=self._until_visible)
            self.runner.generation = generation
            await sweep(self._log)

    async def catch_up(self) -> int:
        """Fold everything in the log; return the number of events folded.

        An event that cannot be folded parks its episode with the reason: the events before it are visible, and the
        other episodes continue. Raises `DatabaseUnavailable`; folded events stay, and the call may be repeated.
        """
        count = 0
        with self._log.translated():
            self._until_visible = True
            self._target.share = WHOLE
            try:
                while (folded := await self.runner.fold_next()) is not None:
                    count += folded
            finally:
                self._until_visible = False
            while await self._refresh():
                pass
            while await self._custom.fold_next_batch(until_visible=True):
                pass
        return count

    async def fold_next_batch(self, share: Share = WHOLE) -> bool:
        """Fold one batch of a share, or do one step of `fold_rest`; return False if nothing was behind the log."""
        return await self.fold_tables(share) is not None or await self.fold_rest(share)

    async def fold_tables(self, share: Share) -> int | None:
        """Fold one batch of a share into the built-in tables; return as `FoldRunner.fold_next` does."""
        self._target.share = share
        return await self.runner.fold_next()

    async def size(self) -> int:
        """Return the number of events that the next batch of all shares would have."""
        self._target.share = WHOLE
        return await self.runner.size()

    async def fold_rest(self, share: Share = WHOLE) -> bool:
        """Refresh some rows of the materialised views or fold custom projections; return False if none was behind.

        Custom projections are checked at intervals only. Of other shares than this one they are folded seldom, because
        another process does that if it has their code.
        """
        with self._log.translated():
            return await self._refresh() or await self._custom.fold_next_batch(share=share)

    async def _refresh(self) -> bool:
        generation = self.runner.generation
        if generation is None or not generation.layout.kept:
            return False
        async with self._log.engine.begin() as connection:
            await dialect_of(connection).lock_log_changes(connection)
            generation = await self._target.generation(connection, "change")
            try:
                return await generations.refresh_some(connection, generation.layout, generation.number)
            except generations.ViewRefused as fault:
                _log.warning("%s; it is left out", fault)
                layout = generation.layout
                layout = layout.with_failed_views(layout.failed_views | {fault.view: fault.reason})
                await generations.show(connection, replace(generation, revision=generation.revision + 1, layout=layout))
                return True
