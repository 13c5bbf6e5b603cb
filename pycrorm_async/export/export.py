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

import inspect
import re
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import msgspec
from sqlalchemy import LargeBinary, Select
from sqlalchemy import inspect as inspect_database

from pycrorm_async.errors import CallerError
from pycrorm_async.export import selection as selections
from pycrorm_async.export.formats import CSV, GROUP, JSONL, PARQUET, Format, Job, Written, format_names, offered_format
from pycrorm_async.export.lerobot import LEROBOT
from pycrorm_async.export.lerobot_images import ExportedImages, check_size
from pycrorm_async.export.neem import NEEM
from pycrorm_async.export.rerun_recording import RERUN
from pycrorm_async.export.scenes import MCAP, Clock
from pycrorm_async.export.traces import OTLP, TRACE
from pycrorm_async.orm.documentation import ViewDescription, described
from pycrorm_async.projections.generations import PROJECTION_VERSION
from pycrorm_async.query.question import Question, SyncQuestion
from pycrorm_async.query.questions import QUESTIONS, Ask, arguments_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.output_files import new_file, new_folder, refuse_existing

if TYPE_CHECKING:
    from pycrorm_async.progress_bar import ProgressCallback


FileFormat: TypeAlias = str
"""The name of a format: `parquet`, `csv` or `jsonl` for rows, `lerobot`, `rrd`, `mcap`, `trace`, `otlp` or `neem` for
episodes, or one of an installed package."""

FORMATS: Final = {
    "parquet": PARQUET,
    "csv": CSV,
    "jsonl": JSONL,
    "lerobot": LEROBOT,
    "rrd": RERUN,
    "mcap": MCAP,
    "trace": TRACE,
    "otlp": OTLP,
    "neem": NEEM,
}
"""The built-in formats by name."""

_OPTIONS = {
    "clock": "clock and fps are options",
    "fps": "clock and fps are options",
    "images": "images are an option",
    "no_formulas": "no_formulas is an option",
}


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
            memory; empty if there is none.
    """

    path: Path
    rows: int
    episodes: int
    left_out: int
    manifest: selections.Manifest
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
    suffix, names = path.suffix.removeprefix(".").lower(), format_names(GROUP, FORMATS)
    if suffix not in names or format_named(suffix).marker:
        listed = ", ".join(names)
        raise CallerError(f"the suffix of {path} names no format: add --format (file_format=), one of {listed}")
    return suffix


def format_named(name: str) -> Format:
    """Return the format of this name. Raises `CallerError`."""
    named: Format = FORMATS.get(name) or offered_format(GROUP, FORMATS, name)
    return named


async def export(
    reading: Reading,
    what: selections.Exportable,
    path: str | PathLike[str],
    *,
    file_format: FileFormat | None = None,
    episodes: Sequence[str | int] = (),
    arguments: Mapping[str, Any] = MappingProxyType({}),
    force: bool = False,
    clock: Clock | None = None,
    fps: int | None = None,
    images: ExportedImages | None = None,
    no_formulas: bool = False,
    report_progress: ProgressCallback | None = None,
) -> Exported:
    """Write rows or episodes to a file that gets its name when it is complete, and its manifest beside it.

    Args:
        what: an episode or several (a row for each node), by number, id or `last`; a view by name, or a mapped
            class, of all episodes that have ended; a question of `memory.ask` or its name; or a select.
        path: of the file.
        file_format: `parquet`, `csv` or `jsonl` for rows; `lerobot` for episodes, into a folder, and `otlp`; `rrd`,
            `mcap` or `trace` for one episode, which may be running; one that an installed package offers
            (`export.formats`); by default that of the suffix.
        episodes: limit a view, or a question about all, to these.
        arguments: of a question that is named.
        force: replace the file if it exists; a folder only if it is such a data set.
        clock, fps: of LeRobot: a frame for each event that changed the robot's state (`event`, the default), or `fps`
            frames each second (`time`). Of MCAP: the times of the events (`time`, the default), or `fps` events in
            each second (`event`).
        images: of LeRobot: width and height of a drawing of the scene at each frame, which needs the extra `world`,
            beside the observed images; or `none` without any.
        no_formulas: of CSV: an apostrophe before each text that a spreadsheet would run as a formula.
        report_progress: gets the number of rows, done and of all; of the formats of episodes that of events, with the
            phase, `reading`, `drawing` or `writing`, also from another thread.

    Raises `CallerError` if the file or its manifest exists, if nothing has this name, or for a running episode;
    `UnknownEpisode`; `MissingExtra`; `OSError` if the disk is full, and then leaves no file.
    """
    target = Path(path)
    _refuse_other_encodings(target)
    refuse_existing(target, force=force, folder=True)
    refuse_existing(selections.manifest_path(target), force=force)
    name = file_format or format_of(target)
    chosen = format_named(name)
    beside = target.with_name(f"{target.name}.{chosen.beside}") if chosen.beside else None
    if beside is not None:
        refuse_existing(beside, force=force)
    options = _options(name, chosen, {"clock": clock, "fps": fps, "images": images, "no_formulas": no_formulas})
    is_of_rows, whole = chosen.holds == "rows", f"the format {name} holds whole episodes"
    if not is_of_rows and (episodes or isinstance(what, type | Select | Question | SyncQuestion)):
        raise CallerError(f"{whole}: name them by number, id or `last`")
    further = new_file(beside, force=force) if beside is not None else nullcontext()
    with new_file(selections.manifest_path(target), force=force) as description, further as unnamed_beside:
        selection = await selections.select_rows(
            reading, what, episodes, arguments=arguments, running=chosen.holds == "episode"
        )
        if not is_of_rows and selection.kind != "episodes":
            raise CallerError(f"{whole}, and {selection.name} is a {selection.kind}")
        if chosen.holds == "episode" and len(selection.episodes) != 1:
            count = len(selection.episodes)
            raise CallerError(f"a file of the format {name} holds one episode, got {count}: name one")
        job = Job(reading, name, selection, options, report_progress)
        folder = new_folder(target, force=force, marker=chosen.marker) if chosen.marker else None
        with folder or new_file(target, force=force) as unnamed:
            written = await chosen.write(job, unnamed)
            if unnamed_beside is not None:
                unnamed_beside.write_text(written.beside)
            log = await reading.log()
            manifest = _manifest(job, chosen, written, log.log_id, selections.checksums(unnamed, target.name))
            # Before the files get their names, so that a full disk leaves neither.
            description.write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")
        unknown_name = ""
        if selection.question is not None and not manifest.rows:
            unknown_name = await selection.question.unknown_name()
    counts = manifest.rows, len(manifest.episodes), selection.left_out
    return Exported(target, *counts, manifest, unknown_name, written.unreadable)


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
    before = selections.read_manifest(Path(manifest))
    log = await reading.log()
    everything = {each.number: "" for each in await log.episodes()}
    present = {each.id: each for each in await selections.covered_episodes(reading, everything)}
    differences = selections.episode_differences(before.episodes, present)
    if any(each.id not in present for each in before.episodes):
        return ExportComparison(same=False, differences=tuple(differences), exported=None)
    what, episodes = _named_by(before, statement)
    with tempfile.TemporaryDirectory(prefix="pycrorm-export-") as folder:
        target = Path(path) if path is not None else Path(folder, "export")
        options: dict[str, Any] = dict(before.options)
        if before.file_format == "mcap" and options["clock"] == "time":
            options["fps"] = None  # its manifest has the default, which `export` refuses beside this clock
        exported = await export(
            reading,
            what,
            target,
            file_format=before.file_format,
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
    by_bytes = format_named(before.file_format).same_bytes
    same = [*before.files.values()] == [*now.files.values()] if by_bytes else not differences
    return ExportComparison(same, tuple(differences), exported if path is not None else None, by_bytes)


def _refuse_other_encodings(path: Path) -> None:
    """Raise `CallerError` for a name that is not UTF-8, which neither a manifest nor Arrow can hold."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise CallerError(f"the name {str(path)!r} is not UTF-8: give another name") from None


