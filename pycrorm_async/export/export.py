"""Export rows and episodes of a memory to a file, and make an export again from its manifest.

>>> await export(reading, "PickUpWithContextView", "picks.parquet")
Exported(path=PosixPath('picks.parquet'), rows=1204, episodes=30, left_out=0, manifest=...)

**Datasette.** Describe a memory for Datasette: hidden tables, meanings and sort orders of views, and the named
questions.

    pycrorm datasette-metadata > metadata.json
    datasette -i pycrorm.db --metadata metadata.json

The names of hidden tables carry the number of a generation, so the description is made again after a rebuild.
"""

from __future__ import annotations

import asyncio
import inspect
import re
import tempfile
from base64 import b64encode
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, aclosing, contextmanager
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, get_args

import msgspec
import numpy as np
from sqlalchemy import LargeBinary, Select, func, select
from sqlalchemy import inspect as inspect_database
from sqlalchemy.exc import CompileError

from pycrorm_async.errors import CallerError, DatabaseForeign, LogDamaged
from pycrorm_async.export.lerobot import DEFAULT_FPS, MARKER, ImageSize, LeRobotFolder, check_size, draw_frames
from pycrorm_async.export.scenes import Clock, frames_of, read_episode, scene_objects, write_mcap, write_rerun
from pycrorm_async.export.selection import (
    CoveredEpisode,
    Exportable,
    Manifest,
    Selection,
    checksums,
    episode_differences,
    manifest_path,
    read_manifest,
    select_rows,
    versions_of,
)
from pycrorm_async.orm.documentation import ViewDescription, described
from pycrorm_async.projections.generations import PROJECTION_VERSION
from pycrorm_async.query.frames import columns_of, needed_pyarrow
from pycrorm_async.query.question import Question
from pycrorm_async.query.questions import QUESTIONS, Ask, arguments_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest
from pycrorm_async.report.output_files import new_file, new_folder, refuse_existing
from pycrorm_async.visible_text import without_formula
from pycrorm_async.writer.drain import run_to_completion

if TYPE_CHECKING:
    import pyarrow as pa

    from pycrorm_async.progress_bar import ProgressCallback


FileFormat: TypeAlias = Literal["parquet", "csv", "jsonl", "lerobot", "rrd", "mcap"]
EPISODE_FORMATS = frozenset(("lerobot", "rrd", "mcap"))
"""The formats that hold episodes, from their events, instead of rows."""


class Exported(NamedTuple):
    """A written export.

    Attributes:
        path: of the file.
        rows: number of rows.
        episodes: number of episodes that it covers.
        left_out: number of episodes without rows in the export, because they run or are not in the tables yet.
        manifest: the description, which is in the file `PATH.manifest.json`.
        unreadable: of LeRobot, by number, the reasons why episodes are not in the export: they are damaged, or of a
            newer version.
        unknown_name: a line about an argument of a question without rows, such as an object, that is nowhere in the
            memory; empty without one.
    """

    path: Path
    rows: int
    episodes: int
    left_out: int
    manifest: Manifest
    unknown_name: str = ""
    unreadable: Mapping[int, str] = MappingProxyType({})


class ExportComparison(NamedTuple):
    """An export that was made again.

    Attributes:
        same: whether its files have the same bytes; of a rerun recording, whose chunks have random ids, whether nothing
            else differs.
        differences: one line for each other difference.
        exported: the new file, if one was asked for.
        by_bytes: False for a rerun recording, whose bytes are not compared.
    """

    same: bool
    differences: tuple[str, ...]
    exported: Exported | None
    by_bytes: bool = True


def format_of(path: Path) -> FileFormat:
    """Return the format that the suffix of a file names. Raises `CallerError`."""
    suffix = path.suffix.removeprefix(".").lower()
    for each in get_args(FileFormat):
        if suffix == each and each != "lerobot":
            return each  # type: ignore[no-any-return]
    raise CallerError(f"the suffix of {path} names no format: add --format (file_format=), one of {_listed()}")


def _listed() -> str:
    return ", ".join(get_args(FileFormat))


