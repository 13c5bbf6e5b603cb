"""Store blobs beside the log: contents too large for an event, named by their SHA-256.

A large blob is divided into parts, each a row and a transaction of its own, so that no other writer waits long. The
parts are inserted in order and never changed, so several processes may store the same blob at once, and one continues
where another was killed. The last part makes a blob complete. A blob is stored before the events that refer to it.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import AbstractAsyncContextManager
from hashlib import sha256
from typing import Final, NamedTuple, Protocol

from sqlalchemy import bindparam, inspect, text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.blobs import Blob, references_in
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.values import BlobReference
from pycrorm_async.store.dialect import Dialect

PART_BYTES: Final = 4 * 2**20
"""Bounds one row and transaction: SQLite's write lock is held for some ten milliseconds."""
_HASHES_MAX: Final = 500
"""Bounds the blobs that one statement asks for."""

_EXISTS: Final = "pycrorm_blob"
_INSERT = text(
    "INSERT INTO pycrorm_blob (hash, part, parts, media_type, size, content)"
    " VALUES (:hash, :part, :parts, :media_type, :size, :content) ON CONFLICT DO NOTHING"
)
_COMPLETE = text("SELECT hash FROM pycrorm_blob WHERE hash IN :hashes AND part = parts - 1").bindparams(
    bindparam("hashes", expanding=True)
)
_SELECT = text("SELECT parts, media_type, content FROM pycrorm_blob WHERE hash = :hash AND part = :part")

_log = logging.getLogger("pycrorm_async")


class BlobSource(Protocol):
    """The place from which the blobs of appended records come: the files of a spool, or another log."""

    async def read_blob(self, name: str) -> bytes | None:
        """Return the content with this SHA-256; None if it is missing or has other bytes."""
        ...


class Blobs:
    """The blobs of one log; `reading` and `writing` open its transactions."""

    def __init__(
        self,
        dialect: Dialect,
        reading: Callable[[], AbstractAsyncContextManager[AsyncConnection]],
        writing: Callable[[], AbstractAsyncContextManager[AsyncConnection]],
    ) -> None:
        self._dialect = dialect
        self._reading = reading
        self._writing = writing
        self.source: BlobSource | None = None

    async def store_for(self, records: Sequence[Record]) -> None:
        """Store the blobs that these records refer to and that are not stored yet, durable on return.

        A blob that the source no longer has is reported and left out: waiting would not bring it back.
        """
        wanted = {each.hash: each for record in records for each in references_in(record.type, record.payload)}
        if not wanted or self.source is None:
            return
        for name in wanted.keys() - await self.complete(wanted):
            content = await self.source.read_blob(name)
            if content is None:
                _log.error("blob %s is missing: `pycrorm verify` names the event that refers to it", name)
            else:
                await self.add(wanted[name], content)

    async def add(self, reference: BlobReference, content: bytes) -> None:
        """Store a blob; its parts that are stored already stay unchanged."""
        parts = max(1, -(-len(content) // PART_BYTES))
        await self._create_table()
        for part in range(parts):
            row = {
                "hash": reference.hash,
                "part": part,
                "parts": parts,
                "media_type": reference.media_type.replace("\0", ""),
                "size": len(content),
                "content": content[part * PART_BYTES : (part + 1) * PART_BYTES],
            }
            async with self._writing() as connection:
                await connection.execute(_INSERT, row)

    async def complete(self, hashes: Iterable[str]) -> set[str]:
        """Return those of these blobs that are stored completely."""
        names = list(hashes)
        stored: set[str] = set()
        async with self._reading() as connection:
            if await _has_table(connection):
                for start in range(0, len(names), _HASHES_MAX):
                    part = {"hashes": names[start : start + _HASHES_MAX]}
                    stored.update((await connection.execute(_COMPLETE, part)).scalars())
        return stored

    async def read(self, name: str) -> Blob | None:
        """Return a stored blob; None if it is missing or incomplete."""
        parts = [each async for each in self._parts(name)]
        if not parts or len(parts) < parts[0].parts:
            return None
        return Blob(b"".join(each.content for each in parts), parts[0].media_type)

    async def read_blob(self, name: str) -> bytes | None:
        """Implement `BlobSource`, for a copy of this log."""
        blob = await self.read(name)
        if blob is None or sha256(blob.content).hexdigest() != name:
            return None
        return blob.content

    async def fault(self, name: str) -> str | None:
        """Return the fault of a stored blob; None if its content has this SHA-256."""
        digest, count, parts = sha256(), 0, 1
        async for each in self._parts(name):
            count, parts = count + 1, each.parts
            await asyncio.to_thread(digest.update, each.content)
        if count < parts:
            return "is missing" if not count else f"is incomplete: {count} of {parts} parts are stored"
        return None if digest.hexdigest() == name else "has a content that does not match its hash"

    async def _parts(self, name: str) -> AsyncIterator[_Part]:
        part, parts = 0, 1
        while part < parts:
            async with self._reading() as connection:
                if not await _has_table(connection):
                    return
                row = (await connection.execute(_SELECT, {"hash": name, "part": part})).first()
            if row is None:
                return
            parts, part = row.parts, part + 1
            yield _Part(parts, row.media_type, bytes(row.content))

    async def _create_table(self) -> None:
        async with self._reading() as connection:
            if await _has_table(connection):
                return
        async with self._writing() as connection:
            await self._dialect.lock_log_changes(connection)
            await self._dialect.execute_all(connection, self._dialect.blob_table)


class _Part(NamedTuple):
    parts: int
    media_type: str
    content: bytes


async def _has_table(connection: AsyncConnection) -> bool:
    return await connection.run_sync(lambda each: inspect(each).has_table(_EXISTS))
