"""Describe the origin of an episode: the plan's source, the libraries, the settings and the clock's quality.

Reading the plan's source is left to the program that starts the plan (`pycrorm run`); a plan's process never does it on
its own.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

from pycrorm_async.clock import SYSTEM_CLOCK, Clock, clock_quality
from pycrorm_async.settings import Settings

_LIBRARIES = (
    *"pycrorm-async pycram-robotics pybullet pycram-bullet optik-py pyjpt".split(),
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
