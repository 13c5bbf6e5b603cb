"""Rules of how long episodes stay: list, add or remove them, and apply them.

Panel: Operate, 8.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Annotated, TypeVar

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli import output
from pycrorm_async.cli.erase import ask, moment_of, name_what_is_left
from pycrorm_async.cli.reading import Place
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import CallerError
from pycrorm_async.operations import retention
from pycrorm_async.operations.retention import DueEpisode, RetentionResult, RetentionRule
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.store.lake import shown
from pycrorm_async.store.log import EventLog

T = TypeVar("T")
FOREVER = "forever"


def list_rules(*, place: Place, form: output.Form) -> None:
    """List the rules of a memory. Of those that concern an episode, the one with most tags decides."""
    rules = asyncio.run(_with_log(place, retention.read_rules, write=False))
    _print_rules(form, place, rules)
    if form.is_table and not rules:
        output.note("every episode stays: add a rule with `pycrorm retention add --keep AGE`")


def add(
    *,
    keep: Annotated[str, typer.Option(metavar="AGE", help="The age up to which they stay: 90d, 52w, 1y, or forever.")],
    tag: Annotated[
        list[str] | None,
        typer.Option("--tag", metavar="TAG", help="Only of episodes with this tag; repeatable: with all."),
    ] = None,
    archive_to: Annotated[
        str | None,
        typer.Option(metavar="LAKE", help="Then move them into this lake, as ducklake:FOLDER; without, erase them."),
    ] = None,
    place: Place,
    form: output.Form,
) -> None:
    """Add a rule, or replace the one with the same tags. It changes nothing until `pycrorm retention apply`.

    The age counts from the end of an episode, and at the earliest from when episodes started that were stored before
    it, because a robot's clock may be years behind. Of several rules that concern an episode, the one with most tags
    decides, and of these the one that keeps longer; what no rule concerns stays. The password of a lake's catalog is
    not stored.
    """
    try:
        age = None if keep == FOREVER else output.parse_age(keep)
    except OverflowError:
        age = None
    if age is None and keep != FOREVER:
        raise CallerError(f"--keep {keep} is not an age: write 12h, 90d, 52w, 1y, or {FOREVER}")
    lake = None if archive_to is None else shown(archive_to)
    rule = asyncio.run(_with_log(place, lambda log: retention.add_rule(log, keep, age, tag or (), lake)))
    _print_rules(form, place, [rule])


def remove(
    *, number: Annotated[int, typer.Argument(metavar="RULE", help="Its number.")], place: Place, form: output.Form
) -> None:
    """Remove a rule. The episodes that it kept are those of the other rules, or stay."""
    _print_rules(form, place, [asyncio.run(_with_log(place, lambda log: retention.remove_rule(log, number)))])


def apply(
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List which episodes would go, and why.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    place: Place,
    form: output.Form,
) -> int:
    """Erase or archive the episodes that no rule keeps any longer; with --yes from a timer.

    An episode that has not ended stays. The journal, `pycrorm erase`, names what went by which rule. Exit code 1 where
    parts of an erased episode are left, 4 where one could not be archived; run it again after an interruption.
    """
    return asyncio.run(_apply(place, form, dry_run=dry_run, yes=yes))


VERBS = {"list": list_rules, "add": add, "remove": remove, "apply": apply}


async def _apply(place: Place, form: output.Form, *, dry_run: bool, yes: bool) -> int:
    now_ns = SYSTEM_CLOCK.wall_ns()

    async def find(log: EventLog) -> list[DueEpisode]:
        return await retention.due_episodes(log, await retention.read_rules(log), now_ns)

    due = await _with_log(place, find, write=False)
    if dry_run:
        _print_due(form, f"Due in {place.address}", due, {})
        return 0
    if due and not yes:
        erased = sum(each.rule.archive_to is None for each in due)
        archived = len(due) - erased
        ask(f"Erase {output.counted(erased, 'episode')} of {place.address} for ever, and archive {archived}?")
    collect_seldom()
    with progress_bar("archiving") as report:

        async def go(log: EventLog) -> RetentionResult:
            numbers = {each.row.number for each in due}
            spool = place.spool or place.address.default_spool
            return await retention.apply_rules(place.url, log, numbers, now_ns, spool=spool, report_progress=report)

        result = await _with_log(place, go)
    outcomes = dict.fromkeys((each.row.id for each in due), "stays: parked, not visible yet, or changed meanwhile")
    outcomes |= {each.removed.id: "erased" for each in result.erased}
    refused: dict[str, str] = {}
    for summary in result.archived.values():
        outcomes |= {each.id: "archived" for each in summary.removed}
        refused |= summary.stayed
    outcomes |= {name: f"stays: {why}" for name, why in refused.items()}
    _print_due(form, f"Removed from {place.address}", due, outcomes)
    for name, why in refused.items():
        output.problem(f"episode {name} stays: {why}")
    for fault in result.faults[1:]:
        output.problem(str(fault))
    for fault in result.faults[:1]:  # its exit code counts
        raise fault
    return name_what_is_left(result.erased) or (4 if refused else 0)


async def _with_log(place: Place, act: Callable[[EventLog], Awaitable[T]], *, write: bool = True) -> T:
    """Return the result of an act on the log of a memory, which must exist."""
    address = place.shared_address
    async with await (EventLog.open_to_change(address) if write else EventLog.open(address, create=False)) as log:
        return await act(log)


def _print_rules(form: output.Form, place: Place, rules: Sequence[RetentionRule]) -> None:
    cells = [
        (each.number, each.keep, ", ".join(each.tags), each.archive_to or ("" if each.keep_s is None else "erase"))
        for each in rules
    ]
    document = [each._asdict() for each in rules]
    output.print_rows(form, document, f"Rules of {place.address}", ("rule", "keep", "tags", "then"), cells)


def _print_due(form: output.Form, title: str, due: Sequence[DueEpisode], outcomes: Mapping[str, str]) -> None:
    columns = ("episode", "id", "events", "ended", "tags", "rule", "keep", "then")
    cells, document = [], []
    for row, tags, rule in due:
        then = outcomes.get(row.id, rule.archive_to or "erase")
        ended = moment_of(row.ended_wall_ns)
        cells.append((row.number, row.id, row.head, ended, ", ".join(tags), rule.number, str(rule.keep), then))
        document.append({**row._asdict(), "tags": tags, "rule": rule.number, "keep": rule.keep, "then": then})
    output.print_rows(form, document, title, columns, cells)