async def export(
    reading: Reading,
    what: Exportable,
    path: str | PathLike[str],
    *,
    file_format: FileFormat | None = None,
    episodes: Sequence[str | int] = (),
    arguments: Mapping[str, Any] = MappingProxyType({}),
    force: bool = False,
    clock: Clock | None = None,
    fps: int | None = None,
    images: ImageSize | None = None,
    no_formulas: bool = False,
    report_progress: ProgressCallback | None = None,
) -> Exported:
    """Write rows or episodes to a file that gets its name when it is complete, and its manifest beside it.

    Args:
        what: an episode or several (a row for each node), by number, id or `last`; a view by name, or a mapped
            class, of all episodes that have ended; a question of `memory.ask` or its name; or a select.
        path: of the file.
        file_format: `parquet`, `csv` or `jsonl` for rows; `lerobot` for episodes, into a folder; `rrd` or `mcap` for
            one episode, which may be running; by default that of the suffix.
        episodes: limit a view, or a question about all, to these.
        arguments: of a question that is named.
        force: replace the file if it exists; a folder only if it is such a data set.
        clock, fps: of LeRobot: a frame for each event that changed the robot's state (`event`, the default), or `fps`
            frames each second (`time`). Of MCAP: the times of the events (`time`, the default), or `fps` events in
            each second (`event`).
        images: of LeRobot: width and height of a picture of the scene at each frame, which needs the extra `world`.
        no_formulas: of CSV: an apostrophe before each text that a spreadsheet would run as a formula.
        report_progress: gets the number of rows, done and of all; of the formats of episodes that of events, with the
            phase, `reading`, `drawing` or `writing`, also from another thread.

    Raises `CallerError` if the file or its manifest exists, if nothing has this name, or for a running episode;
    `UnknownEpisode`; `MissingExtra`; `OSError` if the disk is full, and then leaves no file.
    """
    target = Path(path)
    _refuse_other_encodings(target)
    refuse_existing(target, force=force, folder=True)
    refuse_existing(manifest_path(target), force=force)
    chosen = file_format or format_of(target)
    if chosen not in get_args(FileFormat):
        raise CallerError(f"there is no format {chosen!r}{nearest(chosen, get_args(FileFormat))}; formats: {_listed()}")
    if no_formulas and chosen != "csv":
        raise CallerError("no_formulas is an option of the format csv")
    options = _options(chosen, clock, fps, images)
    left_out, unknown_name, unreadable = 0, "", dict[int, str]()
    with new_file(manifest_path(target), force=force) as described:
        match chosen:
            case "parquet" | "csv" | "jsonl":
                selection = await select_rows(reading, what, episodes, arguments=arguments)
                left_out = selection.left_out
                with new_file(target, force=force) as written:
                    manifest = await _write_rows(
                        reading, selection, written, chosen, report_progress, no_formulas=no_formulas
                    )
                    manifest = _complete(manifest, {target.name: checksums(written)[written.name]}, described)
                if selection.question is not None and not manifest.rows:
                    unknown_name = await selection.question.unknown_name()
            case "lerobot":
                covered = await _episodes(reading, what, episodes, chosen)
                with new_folder(target, force=force, marker=MARKER) as written:
                    frames = await write_lerobot(reading, covered, written, options, report_progress, unreadable)
                    covered = tuple(each for each in covered if each.number not in unreadable)
                    manifest = await _described(reading, covered, chosen, options, frames)
                    manifest = _complete(manifest, checksums(written), described)
            case "rrd" | "mcap":
                covered = await _episodes(reading, what, episodes, chosen, running=True)
                with new_file(target, force=force) as written:
                    changes = await write_scene(reading, covered, written, chosen, options, report_progress)
                    manifest = await _described(reading, covered, chosen, options, changes)
                    manifest = _complete(manifest, {target.name: checksums(written)[written.name]}, described)
    return Exported(target, manifest.rows, len(manifest.episodes), left_out, manifest, unknown_name, unreadable)


