"""Place the rows of a memory: in plain tables, in partitions by episode, or the events on other servers.

`pycrorm init` chooses the placement of a new memory, and it never changes. It is not stored beside the tables: the
partitions of the table `event` are the placement (`Dialect.placement`), so a dump, a restore or a copy of the server's
files keeps it, and no second record can contradict the tables.

All rows of an episode are in one partition of each table, the one with the hash of the episode's number. So a question
about one episode reads one partition, and partitions of equal size fill up evenly, however many episodes a month has.

**Shards.** The partitions of `event` may be foreign tables (`postgres_fdw`) on other PostgreSQL servers, the shards;
digests and all other tables stay on the server that programs connect to, the coordinator. There is no two-phase commit:
the COMMIT of an append commits on the shard first, then on the coordinator. If the coordinator dies in between, the
shard has events behind the head of their episode. No reader looks there. The next append of the episode meets them as
duplicate keys; it then adopts them (`EventLog.store`): it advances the head over them, with their digests, and compares
them with the events that the spool offers again, as it does with all repeats. An episode's row is committed before its
first event goes to a shard, so that the number of an event on a shard never belongs to another episode.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.events.fields import bounded

PARTITIONS_MAX: Final = 16
"""Bounds the partitions of a table. A transaction that makes the tables of a memory locks each partition with its
indexes and its TOAST table until COMMIT: 16 need 5,500 locks, and a default server has room for some 7,000."""
_NAME_LENGTH_MAX: Final = 63
SHARD_SCHEMA: Final = "pycrorm_shard"
"""Schema of the events on a shard. That of a log would be taken for one without its other tables."""
SERVER: Final = "pycrorm_shard"
"""Name of a shard in the coordinator's catalogue, before its number."""
_SERVER_OPTIONS: Final = {
    # The triggers of the coordinator decide which rows its sessions may delete on the shard.
    "options": f"-c synchronous_commit=on -c {SHARD_SCHEMA}.removes=yes",
    "truncatable": "false",
    "connect_timeout": "5",
    "keepalives_idle": "10",
    "keepalives_interval": "5",
    "keepalives_count": "3",
    "tcp_user_timeout": "25000",
    "fetch_size": "10000",
    "batch_size": "1000",
    "use_remote_estimate": "true",  # otherwise a join reads whole shards instead of looking its rows up
}


@dataclass(frozen=True)
class Shard:
    """A database on another server that keeps events, as the coordinator reaches it. The login does not identify it."""

    host: str
    port: str
    dbname: str
    user: str | None = field(default=None, compare=False)
    password: str | None = field(default=None, compare=False, repr=False)

    def __str__(self) -> str:
        return f"{self.host}:{self.port}/{self.dbname}"


class Placement(NamedTuple):
    """The number of hash partitions of each table with rows of episodes, 0 for plain tables; or shards of events."""

    partitions: int = 0
    shards: tuple[Shard, ...] = ()

    @classmethod
    def of(cls, partitions: int, shards: tuple[Shard, ...] = ()) -> Placement:
        """Return the placement that a user asks for. Raises `CallerError`."""
        if partitions and shards:
            raise CallerError("--partitions and --shard exclude each other")
        if not (partitions == 0 or 2 <= partitions <= PARTITIONS_MAX) or len(shards) > PARTITIONS_MAX:
            raise CallerError(
                f"a memory has from 2 to {PARTITIONS_MAX} partitions, or up to {PARTITIONS_MAX} shards, not"
                f" {partitions or len(shards)}"
            )
        if len(set(shards)) < len(shards):
            raise CallerError("the same shard is named twice")
        return cls(partitions, shards)

    def creation(self, create: str, table: str, episode: str | None, *, schema: str | None = None) -> list[str]:
        """Return the statements that create a table, other than `event` of a memory with shards.

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

    def foreign_creation(self, columns: str, table: str, refusal: str) -> list[str]:
        """Return the statements that create a table of these columns on the coordinator, with its rows on shards.

        `refusal` is the function that refuses to delete rows of a partition.
        """
        statements = [
            "CREATE EXTENSION IF NOT EXISTS postgres_fdw",
            f"CREATE TABLE {table} ({columns}) PARTITION BY HASH (episode)",
        ]
        for place, shard in enumerate(self.shards):
            server, part = f"{SERVER}{place}", f"{table}_part{place}"
            at = {"host": shard.host, "port": shard.port, "dbname": shard.dbname}
            login = {name: each for name, each in (("user", shard.user), ("password", shard.password)) if each}
            statements += [
                f"CREATE SERVER {server} FOREIGN DATA WRAPPER postgres_fdw{_options(at | _SERVER_OPTIONS)}",
                f"CREATE USER MAPPING FOR PUBLIC SERVER {server}{_options(login)}",
                f"CREATE FOREIGN TABLE {part} PARTITION OF {table}"
                f" FOR VALUES WITH (MODULUS {len(self.shards)}, REMAINDER {place}) SERVER {server}"
                + _options({"schema_name": SHARD_SCHEMA, "table_name": table.rpartition(".")[2]}),
                f"CREATE TRIGGER is_not_deleted BEFORE DELETE ON {part} EXECUTE FUNCTION {refusal}()",
            ]
        return statements

    def to_print(self) -> dict[str, object]:
        """Return the placement as a JSON document has it."""
        return {"partitions": self.partitions, "shards": [str(each) for each in self.shards]}

    def __str__(self) -> str:
        if self.shards:
            return f"events on {len(self.shards)} shards ({', '.join(map(str, self.shards))})"
        return f"{self.partitions} partitions by episode" if self.partitions else "plain tables"


def _quoted(schema: str | None, name: str) -> str:
    return f'{schema}."{name}"' if schema else f'"{name}"'


def _options(options: dict[str, str]) -> str:
    listed = ", ".join(f"{name} '{each.replace(chr(39), 2 * chr(39))}'" for name, each in options.items())
    return f" OPTIONS ({listed})" if listed else ""


PLAIN: Final = Placement()
