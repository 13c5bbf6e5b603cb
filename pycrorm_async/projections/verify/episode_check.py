"""Check one episode of the log part by part: validate its events and fold them again.

Nodes that still run where a part ends, and the episode's row, are carried to the next part. So a part may be any piece
of an episode, and the memory used does not depend on the episode's length.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pycrorm_async.events.blobs import references_in
from pycrorm_async.events.ids import row_id, row_key
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.events.types import EpisodeEnded, ObjectAdded
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.projections.fold.fold import UndecodablePayload, fold_happening, happening_of
from pycrorm_async.projections.fold.node_row import STATUS
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_batch import Rows
from pycrorm_async.projections.verify.findings import VerifyResult
from pycrorm_async.projections.verify.row_comparison import Difference
from pycrorm_async.store.digests.episode_digest import BLOCK_EVENTS
from pycrorm_async.store.stored import EpisodeRow, Span, StoredEvent


class EpisodeCheck:
    """The check of the episode with this number, up to the last part read. Adds its findings to `result`.

    Attributes:
        compared: whether the rows are compared completely, because the tables ended before the last part did.
        carried: ids of the running nodes, which a later part compares.
        descriptions: fingerprints of the stored descriptions.
        damaged_blocks: indexes of the blocks (`store.digests`) with an event for which damage was reported.
        described: whether an object added in the first block names its description.
        head: the episode's last event in the snapshot of the last part read.
    """

    def __init__(self, number: int, result: VerifyResult) -> None:
        self.number = number
        self._result = result
        self.compared = False
        self.carried: frozenset[int] = frozenset()
        self.descriptions: frozenset[str] = frozenset()
        self.damaged_blocks: set[int] = set()
        self.described = False
        self.head = 0
        self._has_end = False
        self._nodes: dict[int, list[Any]] = {}
        self._row: dict[str, Any] | None = None
        self._order: OrderCheck | None = OrderCheck()
        self._in_gap = False
        self._lost: int | None = None
        self._open_when_lost: set[int] = set()

    def resume(self, rows: Rows, after: int, folded: int) -> None:
        """Add the carried rows to those of this part, which follows `after`."""
        if folded < after:  # a rebuild made the tables shorter, so the carried rows are ahead of them
            self.compared = True
            return
        rows.nodes |= self._nodes
        if self._row is not None:
            rows.episodes[self.number] = self._row
            if self._row["simulated"]:
                rows.inserts["simulated_episode"].append((self.number,))

    def read(
        self,
        span: Span,
        events: Mapping[int, StoredEvent],
        episode: EpisodeRow,
        designators: Designators,
        rows: Rows,
    ) -> None:
        """Check the events of a span, given by sequence, and fold those that are visible into `rows`."""
        self.head = episode.head
        folded = 0 if self.compared else episode.folded
        for sequence in range(span.after + 1, span.last + 1):
            event = events.get(sequence)
            if event is not None:
                self._in_gap = False
                self._one(event, folded, designators, rows)
            elif not self._in_gap:
                self._in_gap = True
                self._damaged(sequence, "is missing")
                self._lose(sequence, folded, rows)
        ended = span.last == episode.head and episode.ended_wall_ns is not None
        if ended and not self._has_end and self._order is not None:
            evidence = "the episode has an end, and no EpisodeEnded"
            self._result.add_deleted(self.number, span.last + 1, f"it and all behind it were deleted: {evidence}")

    def leave(self, rows: Rows, after: int, folded: int) -> None:
        """End a part after event `after` of an episode that continues: take the rows to carry out of `rows`."""
        self._nodes, self._row, self.carried = {}, None, frozenset()
        # Tables that end inside this part are compared to their end now, because the next snapshot may have more rows
        # than this part folded.
        self.compared = self.compared or folded < after
        if self.compared:
            return
        first = row_id(self.number, 0, 0)
        self._nodes = {key: row for key, row in rows.nodes.items() if key >= first and row[STATUS] == "RUNNING"}
        self.carried = frozenset(self._nodes)
        self._row = rows.episodes.pop(self.number, None)
        simulated = rows.inserts["simulated_episode"]
        if (self.number,) in simulated:
            simulated.remove((self.number,))

    def hides(self, difference: Difference) -> bool:
        """Return whether to suppress a difference, because lost events make its expected row unknown."""
        if self._lost is None:
            return False
        open_then = difference.table == "task_tree_node" and difference.sequence in self._open_when_lost
        of_whole = difference.table in ("process_metadata", "simulated_episode")
        return difference.sequence >= self._lost or open_then or of_whole

    def _one(self, event: StoredEvent, folded: int, designators: Designators, rows: Rows) -> None:
        shown = event.sequence <= folded
        self._result.events += 1
        self._result.behind += not shown
        self._has_end = self._has_end or event.type == EpisodeEnded.__name__
        for reference in references_in(event.type, event.payload):
            self._result.blobs.setdefault(reference.hash, (self.number, event.sequence))
        try:
            happening = happening_of(event)
            described = happening.description if isinstance(happening, ObjectAdded) else None
            self.described = self.described or (described is not None and event.sequence <= BLOCK_EVENTS)
            if described is not None and described not in self.descriptions:
                self._damaged(event.sequence, f"the description {described} was never declared")
            if self._order is not None:
                for finding in self._order.read(event.sequence, happening):
                    if finding.kind == "damage":
                        self._damaged(finding.sequence, finding.text)
                    else:
                        self._result.remarks += 1
            if shown and self._lost is None:
                fold_happening(event, happening, designators, rows)
        except CannotFold as reason:
            # An event that is in the tables could be folded once, so the log has changed since.
            if shown or isinstance(reason, UndecodablePayload):
                self._damaged(
                    event.sequence, f"is in the tables, and cannot be folded: {reason}" if shown else str(reason)
                )
            self._lose(event.sequence, folded, rows)

    def _lose(self, sequence: int, folded: int, rows: Rows) -> None:
        self._order = None
        if sequence <= folded and self._lost is None:
            self._lost = sequence
            keys = (row_key(key) for key, row in rows.nodes.items() if row[STATUS] == "RUNNING")
            self._open_when_lost = {key.sequence for key in keys if key.number == self.number}

    def _damaged(self, sequence: int, reason: str) -> None:
        self.damaged_blocks.add((sequence - 1) // BLOCK_EVENTS)
        self._result.add_damage(self.number, sequence, reason)