async def export_again(
    reading: Reading,
    manifest: str | PathLike[str],
    path: str | PathLike[str] | None = None,
    *,
    statement: Question | Select[*tuple[Any, ...]] | None = None,
    force: bool = False,
    report_progress: ProgressCallback | None = None,
) -> ExportComparison:
    """Make an export again from the episodes that its manifest names, and compare.

    Args:
        manifest: the file `PATH.manifest.json`.
        path: of the new file; by default the export is only compared.
        statement: the select or question, if the export was made from one without a name.

    If episodes are missing, nothing is made and `differences` lists them. Raises what `export` raises.
    """
    before = read_manifest(Path(manifest))
    log = await reading.log()
    rows, digests = await log.episodes(), await log.last_digests()
    present = {
        each.id: CoveredEpisode(
            each.number, each.id, "", each.head, digests[each.number].digest if each.number in digests else None
        )
        for each in rows
    }
    differences = episode_differences(before.episodes, present)
    if any(each.id not in present for each in before.episodes):
        return ExportComparison(same=False, differences=tuple(differences), exported=None)
    what, episodes = _named_by(before, statement)
    with tempfile.TemporaryDirectory(prefix="pycrorm-export-") as folder:
        target = Path(path) if path is not None else Path(folder, "export")
        file_format: Any = before.file_format
        options: dict[str, Any] = dict(before.options)
        if file_format == "mcap" and options["clock"] == "time":
            options["fps"] = None  # its manifest has the default, which `export` refuses beside this clock
        exported = await export(
            reading,
            what,
            target,
            file_format=file_format,
            episodes=episodes,
            force=force,
            report_progress=report_progress,
            **options,
        )
    now = exported.manifest
    differences += _changes("version of", before.versions, now.versions)
    differences += _changes("type of the column", before.columns, now.columns)
    if before.tables != now.tables:
        differences.append(f"version of the tables: {now.tables} instead of {before.tables}")
    if before.rows != now.rows:
        differences.append(f"rows: {now.rows} instead of {before.rows}")
    by_bytes = before.file_format != "rrd"
    same = [*before.files.values()] == [*now.files.values()] if by_bytes else not differences
    return ExportComparison(same, tuple(differences), exported if path is not None else None, by_bytes)


