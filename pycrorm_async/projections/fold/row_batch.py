"""What a batch of events makes: rows to insert, and changes of rows that are in the tables already.

A node that starts and ends in one batch is one row to insert. Rows are tuples in the order of `tables.COLUMNS`; of
nodes and episodes they are lists until the batch is over.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

from pycrorm_async.bulk_records import make
from pycrorm_async.projections.schema.tables import COLUMNS

__all__ = ["Rows", "Row", "NodeEnd", "EpisodeEnd"]

Row: TypeAlias = tuple[Any, ...]

_NODE = COLUMNS["task_tree_node"]
_EPISODE = COLUMNS["process_metadata"]


class NodeEnd(NamedTuple):
    """What the end of a node changes in its row."""

    id: int
    status: str
    end_time: int | None
    end_ns: int | None
    reason: str | None
    failure_message: str | None
    failure_arguments: str | None
    result: str | None


class EpisodeEnd(NamedTuple):
    """What the end of an episode changes in its row."""

    id: int
    status: str
    ended_at: int
    failure_type: str | None
    failure_message: str | None
    continued_in: str | None


_STATUS, _END_TIME, _END_NS = (_NODE.index(name) for name in ("status", "end_time", "end_ns"))
_OUTCOME = slice(_NODE.index("reason"), _NODE.index("result") + 1)
assert NodeEnd._fields == ("id", "status", "end_time", "end_ns", *_NODE[_OUTCOME])
_EPISODE_END = tuple(_EPISODE.index(name) for name in EpisodeEnd._fields)
_NODE_NUMBER = _NODE.index("process_metadata_id")


class Rows:
    """The rows of one batch.

    Attributes:
        nodes, episodes: to insert, by id.
        inserts: to insert into the other core tables, by table.
        leaves: to insert into leaf tables, by (table, columns).
        node_ends, episode_ends: to update, of rows that came with an earlier batch.
        lost: episodes whose nodes that are still running in the tables are lost.
    """

    def __init__(self) -> None:
        self.nodes: dict[int, list[Any]] = {}
        self.episodes: dict[int, list[Any]] = {}
        self.inserts: dict[str, list[Row]] = {table: [] for table in COLUMNS}
        self.leaves: dict[tuple[str, tuple[str, ...]], list[Row]] = {}
        self.node_ends: list[NodeEnd] = []
        self.episode_ends: list[EpisodeEnd] = []
        self.lost: list[int] = []

    def end_node(self, node: int, status: str, end_time: int | None, end_ns: int | None, outcome: Row) -> None:
        """The node's row has an end, here or in the tables. `outcome` is the columns reason to result."""
        row = self.nodes.get(node)
        if row is None:
            self.node_ends.append(make(NodeEnd, (node, status, end_time, end_ns, *outcome)))
            return
        row[_STATUS] = status
        row[_END_TIME] = end_time
        row[_END_NS] = end_ns
        row[_OUTCOME] = outcome

    def end_episode(self, end: EpisodeEnd) -> None:
        """The episode's row has an end, here or in the tables."""
        row = self.episodes.get(end.id)
        if row is None:
            self.episode_ends.append(end)
        else:
            for index, value in zip(_EPISODE_END, end, strict=True):
                row[index] = value
        if end.status == "LOST":
            self._lose_nodes(end.id)

    def _lose_nodes(self, number: int) -> None:
        self.lost.append(number)
        for row in self.nodes.values():
            if row[_NODE_NUMBER] == number and row[_STATUS] == "RUNNING":
                row[_STATUS] = "LOST"

    def to_insert(self) -> dict[tuple[str, tuple[str, ...]], list[Row]]:
        """All rows to insert, by (table, columns)."""
        self.inserts["task_tree_node"] = list(map(tuple, self.nodes.values()))
        self.inserts["process_metadata"] = list(map(tuple, self.episodes.values()))
        core = {(table, COLUMNS[table]): rows for table, rows in self.inserts.items()}
        return {key: rows for key, rows in (core | self.leaves).items() if rows}
