"""Report recorders, writers, running episodes, and the lag of database and tables.

Panel: Operate, 1.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import msgspec

from pycrorm_async import core
from pycrorm_async.cli.output import JsonOption, counted, moment, note, print_json, print_table, problem, stdout
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.clock import SYSTEM_CLOCK, utc_of
from pycrorm_async.errors import DatabaseError, DatabaseForeign
from pycrorm_async.operations.workers import DaemonNote, FoldWorkerState
from pycrorm_async.projections import generations
from pycrorm_async.projections.custom import installed_projections
from pycrorm_async.projections.custom_tables import ProjectionState, states
from pycrorm_async.projections.generations import failed_views
from pycrorm_async.query.running_episodes import RunningEpisode, running_episodes
from pycrorm_async.queue.maintenance import inspect_recorder
from pycrorm_async.queue.spool import RecorderFolder, Spool, wrap_os_errors
from pycrorm_async.queue.stored_segments import kept_segments
from pycrorm_async.recall.blocks import WORDS_MAX
from pycrorm_async.recall.cases import CaseProjection, read_left_out
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialect import StoredOn
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.placement import PLAIN, Placement
from pycrorm_async.store.replica import SETTLE_S, ReplicaLag, lag_between
from pycrorm_async.store.stored import Incarnation

# === durability ===============================================================================================
#
# Report durability: the machines that hold stored events, and the period whose events could be stored again.
#
# Events are *stored* when the database has committed them. A failover, or the restore of a backup, can lose stored
# events: the log then *went back*, and each time it did is an `Incarnation` of the log. Two sources can store the lost
# events again. A recorder that still runs has its last events in its queue. The segments, which are the queue's files,
# are kept below `spool/stored` for a while after all their events were stored.


@dataclass(frozen=True)
class KeptSegments:
    """Segments kept below `spool/stored` after all their records were stored.

    Attributes:
        segments: number of segments.
        bytes: their size.
        since: events stored after this moment can be stored again from the segments; None if there are no segments.
    """

    segments: int
    bytes: int
    since: datetime | None


def summarise_kept_segments(spool: Path) -> KeptSegments:
    """Summarise the segments kept in a spool after their events were stored. Raises `SpoolUnavailable`."""
    with wrap_os_errors(spool):
        segments = kept_segments(spool)
    return KeptSegments(
        len(segments), sum(each.bytes for each in segments), utc_of(segments[0].stored_ns // 1000) if segments else None
    )


def durability(kept: KeptSegments, state: DatabaseState) -> Iterator[str]:
    """Yield the durability in sentences."""
    if state.stored_on is not None:  # else the database did not answer
        machines, standbys = state.stored_on
        replicas = f" (synchronous standby {', '.join(standbys)})" if standbys else ""
        yield f"A stored event is on {counted(machines, 'machine')}{replicas}."
    if kept.since is None:
        yield "No stored segments are kept; after a data loss, only events of running recorders can be stored again."
    else:
        size = f"{counted(kept.segments, 'segment')}, {kept.bytes / 2**20:,.1f} MiB"
        yield f"After a data loss, events stored since {moment(kept.since)} UTC can be stored again ({size} kept)."
    for each in state.went_back:
        when = f"{moment(utc_of(each.noticed_wall_ns // 1000))} UTC"
        yield f"The database lost stored events, noticed {when} by {each.noticed_by}: {each.reason}"


# === status ===================================================================================================

RUNNING_MAX = 20
"""Bounds the running episodes that are listed: a simulator may have hundreds, and the newest matter most."""
_DRAINED_BY = {"itself": "itself", "another": "another process", "nobody": "no process"}
"""The table's words for the values of `RecorderState.drained`, which are part of the `--json` document."""


