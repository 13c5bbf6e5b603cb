"""`pycrorm show EPISODE` shows one episode and its task tree; with `--at`, tree and world at one moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from pycrorm_async.cli.options import DEFAULT_URL, EpisodeArgument, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import moment, print_facts, print_json
from pycrorm_async.cli.reading import read_memory
from pycrorm_async.cli.snapshot_view import print_percepts, print_places, print_snapshot
from pycrorm_async.cli.tree import print_tree, simulated_by
from pycrorm_async.query.as_of import parse_moment
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary
from pycrorm_async.query.parameter_text import duration, one_line
from pycrorm_async.query.percepts_and_places import Percept, PlaceSearch, percepts_of, searches_of
from pycrorm_async.query.reading import Reading

_Answers: TypeAlias = "tuple[Sequence[Percept], Sequence[PlaceSearch]]"

_DIGITS_MAX = 12
"""Bounds the digits of a hash, which are enough to compare it by eye; `--full` prints all."""


def show(
    episode: EpisodeArgument,
    at: Annotated[
        str | None,
        typer.Option(
            help="Show this moment: seconds since the start (12.5), or after an event (e300, also '#300').",
            metavar="WHEN",
        ),
    ] = None,
    events: Annotated[
        bool, typer.Option("--events", help="Print the events of each node's start and end, as in e6-e11.")
    ] = False,
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            help="Print texts, lists, hashes and numbers in full, and all percepts and places; --json always does.",
        ),
    ] = False,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show an episode's task tree with statuses and durations; with --at, tree and world at one moment."""
    if at is None:
        _show(episode, url, spool, events=events, full=full, as_json=as_json)
    else:
        _show_moment(episode, at, url, spool, events=events, full=full, as_json=as_json)


def _show(episode: str, url: str, spool: Path | None, *, events: bool, full: bool, as_json: bool) -> None:
    async def query(reading: Reading) -> tuple[EpisodeSummary, list[NodeSummary], _Answers]:
        summary = await reading.episode(episode)
        tree = await reading.tree(summary)
        if not (full or as_json):
            return summary, tree, ((), ())
        async with reading.session(simulated=True) as session:
            number = summary.number
            return summary, tree, (await percepts_of(session, number), await searches_of(session, number))

    summary, tree, (percepts, places) = read_memory(url, spool, query)
    if as_json:
        print_json({"episode": summary, "tree": tree, "percepts": percepts, "places": places})
        return
    print_facts(
        f"Episode {summary.number}: {summary.description}",
        {
            "id": summary.id,
            "started": f"{moment(summary.started_at)} UTC",
            "by": summary.created_by,
            "took": duration(summary.duration_ns),
            "events": summary.end_sequence,
            "status": summary.status,
            "continues": f"episode {summary.continues}" if summary.continues else None,
            "continued": f"in episode {summary.continued_in}" if summary.continued_in else None,
            "simulated": simulated_by(summary) if summary.simulated else None,
            "robot": ", ".join(map(str, summary.robots)) or None,
            "tags": ", ".join(summary.tags) or None,
            "metadata": _pairs(summary.metadata),
            **_provenance(summary, full=full),
        },
    )
    print_tree(tree, events=events, full=full)
    print_percepts(percepts)
    print_places(places)


def _provenance(summary: EpisodeSummary, *, full: bool) -> dict[str, str | None]:
    """Return the plan, commit, world, settings and clock of the recording; None for each that is unknown."""
    digits_max = None if full else _DIGITS_MAX
    commit, source, clock = summary.git_commit, summary.plan_sha256, summary.clock_synchronized
    kept = "synchronized" if clock else "not synchronized"
    error_ns = None if summary.clock_error_us is None else summary.clock_error_us * 1_000
    return {
        "plan": f"{summary.plan} (sha256 {one_line(source, digits_max)})" if source else summary.plan,
        "commit": f"{one_line(commit, digits_max)}{' and uncommitted changes' if summary.git_dirty else ''}"
        if commit
        else None,
        "world": summary.world,
        "settings": _pairs(summary.settings),
        "libraries": _pairs(summary.libraries) if full else None,
        "clock": f"{kept}, estimated error {duration(error_ns)}" if clock is not None else None,
    }


def _pairs(values: Mapping[str, object] | None) -> str | None:
    return ", ".join(f"{name} {value}" for name, value in values.items()) if values else None


def _show_moment(
    episode: str, at: str, url: str, spool: Path | None, *, events: bool, full: bool, as_json: bool
) -> None:
    time, sequence = parse_moment(at, "--at")
    snapshot = read_memory(url, spool, lambda reading: reading.as_of(episode, time=time, sequence=sequence))
    if as_json:
        print_json(snapshot)
    else:
        print_snapshot(snapshot, at if sequence is not None else f"{time:g} s", events=events, full=full)
