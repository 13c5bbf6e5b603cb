"""Write episodes, or the rows of a view or a question, to files of other programs.

Panel: Hand over, 1.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from pycrorm_async.cli import output
from pycrorm_async.cli.interruption import interrupt_on_termination
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.export.export import Exported, export_again, format_named, format_of
from pycrorm_async.export.export import export as write_export
from pycrorm_async.export.selection import read_manifest
from pycrorm_async.progress_bar import ProgressCallback, progress_bar, stderr
from pycrorm_async.query.named_queries import EpisodeChoice
from pycrorm_async.query.question import absence_of_episodes
from pycrorm_async.query.questions import QUESTIONS, arguments_of
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import shared_address

T = TypeVar("T")
_READ: Mapping[Any, Callable[[str], Any]] = {
    bool: lambda text: {"true": True, "false": False}[text.lower()],
    int: int,
    float: float,
    datetime: output.parse_since,
}
"""Functions that read the text of an argument, by its type. An argument of another type stays a text."""


def export(
    *,
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="EPISODE...|VIEW|QUESTION",
            help="Episodes by number, id or `last`; or a view or a question of `pycrorm ask` by name.",
        ),
    ] = None,
    file_format: Annotated[
        str | None,
        typer.Option(
            "--format", help="parquet, csv, jsonl, lerobot, rrd, mcap, trace, otlp or neem; default: the suffix."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="PATH", help="The file or folder to write.")] = None,
    episode: Annotated[
        list[str] | None,
        typer.Option("--episode", metavar="EPISODE", help="Of a view or a question: only this episode; repeatable."),
    ] = None,
    status: output.StatusOption = None,
    tag: output.TagOption = None,
    without_tag: Annotated[
        list[str] | None, typer.Option("--without-tag", metavar="TAG", help="No episodes with this tag; repeatable.")
    ] = None,
    arguments: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="NAME=VALUE", help="Of a question: an argument, as in object=milk; repeatable."),
    ] = None,
    again: Annotated[
        Path | None,
        typer.Option(
            "--again",
            metavar="MANIFEST",
            help="Make the export of this manifest again and compare; with --out, also write it there.",
        ),
    ] = None,
    clock: Annotated[
        str | None,
        typer.Option(help="Of lerobot and mcap: the axis, event or time."),
    ] = None,
    fps: Annotated[int | None, typer.Option(help="Of lerobot: frames per second; of mcap by event: events.")] = None,
    images: Annotated[
        str | None,
        typer.Option(metavar="WIDTHxHEIGHT|none", help="Of lerobot: also drawings of the scene; or no images at all."),
    ] = None,
    no_formulas: Annotated[
        bool, typer.Option("--no-formulas", help="Of csv: an apostrophe before each text that a spreadsheet would run.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file and its manifest if they exist.")] = False,
    place: ReadingPlace,
    as_json: output.JsonOption = False,
) -> int:
    """Write episodes, or the rows of a view, to a file, with a manifest from which it can be made again.

    --status, --tag and --without-tag choose among the episodes that have ended, of which a view or a question has the
    rows; without a name each node of them is a row. Exit code 1 if an episode cannot be read and is left out of a
    lerobot data set.
    """
    shared_address(place.url)
    if again is not None and what:
        raise CallerError(f"name {' '.join(what)} or make an export again with --again, not both")
    choice = EpisodeChoice(status, tags=tuple(tag or ()), without_tags=tuple(without_tag or ()))
    if again is None and not what and choice == EpisodeChoice():
        raise CallerError("name what to export, for example `pycrorm export last --out last.parquet`, or --again")
    if again is not None:
        given = file_format, clock, fps
        if given != (None, None, None) or episode or arguments or images or no_formulas or choice != EpisodeChoice():
            raise CallerError("--again takes all but --out and --force from the manifest: leave the other options out")
        return _again(again, out, place, force=force, as_json=as_json)
    if choice != EpisodeChoice() and episode:
        raise CallerError("--episode names episodes, and --status, --tag and --without-tag choose them: leave one out")
    if out is None:
        file_format = file_format or "parquet"
        out = Path(f"{'-'.join(what or ['episodes'])[:100].replace('/', '-')}.{file_format}")
    options: dict[str, Any] = {"file_format": file_format, "clock": clock, "fps": fps, "no_formulas": no_formulas}
    options["images"] = images if images in (None, "none") else output.parse_size("--images", images)
    options["arguments"] = _arguments(what[0], arguments or []) if what else {}

    async def write(reading: Reading, report: ProgressCallback | None) -> Exported:
        chosen = episode or []
        if choice != EpisodeChoice():
            chosen = [str(each.number) for each in await reading.episodes(choice) if each.status != "RUNNING"]
            if not chosen:
                raise CallerError(f"{await absence_of_episodes(reading, choice)}: nothing is exported")
        named, limited = (what, chosen) if what else (chosen, [])
        return await write_export(reading, named, out, episodes=limited, force=force, report_progress=report, **options)

    exported = _shown(place, file_format or format_of(out), write)
    _print(exported, as_json=as_json)
    for number, reason in exported.unreadable.items():
        output.problem(f"episode {number} is not in it: {reason}")
    return 1 if exported.unreadable else 0


def _shown(
    place: ReadingPlace, file_format: str, write: Callable[[Reading, ProgressCallback | None], Awaitable[T]]
) -> T:
    """Return the result of an export, which SIGTERM interrupts and whose progress is shown on a terminal."""
    interrupt_on_termination()
    unit = "rows" if format_named(file_format).holds == "rows" else "events"
    with progress_bar("exporting", unit=unit) as report_progress:
        return place.read(lambda reading: write(reading, report_progress if stderr.is_terminal else None))


def _arguments(question: str, pairs: list[str]) -> dict[str, Any]:
    """Return the arguments of a question by name, as the types that it declares."""
    arguments: dict[str, Any] = {}
    valid = arguments_of(question) if question in QUESTIONS else {}
    for each in pairs:
        name, separator, text = each.partition("=")
        if not separator:
            raise CallerError(f"--with must be NAME=VALUE, as in object=milk, got {each!r}")
        if name in arguments:
            raise CallerError(f"{name} of {question} is given twice: give one value")
        type_ = valid[name].type if name in valid else str
        try:
            arguments[name] = _READ.get(type_, str)(text)
        except (KeyError, ValueError):
            raise CallerError(f"{name} of {question} must be of the type {type_.__name__}, got {text!r}") from None
    return arguments


def _again(manifest: Path, out: Path | None, place: ReadingPlace, *, force: bool, as_json: bool) -> int:
    comparison = _shown(
        place,
        read_manifest(manifest).file_format,
        lambda reading, report: export_again(reading, manifest, out, force=force, report_progress=report),
    )
    if as_json:
        file = comparison.exported and out
        outcome = {"same": comparison.same, "by_bytes": comparison.by_bytes, "differences": comparison.differences}
        output.print_json({**outcome, "file": file})
    else:
        same = "the same bytes" if comparison.by_bytes else "the same episode and changes; rerun gives random ids"
        output.print_line(same if comparison.same else "not the same")
        for each in comparison.differences:
            output.print_line(f"  {each}")
    return 0 if comparison.same else 1


def _print(exported: Exported, *, as_json: bool) -> None:
    manifest = exported.manifest
    if as_json:
        counts: dict[str, Any] = {"rows": exported.rows, "episodes": exported.episodes, "left_out": exported.left_out}
        counts |= {"unreadable": exported.unreadable} if exported.unreadable else {}
        output.print_json({"file": exported.path, "format": manifest.file_format, **counts, "files": manifest.files})
        return
    output.print_line(exported.path)
    noun = format_named(manifest.file_format).noun
    content = f"{output.counted(exported.rows, noun)} of {output.counted(exported.episodes, 'episode')}"
    output.note(f"It has {content}; {exported.path}.manifest.json describes it.")
    if exported.unknown_name:
        output.note(f"no row answers; {exported.unknown_name}")
    if exported.left_out:
        output.note(f"{exported.left_out} episodes are left out, because they run or are not in the tables yet.")
