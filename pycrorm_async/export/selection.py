"""Resolve the rows to export (episodes, a view or table, a named question, a select) and the episodes that they cover.

Rows, also those that a question sums up, come from episodes that have ended and are visible in the tables to their last
event, so that the same export can be made again. Those of a view are ordered by its key.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from inspect import signature as inspect_signature
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import msgspec
from sqlalchemy import Select, column, inspect, select, table
from sqlalchemy.orm import Mapper

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Base, Designator, ProcessMetaData, TaskTreeNode
from pycrorm_async.orm.base import EPISODE, same_row, view_mappers
from pycrorm_async.query.frames import of_episode
from pycrorm_async.query.question import Question, SyncQuestion, episode_name
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.text import nearest

Exportable: TypeAlias = "str | int | type | Sequence[str | int] | Question | SyncQuestion | Select[*tuple[Any, ...]]"
"""An episode or several, by number, id or `last`; a view, a table or a question by name; a mapped class; a question of
`memory.ask`; a select."""

_ID_DIGITS = frozenset("0123456789abcdef-")


class CoveredEpisode(msgspec.Struct, frozen=True):
    """An episode whose events an export covers: number and id, events, and the digest of them if the log keeps it."""

    number: int
    id: str
    status: str
    events: int
    digest: str | None


@dataclass(frozen=True)
class Selection:
    """The rows to export.

    Attributes:
        kind: `episodes`, `view`, `question` or `select`.
        name: of the view or the question.
        arguments: of the question.
        question: the question, named or made by the caller; None for other rows.
        statement: the select.
        episodes: those that it covers, by number; for a select of the caller all that the memory has.
        simulated: True if simulations are among them.
        left_out: the number of episodes without all their rows yet.
    """

    kind: str
    name: str
    statement: Select[*tuple[Any, ...]]
    episodes: tuple[CoveredEpisode, ...]
    simulated: bool = False
    left_out: int = 0
    arguments: Mapping[str, Any] = field(default_factory=dict)
    question: Question | None = None


class _Covered(NamedTuple):
    episodes: tuple[CoveredEpisode, ...]
    simulated: bool = False
    left_out: int = 0


async def select_rows(
    reading: Reading,
    what: Exportable,
    episodes: Sequence[str | int] = (),
    *,
    arguments: Mapping[str, Any] = MappingProxyType({}),
    running: bool = False,
) -> Selection:
    """Return the selection that `what` names.

    `episodes` limits a view or a question to these, `arguments` are those of a question, and `running` admits episodes
    that run.

    Raises `CallerError` for an unknown name, with the nearest ones; if `episodes` is given and `what` chooses them
    itself; for wrong arguments; and for an episode that has not ended. Raises `UnknownEpisode`.
    """
    await reading.refresh()
    chosen = [str(each) for each in episodes]
    if isinstance(what, Select):
        if chosen:
            raise CallerError("a select of your own chooses its episodes itself: add a condition to it")
        return Selection("select", "", what, *await _covered(reading, ()))
    if isinstance(what, Question | SyncQuestion):
        question = what.question if isinstance(what, SyncQuestion) else what
        return await _asked(reading, "select", question, {}, chosen)
    if isinstance(what, type):
        what = what.__name__
    names = [str(what)] if isinstance(what, str | int) else [str(each) for each in what]
    views = await _views(reading)
    if len(names) == 1 and names[0] in views:
        if arguments:
            raise CallerError(f"{names[0]} is a view, and arguments are for questions: {', '.join(QUESTIONS)}")
        return await _view(reading, names[0], views[names[0]], chosen)
    if len(names) == 1 and names[0] in QUESTIONS:
        return await _asked(reading, "question", _question(reading, names[0], arguments), arguments, chosen)
    for each in names:
        if each in views or each in QUESTIONS:
            raise CallerError(
                f"an export is of episodes or of one view or question: export {each} to a file of its own"
            )
        if not _may_be_episode(each):
            near = nearest(each, [*views, *QUESTIONS])
            raise CallerError(f"the memory has no episode, view, class or question {each!r}{near}")
    if chosen:
        raise CallerError("episodes are exported whole: name them all instead of choosing among them")
    of_names = await _named(reading, names, running=running)
    node, designator = TaskTreeNode, Designator.__table__.alias("performed")
    statement = (
        select(node, designator.c.parameters)
        .outerjoin(designator, same_row(designator, node.__table__))
        .where(of_episode(node.process_metadata_id, _numbers(of_names.episodes)))
        .order_by(node.id)
    )
    return Selection("episodes", "", statement, *of_names)


def _question(reading: Reading, name: str, arguments: Mapping[str, Any]) -> Question:
    """Return the question. Raises `CallerError` for arguments that it does not take."""
    ask = getattr(reading.ask, name)
    valid = inspect_signature(ask).parameters
    for each in arguments:
        if each not in valid:
            raise CallerError(f"{name} has no argument {each!r}{nearest(each, valid)}; it has {', '.join(valid)}")
    missing = [each.name for each in valid.values() if each.default is each.empty and each.name not in arguments]
    if missing:
        raise CallerError(f"{name} needs {', '.join(missing)}: give it as an argument (--with {missing[0]}=...)")
    values = dict(arguments)
    if isinstance(values.get("since"), str):  # from a manifest
        values["since"] = datetime.fromisoformat(values["since"])
    question: Question = ask(**values)
    return question


def _recorded(value: Any) -> Any:
    """Return an argument as a manifest holds it."""
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, datetime):
        return value.isoformat()
    return value if isinstance(value, str | int | float | bool | None) else episode_name(value)


async def _asked(
    reading: Reading, kind: str, question: Question, arguments: Mapping[str, Any], chosen: Sequence[str]
) -> Selection:
    recorded = {name: _recorded(value) for name, value in arguments.items()}
    if question.episode is not None:
        if chosen:
            raise CallerError(
                "the question has the argument `episode`, which chooses it already: leave one of both out"
            )
        chosen = [episode_name(question.episode)]
    covered = await _covered(reading, chosen)
    if recorded.get("episode") is not None:
        recorded["episode"] = covered.episodes[0].id  # later, `last` and a number may be of another episode
    statement = question.select_among(_numbers(covered.episodes))
    return Selection(kind, question.name, statement, *covered, recorded, question)


async def _view(reading: Reading, name: str, mapper: Mapper[Any] | None, chosen: Sequence[str]) -> Selection:
    """Return the rows of a view, of a mapped class if it has one."""
    statement: Select[*tuple[Any, ...]]
    if mapper is not None:
        class_ = mapper.class_
        keys = [getattr(class_, mapper.get_property_by_column(each).key) for each in mapper.primary_key]
        statement = select(class_).order_by(*keys)
        episode = class_.id if class_ is ProcessMetaData else getattr(class_, EPISODE, None)
    else:
        log = await reading.log()
        async with log.reading() as connection:
            columns = await connection.run_sync(lambda each: inspect(each).get_columns(name))
        rows = table(name, *(column(each["name"], each["type"]) for each in columns))
        statement, episode = select(rows).order_by(*rows.c), rows.c.get(EPISODE)
    if episode is None:
        if chosen:
            raise CallerError(f"the rows of {name} are of no episode: export all of them")
        return Selection("view", name, statement, ())
    covered = await _covered(reading, chosen)
    return Selection("view", name, statement.where(of_episode(episode, _numbers(covered.episodes))), *covered)


async def _views(reading: Reading) -> dict[str, Mapper[Any] | None]:
    """Return the mapper of each view by the view's and the class's name; None for a view that no class maps."""
    log = await reading.log()
    async with log.reading() as connection:
        names = await connection.run_sync(lambda each: inspect(each).get_view_names())
    mappers: dict[str, Mapper[Any] | None] = dict.fromkeys(names) | view_mappers()
    for name in [each for each in names if mappers[each] is None]:
        with suppress(CallerError):
            mappers[name] = inspect(reading.mapped(name))
    present = [each for each in (*mappers.values(), *Base.registry.mappers) if each is not None]
    of_classes = {each.class_.__name__: each for each in present if each.local_table.description in names}
    return {name: mappers[name] for name in names} | of_classes


async def _covered(reading: Reading, chosen: Sequence[str]) -> _Covered:
    """Return the chosen episodes; without any, those that have ended and are in the tables to their last event."""
    if chosen:
        return await _named(reading, chosen)
    log = await reading.log()
    rows = {each.number: each for each in await log.episodes() if each.head}
    episode = ProcessMetaData
    async with reading.session() as session:
        statuses = (await session.execute(select(episode.id, episode.status))).all()
    ended = {
        number: status
        for number, status in statuses
        if number in rows and rows[number].ended_wall_ns is not None and rows[number].folded == rows[number].head
    }
    return _Covered(await covered_episodes(reading, ended), left_out=len(statuses) - len(ended))


async def _named(reading: Reading, names: Iterable[str], *, running: bool = False) -> _Covered:
    summaries = {each.number: each for each in [await reading.episode(name) for name in names]}
    for number, each in summaries.items():
        if each.status == "RUNNING" and not running:
            raise CallerError(f"episode {number} is still running, so its rows change: export it when it has ended")
    covered = await covered_episodes(reading, {number: each.status for number, each in summaries.items()})
    return _Covered(covered, any(each.simulated for each in summaries.values()))


async def covered_episodes(reading: Reading, statuses: dict[int, str]) -> tuple[CoveredEpisode, ...]:
    """Return the episodes of these numbers, with their statuses."""
    log = await reading.log()
    span = min(statuses, default=1), max(statuses, default=0)
    rows = {each.number: each for each in await log.episodes(*span)}
    digests = {
        number: each for number, each in (await log.last_digests(*span)).items() if each.sequence == rows[number].head
    }
    return tuple(
        CoveredEpisode(
            number, rows[number].id, status, rows[number].head, digests[number].digest if number in digests else None
        )
        for number, status in sorted(statuses.items())
    )


def _numbers(covered: Sequence[CoveredEpisode]) -> list[int]:
    return [each.number for each in covered]


def _may_be_episode(name: str) -> bool:
    return name == "last" or name.isdigit() or (len(name) >= 4 and set(name.lower()) <= _ID_DIGITS)


# === manifest =================================================================================================
#
# Describe an export in a file beside it, so that a data set can be made again and checked.
#
# The manifest of `picks.parquet` is `picks.parquet.manifest.json`: the names and the query, the versions, the columns,
# the episodes with the digests of their events, and the SHA-256 of each written file.


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """The description of an export.

    Attributes:
        format: version of this description.
        kind, names: `episodes` with their ids, `view` or `question` with its name, or `select`.
        file_format, options: as given.
        query: the SQL of the rows; empty for a format that is made from events.
        columns: the Arrow type of each column, by name.
        rows: number of rows, or of frames.
        versions: of the packages that wrote it.
        tables: version of the fold that made the tables.
        memory: id of the log.
        episodes: those that it covers.
        files: SHA-256 of each file, by name in the folder, or of the one file.
    """

    format: int = 1
    kind: str
    names: tuple[str, ...]
    file_format: str
    options: dict[str, Any] = {}
    query: str = ""
    columns: dict[str, str] = {}
    rows: int
    versions: dict[str, str]
    tables: int
    memory: str
    episodes: tuple[CoveredEpisode, ...]
    files: dict[str, str]


def manifest_path(path: Path) -> Path:
    """Return the file of the manifest of an export."""
    return path.with_name(f"{path.name}.manifest.json")


def read_manifest(path: Path) -> Manifest:
    """Read a manifest. Raises `CallerError` for another file, and for a manifest of a newer version."""
    try:
        manifest = msgspec.json.decode(path.read_bytes(), type=Manifest)
    except OSError as error:
        raise CallerError(f"the manifest {path} cannot be read: {error.strerror or error}") from None
    except msgspec.DecodeError as error:
        raise CallerError(f"{path} is not a manifest of an export: {error}") from None
    if manifest.format > Manifest.__struct_defaults__[0]:
        raise CallerError(f"{path} has the version {manifest.format}: use a newer pycrorm")
    return manifest


def versions_of(*packages: str) -> dict[str, str]:
    """Return the versions of this package and of these others, as far as they are installed."""
    versions = {}
    for name in ("pycrorm-async", *packages):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def episode_differences(recorded: tuple[CoveredEpisode, ...], present: dict[str, CoveredEpisode]) -> list[str]:
    """Return a line for each episode of a manifest that the memory lacks, or has with other events."""
    lines = []
    for each in recorded:
        now = present.get(each.id)
        if now is None:
            lines.append(f"episode {each.number} ({each.id}) is not in this memory")
        elif now.events != each.events:
            lines.append(f"episode {now.number} ({each.id}) has {now.events} events instead of {each.events}")
        elif now.digest is not None and each.digest is not None and now.digest != each.digest:
            lines.append(f"episode {now.number} ({each.id}) has other events: its digest differs")
        elif now.number != each.number:
            lines.append(f"episode {each.number} ({each.id}) has the number {now.number} here, so its ids differ")
    return lines


def checksums(path: Path, name: str) -> dict[str, str]:
    """Return the SHA-256 of a file under the name that it will have, or of each file in a folder by name inside it."""
    if not path.is_dir():
        return {name: _sha256(path)}
    return {str(each.relative_to(path)): _sha256(each) for each in sorted(path.rglob("*")) if each.is_file()}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