def _refuse_other_encodings(path: Path) -> None:
    """Raise `CallerError` for a name that is not UTF-8, which neither a manifest nor Arrow can hold."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise CallerError(f"the name {str(path)!r} is not UTF-8: give another name") from None


def _named_by(
    manifest: Manifest, statement: Question | Select[*tuple[Any, ...]] | None
) -> tuple[Exportable, tuple[str, ...]]:
    """Return the exportable that the manifest names, and the episodes to limit it to."""
    ids = tuple(each.id for each in manifest.episodes)
    match manifest.kind:
        case "episodes":
            return ids, ()
        case "view":
            return manifest.names[0], ids
        case "question":
            asked = manifest.options.get("arguments", {})
            return manifest.names[0], ids if asked.get("episode") is None else ()
    if statement is None:
        raise CallerError(
            "this is the export of a program's own select: call `await memory.export_again(manifest, statement=...)`"
        )
    return statement, ids if isinstance(statement, Question) and statement.episode is None else ()


def _changes(subject: str, before: dict[str, str], now: dict[str, str]) -> list[str]:
    names = [name for name in before | now if before.get(name) != now.get(name)]
    return [f"{subject} {name}: {now.get(name, 'none')} instead of {before.get(name, 'none')}" for name in names]


async def _write_rows(
    reading: Reading,
    selection: Selection,
    path: Path,
    file_format: RowFormat,
    report_progress: ProgressCallback | None,
    *,
    no_formulas: bool,
) -> Manifest:
    log = await reading.log()
    columns = columns_of(selection.statement, deferred=True)
    plain = selection.statement.with_only_columns(*(each.expression for each in columns))
    total = 0
    if report_progress is not None:
        counted = await reading.dataframe(
            select(func.count().label("rows")).select_from(plain.order_by(None).subquery()),
            to="arrow",
            simulated=selection.simulated,
        )
        total = counted.column("rows")[0].as_py()
    stream = reading.batches(
        selection.statement, simulated=selection.simulated, deferred=True, enums_as_text=file_format == "csv"
    )
    async with aclosing(stream) as batches:
        json_columns = frozenset(each.name for each in columns if each.kind == "json")
        shown = (_guarded(each) async for each in batches) if no_formulas else batches
        rows, schema = await write_rows(shown, path, file_format, json_columns, _reporting(report_progress, total))
    return Manifest(
        kind=selection.kind,
        names=(selection.name,) if selection.name else tuple(each.id for each in selection.episodes),
        file_format=file_format,
        options=({"arguments": dict(selection.arguments)} if selection.arguments else {})
        | ({"no_formulas": True} if no_formulas else {}),
        query=_sql(plain, log.engine.dialect),
        columns={each.name: str(each.type) for each in schema},
        rows=rows,
        versions=versions_of("pyarrow"),
        tables=PROJECTION_VERSION,
        memory=log.log_id,
        episodes=selection.episodes,
        files={},
    )


def _complete(manifest: Manifest, files: dict[str, str], path: Path) -> Manifest:
    """Write the manifest with the files, before they get their names, so that a full disk leaves neither."""
    whole = msgspec.structs.replace(manifest, files=files)
    path.write_bytes(msgspec.json.format(msgspec.json.encode(whole), indent=1) + b"\n")
    return whole


def _options(file_format: FileFormat, clock: Clock | None, fps: int | None, images: ImageSize | None) -> EpisodeOptions:
    """Return the options of formats with a clock. Raises `CallerError` for an option that the format does not have."""
    if file_format not in ("lerobot", "mcap") and (clock, fps) != (None, None):
        raise CallerError("clock and fps are options of the formats lerobot and mcap")
    if file_format == "mcap" and clock != "event" and fps is not None:
        raise CallerError("fps of mcap is for events at equal intervals: choose the clock `event`, or leave fps out")
    if file_format != "lerobot" and images is not None:
        raise CallerError("images are an option of the format lerobot")
    options = EpisodeOptions(
        clock or ("time" if file_format == "mcap" else "event"), DEFAULT_FPS if fps is None else fps, images
    )
    options.check()
    return options


async def _episodes(
    reading: Reading, what: Exportable, limited: Sequence[str | int], file_format: str, *, running: bool = False
) -> tuple[CoveredEpisode, ...]:
    """Return the episodes that `what` names. Raises `CallerError` for anything else."""
    if limited or isinstance(what, type | Select | Question):
        raise CallerError(f"the format {file_format} holds whole episodes: name them by number, id or `last`")
    selection = await select_rows(reading, what, running=running)
    if selection.kind != "episodes":
        raise CallerError(f"the format {file_format} holds whole episodes, and {selection.name} is a {selection.kind}")
    return selection.episodes


async def _described(
    reading: Reading, covered: tuple[CoveredEpisode, ...], file_format: FileFormat, options: EpisodeOptions, rows: int
) -> Manifest:
    log = await reading.log()
    packages = {"lerobot": ("pyarrow",), "mcap": ("mcap", "foxglove-sdk"), "rrd": ("rerun-sdk",)}
    return Manifest(
        kind="episodes",
        names=tuple(each.id for each in covered),
        file_format=file_format,
        options=options._asdict() if file_format != "rrd" else {},
        rows=rows,
        versions=versions_of(*packages[file_format]),
        tables=PROJECTION_VERSION,
        memory=log.log_id,
        episodes=covered,
        files={},
    )


def _reporting(report_progress: ProgressCallback | None, total: int) -> Callable[[int], object]:
    return lambda rows: report_progress(rows, total) if report_progress is not None else None


def _sql(statement: Select[*tuple[Any, ...]], dialect: Any) -> str:
    """Return the SQL, with the parameters as literals if they have a literal form."""
    try:
        return str(statement.compile(dialect=dialect, compile_kwargs={"literal_binds": True}))
    except (CompileError, NotImplementedError):
        return str(statement.compile(dialect=dialect))


# === episode files ============================================================================================
#
# Write episodes as LeRobot, rerun or MCAP: formats for motion over time, so they are made from events, not tables.
#
# A thread does each long step, and a cancelled task waits for its end: a writer that is closed, or a file that is
# deleted, while a thread still writes would crash the process or leave a file.


class EpisodeOptions(NamedTuple):
    """Choices for the frames of LeRobot and the messages of MCAP; see `export` for the meaning of each clock.

    Attributes:
        clock: the axis: the events one after the other, or their times.
        fps: frames or events per second.
        images: width and height of LeRobot's pictures; None for no pictures.
    """

    clock: Clock
    fps: int = DEFAULT_FPS
    images: ImageSize | None = None

    def check(self) -> None:
        """Raise `CallerError` for an unknown clock, and for a rate or an image size out of range."""
        if self.clock not in ("event", "time"):
            raise CallerError(f"clock must be 'event' or 'time', got {self.clock!r}")
        if self.images is not None:
            check_size(self.images)
        if not 1 <= self.fps <= 1000:
            raise CallerError(f"fps must be 1 to 1000, got {self.fps}")


async def write_lerobot(
    reading: Reading,
    episodes: Sequence[CoveredEpisode],
    folder: Path,
    options: EpisodeOptions,
    report_progress: ProgressCallback | None,
    unreadable: dict[int, str],
) -> int:
    """Write the episodes into an empty folder; return the number of frames.

    An episode that cannot be read is left out, with its reason in `unreadable`, unless it is the only one. Raises
    `CallerError` for episodes that the format cannot hold, and `MissingExtra`.
    """
    progress = _Progress(report_progress, sum(each.events for each in episodes))
    dataset = LeRobotFolder(folder, fps=options.fps)
    for each in episodes:
        try:
            episode = await read_episode(reading, each, progress.of("reading"))
        except (LogDamaged, DatabaseForeign) as error:
            unreadable[each.number] = str(error)
            if len(unreadable) == len(episodes):
                raise
            continue
        frames = await run_to_completion(asyncio.to_thread(frames_of, episode, options.clock, options.fps))
        pictures = None
        if options.images is not None:
            pictures = np.stack(await draw_frames(reading, episode, frames, options.images, progress.of("drawing")))
        await run_to_completion(asyncio.to_thread(dataset.add, episode, frames, pictures))
        progress.of("writing")(each.events)
        progress.before += each.events
    await run_to_completion(asyncio.to_thread(dataset.finish))
    return dataset.frames


async def write_scene(
    reading: Reading,
    episodes: Sequence[CoveredEpisode],
    path: Path,
    file_format: Literal["rrd", "mcap"],
    options: EpisodeOptions,
    report_progress: ProgressCallback | None,
) -> int:
    """Write one episode to a file; return the number of changes (`rrd`) or messages (`mcap`) in it.

    Only MCAP uses the options. Raises as `write_lerobot` does.
    """
    if len(episodes) != 1:
        raise CallerError(f"a file of the format {file_format} holds one episode, got {len(episodes)}: name one")
    progress = _Progress(report_progress, episodes[0].events)
    episode = await read_episode(reading, episodes[0], progress.of("reading"))
    objects = await scene_objects(reading, episode)
    report = progress.of("writing")
    if file_format == "rrd":
        written = await run_to_completion(asyncio.to_thread(write_rerun, episode, objects, path, report))
    else:
        clock, fps = options.clock, options.fps
        written = await run_to_completion(
            asyncio.to_thread(lambda: write_mcap(episode, objects, path, report, clock=clock, fps=fps))
        )
    report(episodes[0].events)
    return written


class _Progress:
    """Reports how many events of all episodes a phase has done; `before` counts those of the earlier episodes."""

    def __init__(self, report_progress: ProgressCallback | None, total: int) -> None:
        self.before = 0
        self._report_progress = report_progress
        self._total = total

    def of(self, phase: str) -> Callable[[int], None]:
        """Return a function that takes the number of done events of the current episode; any thread may call it."""

        def report_events(done: int) -> None:
            if self._report_progress is not None:
                self._report_progress(self.before + done, self._total, phase)

        return report_events


# === row files ================================================================================================
#
# Write the rows of a select as Parquet, CSV or JSON lines, one batch after the other.

RowFormat: TypeAlias = Literal["parquet", "csv", "jsonl"]
_Write: TypeAlias = "Callable[[pa.RecordBatch], object]"


def _guarded(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the rows with no text that a spreadsheet would run as a formula."""
    pa = needed_pyarrow()
    columns = [
        pa.array([None if text is None else without_formula(text) for text in each.to_pylist()], each.type)
        if pa.types.is_string(each.type) or pa.types.is_large_string(each.type)
        else each
        for each in batch.columns
    ]
    return pa.RecordBatch.from_arrays(columns, schema=batch.schema)


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


