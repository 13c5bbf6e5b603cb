"""Define the formats of exports, and write rows as Parquet, CSV or JSON lines.

A package adds a format with an entry point in the group `pycrorm.export_formats`, whose name is that of the
format and the suffix of its files, and whose value is a `Format`.
"""

from __future__ import annotations

import asyncio
from base64 import b64encode
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, aclosing, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import msgspec
from sqlalchemy import Select, func, select
from sqlalchemy.exc import CompileError

from pycrorm_async.errors import CallerError
from pycrorm_async.export.selection import Selection
from pycrorm_async.query.frames import columns_of, needed_pyarrow
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest
from pycrorm_async.visible_text import without_formula
from pycrorm_async.writer.drain import run_to_completion

if TYPE_CHECKING:
    import pyarrow as pa

    from pycrorm_async.progress_bar import ProgressCallback

GROUP = "pycrorm.export_formats"
"""The group of the entry points of formats."""


@dataclass(frozen=True)
class Job:
    """An export that a format writes.

    Attributes:
        file_format: name of the format.
        selection: the rows, and the episodes that they come from.
        options: the values of the format's options, by name.
        report_progress: gets the number of rows or events, done and of all; of events also the phase.
    """

    reading: Reading
    file_format: str
    selection: Selection
    options: Mapping[str, Any]
    report_progress: ProgressCallback | None

    def reporter(self, phase: str, before: int = 0) -> Callable[[int], None]:
        """Return a function that takes the number of done events of an episode; any thread may call it.

        `before` is the number of events of the episodes before that one.
        """
        total = sum(each.events for each in self.selection.episodes)

        def report(done: int) -> None:
            if self.report_progress is not None:
                self.report_progress(before + done, total, phase)

        return report


class Written(NamedTuple):
    """The content of a written export.

    Attributes:
        rows: their number, or that of frames, changes or messages.
        query: the SQL of the rows; empty for a format that is made from events.
        columns: the Arrow type of each column, by name.
        unreadable: by number, the reasons why episodes are left out.
        beside: the content of the file beside the export, for a format that has one.
    """

    rows: int
    query: str = ""
    columns: Mapping[str, str] = MappingProxyType({})
    unreadable: Mapping[int, str] = MappingProxyType({})
    beside: str = ""


class Format(NamedTuple):
    """A file format.

    Attributes:
        write: writes a job to an empty file, or into an empty folder.
        noun: what `Written.rows` counts.
        holds: rows; or whole episodes, made from their events; or one of them, which may run.
        options: the arguments of `export` that the format takes, each with its default.
        packages: those whose versions the manifest names.
        marker: of a data set in a folder, the file that each has; empty for a file.
        same_bytes: whether the same events give the same bytes.
        beside: the suffix that a further file adds to the name of the export; empty without one.
    """

    write: Callable[[Job, Path], Awaitable[Written]]
    noun: str = "row"
    holds: Literal["rows", "episodes", "episode"] = "rows"
    options: Mapping[str, Any] = MappingProxyType({})
    packages: tuple[str, ...] = ("pyarrow",)
    marker: str = ""
    same_bytes: bool = True
    beside: str = ""


def format_names(group: str, built_in: Iterable[str]) -> list[str]:
    """Return the names of the built-in formats, and of those that installed packages offer in a group."""
    return [*built_in, *sorted({each.name for each in entry_points(group=group)} - {*built_in})]


def offered_format(group: str, built_in: Iterable[str], name: str) -> Any:
    """Load the format of this name that an installed package offers in a group. Raises `CallerError`."""
    for each in entry_points(group=group, name=name):
        return each.load()
    names = format_names(group, built_in)
    raise CallerError(f"there is no format {name!r}{nearest(name, names)}; formats: {', '.join(names)}")


# === row files ================================================================================================
#
# Write the rows of a select, one batch after the other.

