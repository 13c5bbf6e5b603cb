"""`pycrorm retention`: rules, stored in the memory, of how long its episodes stay, and what becomes of them then.

A rule has an age and tags, and concerns the episodes with all of these tags. Of several, the one with most tags
decides, and among these the one that keeps longer: so `--keep forever --tag demo` is stronger than `--keep 90d`, and so
is `--keep 7d --tag tryout`. An episode that no rule concerns stays, and so does one that has not ended.

What a rule removes, the journal (`pycrorm_removed_episode`) names with the rule: `operations.removal` erases it, or
`operations.archive` moves it into a lake.
"""

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple

from sqlalchemy import ColumnClause, column, select, table
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import CallerError, PycrormError
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.operations.archive import ArchiveSummary, archive_episodes
from pycrorm_async.operations.removal import ErasedEpisode, ages_from, erase
from pycrorm_async.progress_bar import ProgressCallback
from pycrorm_async.projections.columns import EPISODE, physical_name
from pycrorm_async.projections.generations import PROJECTION_VERSION, SHOWN, read_generation
from pycrorm_async.store import schema
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog, tags_of
from pycrorm_async.store.stored import EpisodeRow, RemovedEpisode

BY_RULE: Final = "retention --keep "
"""Begins the reason in the journal of what a rule removed, and no reason that a user gives."""


class RetentionRule(NamedTuple):
    """One rule.

    Attributes:
        number: names it; assigned by `add_rule`.
        keep: the age as the user wrote it, such as 90d, or "forever".
        keep_s: the age in s, which `removal.ages_from` counts; None for ever.
        tags: all of these; none concerns every episode.
        archive_to: the address of the lake to which the episodes go; None erases them.
    """

    number: int
    keep: str
    keep_s: int | None
    tags: tuple[str, ...]
    archive_to: str | None

    def __str__(self) -> str:
        tags = "".join(f" --tag {each}" for each in self.tags)
        return f"{BY_RULE}{self.keep}{tags}" + (f" --archive-to {self.archive_to}" if self.archive_to else "")


class DueEpisode(NamedTuple):
    """An episode that is older than the rule that decides about it keeps it."""

    row: EpisodeRow
    tags: tuple[str, ...]
    rule: RetentionRule


class RetentionResult(NamedTuple):
    """The episodes that were erased, the summaries of the archives by lake, and the faults that ended some early."""

    erased: list[ErasedEpisode]
    archived: dict[str, ArchiveSummary]
    faults: list[PycrormError]


def deciding_rule(rules: Collection[RetentionRule], tags: Collection[str]) -> RetentionRule | None:
    """Return the rule that decides about an episode with these tags; None if none concerns it."""
    apt = [each for each in rules if {*each.tags} <= {*tags}]
    return max(
        apt,
        key=lambda each: (len(each.tags), math.inf if each.keep_s is None else each.keep_s, -each.number),
        default=None,
    )


# --- the rules ------------------------------------------------------------------------------------------------


async def read_rules(log: EventLog) -> list[RetentionRule]:
    """Read the rules of a memory, by number. Raises `DatabaseUnavailable` for a login that may not read them."""
    async with log.reading() as connection:
        return await _rules(connection)


async def _rules(connection: AsyncConnection) -> list[RetentionRule]:
    table, query = schema.RETENTION, schema.SELECT_RULES
    rows = await dialect_of(connection).rows_if_created(connection, table, RetentionRule, query)
    return [each._replace(tags=tuple(json.loads(each.tags))) for each in rows]


async def add_rule(
    log: EventLog, keep: str, age: timedelta | None, tags: Collection[str], archive_to: str | None
) -> RetentionRule:
    """Store a rule, which replaces that of the same tags; `age` None keeps for ever.

    Raises `CallerError` for a rule that keeps for ever and archives, and for a tag that no episode can have.
    """
    if age is None and archive_to is not None:
        raise CallerError("--keep forever leaves nothing to archive: leave out --archive-to")
    keep_s, named = None if age is None else int(age.total_seconds()), tuple(sorted(checked_tags(tags)))
    with log.translated():
        async with log.writing() as connection:
            dialect = dialect_of(connection)
            await dialect.lock_log_changes(connection)
            await dialect.create_if_missing(connection, schema.RETENTION)
            numbers = {each.tags: each.number for each in await _rules(connection)}
            number = numbers.get(named, 1 + max(numbers.values(), default=0))
            rule = RetentionRule(number, keep, keep_s, named, archive_to)
            stored = (number, keep, keep_s, json.dumps(named), archive_to)
            await dialect.execute(connection, schema.UPSERT_RULES, rules=[stored])
    return rule


