"""`pycrorm status`: who records, who drains, how far the database and its tables are behind, and what is stopped."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec

from pycrorm_async.cli.durability import Durability, durability, print_durability, summarise_kept_segments
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import note, print_json, print_table, problem, stdout
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import DatabaseError
from pycrorm_async.operations.destination import shared_address
from pycrorm_async.operations.fold_workers import DaemonNote, FoldWorkerState
from pycrorm_async.projections.custom.discovery import installed_besides
from pycrorm_async.projections.custom.projection_tables import ProjectionState, states
from pycrorm_async.projections.schema.unmade_types import unmade_types
from pycrorm_async.queue.files.drain_status import Progress
from pycrorm_async.queue.files.locks import is_locked
from pycrorm_async.queue.files.names import DRAIN
from pycrorm_async.queue.files.recorder_folder import folder_error, wrap_os_errors
from pycrorm_async.queue.files.segment import segment_numbers, segment_path
from pycrorm_async.queue.files.spool import RecorderFolder, Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog

__all__ = ["status", "RecorderState", "EpisodeState", "RefusedState"]


@dataclass(frozen=True)
class RecorderState:
    """One recorder of the spool, as its folder shows it.

    Attributes:
        name: of its folder, a UUID that sorts by time.
        alive: whether its process lives.
        drained: by `itself`, by `another` process, or by `nobody`.
        synced, stored, folded: positions; None where its own process drains it, or it is dead.
        bytes_spooled: what its files take; a living one's are allocated ahead.
        away: why the database takes nothing now, as whoever drains it says.
        given_up: why nothing more of it is stored.
        stopped: by id, its episodes that are refused or parked, and why.
        fault: why its folder cannot be read; the other fields say nothing then.
    """

    name: str
    alive: bool
    drained: str
    synced: int | None
    stored: int | None
    folded: int | None
    bytes_spooled: int
    away: str | None
    given_up: str | None
    stopped: Mapping[str, str]
    fault: str | None = None


@dataclass(frozen=True)
class EpisodeState:
    """An episode the tables do not show all of, or that is stopped; `lag_s` is the age of what they show next."""

    number: int
    id: str
    head: int
    folded: int
    lag_events: int
    lag_s: float | None
    refused: str | None
    parked: str | None


@dataclass(frozen=True)
class RefusedState:
    """Events of one episode that the database refused: kept in this folder, and offered to it again by every start."""

    episode: str
    folder: Path
    bytes: int


def status(url: UrlOption = DEFAULT_URL, spool: SpoolOption = None, as_json: JsonOption = False) -> int:
    """Say who records, who drains, and how far database and tables are behind. Reads only.

    Exit code 1 if an episode or a recorder is stopped or a designator type has no tables, 3 if the database or the
    spool is not available.
    """
    address = shared_address(url)
    place = Spool(spool or address.default_spool)
    folders = place.recorders()
    recorders = [_recorder(each) for each in folders if each.refused is None]
    refused = [RefusedState(each.refused, each.path, _bytes(each.path)) for each in folders if each.refused is not None]
    has_daemon = place.has_writer
    workers = _workers(place.writer_note())
    episodes: list[EpisodeState] = []
    projections: list[ProjectionState] = []
    limits_near: list[str] = []
    unmade: dict[str, str] = {}
    kept, known = summarise_kept_segments(place.path), None
    fault: str | None = None
    try:
        episodes, projections, limits_near, unmade, known = asyncio.run(_episodes(address))
    except DatabaseError as error:
        fault = str(error)
    if as_json:
        print_json(
            {
                "url": address.to_type,
                "spool": place.path,
                "daemon": has_daemon,
                "fold_workers": workers,
                "database": fault or "ok",
                "recorders": recorders,
                "episodes": episodes,
                "refused": refused,
                "projections": [each._asdict() for each in projections],
                "warnings": limits_near,
                "unmade": unmade,
                "kept": kept,
                "stored_on": None if known is None else known.stored_on._asdict(),
                "went_back": [] if known is None else [each._asdict() for each in known.went_back],
            }
        )
    else:
        _print(place, recorders, episodes, has_daemon=has_daemon, known=fault is None)
        _print_workers(workers)
        print_durability(kept, known)
        for projection in projections:
            late = f"is {projection.behind} events behind" if projection.behind else "shows all that is stored"
            stdout.print(f"The projection {projection.name}, version {projection.version}, {late}.", markup=False)
        _warn(limits_near)
    if fault is not None:
        problem(fault)
        return 3
    stopped = [each for each in episodes if each.refused or each.parked]
    for episode in stopped:
        problem(f"episode {episode.number} ({episode.id}) is stopped: {episode.refused or episode.parked}")
    for dtype, reason in unmade.items():
        problem(f"{dtype[:80]!r} has no tables: {reason}")
    halted = _halted(projections)
    unreadable = [each for each in recorders if each.fault]
    for recorder in unreadable:
        problem(f"recorder {recorder.name}: {recorder.fault}")
    given_up = [each for each in recorders if each.given_up]
    for recorder in given_up:
        problem(f"nothing more of recorder {recorder.name} is stored: {recorder.given_up}")
    for each in refused:
        problem(f"what the database refused of episode {each.episode} is kept in {each.folder}")
    return 1 if stopped or unmade or halted or given_up or refused or unreadable else 0


def _halted(projections: Sequence[ProjectionState]) -> bool:
    """Whether any of them is not kept up to date, after a line for each reason."""
    for projection in projections:
        if projection.fault is not None:
            problem(projection.fault)
        for number, reason in projection.parked.items():
            problem(f"episode {number} is stopped in the projection {projection.name}: {reason}")
    return any(each.parked or each.fault for each in projections)


def _warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        note(f"warning: {warning}")


def _workers(note: bytes | None) -> Sequence[FoldWorkerState]:
    """The fold workers of the daemon that wrote this; none if a daemon of another version did."""
    try:
        return () if note is None else msgspec.json.decode(note, type=DaemonNote).fold_workers
    except msgspec.DecodeError:
        return ()


def _print_workers(workers: Sequence[FoldWorkerState]) -> None:
    if not workers:
        return
    now_ns = SYSTEM_CLOCK.wall_ns()
    print_table(
        "Fold workers of the daemon",
        ("worker", "state", "for s", "pid", "restarts", "last death", "batches folded"),
        [
            (
                each.number,
                each.state,
                round((now_ns - each.since_wall_ns) / 1e9),
                each.pid,
                each.restarts,
                each.reason,
                each.batches,
            )
            for each in workers
        ],
    )


def _recorder(folder: RecorderFolder) -> RecorderState:
    try:
        return _state(folder)
    except Exception as error:  # noqa: BLE001 - shown with this recorder; the others are looked at
        fault = str(folder_error(folder.path, error))
        return RecorderState(folder.name, folder.alive, "nobody", None, None, None, 0, None, None, {}, fault)


def _state(folder: RecorderFolder) -> RecorderState:
    with wrap_os_errors(folder.path):
        locked = is_locked(folder.path / DRAIN)
        spooled = _bytes(folder.path)
        progress = Progress.open(folder.path, writing=False) if folder.alive else None
        if progress is None:
            drained = "nobody" if not locked else "itself" if folder.alive else "another"
            return RecorderState(folder.name, folder.alive, drained, None, None, None, spooled, None, None, {})
        try:
            recorded, said = progress.recorded(), progress.drained()
        finally:
            progress.close()
    drained, note = ("another" if locked else "nobody"), said.note
    return RecorderState(
        folder.name,
        folder.alive,
        drained,
        recorded.synced,
        said.stored,
        said.folded,
        spooled,
        note.away if locked else None,
        note.given_up if locked else None,
        note.stopped,
    )


def _bytes(folder: Path) -> int:
    with suppress(OSError):  # all of it was stored and deleted since it was listed, or `_state` says why not
        return sum(_size(segment_path(folder, number)) for number in segment_numbers(folder))
    return 0


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


async def _episodes(
    address: DatabaseAddress,
) -> tuple[list[EpisodeState], list[ProjectionState], list[str], dict[str, str], Durability]:
    log = await EventLog.open(address, create=False)
    try:
        found = {each.number: each for each in [*await log.behind(), *await log.stopped()]}
        now_ns = SYSTEM_CLOCK.wall_ns()
        found_states = []
        for row in (found[number] for number in sorted(found)):
            following = await log.events(row.number, after=row.folded, limit=1)
            lag_s = (now_ns - following[0].wall_ns) / 1e9 if following else None
            lag_events = row.head - row.folded
            found_states.append(
                EpisodeState(row.number, row.id, row.head, row.folded, lag_events, lag_s, row.refused, row.parked)
            )
        projections = await states(log, installed_besides(()))
        return found_states, projections, await log.limits_near(), await unmade_types(log), await durability(log)
    finally:
        await log.close()


def _print(
    place: Spool, recorders: list[RecorderState], episodes: list[EpisodeState], *, has_daemon: bool, known: bool
) -> None:
    if recorders:
        print_table(
            f"Recorders below {place.path}",
            ("recorder", "process", "drained by", "synced", "stored", "folded", "bytes", "database"),
            [
                (
                    each.name,
                    "alive" if each.alive else "dead",
                    each.drained,
                    each.synced,
                    each.stored,
                    each.folded,
                    each.bytes_spooled,
                    f"away: {each.away}" if each.away else "",
                )
                for each in recorders
            ],
        )
    else:
        stdout.print(f"Nobody records below {place.path}", markup=False)
    stdout.print("A daemon drains this spool." if has_daemon else "No daemon drains this spool.")
    if episodes:
        print_table(
            "Episodes the tables do not show all of",
            ("episode", "id", "stored", "folded", "behind", "by s", "stopped"),
            [(e.number, e.id, e.head, e.folded, e.lag_events, e.lag_s, e.refused or e.parked) for e in episodes],
        )
    elif known:
        stdout.print("The tables show all that is stored.")
