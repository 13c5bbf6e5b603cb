"""One episode of the log read again, part after part: are its events whole, and what rows do they make.

What has not ended where a part ends is carried to the next one: the nodes that run, and the episode itself. So a part
can be any piece of an episode, and memory stays flat however long that is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pycrorm_async.events.ids import row_id, row_key
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.projections.fold.fold import CannotFold, Undecodable, fold_happening, happening_of
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_batch import Rows
from pycrorm_async.projections.schema.tables import COLUMNS
from pycrorm_async.projections.verify.row_comparison import Difference
from pycrorm_async.store.stored import Span, StoredEvent

__all__ = ["EpisodeCheck"]

_STATUS = COLUMNS["task_tree_node"].index("status")
_SIMULATED = COLUMNS["process_metadata"].index("simulated")


class EpisodeCheck:
    """What is known of the episode of this number, up to where it was read.

    Attributes:
        events, behind, remarks: how many were found: events, those of them that the tables do not show, unusual orders.
        damages: sequence and reason of each.
        compared: whether the tables show nothing of what comes now; they were behind when the last part was read.
        carried: ids of the nodes that run, and are compared later.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.events = self.behind = self.remarks = 0
        self.damages: list[tuple[int, str]] = []
        self.compared = False
        self.carried: frozenset[int] = frozenset()
        self._nodes: dict[int, list[Any]] = {}
        self._row: list[Any] | None = None
        self._order: OrderCheck | None = OrderCheck()
        self._in_gap = False
        self._lost: int | None = None
        self._open_when_lost: set[int] = set()

    def resume(self, rows: Rows, after: int, folded: int) -> None:
        """Puts what was carried into the rows of this part, which follows `after`."""
        if folded < after:  # the tables went back, and what is carried is ahead of them
            self.compared = True
            return
        rows.nodes |= self._nodes
        if self._row is not None:
            rows.episodes[self.number] = self._row
            if self._row[_SIMULATED]:
                rows.inserts["simulated_episode"].append((self.number,))

    def read(
        self, span: Span, events: Mapping[int, StoredEvent], folded: int, designators: Designators, rows: Rows
    ) -> None:
        """The events of a span by sequence; the rows they make, as far as the tables show them."""
        if self.compared:
            folded = 0
        for sequence in range(span.after + 1, span.last + 1):
            event = events.get(sequence)
            if event is not None:
                self._in_gap = False
                self._one(event, folded, designators, rows)
            elif not self._in_gap:
                self._in_gap = True
                self._damaged(sequence, "is missing")
                self._lose(sequence, folded, rows)

    def leave(self, rows: Rows, after: int, folded: int) -> None:
        """This part ends after that event, and there are more: takes back what is compared later."""
        self._nodes, self._row, self.carried = {}, None, frozenset()
        # In the next snapshot the tables may show more than is folded here; they are compared to their end now.
        self.compared = self.compared or folded < after
        if self.compared:
            return
        first = row_id(self.number, 0, 0)
        self._nodes = {key: row for key, row in rows.nodes.items() if key >= first and row[_STATUS] == "RUNNING"}
        self.carried = frozenset(self._nodes)
        self._row = rows.episodes.pop(self.number, None)
        simulated = rows.inserts["simulated_episode"]
        if (self.number,) in simulated:
            simulated.remove((self.number,))

    def hides(self, difference: Difference) -> bool:
        """Whether it is about a row of which nothing can be told, because events before it are lost."""
        if self._lost is None:
            return False
        open_then = difference.table == "task_tree_node" and difference.sequence in self._open_when_lost
        of_whole = difference.table in ("process_metadata", "simulated_episode")
        return difference.sequence >= self._lost or open_then or of_whole

    def _one(self, event: StoredEvent, folded: int, designators: Designators, rows: Rows) -> None:
        shown = event.sequence <= folded
        self.events += 1
        self.behind += not shown
        try:
            happening = happening_of(event)
            if self._order is not None:
                for finding in self._order.read(event.sequence, happening):
                    if finding.kind == "damage":
                        self._damaged(finding.sequence, finding.text)
                    else:
                        self.remarks += 1
            if shown and self._lost is None:
                fold_happening(event, happening, designators, rows)
        except CannotFold as reason:
            # What the tables show was folded once, so it was something else then.
            if shown or isinstance(reason, Undecodable):
                self._damaged(
                    event.sequence, f"is in the tables, and cannot be folded: {reason}" if shown else str(reason)
                )
            self._lose(event.sequence, folded, rows)

    def _lose(self, sequence: int, folded: int, rows: Rows) -> None:
        self._order = None
        if sequence <= folded and self._lost is None:
            self._lost = sequence
            keys = (row_key(key) for key, row in rows.nodes.items() if row[_STATUS] == "RUNNING")
            self._open_when_lost = {key.sequence for key in keys if key.number == self.number}

    def _damaged(self, sequence: int, reason: str) -> None:
        self.damages.append((sequence, reason))