_Write: TypeAlias = "Callable[[pa.RecordBatch], object]"
_Open: TypeAlias = "Callable[[Path, pa.Schema, frozenset[str], Mapping[str, Any]], AbstractContextManager[_Write]]"


async def _write_rows(open_file: _Open, job: Job, path: Path) -> Written:
    log = await job.reading.log()
    statement, simulated, report = job.selection.statement, job.selection.simulated, job.report_progress
    columns = columns_of(statement, deferred=True)
    plain = statement.with_only_columns(*(each.expression for each in columns))
    total = 0
    if report is not None:
        count = select(func.count().label("rows")).select_from(plain.order_by(None).subquery())
        counted = await job.reading.dataframe(count, to="arrow", simulated=simulated)
        total = counted.column("rows")[0].as_py()
    json_columns = frozenset(each.name for each in columns if each.kind == "json")
    as_text = job.file_format == "csv"
    stream = job.reading.batches(statement, simulated=simulated, deferred=True, enums_as_text=as_text)
    rows, schema = 0, None
    with ExitStack() as stack:
        async with aclosing(stream) as batches:
            async for batch in batches:  # at least one, which may be empty
                if schema is None:
                    schema = batch.schema
                    write = stack.enter_context(open_file(path, schema, json_columns, job.options))
                await run_to_completion(asyncio.to_thread(write, batch))
                rows += batch.num_rows
                if report is not None:
                    report(rows, total)
    assert schema is not None
    return Written(rows, _sql(plain, log.engine.dialect), {each.name: str(each.type) for each in schema})


def _sql(statement: Select[*tuple[Any, ...]], dialect: Any) -> str:
    """Return the SQL, with the parameters as literals if they have a literal form."""
    try:
        return str(statement.compile(dialect=dialect, compile_kwargs={"literal_binds": True}))
    except (CompileError, NotImplementedError):
        return str(statement.compile(dialect=dialect))


@contextmanager
def _parquet(path: Path, schema: pa.Schema, _json: frozenset[str], _options: Mapping[str, Any]) -> Iterator[_Write]:
    needed_pyarrow()
    from pyarrow import parquet

    # A batch is a row group, so that a reader that wants some episodes or columns reads no others.
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        yield writer.write_batch


@contextmanager
def _csv(path: Path, schema: pa.Schema, _json: frozenset[str], options: Mapping[str, Any]) -> Iterator[_Write]:
    pa = needed_pyarrow()
    from pyarrow import csv

    texts: dict[int, Callable[[Any], str]] = {}
    for number, each in enumerate(schema):
        if pa.types.is_binary(each.type):  # in base64 as in JSON lines, because a text file cannot hold bytes
            texts[number] = lambda content: b64encode(content).decode()
            schema = schema.set(number, each.with_type(pa.string()))
        elif options["no_formulas"] and (pa.types.is_string(each.type) or pa.types.is_large_string(each.type)):
            texts[number] = without_formula

    def write(batch: Any) -> None:
        columns = list(batch.columns)
        for number, text in texts.items():
            values = [None if each is None else text(each) for each in columns[number].to_pylist()]
            columns[number] = pa.array(values, schema.field(number).type)
        writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))

    with csv.CSVWriter(path, schema) as writer:
        yield write if texts else writer.write_batch


@contextmanager
def _jsonl(path: Path, _schema: pa.Schema, json: frozenset[str], _options: Mapping[str, Any]) -> Iterator[_Write]:
    def value(name: str, each: Any) -> Any:
        return msgspec.Raw(each.encode()) if name in json and each is not None else each

    with path.open("wb") as file:
        encoder = msgspec.json.Encoder()

        def write(batch: pa.RecordBatch) -> None:
            rows = ({name: value(name, each) for name, each in row.items()} for row in batch.to_pylist())
            file.write(encoder.encode_lines(rows))

        yield write


PARQUET = Format(partial(_write_rows, _parquet))
CSV = Format(partial(_write_rows, _csv), options={"no_formulas": False})
JSONL = Format(partial(_write_rows, _jsonl))
