"""Describe an episode when it opens: its arguments, provenance and first event, and the statuses it may end with."""

from __future__ import annotations

import asyncio
import getpass
import platform
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final, NamedTuple, TypeAlias, cast

from pycrorm_async.clock import SYSTEM_CLOCK, Clock, clock_quality
from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import NotEncodable, encoded_bytes
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.events.types import EpisodeStarted, EpisodeStatus, NodeReference, NodeStatus
from pycrorm_async.record.values import NO_REFERENCES, MissingValues, ValueReader, clean
from pycrorm_async.settings import Settings

EPISODE_TEXT_MAX: Final = 10_000
"""Bounds the characters of an episode's description, plan and world, so that their columns stay readable."""

# === episode arguments ========================================================================================
#
# Check the arguments with which a program opens an episode.

_METADATA_BYTES_MAX: Final = 64 * 2**10
"""Bounds the metadata of an episode, which is one column: a page of settings, not data."""


def check_opening(opening: EpisodeOpening) -> None:
    """Check that an episode's arguments fit its columns. Raises `CallerError` naming the argument."""
    seed = cast("object", opening.seed)
    for name in ("description", "plan", "world", "created_by"):
        text = getattr(opening, name)
        if text is not None and not isinstance(text, str):
            raise CallerError(f"the {name} of an episode must be a str, not {text!r:.100}")
    # A bool is an int, but a reader of the event refuses it.
    if seed is not None and (isinstance(seed, bool) or not (isinstance(seed, int) and -(2**63) <= seed < 2**63)):
        raise CallerError(f"the seed of an episode must be an int of at most 64 bits, not {seed!r:.100}")


