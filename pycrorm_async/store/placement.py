"""Place the rows of a memory: in plain tables, or in tables that PostgreSQL partitions by episode.

`pycrorm init` chooses the placement of a new memory, and it never changes. It is not stored beside the tables: the
partitions of the table `event` are the placement (`Dialect.placement`), so a dump, a restore or a copy of the server's
files keeps it, and no second record can contradict the tables.

All rows of an episode are in one partition of each table, the one with the hash of the episode's number. So a question
about one episode reads one partition, and partitions of equal size fill up evenly, however many episodes a month has.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import bounded

PARTITIONS_MAX: Final = 16
"""Bounds the partitions of a table. A transaction that makes the tables of a memory locks each partition with its
indexes and its TOAST table until COMMIT: 16 need 5,500 locks, and a default server has room for some 7,000."""
_NAME_LENGTH_MAX: Final = 63


class Placement(NamedTuple):
    """The number of hash partitions of each table with rows of episodes; 0 for plain tables."""

    partitions: int = 0

    @classmethod
    def of(cls, partitions: int) -> Placement:
        """Return the placement that a user asks for. Raises `CallerError`."""
        if not (partitions == 0 or 2 <= partitions <= PARTITIONS_MAX):
            raise CallerError(f"a memory has from 2 to {PARTITIONS_MAX} partitions, not {partitions}")
        return cls(partitions)

    def creation(self, create: str, table: str, episode: str | None, *, schema: str | None = None) -> list[str]:
        """Return the statements that create a table.

        Args:
            create: the statement that creates it as a plain table.
            table: its name.
            episode: the column with the number of each row's episode; None leaves the table plain.
            schema: the schema of the table, if it is not the first one of the search path.
        """
        if episode is None or not self.partitions:
            return [create]
        parts = (
            f"CREATE TABLE {part} PARTITION OF {_quoted(schema, table)}"
            f" FOR VALUES WITH (MODULUS {self.partitions}, REMAINDER {place})"
            for place, part in enumerate(self.parts(table, schema=schema))
        )
        return [f"{create} PARTITION BY HASH ({episode})", *parts]

    def parts(self, table: str, *, schema: str | None = None) -> list[str]:
        """Return the names of a table's partitions, in quotes."""
        names = (bounded(f"{table}_part{place}", _NAME_LENGTH_MAX) for place in range(self.partitions))
        return [_quoted(schema, each) for each in names]

    def __str__(self) -> str:
        if not self.partitions:
            return "plain tables"
        return f"{self.partitions} partitions by episode"


def _quoted(schema: str | None, name: str) -> str:
    return f'{schema}."{name}"' if schema else f'"{name}"'


PLAIN: Final = Placement()
