"""Export rows and episodes of a memory to a file, and make an export again from its manifest.

>>> await export(reading, "PickUpWithContextView", "picks.parquet")
Exported(path=PosixPath('picks.parquet'), rows=1204, episodes=30, left_out=0, manifest=...)
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import aclosing
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, get_args

import msgspec
from sqlalchemy import Select, func, select
from sqlalchemy.exc import CompileError

from pycrorm_async.errors import CallerError
from pycrorm_async.export.episode_files import EpisodeOptions, write_lerobot, write_scene
from pycrorm_async.export.lerobot.dataset import DEFAULT_FPS, MARKER
from pycrorm_async.export.lerobot.images import ImageSize
from pycrorm_async.export.lerobot.states import Clock
from pycrorm_async.export.manifest import (
    Manifest,
    checksums,
    episode_differences,
    manifest_path,
    read_manifest,
    versions_of,
)
from pycrorm_async.export.row_files import RowFormat, write_rows
from pycrorm_async.export.selection import CoveredEpisode, Exportable, Selection, select_rows
from pycrorm_async.projections.schema.generations import PROJECTION_VERSION
from pycrorm_async.query.asking.question import Question
from pycrorm_async.query.frames.columns import columns_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.suggestions import nearest
from pycrorm_async.report.output_files import new_file, new_folder, refuse_existing

if TYPE_CHECKING:
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
        unknown_name: a line about an argument of a question without rows, such as an object, that is nowhere in the
            memory; empty without one.
    """

    path: Path
    rows: int
    episodes: int
    left_out: int
    manifest: Manifest
    unknown_name: str = ""


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
            frames each second (`time`). Of MCAP: the wall time of the events (`time`, the default), or `fps` events in
            each second (`event`).
        images: of LeRobot: width and height of a picture of the scene at each frame, which needs the extra `world`.
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
    options = _options(chosen, clock, fps, images)
    left_out, unknown_name = 0, ""
    with new_file(manifest_path(target), force=force) as described:
        match chosen:
            case "parquet" | "csv" | "jsonl":
                selection = await select_rows(reading, what, episodes, arguments=arguments)
                left_out = selection.left_out
                with new_file(target, force=force) as written:
                    manifest = await _write_rows(reading, selection, written, chosen, report_progress)
                    manifest = _complete(manifest, {target.name: checksums(written)[written.name]}, described)
                if selection.question is not None and not manifest.rows:
                    unknown_name = await selection.question.unknown_name()
            case "lerobot":
                covered = await _episodes(reading, what, episodes, chosen)
                with new_folder(target, force=force, marker=MARKER) as written:
                    frames = await write_lerobot(reading, covered, written, options, report_progress)
                    manifest = await _described(reading, covered, chosen, options, frames)
                    manifest = _complete(manifest, checksums(written), described)
            case "rrd" | "mcap":
                covered = await _episodes(reading, what, episodes, chosen, running=True)
                with new_file(target, force=force) as written:
                    changes = await write_scene(reading, covered, written, chosen, options, report_progress)
                    manifest = await _described(reading, covered, chosen, options, changes)
                    manifest = _complete(manifest, {target.name: checksums(written)[written.name]}, described)
    return Exported(target, manifest.rows, len(manifest.episodes), left_out, manifest, unknown_name)


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
    reading: Reading, selection: Selection, path: Path, file_format: RowFormat, report_progress: ProgressCallback | None
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
        rows, schema = await write_rows(batches, path, file_format, json_columns, _reporting(report_progress, total))
    return Manifest(
        kind=selection.kind,
        names=(selection.name,) if selection.name else tuple(each.id for each in selection.episodes),
        file_format=file_format,
        options={"arguments": dict(selection.arguments)} if selection.arguments else {},
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