# === datasette ================================================================================================

_INTERNAL = re.compile(r"zz_.*|.*__\d+|pycrorm_.*|sqlite_stat\d")
"""The tables of a generation, the bookkeeping of the log, and the statistics of SQLite's planner."""
_LOG = {
    "event": "The log: every event with its payload as JSON. All views can be made from it again.",
    "episode": "How far each episode is stored (head) and visible in the views (folded).",
}
"""The tables that no class maps."""
_FACETS = ("dtype", "kind", "status", "reason", "arm", "grasp", "obj_type", "robot", "relation", "source", "recovered")
_FACETS_MAX = 4
"""Datasette counts the values of each facet at every visit."""
_NEWEST = ("id", "node_id", "process_metadata_id", "global_position", "number")
"""Columns by which the newest rows come first, the first that a table has."""
_TIMES = " Times are integers, in µs since 1970-01-01 00:00 UTC, and durations are in s."
_TEXT, _NUMBER = "pycrorm-value-", 200_000_000
"""Placeholders (a text, numbers in m) in a question's SQL that become Datasette parameters."""


async def datasette_metadata(reading: Reading) -> dict[str, Any]:
    """Return the metadata of a SQLite memory, for Datasette 0.65.

    Raises `CallerError` for another database, which Datasette cannot open.
    """
    log = await reading.log()
    if not log.address.is_sqlite:
        raise CallerError(
            f"Datasette opens SQLite files: copy {log.address} with `pycrorm copy --to sqlite:///copy.db`"
        )
    async with log.reading() as connection:
        tables = await connection.run_sync(_columns_by_table)
    views = described()
    return {
        "title": "Episodic memory of robots",
        "description": "The views of a memory of pycrorm-async, and the questions of `pycrorm ask`." + _TIMES,
        "databases": {
            log.address.path.stem: {
                "tables": {
                    name: {"hidden": True} if columns is None else _table(name, columns, views.get(name))
                    for name, columns in tables.items()
                },
                "queries": {name: _query(reading, name) for name in QUESTIONS},
            }
        },
    }


