"""Store blocks of cases in the two tables of a generation, merge them as they grow, and read them.

Theory of operation. Each batch of folded events writes the cases of its actions as one block, in the transaction that
advances the checkpoints. A block has a level, by the number of its cases: 1, 16, 256, 4,096 or 65,536 and more. In the
same transaction, the blocks of a level are merged into one of the next level when there are 16 of them, or when they
hold 65,536 cases. So a case is rewritten at most four times, a memory has at most some sixty blocks besides the full
ones, and the full ones never change.

Several processes may fold one memory. On PostgreSQL a merge locks the blocks that it takes and skips those that another
transaction has locked, so that two merges never take the same block, and no process waits. A transaction that is rolled
back, by a kill too, leaves the blocks as they were, with the checkpoints. A reader that reads the list of the blocks
and then their columns in one snapshot finds each case once.

The number of a block is the greatest node id among its cases, plus its level: node ids end in five zero bits. A case
moves to higher levels only, so a number is never used twice in a generation.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterable, Mapping
from typing import Any, Final, NamedTuple

from sqlalchemy import Select, TableClause, column, delete, func, select, table, true
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DamageError, DatabaseForeign
from pycrorm_async.projections.schema.core_columns import OWN
from pycrorm_async.projections.schema.generations import select_generation
from pycrorm_async.projections.table_names import physical_name
from pycrorm_async.recall.block_rows import BlockRow, decode, encode
from pycrorm_async.recall.blocks import Block, merge
from pycrorm_async.store.dialect import RowsByTable
from pycrorm_async.store.dialects import dialect_of

BLOCKS: Final = "recall_block"
COLUMNS: Final = "recall_column"
BLOCK_COLUMNS: Final = {
    "level": "integer",
    "cases": "integer",
    "episode_min": "integer",
    "episode_max": "integer",
    "time_min": "time",
    "time_max": "time",
    "format": "integer",
}
"""The columns of `recall_block`. Its `id` is the block's number. The episodes and times are those of its cases."""
COLUMN_COLUMNS: Final = {"feature": "key", "kind": "key", "words": "text", "data": "bytes", "checksum": "integer"}
"""The columns of `recall_column`. Its `id` is the block's number; see `block_rows` for the others. The checksum is the
CRC-32 of feature, kind, words and data."""
_FORMAT: Final = 1
"""The format of the rows of a block (`block_rows`)."""
_MERGED: Final = 16
"""The number of blocks of one level that are merged into one of the next level."""
_FULL_LEVEL: Final = 4
"""The level of a block that is not merged any more, with 65,536 cases. Its columns take some 4 MB, and merging several
of them would hold the write lock of SQLite for long."""
_NO_EPISODE: Final = 0
"""The episode of the rows of blocks, because a block has cases of many."""


class BlockHeading(NamedTuple):
    """A stored block without its columns: number, level, number of cases, and the first and last episode of them."""

    number: int
    level: int
    cases: int
    episode_min: int
    episode_max: int


def rows_of(block: Block, generation: int) -> RowsByTable:
    """Return the rows of a block in both tables of this generation."""
    groups = block.groups.values()
    nodes = [int(each.nodes.max()) for each in groups]
    cases = len(block)
    level = _level_of(cases)
    number = max(nodes) + level
    heading = (
        number,
        _NO_EPISODE,
        level,
        cases,
        min(int(each.episodes.min()) for each in groups),
        max(int(each.episodes.max()) for each in groups),
        min(int(each.started_us.min()) for each in groups),
        max(int(each.started_us.max()) for each in groups),
        _FORMAT,
    )
    rows = [(number, _NO_EPISODE, *each, _checksum(each)) for each in encode(block)]
    episode = "process_metadata_id"
    return {
        (physical_name(f"{OWN}{BLOCKS}", generation), ("id", episode, *BLOCK_COLUMNS)): [heading],
        (physical_name(f"{OWN}{COLUMNS}", generation), ("id", episode, *COLUMN_COLUMNS)): rows,
    }


async def read_headings(connection: AsyncConnection, generation: int) -> list[BlockHeading]:
    """Read the list of the blocks, by number."""
    blocks = _blocks(generation)
    columns = blocks.c.id, blocks.c.level, blocks.c.cases, blocks.c.episode_min, blocks.c.episode_max
    return [BlockHeading(*row) for row in await connection.execute(select(*columns).order_by(blocks.c.id))]


def select_numbers(name: str, generation: int) -> Select[Any]:
    """Return the query of number and version of the generation under this key, and of the blocks of another one.

    The result has a row for each block, and at least one. Where the first number is that of `generation`, the tables
    were not replaced.
    """
    blocks = _blocks(generation)
    return select_generation(name).outerjoin(blocks, true()).add_columns(blocks.c.id)