async def remove_rule(log: EventLog, number: int) -> RetentionRule:
    """Remove a rule. Raises `CallerError` if there is none of this number."""
    with log.translated():
        async with log.writing() as connection:
            for rule in await _rules(connection):
                if rule.number == number:
                    await dialect_of(connection).execute(connection, schema.DELETE_RULE, number=number)
                    return rule
    raise CallerError(f"there is no rule {number}: `pycrorm retention list` shows the rules")


# --- their application ----------------------------------------------------------------------------------------


async def due_episodes(log: EventLog, rules: Sequence[RetentionRule], now_ns: int) -> list[DueEpisode]:
    """Return the episodes that rules no longer keep at this time, by number.

    The tables, if they are of this version, say which may be due, because an index finds their tags; the log, which may
    have later ones, decides.
    """
    tags_by_number = await _tags_in_tables(log, {tag for each in rules for tag in each.tags})
    due: list[DueEpisode] = []
    for row, from_ns in ages_from(await log.episodes(), now_ns):
        age_ns = now_ns - from_ns
        if tags_by_number is None or _rule_that_ended(rules, tags_by_number.get(row.number, ()), age_ns):
            tags = await tags_of(log, row)
            rule = _rule_that_ended(rules, tags, age_ns)
            if rule is not None:
                due.append(DueEpisode(row, tags, rule))
    return due


def _rule_that_ended(rules: Sequence[RetentionRule], tags: Collection[str], age_ns: int) -> RetentionRule | None:
    """Return the rule that decides about an episode of this age, if it no longer keeps it."""
    rule = deciding_rule(rules, tags)
    return rule if rule is not None and rule.keep_s is not None and age_ns > rule.keep_s * 10**9 else None


async def _tags_in_tables(log: EventLog, names: Collection[str]) -> Mapping[int, Collection[str]] | None:
    """Return which of these tags the episodes have, by number, as far as they are folded.

    Returns None where the tables are missing or of another version.
    """
    tags: dict[int, set[str]] = {}
    async with log.reading() as connection:
        generation = await read_generation(connection, SHOWN)
        if generation is None or generation.version != PROJECTION_VERSION:
            return None
        # Not the view `episode_tag`, which leaves out simulations.
        columns: list[ColumnClause[Any]] = [column(each) for each in (EPISODE, "tag", "added", "id", "position")]
        change = table(physical_name("episode_tagging", generation.number), *columns).c
        changes = select(change[EPISODE], change.tag, change.added).where(change.tag.in_(sorted(names)))
        for number, name, added in await connection.execute(changes.order_by(change.id, change.position)):
            some = tags.setdefault(number, set())
            some.add(name) if added else some.discard(name)
    return tags


async def apply_rules(
    url: str,
    log: EventLog,
    confirmed: Collection[int],
    now_ns: int,
    *,
    spool: Path,
    report_progress: ProgressCallback = lambda _done, _total, _what=None: None,
) -> RetentionResult:
    """Erase or archive those of the confirmed episodes, by number, that are due still; finish earlier erasures.

    A fault, such as a lake that is away, ends what concerns this rule, and the others are applied.
    """
    due = [each for each in await due_episodes(log, await read_rules(log), now_ns) if each.row.number in confirmed]
    by_rule: dict[RetentionRule, list[EpisodeRow | RemovedEpisode]] = {}
    for each in due:
        by_rule.setdefault(each.rule, []).append(each.row)
    result = RetentionResult([], {}, [])
    begun: dict[str, list[EpisodeRow | RemovedEpisode]] = {}
    for removed in await log.all_removed():
        if removed.finished_wall_ns is None and removed.reason.startswith(BY_RULE):
            begun.setdefault(removed.reason, []).append(removed)
    erasures = [*begun.items(), *((str(rule), rows) for rule, rows in by_rule.items() if rule.archive_to is None)]
    for reason, rows in erasures:
        with _noting(result):
            result.erased.extend(await erase(log, rows, reason=reason, spool=spool))
    for rule, rows in by_rule.items():
        if rule.archive_to is not None:
            with _noting(result):
                await archive_episodes(
                    url,
                    rule.archive_to,
                    before=datetime.fromtimestamp(now_ns / 1e9, UTC),
                    only={each.number for each in rows},
                    reason=str(rule),
                    summary=result.archived.setdefault(rule.archive_to, ArchiveSummary([], {})),
                    report_progress=report_progress,
                )
    return result


@contextmanager
def _noting(result: RetentionResult) -> Iterator[None]:
    """Note a fault in the result instead of raising it."""
    try:
        yield
    except PycrormError as fault:
        result.faults.append(fault)