def read_labels(tags: Iterable[str], metadata: object, settings: Settings, missing: MissingValues) -> dict[str, Any]:
    """Return the tags of an episode, checked, and its metadata as JSON values, by their names in `EpisodeOpening`.

    A value of the metadata that cannot be recorded is null, and counted as missing. Raises `CallerError` if the
    tags are not a list of short texts, and for metadata without text keys.
    """
    checked = checked_tags(tags)
    if not isinstance(metadata, Mapping) or not all(isinstance(key, str) for key in metadata):
        raise CallerError(f"the metadata of an episode must be a dict with text keys, not {metadata!r:.100}")
    reader = ValueReader(NO_REFERENCES, _refuse_blob)
    values = reader.read(dict(metadata)) or {}
    for path, reason in reader.missing.items():
        missing.note("Episode.metadata", path or "metadata", reason)
    try:
        size = encoded_bytes(values)
    except NotEncodable:
        size = _METADATA_BYTES_MAX + 1
    if size > min(_METADATA_BYTES_MAX, settings.record_bytes_max // 4):
        missing.note("Episode", "metadata", f"it takes {size:,} bytes, {_METADATA_BYTES_MAX:,} are allowed")
        values = {}
    return {"tags": checked, "metadata": values}


def _refuse_blob(_content: bytes, _media_type: str) -> Any:
    raise ValueError("metadata holds no blobs and no large arrays: record them with `memory.observe`")


# === provenance ===============================================================================================
#
# Describe the origin of an episode: the plan's source, the libraries, the settings and the clock's quality.
#
# Reading the plan's source is left to the program that starts the plan (`pycrorm run`); a plan's process never does it
# on its own.

_LIBRARIES = (
    *"pycrorm-async pycram-robotics pybullet pycram-bullet pybullet-arm64 mujoco-core optik-py pyjpt".split(),
    *"numpy msgspec SQLAlchemy aiosqlite asyncpg".split(),
)
"""The packages whose versions are recorded: those that act in the world, learn, encode events and store them."""


class PlanSource(NamedTuple):
    """The source of a plan.

    Attributes:
        sha256: SHA-256 of the plan's file, hexadecimal.
        git_commit: the commit that is checked out where the file is; None outside a repository and without git.
        git_dirty: whether a tracked file differs from that commit, or the plan's file is not tracked.
    """

    sha256: str
    git_commit: str | None = None
    git_dirty: bool | None = None


class Provenance(NamedTuple):
    """The program, settings and clock with which the episodes of one memory are recorded.

    Attributes:
        source: the plan's source, if the program that started it has read it.
        libraries: version by package.
        settings: the settings that differ from their defaults, by name.
        clock: the clock that gives the times of events; only the system's has a known quality.
    """

    source: PlanSource | None
    libraries: dict[str, str]
    settings: dict[str, Any]
    clock: Clock

    @classmethod
    def of(cls, source: PlanSource | None, settings: Settings, clock: Clock) -> Provenance:
        """Read the versions of the installed libraries; takes 3 ms the first time."""
        versions = {name: installed for name in _LIBRARIES if (installed := _version(name)) is not None}
        return cls(source, versions, settings.changed(), clock)

    def fields(self) -> dict[str, Any]:
        """Return the fields of `EpisodeStarted`, with the clock's quality at this moment."""
        quality = clock_quality() if self.clock is SYSTEM_CLOCK else None
        return {
            "plan_sha256": self.source.sha256 if self.source else None,
            "git_commit": self.source.git_commit if self.source else None,
            "git_dirty": self.source.git_dirty if self.source else None,
            "libraries": self.libraries,
            "settings": self.settings,
            "clock_synchronized": quality.synchronized if quality else None,
            "clock_error_us": quality.error_us if quality else None,
        }


@cache
def _version(package: str) -> str | None:
    """Return the version of an installed package; None for a source tree that is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


# === episode opening ==========================================================================================
#
# Build the first event of an episode, and the statuses that an episode and its root end with.

Failures: TypeAlias = tuple[type[BaseException], ...]
"""The classes of an executive's own plan failures."""


class EpisodeOpening(NamedTuple):
    """The arguments an episode is opened with; `is_past` if it happened at other times than those of the clock."""

    description: str
    software: str
    plan: str | None = None
    seed: int | None = None
    world: str | None = None
    simulated: bool = False
    thought_by: NodeReference | None = None
    provenance: Provenance | None = None
    tags: tuple[str, ...] = ()
    metadata: Mapping[str, Any] = {}
    created_by: str | None = None
    is_past: bool = False


def episode_started(opening: EpisodeOpening) -> EpisodeStarted:
    """Build the first event of an episode."""
    provenance = opening.provenance.fields() if opening.provenance is not None else {}
    if opening.is_past:
        provenance |= {"clock_synchronized": None, "clock_error_us": None}
    return EpisodeStarted(
        description=clean(opening.description),
        created_by=clean(_user() if opening.created_by is None else opening.created_by),
        host=clean(platform.node()),
        software=opening.software,
        python=platform.python_version(),
        plan=clean(opening.plan) if opening.plan is not None else None,
        seed=opening.seed,
        world=clean(opening.world) if opening.world is not None else None,
        simulated=opening.simulated,
        thought_by=opening.thought_by,
        tags=opening.tags,
        metadata=dict(opening.metadata),
        **provenance,
    )


def end_statuses(failure: BaseException | None, failures: Failures = ()) -> tuple[EpisodeStatus, NodeStatus]:
    """Return the statuses of an episode, and of a node, that this exception left."""
    if failure is None:
        return "SUCCEEDED", "SUCCEEDED"
    if is_plan_failure(failure, failures):
        return "FAILED", "FAILED"
    if isinstance(failure, asyncio.CancelledError | KeyboardInterrupt | SystemExit):
        return "INTERRUPTED", "CANCELLED"
    return "ERROR", "ERROR"


def is_plan_failure(error: BaseException, failures: Failures) -> bool:
    """Return whether it is a plan failure, one of these classes or of a plan layer, or a group of such only."""
    if isinstance(error, ExceptionGroup):
        return all(is_plan_failure(each, failures) for each in error.exceptions)
    return isinstance(error, failures) or getattr(type(error), "__is_plan_failure__", False)


def current_task() -> asyncio.Task[Any] | None:
    """Return the running asyncio task; None outside an event loop."""
    try:
        return asyncio.current_task()
    except RuntimeError:
        return None


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no entry for this uid, as in many containers
        return "unknown"
