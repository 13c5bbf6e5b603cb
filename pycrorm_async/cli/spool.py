"""The write-ahead queue's files: inspect, repair, or store them in another database.

Panel: Operate, 6.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli import output
from pycrorm_async.cli.reading import Place
from pycrorm_async.cli.writer import store_once
from pycrorm_async.clock import utc_of
from pycrorm_async.errors import PycrormError
from pycrorm_async.operations import recovery
from pycrorm_async.operations.recovery import Rebinding
from pycrorm_async.projections.custom import load_projections
from pycrorm_async.queue import maintenance
from pycrorm_async.queue.locks import REFUSED
from pycrorm_async.queue.spool import folder_error
from pycrorm_async.settings import Settings

FolderArgument = Annotated[
    Path | None, typer.Argument(metavar="DIR", help="Folder of the spool; default: --spool, or the spool of --url.")
]


def inspect(*, folder: FolderArgument = None, place: Place, as_json: output.JsonOption = False) -> int:
    """List the contents of a spool, reading only its files. Changes nothing.

    Exit code 4 if a file is damaged, 3 if a folder cannot be read, 1 if the spool contains files of other programs.
    """
    spool = _spool_folder(folder, place)
    report = maintenance.inspect_spool(spool)
    if as_json:
        output.print_json(_document(report))
    else:
        _print(report)
    for each in report.recorders:
        if each.damage is not None:
            remedy = "stop its process first" if each.alive else f"repair it with: pycrorm spool repair {spool}"
            output.problem(f"{_damage_text(each.damage)}; {remedy}")
        if each.refused is not None:
            output.problem(each.refused)
    for name in report.strangers:
        output.problem(f"{spool / name} does not belong to a spool and is ignored")
    if any(each.damage for each in report.recorders):
        return 4
    if any(each.refused for each in report.recorders):
        return 3
    return 1 if report.strangers or any(each.foreign for each in report.recorders) else 0


def repair(*, folder: FolderArgument = None, place: Place, as_json: output.JsonOption = False) -> int:
    """Repair damaged folders of dead recorders, so that the records that are kept can be stored.

    Does not keep unreadable records, nor later ones of the same episode. Prints the folder that has the originals. Exit
    code 1 if a record is not kept, 3 if a damaged folder cannot be repaired.
    """
    spool = _spool_folder(folder, place)
    maintenance.inspect_spool(spool)
    finished = maintenance.finish_repairs(spool)
    repaired: list[maintenance.RepairReport] = []
    refused: dict[str, PycrormError] = {}
    for each in maintenance.inspect_spool(spool).recorders:
        if each.damage is None and each.refused is None:
            continue
        try:
            report = maintenance.repair_folder(Path(each.path))
        except Exception as fault:  # noqa: BLE001 - reported for this folder; the others can still be repaired
            refused[each.name] = folder_error(Path(each.path), fault)
        else:
            repaired += [report] if report is not None else []
    if as_json:
        output.print_json(_repair_document(finished, repaired, refused))
    else:
        for path in finished:
            output.print_line(f"{path.name}: completed an interrupted repair")
        for report in repaired:
            _print_repair(report)
        if not (finished or repaired or refused):
            output.print_line("nothing is damaged")
    for error in refused.values():
        output.problem(str(error))
    if repaired and not as_json:
        output.note(f"Store the kept records with: pycrorm writer --once --url DATABASE --spool {spool}")
    if refused:
        return 3
    return 0 if all(each.complete for each in repaired) else 1


def _spool_folder(folder: Path | None, place: Place) -> Path:
    return folder or place.spool or place.shared_address.default_spool


def rebind(
    place: Place,
    projection: output.ProjectionOption = None,
    file_access: output.FileAccessOption = "owner",
    as_json: output.JsonOption = False,
) -> int:
    """Bind a spool to the database at the URL, after its own database was deleted or replaced, and store its events.

    Creates the database if it does not exist. Deletes no event before it is stored. An episode whose first events were
    only in the deleted database cannot be stored: its events stay in the spool as dead letters, and the exit code is 1.
    Exit code 3 while a process records into the spool or drains it. Other exit codes are those of `pycrorm writer
    --once`.
    """
    projections, settings = load_projections(projection or ()), Settings(file_access=file_access)
    done = asyncio.run(recovery.rebind(place.url, spool=place.spool, settings=settings, on_rebinding=_print_rebinding))
    extra = {"spool": str(done.spool), "log_before": done.before, "log": done.after, "events_found": done.events}
    return store_once(place, projections, settings, as_json=as_json, extra=extra)


def _print_rebinding(planned: Rebinding) -> None:
    before = f"log {planned.before}" if planned.before else "no log"
    events = f"{planned.events} events of {output.counted(planned.recorders, 'recorder')}"
    output.note(f"binding {planned.spool} to log {planned.after} (before: {before}) and storing its {events} there")


def _print(report: maintenance.SpoolReport) -> None:
    output.print_facts(
        f"Spool {report.path}",
        {
            "log": report.log_id or "none: no writer has drained the spool yet",
            "recorders": str(len(report.recorders)),
            "originals of repaired folders": ", ".join(report.set_aside),
            "incomplete folders": ", ".join(report.unfinished),
        },
    )
    if report.recorders:
        output.print_table(
            "Recorders",
            ("recorder", "state", "files", "first", "last", "synced", "records", "episodes", "open", "torn bytes"),
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


def _print_recorder(each: maintenance.RecorderReport) -> None:
    output.print_facts(
        each.name,
        {
            "types": ", ".join(f"{name} {count}" for name, count in each.types.items()),
            "files": ", ".join(f"{one.file} from {one.base}" for one in each.segments if one.base is not None),
            "copies of torn tails": ", ".join(each.cut_off),
            "foreign": ", ".join(each.foreign),
        },
    )
    for one in each.open:
        output.print_line(f"  open: episode {one.id}, {one.sequence} events, the last at {_time(one.wall_ns)}")


def _print_repair(report: maintenance.RepairReport) -> None:
    output.print_line(
        f"{report.name}: repaired; {report.kept} records before the damage are kept,"
        f" {report.saved} behind it are salvaged"
    )
    output.print_line(f"  original folder: {report.set_aside}")
    output.print_line(f"  damage: {_damage_text(report.damage)}")
    if report.unreadable:
        output.print_line(f"  not kept: {_spans('position', report.unreadable)}, because the bytes cannot be read")
    for each in report.given_up:
        kept = f"kept up to event {each.kept_to}" if each.kept_to else "not kept at all"
        output.print_line(
            f"  not kept: {_spans('event', each.sequences)} of episode {each.episode}, because the events before them"
            f" are missing ({_spans('position', each.positions)} in the original folder); the episode is {kept}"
        )
    if report.headless:
        output.print_line("  not kept: the oldest file's list of open episodes; one without a later record gets no end")


def _state(each: maintenance.RecorderReport) -> str:
    state = "refused" if each.name.endswith(REFUSED) else "alive" if each.alive else "dead"
    return f"{state}, being drained" if each.being_drained else state


def _damage_text(damage: maintenance.FileDamage) -> str:
    return f"{damage.file} is damaged at byte {damage.offset}: {damage.reason}"


def _time(wall_ns: int) -> str:
    try:
        return f"{output.moment(utc_of(wall_ns // 1000))} UTC"
    except OverflowError:  # the recording machine's clock was not set
        return f"{wall_ns} ns"


def _spans(noun: str, ranges: Sequence[maintenance.Range]) -> str:
    """Format ranges of numbers behind their noun.

    >>> _spans("event", [(5, 5)]), _spans("event", [(5, 7), (9, 9)])
    ('event 5', 'events 5 to 7, 9')
    """
    texts = [str(first) if first == last else f"{first} to {last}" for first, last in ranges]
    is_plural = len(ranges) > 1 or ranges[0][0] != ranges[0][1]
    return f"{noun}{'s' * is_plural} {', '.join(texts)}"


def _document(report: maintenance.SpoolReport) -> dict[str, object]:
    recorders = [asdict(each) | {"records": each.records} for each in report.recorders]
    for each in recorders:  # `pycrorm status` shows these
        del each["bytes_spooled"], each["recorded"], each["drained"]
    return asdict(report) | {"recorders": recorders}


def _repair_document(
    finished: Sequence[Path], repaired: Sequence[maintenance.RepairReport], refused: dict[str, PycrormError]
) -> dict[str, object]:
    return {
        "repaired": [asdict(each) | {"complete": each.complete} for each in repaired],
        "finished": [path.name for path in finished],
        "refused": {name: str(error) for name, error in refused.items()},
    }


VERBS = {"inspect": inspect, "repair": repair, "rebind": rebind}