def _named_by(
    manifest: selections.Manifest, statement: Question | Select[*tuple[Any, ...]] | None
) -> tuple[selections.Exportable, tuple[str, ...]]:
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


def _manifest(job: Job, format_: Format, written: Written, memory: str, files: dict[str, str]) -> selections.Manifest:
    selection = job.selection
    episodes = tuple(each for each in selection.episodes if each.number not in written.unreadable)
    arguments = {"arguments": dict(selection.arguments)} if selection.arguments else {}
    return selections.Manifest(
        kind=selection.kind,
        names=(selection.name,) if selection.name else tuple(each.id for each in episodes),
        file_format=job.file_format,
        options=arguments | {name: value for name, value in job.options.items() if value is not False},
        query=written.query,
        columns=dict(written.columns),
        rows=written.rows,
        versions=selections.versions_of(*format_.packages),
        tables=PROJECTION_VERSION,
        memory=memory,
        episodes=episodes,
        files=files,
    )


def _options(name: str, format_: Format, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a format. Raises `CallerError` for one that it does not have, and for a wrong value."""
    given = {option: value for option, value in values.items() if value is not None and value is not False}
    for option in [each for each in given if each not in format_.options]:
        having = [other for other, each in FORMATS.items() if option in each.options]
        raise CallerError(f"{_OPTIONS[option]} of the format{'s' * (len(having) > 1)} {' and '.join(having)}")
    if name == "mcap" and given.get("clock") != "event" and "fps" in given:
        raise CallerError("fps of mcap is for events at equal intervals: choose the clock `event`, or leave fps out")
    if given.get("clock") not in (None, "event", "time"):
        raise CallerError(f"clock must be 'event' or 'time', got {given['clock']!r}")
    if given.get("images", "none") != "none":
        check_size(given["images"])
    if not 1 <= given.get("fps", 1) <= 1000:
        raise CallerError(f"fps must be 1 to 1000, got {given['fps']}")
    return {**format_.options, **given}


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
