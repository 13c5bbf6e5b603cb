"""Collect the rows of one batch of events: those to insert, and changes to rows that the tables contain already.

A node that starts and ends in one batch is one row to insert. Rows are tuples in the order of `core_columns`. Until
the batch is complete later events change the rows of nodes and episodes, which are lists (`node_row`) and dicts.
"""

from __future__ import annotations

from operator import itemgetter
from typing import Any, NamedTuple, TypeAlias

from pycrorm_async.bulk_records import make
from pycrorm_async.projections.fold.node_row import (
    END_NS,
    END_SEQUENCE,
    END_TIME,
    OUTCOME,
    PROCESS_METADATA_ID,
    STATUS,
)
from pycrorm_async.projections.schema.core_columns import COLUMNS

Row: TypeAlias = tuple[Any, ...]

_EPISODE_COLUMNS = itemgetter(*COLUMNS["process_metadata"])


class NodeEnd(NamedTuple):
    """The columns that the end of a node sets in its row."""

    id: int
    status: str
    end_time: int | None
    end_ns: int | None
    end_sequence: int | None
    reason: str | None
    failure_message: str | None
    failure_arguments: str | None
    result: str | None


class EpisodeEnd(NamedTuple):
    """The columns that the end of an episode sets in its row."""

    id: int
    status: str
    ended_at: int
    end_sequence: int
    failure_type: str | None
    failure_message: str | None
    continued_in: str | None
    entered_world: str | None


assert NodeEnd._fields == ("id", "status", "end_time", "end_ns", "end_sequence", *COLUMNS["task_tree_node"][OUTCOME])


class Rows:
    """The rows of one batch.

    Attributes:
        nodes, episodes: rows to insert, by id.
        inserts: rows to insert into the other core tables, by table.
        leaves: rows to insert into leaf tables, by (table, columns).
        descriptions: fingerprints of the descriptions of added objects.
        node_ends, episode_ends: updates of rows that an earlier batch inserted.
        lost: numbers of the episodes whose nodes that are RUNNING in the tables become LOST.
    """

    def __init__(self) -> None:
        self.nodes: dict[int, list[Any]] = {}
        self.episodes: dict[int, dict[str, Any]] = {}
        self.inserts: dict[str, list[Row]] = {table: [] for table in COLUMNS}
        self.leaves: dict[tuple[str, tuple[str, ...]], list[Row]] = {}
        self.descriptions: set[str] = set()
        self.node_ends: list[NodeEnd] = []
        self.episode_ends: list[EpisodeEnd] = []
        self.lost: list[int] = []

    def end_node(
        self,
        node: int,
        status: str,
        end_time: int | None,
        end_ns: int | None,
        end_sequence: int | None,
        outcome: Row,
    ) -> None:
        """Set the end of a node's row, in this batch or in the tables. `outcome`: the columns reason to result."""
        row = self.nodes.get(node)
        if row is None:
            self.node_ends.append(make(NodeEnd, (node, status, end_time, end_ns, end_sequence, *outcome)))
            return
        row[STATUS] = status
        row[END_TIME] = end_time
        row[END_NS] = end_ns
        row[END_SEQUENCE] = end_sequence
        row[OUTCOME] = outcome

    def end_episode(self, end: EpisodeEnd) -> None:
        """Set the end of an episode's row, in this batch or in the tables."""
        row = self.episodes.get(end.id)
        if row is None:
            self.episode_ends.append(end)
        else:
            row.update(end._asdict())
        if end.status == "LOST":
            self._lose_nodes(end.id)

    def _lose_nodes(self, number: int) -> None:
        self.lost.append(number)
        for row in self.nodes.values():
            if row[PROCESS_METADATA_ID] == number and row[STATUS] == "RUNNING":
                row[STATUS] = "LOST"

    def to_insert(self) -> dict[tuple[str, tuple[str, ...]], list[Row]]:
        """Return all rows to insert, by (table, columns)."""
        self.inserts["task_tree_node"] = list(map(tuple, self.nodes.values()))
        self.inserts["process_metadata"] = list(map(_EPISODE_COLUMNS, self.episodes.values()))
        core = {(table, COLUMNS[table]): rows for table, rows in self.inserts.items()}
        to_insert = {key: rows for key, rows in (core | self.leaves).items() if rows}
        for (table, columns), rows in to_insert.items():
            assert len(rows[0]) == len(columns), f"a row of {table} has {len(rows[0])} values, not {len(columns)}"
        return to_insert