@dataclass(frozen=True)
class RecorderState:
    """The state of one recorder, read from its folder in the spool.

    Attributes:
        name: the folder's name, a UUID that sorts by time.
        alive: whether the recorder's process is running.
        drained: the process that drains it: `itself`, `another`, or `nobody`.
        synced, stored, folded: positions; None for a dead recorder and for one that its own process drains.
        bytes_spooled: size of its files; a living recorder allocates them in advance.
        away: reason why the database is unavailable, as the draining process reports it.
        given_up: reason why no further records of it are stored.
        stopped: reasons of its refused and parked episodes, by episode id.
        fault: reason why its folder cannot be read; the other fields are then meaningless.
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
    """An episode that is not completely folded, or that is stopped.

    `lag_s` is the age in seconds of the first event that is not folded yet.
    """

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
    """The folder of dead letters of one episode; each start of a writer offers them to the database again."""

    episode: str
    folder: Path
    bytes: int


@dataclass(frozen=True)
class DatabaseState:
    """The state that the database reports; without arguments that of one that does not answer.

    Attributes:
        episodes: those that are stopped or not completely folded.
        running: the newest running episodes; `running_total` counts all of them.
        warnings: limits that are near, and what the tables or recall leave out.
        unmade, failed_views: the reasons why designator types have no tables and views are left out, by name.
        stored_on: number of machines that hold each stored event, and the names of the synchronous standbys.
        went_back: each time at which the log was noticed to have lost stored events.
        placement: that of the memory's rows.
        replica: how far the replica is behind that `--read-url` names; None if it cannot be read, which is a warning.
    """

    episodes: Sequence[EpisodeState] = ()
    running: Sequence[RunningEpisode] = ()
    running_total: int = 0
    projections: Sequence[ProjectionState] = ()
    warnings: Sequence[str] = ()
    unmade: Mapping[str, str] = field(default_factory=dict)
    failed_views: Mapping[str, str] = field(default_factory=dict)
    stored_on: StoredOn | None = None
    went_back: Sequence[Incarnation] = ()
    are_tables_outdated: bool = False
    placement: Placement = PLAIN
    replica: ReplicaLag | None = None


def status(place: ReadingPlace, as_json: JsonOption = False) -> int:
    """Report recorders, writers, running episodes with their robots, and the lag of database and tables.

    Changes nothing.

    Exit code 1 if an episode or a recorder is stopped or a designator type has no tables or a view is left out, 3
    if the database or the spool is unavailable.
    """
    address = place.place.shared_address
    spool = Spool(place.spool or address.default_spool)
    folders = spool.recorders()
    recorders = [_recorder(each) for each in folders if each.refused is None]
    refused = [
        RefusedState(each.refused, each.path, inspect_recorder(each, scanning=False).bytes_spooled)
        for each in folders
        if each.refused is not None
    ]
    has_daemon = spool.has_writer
    workers = _workers(spool.writer_note())
    kept, state, fault = summarise_kept_segments(spool.path), DatabaseState(), None
    try:
        state = asyncio.run(_query(address, place.replica))
    except DatabaseError as error:
        fault = str(error)
    if as_json:
        print_json(
            {
                "url": address.to_type,
                "spool": spool.path,
                "daemon": has_daemon,
                "fold_workers": workers,
                "database": fault or "ok",
                "recorders": recorders,
                "episodes": state.episodes,
                "refused": refused,
                "projections": [each._asdict() for each in state.projections],
                "warnings": state.warnings,
                "unmade": state.unmade,
                "failed_views": state.failed_views,
                "kept": kept,
                "stored_on": state.stored_on and state.stored_on._asdict(),
                "running": state.running,
                "running_total": state.running_total,
                "went_back": [each._asdict() for each in state.went_back],
                "placement": state.placement.to_print(),
                "replica": state.replica and state.replica._asdict(),
                "core": {"compiled": core.IS_COMPILED, "reason": core.PURE_REASON},
            }
        )
    else:
        is_shown = fault is None and not state.are_tables_outdated
        _print(spool, recorders, state.episodes, has_daemon=has_daemon, is_shown=is_shown)
        _print_running(state.running, state.running_total)
        _print_workers(workers)
        for line in (*durability(kept, state), *_facts(state), core.description()):
            stdout.print(line, markup=False)
        for warning in state.warnings:
            note(f"warning: {warning}")
        if not has_daemon:
            place.place.note_pending_events()
    if fault is not None:
        problem(fault)
        return 3
    problems = [*_problems(state, recorders, refused)]
    for line in problems:
        problem(line)
    return 1 if problems else 0


def _facts(state: DatabaseState) -> Iterator[str]:
    """Yield the placement of the memory, and how far its replica and its projections are behind, in sentences."""
    if state.placement != PLAIN:
        yield f"Placement of the memory: {state.placement}."
    if state.replica is not None:
        yield f"The replica {state.replica}."
    for projection in state.projections:
        lag = f"is {projection.behind} events behind" if projection.behind else "shows all stored events"
        yield f"The projection {projection.name}, version {projection.version}, {lag}."


def _problems(
    state: DatabaseState, recorders: Sequence[RecorderState], refused: Sequence[RefusedState]
) -> Iterator[str]:
    """Yield a line for each stopped episode or recorder, for each type or view left out, and for each refusal."""
    for episode in state.episodes:
        if stop := episode.refused or episode.parked:
            yield f"episode {episode.number} ({episode.id}) is stopped: {stop}"
    for dtype, reason in state.unmade.items():
        yield f"designator type {dtype[:80]!r} has no tables: {reason}"
    for name, reason in state.failed_views.items():
        yield f"the view {name} is left out, because the database refuses it: {reason}"
    for projection in state.projections:
        if projection.fault is not None:
            yield projection.fault
        for number, reason in projection.parked.items():
            yield f"episode {number} is stopped in the projection {projection.name}: {reason}"
    for recorder in recorders:
        if recorder.fault:
            yield f"recorder {recorder.name}: {recorder.fault}"
        if recorder.given_up:
            yield f"further records of recorder {recorder.name} are not stored: {recorder.given_up}"
    for each in refused:
        yield f"the database refused events of episode {each.episode}; they are kept in {each.folder}"


def _workers(note: bytes | None) -> Sequence[FoldWorkerState]:
    """Decode the fold workers from the daemon's note; return none if another version wrote the note."""
    try:
        return () if note is None else msgspec.json.decode(note, type=DaemonNote).fold_workers
    except msgspec.DecodeError:
        return ()


