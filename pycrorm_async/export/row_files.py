"""Write the rows of a select as Parquet, CSV or JSON lines, one batch after the other."""

from __future__ import annotations

import asyncio
from base64 import b64encode
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import msgspec

from pycrorm_async.query.frames.arrow_batches import needed_pyarrow
from pycrorm_async.writer.drain import run_to_completion

if TYPE_CHECKING:
    import pyarrow as pa

RowFormat: TypeAlias = Literal["parquet", "csv", "jsonl"]
_Write: TypeAlias = "Callable[[pa.RecordBatch], object]"


async def write_rows(
    batches: AsyncIterator[pa.RecordBatch],
    path: Path,
    file_format: RowFormat,
    json_columns: frozenset[str],
    report_rows: Callable[[int], object],
) -> tuple[int, pa.Schema]:
    """Write the batches to a file; return the number of rows and their schema. `report_rows` gets the number so far.

    `batches` has at least one, which may be empty.
    """
    rows, schema = 0, None
    with ExitStack() as stack:
        async for batch in batches:
            if schema is None:
                schema = batch.schema
                write = stack.enter_context(_WRITERS[file_format](path, schema, json_columns))
            await run_to_completion(asyncio.to_thread(write, batch))
            rows += batch.num_rows
            report_rows(rows)
    return rows, schema


@contextmanager
def _parquet(path: Path, schema: pa.Schema, _json_columns: frozenset[str]) -> Iterator[_Write]:
    needed_pyarrow()
    from pyarrow import parquet

    # A batch is a row group, so that a reader that wants some episodes or columns reads no others.
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        yield writer.write_batch


@contextmanager
def _csv(path: Path, schema: pa.Schema, _json_columns: frozenset[str]) -> Iterator[_Write]:
    pa = needed_pyarrow()
    from pyarrow import csv

    binary = [number for number, each in enumerate(schema) if pa.types.is_binary(each.type)]
    for number in binary:
        schema = schema.set(number, schema.field(number).with_type(pa.string()))

    def in_base64(column: Any) -> Any:  # as in JSON lines, because a text file cannot hold bytes
        return pa.array([None if each is None else b64encode(each).decode() for each in column.to_pylist()], "string")

    def write(batch: Any) -> None:
        columns = list(batch.columns)
        for number in binary:
            columns[number] = in_base64(columns[number])
        writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))

    with csv.CSVWriter(path, schema) as writer:
        yield write if binary else writer.write_batch


@contextmanager
def _jsonl(path: Path, _schema: pa.Schema, json_columns: frozenset[str]) -> Iterator[_Write]:
    def value(name: str, each: Any) -> Any:
        return msgspec.Raw(each.encode()) if name in json_columns and each is not None else each

    with path.open("wb") as file:
        encoder = msgspec.json.Encoder()

        def write(batch: pa.RecordBatch) -> None:
            rows = ({name: value(name, each) for name, each in row.items()} for row in batch.to_pylist())
            file.write(encoder.encode_lines(rows))

        yield write


_WRITERS: dict[str, Callable[[Path, Any, frozenset[str]], AbstractContextManager[_Write]]] = {
    "parquet": _parquet,
    "csv": _csv,
    "jsonl": _jsonl,
}