def _columns_by_table(connection: Any) -> dict[str, list[str] | None]:
    """Return the columns of each table and view; None for one to hide.

    Views with bytes are hidden too: Datasette 0.65 answers their pages with an error, because it links a value of bytes
    by its row's key, which no view has.
    """
    inspector = inspect_database(connection)
    tables, views = inspector.get_table_names(sqlite_include_internal=True), inspector.get_view_names()
    columns: dict[str, list[str] | None] = {}
    for name in sorted([*tables, *views]):
        described = inspector.get_columns(name)
        has_bytes = name in views and any(isinstance(each["type"], LargeBinary) for each in described)
        is_hidden = has_bytes or _INTERNAL.fullmatch(name) is not None
        columns[name] = None if is_hidden else [each["name"] for each in described]
    return columns


def _table(name: str, columns: list[str], view: ViewDescription | None) -> dict[str, Any]:
    table: dict[str, Any] = {"description": _LOG[name]} if name in _LOG else {}
    if view is not None:
        table["description"] = view.text
        table["columns"] = {name: text for name, text in view.columns.items() if name in columns}
    newest = next((each for each in _NEWEST if each in columns), None)
    if newest is not None:
        table["sort_desc"] = newest
    facets = [each for each in _FACETS if each in columns][:_FACETS_MAX]
    if facets:
        table["facets"] = facets
    return table


def _query(reading: Reading, name: str) -> dict[str, str]:
    """Return a question as a canned query of Datasette; its required arguments are parameters of the query."""
    needed = {each.name: each.type for each in arguments_of(name).values() if each.is_required}
    numbers = {each: _NUMBER * (index + 1) for index, each in enumerate(needed) if needed[each] is float}
    texts = {each: f"{_TEXT}{each}" for each in needed if each not in numbers}
    sql = getattr(reading.ask, name)(**numbers, **texts).sql
    for each, text in texts.items():
        sql = sql.replace(f"'{text}'", f":{each}")

    def with_parameter(number: re.Match[str]) -> str:
        for each, place in numbers.items():
            if abs(float(number[0]) - place) < _NUMBER / 2:
                return f"(:{each} + {float(number[0]) - place:g})"  # Datasette passes texts: the sum is a number
        return number[0]

    sql = re.sub(r"\b\d{9,}(?:\.\d+)?\b", with_parameter, sql)
    return {"sql": sql, "title": name.replace("_", " "), "description": _first_sentence(getattr(Ask, name))}


def _first_sentence(documented: Any) -> str:
    return " ".join((inspect.getdoc(documented) or "").partition("\n\n")[0].split())