async def read_blocks(connection: AsyncConnection, generation: int, numbers: Collection[int]) -> dict[int, Block]:
    """Read these blocks, by number; one that was merged in the meantime is left out.

    Raises `DamageError` for a block whose bytes were changed, `DatabaseForeign` for one in a newer format.
    """
    blocks, columns = _blocks(generation), _columns(generation)
    wanted = list(numbers)
    formats = await connection.execute(select(blocks.c.id, blocks.c.format).where(blocks.c.id.in_(wanted)))
    for number, format_ in formats:
        if format_ != _FORMAT:
            raise DatabaseForeign(f"block {number} of recall has format {format_}: use a newer pycrorm")
    fields = columns.c.id, columns.c.feature, columns.c.kind, columns.c.words, columns.c.data, columns.c.checksum
    rows_by_number: dict[int, list[BlockRow]] = {}
    for number, feature, kind, words, data, checksum in await connection.execute(
        select(*fields).where(columns.c.id.in_(wanted))
    ):
        if isinstance(data, str):  # SQLite keeps a value of any type in a column
            raise _damaged(number, f"its column {feature!r} is a text")
        row = BlockRow(feature, kind, words, bytes(data))
        if _checksum(row) != checksum:
            raise _damaged(number, f"the bytes of its column {feature!r} were changed")
        rows_by_number.setdefault(number, []).append(row)
    return {number: _decoded(number, rows) for number, rows in rows_by_number.items()}


async def read_left_out(connection: AsyncConnection, generation: int) -> list[str]:
    """Read the names of the features that a block has left out, because they have more than `WORDS_MAX` words."""
    columns = _columns(generation)
    query = select(columns.c.feature).where(columns.c.kind == "left_out").distinct().order_by(columns.c.feature)
    return list(await connection.scalars(query))


async def merge_blocks(connection: AsyncConnection, generation: int) -> None:
    """Merge the blocks of each level that has enough of them, in the caller's transaction. Raises `DamageError`."""
    while (level := await _full_level(connection, generation)) is not None:
        if not await _merge_level(connection, generation, level):
            return


async def _full_level(connection: AsyncConnection, generation: int) -> int | None:
    """Return the lowest level whose blocks are to be merged."""
    blocks = _blocks(generation)
    sizes = await connection.execute(
        select(blocks.c.level, func.count(), func.sum(blocks.c.cases))
        .where(blocks.c.level < _FULL_LEVEL)
        .group_by(blocks.c.level)
        .order_by(blocks.c.level)
    )
    return next((level for level, count, cases in sizes if _is_enough(count, cases)), None)


async def _merge_level(connection: AsyncConnection, generation: int, level: int) -> bool:
    """Merge blocks of this level; return False if other transactions have locked too many of them."""
    blocks, columns = _blocks(generation), _columns(generation)
    query = select(blocks.c.id, blocks.c.cases).where(blocks.c.level == level).order_by(blocks.c.id)
    locked = (await connection.execute(query.with_for_update(skip_locked=True))).all()
    numbers: list[int] = []
    cases = 0
    for each in locked:
        numbers.append(each.id)
        cases += each.cases
        if _is_enough(len(numbers), cases):
            break
    else:
        return False
    merged = merge([*(await read_blocks(connection, generation, numbers)).values()])
    if len(merged) != cases:
        raise DamageError(f"{len(numbers)} blocks of recall have {len(merged)} cases instead of {cases}: {_ADVICE}")
    for place in (columns, blocks):
        await connection.execute(delete(place).where(place.c.id.in_(numbers)))
    dialect = dialect_of(connection)
    await dialect.insert(connection, await dialect.insertion(rows_of(merged, generation)))
    return True


_ADVICE = "run `pycrorm rebuild recall`"


def _is_enough(count: int, cases: int) -> bool:
    return count >= _MERGED or cases >= _MERGED**_FULL_LEVEL


def _level_of(cases: int) -> int:
    """Return the level of a block with this many cases.

    >>> [_level_of(cases) for cases in (1, 15, 16, 4_095, 4_096, 65_535, 65_536, 131_071)]
    [0, 0, 1, 2, 3, 3, 4, 4]
    """
    return max(level for level in range(_FULL_LEVEL + 1) if cases >= _MERGED**level)


def _checksum(row: BlockRow) -> int:
    text = "\0".join((row.feature, row.kind, row.words or ""))
    return zlib.crc32(row.data, zlib.crc32(text.encode()))


def _decoded(number: int, rows: Iterable[BlockRow]) -> Block:
    try:
        return decode(rows)
    except ValueError as fault:
        raise _damaged(number, str(fault)) from fault


def _damaged(number: int, reason: str) -> DamageError:
    return DamageError(f"block {number} of recall is damaged: {reason}: {_ADVICE}")


def _blocks(generation: int) -> TableClause:
    return _table(BLOCKS, BLOCK_COLUMNS, generation)


def _columns(generation: int) -> TableClause:
    return _table(COLUMNS, COLUMN_COLUMNS, generation)


def _table(name: str, columns: Mapping[str, str], generation: int) -> TableClause:
    return table(physical_name(f"{OWN}{name}", generation), column("id"), *map(column, columns))