def _print_running(episodes: Sequence[RunningEpisode], total: int) -> None:
    if not episodes:
        return
    print_table(
        "Running episodes" if total == len(episodes) else f"The {len(episodes)} newest of {total} running episodes",
        ("episode", "id", "started", "description", "robots"),
        [(e.number, e.id, moment(e.started_at), e.description, ", ".join(map(str, e.robots))) for e in episodes],
    )


def _print_workers(workers: Sequence[FoldWorkerState]) -> None:
    if not workers:
        return
    now_ns = SYSTEM_CLOCK.wall_ns()
    print_table(
        "Fold workers of the daemon",
        ("worker", "state", "since s", "pid", "restarts", "last exit", "batches folded"),
        [
            (
                each.number,
                each.state,
                max(0, round((now_ns - each.since_wall_ns) / 1e9)),
                each.pid,
                each.restarts,
                each.reason,
                each.batches,
            )
            for each in workers
        ],
    )


def _recorder(folder: RecorderFolder) -> RecorderState:
    report = inspect_recorder(folder, scanning=False)
    drained_by = "another" if report.recorded is not None or not folder.alive else "itself"
    status, locked = report.drained, report.being_drained
    return RecorderState(
        report.name,
        report.alive,
        drained_by if locked else "nobody",
        None if report.recorded is None else report.recorded.synced,
        None if status is None else status.stored,
        None if status is None else status.folded,
        report.bytes_spooled,
        status.note.unavailable if locked and status is not None else None,
        status.note.failure if locked and status is not None else None,
        {} if status is None else status.note.stopped,
        report.refused,
    )


