"""`pycrorm spool`: `inspect` its files, `repair` damaged ones, `rebind` it to another database."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli.options import (
    DEFAULT_URL,
    FileAccessOption,
    JsonOption,
    ProjectionOption,
    SpoolOption,
    UrlOption,
)
from pycrorm_async.cli.output import moment, note, print_facts, print_json, print_table, problem, stdout
from pycrorm_async.cli.writer import store_once
from pycrorm_async.errors import PycrormError
from pycrorm_async.operations import recovery
from pycrorm_async.operations.recovery import Rebinding
from pycrorm_async.projections.custom.discovery import named
from pycrorm_async.queue.files.names import REFUSED
from pycrorm_async.queue.files.recorder_folder import folder_error
from pycrorm_async.queue.maintenance.inspection import Damage, RecorderReport, SpoolReport, inspect_spool
from pycrorm_async.queue.maintenance.repair import RepairReport, finish_repairs, repair_folder
from pycrorm_async.queue.maintenance.salvage import Range
from pycrorm_async.settings import Settings

__all__ = ["inspect", "repair", "rebind"]

FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The spool: `memory.db.spool` beside `memory.db`.")]


def inspect(folder: FolderArgument, as_json: JsonOption = False) -> int:
    """Say what is in a spool, from its files alone. Changes nothing.

    Exit code 4 if something in it is damaged, 3 if something cannot be read, 1 if something in it is not ours.
    """
    report = inspect_spool(folder)
    if as_json:
        print_json(_document(report))
    else:
        _print(report)
    for each in report.recorders:
        if each.damage is not None:
            what = "stop its process first" if each.alive else f"mend it with: pycrorm spool repair {folder}"
            problem(f"{_told(each.damage)}; {what}")
        if each.refused is not None:
            problem(each.refused)
    for name in report.strangers:
        problem(f"{folder / name} is not ours; it is left alone")
    if any(each.damage for each in report.recorders):
        return 4
    if any(each.refused for each in report.recorders):
        return 3
    return 1 if report.strangers or any(each.foreign for each in report.recorders) else 0


def repair(folder: FolderArgument, as_json: JsonOption = False) -> int:
    """Mend damaged folders of dead recorders, so that all that is whole in them can be stored.

    A damaged folder is put aside as it is, and told. Exit code 1 if records were given up, 3 if a damaged folder
    cannot be mended.
    """
    inspect_spool(folder)
    finished = finish_repairs(folder)
    mended: list[RepairReport] = []
    refused: dict[str, PycrormError] = {}
    for each in inspect_spool(folder).recorders:
        if each.damage is None and each.refused is None:
            continue
        try:
            report = repair_folder(Path(each.path))
        except Exception as fault:  # noqa: BLE001 - reported of this folder; the next may be repaired
            refused[each.name] = folder_error(Path(each.path), fault)
        else:
            mended += [report] if report is not None else []
    if as_json:
        print_json(_repaired(finished, mended, refused))
    else:
        for path in finished:
            _line(f"{path.name}: a repair that was interrupted is finished")
        for report in mended:
            _print_repair(report)
        if not (finished or mended or refused):
            _line("nothing is damaged")
    for error in refused.values():
        problem(str(error))
    if mended and not as_json:
        note(f"Store what was kept with: pycrorm writer --once --url DATABASE --spool {folder}")
    if refused:
        return 3
    return 0 if all(each.complete for each in mended) else 1


def rebind(
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    projection: ProjectionOption = None,
    file_access: FileAccessOption = "owner",
    as_json: JsonOption = False,
) -> int:
    """Store what a spool holds in the database that is at the URL now, when its own was deleted or replaced.

    A database that does not exist is made. Nothing is deleted before it is stored. An episode whose beginning was in
    the deleted database alone cannot be stored: its events stay in the spool as dead letters, and the exit code is 1.
    Refused with exit code 3 while a process records into the spool or drains it. Other exit codes as of `pycrorm writer
    --once`.
    """
    projections, settings = named(projection or ()), Settings(file_access=file_access)
    done = asyncio.run(recovery.rebind(url, spool=spool, settings=settings, say=_say_rebinding))
    beside = {"spool": str(done.spool), "log_before": done.before, "log": done.after, "events_found": done.events}
    return store_once(url, spool, projections, settings, as_json=as_json, beside=beside)


def _say_rebinding(planned: Rebinding) -> None:
    before = f"log {planned.before}" if planned.before else "no log yet"
    holds = f"{planned.events} events of {planned.recorders} recorder{'' if planned.recorders == 1 else 's'}"
    note(f"{planned.spool} belongs to {before}; from now on to log {planned.after}, which gets its {holds}.")


def _print(report: SpoolReport) -> None:
    print_facts(
        f"Spool {report.path}",
        {
            "log": report.log_id or "none yet: nothing was ever drained from it",
            "recorders": str(len(report.recorders)),
            "aside": ", ".join(report.set_aside),
            "half made or removed": ", ".join(report.unfinished),
        },
    )
    if report.recorders:
        print_table(
            "Recorders",
            ("recorder", "state", "files", "first", "last", "safe to", "records", "episodes", "open", "torn bytes"),
            [
                (
                    each.name,
                    _state(each),
                    len(each.segments),
                    each.first,
                    each.last,
                    each.safe,
                    each.records,
                    each.episodes,
                    len(each.open),
                    each.tail_bytes,
                )
                for each in report.recorders
            ],
        )
    for each in report.recorders:
        _print_recorder(each)


def _print_recorder(each: RecorderReport) -> None:
    print_facts(
        each.name,
        {
            "types": ", ".join(f"{name} {count}" for name, count in each.types.items()),
            "files": ", ".join(f"{one.file} from {one.base}" for one in each.segments if one.base is not None),
            "cut off": ", ".join(each.cut_off),
            "foreign": ", ".join(each.foreign),
        },
    )
    for one in each.open:
        _line(f"  open: episode {one.id}, {one.sequence} events, the last {_time(one.wall_ns)}")


def _print_repair(report: RepairReport) -> None:
    _line(
        f"{report.name}: mended; {report.kept} records before the damage are kept,"
        f" {report.saved} from behind it are saved"
    )
    _line(f"  as it was: {report.set_aside}")
    _line(f"  damage: {_told(report.damage)}")
    if report.unreadable:
        _line(f"  given up: {_spans('position', report.unreadable)}, which cannot be read any more")
    for each in report.given_up:
        kept = f"kept up to event {each.kept_to}" if each.kept_to else "not kept at all"
        _line(
            f"  given up: {_spans('event', each.sequences)} of episode {each.episode}, which is {kept}: what comes"
            f" between is missing ({_spans('position', each.positions)} in the folder put aside)"
        )
    if report.headless:
        _line("  given up: the end of episodes that were open in the oldest file and wrote nothing after it")


def _state(each: RecorderReport) -> str:
    state = "refused" if each.name.endswith(REFUSED) else "alive" if each.alive else "dead"
    return f"{state}, drained now" if each.being_drained else state


def _told(damage: Damage) -> str:
    return f"{damage.file} is damaged at byte {damage.offset}: {damage.reason}"


def _time(wall_ns: int) -> str:
    try:
        return f"{moment(datetime.fromtimestamp(wall_ns / 1e9, UTC))} UTC"
    except (ValueError, OverflowError, OSError):  # a clock that was never set
        return f"{wall_ns} ns"


def _line(text: str) -> None:
    """A whole line, however long: paths and ids are copied from it."""
    stdout.print(text, markup=False, soft_wrap=True)


def _spans(noun: str, found: Sequence[Range]) -> str:
    """Numbers in words.

    >>> _spans("event", [(5, 5)]), _spans("event", [(5, 7), (9, 9)])
    ('event 5', 'events 5 to 7, 9')
    """
    texts = [str(first) if first == last else f"{first} to {last}" for first, last in found]
    many = len(found) > 1 or found[0][0] != found[0][1]
    return f"{noun}{'s' * many} {', '.join(texts)}"


def _document(report: SpoolReport) -> dict[str, object]:
    recorders = [asdict(each) | {"records": each.records} for each in report.recorders]
    return asdict(report) | {"recorders": recorders}


def _repaired(
    finished: Sequence[Path], mended: Sequence[RepairReport], refused: dict[str, PycrormError]
) -> dict[str, object]:
    return {
        "mended": [asdict(each) | {"complete": each.complete} for each in mended],
        "finished": [path.name for path in finished],
        "refused": {name: str(error) for name, error in refused.items()},
    }
