"""Every error of this package descends from `PycrormError`; its branch says who is at fault.

`CallerError`: the call, the plan file, the URL. `FilesError`: the spool's files or their disk. `DatabaseError`: the
database or the way to it. `DamageError`: stored bytes that contradict themselves. `InternalError`: us.
The outcome of a plan is none of these: plans fail with `pycrorm_async.plan.PlanFailure`.
"""

from __future__ import annotations

from pathlib import Path

__all__ = [
    "PycrormError",
    "CallerError",
    "UnknownUrl",
    "Unrecordable",
    "DeclarationRefused",
    "EpisodeRefused",
    "UnknownEpisode",
    "MissingExtra",
    "ImpossibleCondition",
    "NotEnoughExperience",
    "PolicyFileRefused",
    "FilesError",
    "SpoolUnavailable",
    "SpoolTaken",
    "SpoolFull",
    "SpoolStuck",
    "SpoolClosed",
    "SpoolForeign",
    "DatabaseError",
    "DatabaseUnavailable",
    "LogWentBack",
    "DatabaseForeign",
    "TablesForeign",
    "TablesOutdated",
    "TablesUntrusted",
    "EpisodeParked",
    "FlushTimeout",
    "DamageError",
    "SpoolDamaged",
    "LogDamaged",
    "PolicyDamaged",
    "InternalError",
]


class PycrormError(Exception):
    """The root: catch this to catch everything the memory itself can raise."""


# --- the caller -----------------------------------------------------------------------------------------------


class CallerError(PycrormError):
    """The call cannot be carried out as it was made; the message says what to change."""


class UnknownUrl(CallerError):
    """The database URL has a scheme or a form that is not ours. Never shows a password."""


class Unrecordable(CallerError):
    """A value of a designator cannot be written down without changing its meaning."""

    def __init__(self, designator: str, field: str, reason: str) -> None:
        super().__init__(f"{designator}.{field} cannot be recorded: {reason}")
        self.designator = designator
        self.field = field
        self.reason = reason


class DeclarationRefused(CallerError):
    """A designator class cannot be remembered as it is declared."""

    def __init__(self, designator: str, reason: str) -> None:
        super().__init__(f"{designator} cannot be declared: {reason}")
        self.designator = designator
        self.reason = reason


class EpisodeRefused(CallerError):
    """An episode cannot be opened here: one is open already in this task, or a world is in the way."""


class UnknownEpisode(CallerError):
    """No episode of that number or id is in this database."""


class MissingExtra(CallerError):
    """The call needs an optional part of the package; the message names the extra to install."""


class ImpossibleCondition(CallerError):
    """A policy is asked for what it gives no probability at all; the message says for what."""


class NotEnoughExperience(CallerError):
    """There are too few samples to learn from; the message says how many there are, and how many it takes."""


class PolicyFileRefused(CallerError):
    """A file cannot be read or written, holds something else than a policy, or one of another version."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"policy {path}: {reason}")
        self.path = path
        self.reason = reason


# --- files ----------------------------------------------------------------------------------------------------


class FilesError(PycrormError):
    """The spool's files, or the disk below them, cannot be used."""


class SpoolUnavailable(FilesError):
    """The spool cannot be opened, written or synced; `path` says where."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"spool {path}: {reason}")
        self.path = path
        self.reason = reason


class SpoolTaken(SpoolUnavailable):
    """Another daemon drains this spool."""


class SpoolFull(FilesError):
    """The spool holds as much as it may (`spool_bytes_max`) and the caller chose not to wait."""


class SpoolStuck(FilesError):
    """The spool is full and waiting is no use: nothing empties it any more; the message says why."""


class SpoolClosed(FilesError):
    """Nothing more can be put: the queue was closed, or belongs to another process (a fork)."""


class SpoolForeign(FilesError):
    """The spool belongs to another database, another program, or a newer format of this one."""


# --- database -------------------------------------------------------------------------------------------------


class DatabaseError(PycrormError):
    """The database cannot do what was asked; the message names it without its password."""


class DatabaseUnavailable(DatabaseError):
    """No such database, or it does not answer."""


class LogWentBack(DatabaseUnavailable):
    """The log holds less of an episode than it had confirmed: a failover, or a backup that was restored.

    Nothing of the batch is stored, and the call may be made again once what is missing was offered again.
    """

    def __init__(self, episode: str, confirmed: int, head: int) -> None:
        super().__init__(
            f"the database went back: it had stored events 1 to {confirmed} of episode {episode} and holds {head}"
        )
        self.episode = episode
        self.confirmed = confirmed
        self.head = head


class DatabaseForeign(DatabaseError):
    """A database of another program, or of a newer version of this one."""


class TablesForeign(DatabaseForeign):
    """This process can append to the log and cannot use the tables: recording goes on."""


class TablesOutdated(TablesForeign):
    """The tables were made by an older fold: they are shown again after `pycrorm rebuild`."""


class TablesUntrusted(TablesForeign):
    """The tables belong to a role with fewer rights than this login has, and could hold code that would use them."""


class EpisodeParked(DatabaseError):
    """An episode stopped on its way to the tables; `reasons` maps its id to why."""

    def __init__(self, reasons: dict[str, str]) -> None:
        lines = "; ".join(f"episode {episode}: {reason}" for episode, reason in reasons.items())
        super().__init__(f"not everything could be stored or folded: {lines}")
        self.reasons = reasons


class FlushTimeout(DatabaseError):
    """`flush` did not finish in time; what was emitted is safe in the spool."""


# --- damage ---------------------------------------------------------------------------------------------------


class DamageError(PycrormError):
    """Stored bytes contradict themselves. Nothing is cut or overwritten when this is raised."""


class SpoolDamaged(DamageError):
    """A segment holds bytes that were safe once and are not what was written."""

    def __init__(self, path: Path, offset: int, reason: str) -> None:
        super().__init__(f"{path} is damaged at byte {offset}: {reason}")
        self.path = path
        self.offset = offset
        self.reason = reason


class LogDamaged(DamageError):
    """The event log contradicts itself, or a spool contradicts the log."""

    def __init__(self, episode: str, sequence: int, reason: str) -> None:
        super().__init__(f"episode {episode}, event {sequence}: {reason}")
        self.episode = episode
        self.sequence = sequence
        self.reason = reason


class PolicyDamaged(DamageError):
    """A policy's file is not what was written."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"policy {path} is damaged: {reason}")
        self.path = path
        self.reason = reason


# --- us -------------------------------------------------------------------------------------------------------


class InternalError(PycrormError):
    """A fault of this package; please report it with the message."""