async def _query(address: DatabaseAddress, replica: DatabaseAddress | None) -> DatabaseState:
    async with await EventLog.open(address, create=False) as log:
        rows = {each.number: each for each in [*await log.behind(), *await log.stopped()]}
        now_ns = SYSTEM_CLOCK.wall_ns()
        episode_states = []
        for row in (rows[number] for number in sorted(rows)):
            following = await log.events(row.number, after=row.folded, limit=1)
            # The wall clock of the recorder may be ahead of this one.
            lag_s = max(0.0, (now_ns - following[0].wall_ns) / 1e9) if following else None
            lag_events = row.head - row.folded
            episode_states.append(
                EpisodeState(row.number, row.id, row.head, row.folded, lag_events, lag_s, row.refused, row.parked)
            )
        running, running_total = await _running(log)
        outdated = await _outdated(log)
        lag, unread = await _lag(log, replica)
        return DatabaseState(
            episode_states,
            running,
            running_total,
            await states(log, installed_projections(())),
            [
                *outdated,
                *await log.limits_near(),
                *await _left_out_of_recall(log),
                *await generations.contradictions(log),
                *unread,
            ],
            await generations.unmade_types(log),
            await failed_views(log),
            await log.stored_on(),
            await log.incarnations(),
            bool(outdated),
            await log.placement(),
            lag,
        )


async def _lag(log: EventLog, address: DatabaseAddress | None) -> tuple[ReplicaLag | None, list[str]]:
    """Return how far the replica is behind, and a line if it cannot be read."""
    if address is None:
        return None, []
    try:
        async with await EventLog.open(address, create=False) as replica:
            return await lag_between(replica, log, SETTLE_S), []
    except DatabaseError as fault:
        return None, [f"the replica cannot be read: {fault}"]


async def _outdated(log: EventLog) -> list[str]:
    """Return a line if the tables are those of another version."""
    try:
        async with log.reading() as connection:
            await generations.current_generation(connection)
    except DatabaseForeign as fault:
        heads = [each.head for each in await log.episodes()]
        return [
            f"all {sum(heads):,} events of {len(heads):,} episodes are stored, but queries cannot show them: {fault}"
        ]
    return []


async def _left_out_of_recall(log: EventLog) -> list[str]:
    """Return a line for each feature that recall does not compare."""
    async with log.snapshot() as connection:
        generation = await generations.read_generation(connection, f"{generations.PROJECTION}{CaseProjection.name}")
        if generation is None or generation.version != CaseProjection.version:
            return []
        features = await read_left_out(connection, generation.number)
    return [f"recall does not compare {each}: it has more than {WORDS_MAX:,} different texts" for each in features]


async def _running(log: EventLog) -> tuple[list[RunningEpisode], int]:
    """Query the running episodes; none where this version cannot read the tables."""
    async with log.snapshot() as connection:
        generation = await generations.read_generation(connection, generations.SHOWN)
        if generation is None or generation.version != generations.PROJECTION_VERSION:
            return [], 0
        return await running_episodes(connection, RUNNING_MAX)


def _print(
    spool: Spool,
    recorders: list[RecorderState],
    episodes: Sequence[EpisodeState],
    *,
    has_daemon: bool,
    is_shown: bool,
) -> None:
    if recorders:
        print_table(
            f"Recorders below {spool.path}",
            ("recorder", "process", "drained by", "synced", "stored", "folded", "bytes", "database"),
            [
                (
                    each.name,
                    "alive" if each.alive else "dead",
                    _DRAINED_BY[each.drained],
                    each.synced,
                    each.stored,
                    each.folded,
                    each.bytes_spooled,
                    f"unavailable: {each.away}" if each.away else "",
                )
                for each in recorders
            ],
        )
    else:
        absence = "" if spool.path.is_dir() else ", which does not exist"
        stdout.print(f"No recorders below {spool.path}{absence}", markup=False)
    stdout.print("A daemon drains this spool." if has_daemon else "No daemon drains this spool.")
    if episodes:
        print_table(
            "Episodes that are stopped or not completely folded",
            ("episode", "id", "stored", "folded", "behind", "by s", "stopped"),
            [(e.number, e.id, e.head, e.folded, e.lag_events, e.lag_s, e.refused or e.parked) for e in episodes],
        )
    elif is_shown:
        stdout.print("The tables show all stored events.")
