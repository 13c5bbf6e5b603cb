"""Define the errors of this package: all descend from `PycrormError`, and each branch names the party at fault.

`CallerError`: the call, the plan file or the URL. `FilesError`: the spool's files or their disk. `DatabaseError`: the
database or the connection to it. `DamageError`: stored bytes that contradict themselves. `InternalError`: this package.
A plan that fails raises none of these, but `pycrorm_async.plan.PlanFailure`.
"""

from pathlib import Path
from typing import Any


class PycrormError(Exception):
    """The root of the tree: `except PycrormError` catches every error that the memory itself can raise."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with message and data, for another process; by default the message would become the first argument."""
        return _restored, (type(self), self.args, self.__dict__)


def _restored(kind: type[PycrormError], args: tuple[Any, ...], data: dict[str, Any]) -> PycrormError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(data)
    return error


# --- the caller -----------------------------------------------------------------------------------------------


class CallerError(PycrormError):
    """The call cannot be carried out with these arguments; the message names the change that is needed."""


class UnknownUrl(CallerError):
    """The database URL has an unsupported scheme or form. The message never shows a password."""


class Unrecordable(CallerError):
    """A designator's value cannot be encoded without changing its meaning."""

    def __init__(self, designator: str, field: str, reason: str) -> None:
        super().__init__(f"{designator}.{field} cannot be recorded: {reason}")
        self.designator = designator
        self.field = field
        self.reason = reason


class DeclarationRefused(CallerError):
    """A designator class has a declaration that no table can hold."""

    def __init__(self, designator: str, reason: str) -> None:
        super().__init__(f"{designator} cannot be declared: {reason}")
        self.designator = designator
        self.reason = reason


class EpisodeRefused(CallerError):
    """An episode cannot be opened: this task has one open already, or the world belongs to another episode."""


class EpisodeFull(CallerError):
    """An episode has as many events as it can hold; only ends are still recorded in it."""


class UnknownEpisode(CallerError):
    """The database holds no episode of that number or id."""


class QueryRefused(CallerError):
    """A query in SQL or a select is wrong, would do more than read, or took longer or returned more than it may."""


class MissingExtra(CallerError):
    """The call needs an optional dependency; the message names the extra to install."""


class ImpossibleCondition(CallerError):
    """The policy gives the condition a probability of zero; the message names the condition."""


class NotEnoughExperience(CallerError):
    """Learning needs more samples than the database holds; the message gives both numbers."""


class PolicyFileRefused(CallerError):
    """A policy file cannot be read or written, is not a policy, or has another version."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"policy {path}: {reason}")
        self.path = path
        self.reason = reason


# --- files ----------------------------------------------------------------------------------------------------


class FilesError(PycrormError):
    """The spool's files, or the disk they are on, cannot be used."""


class SpoolUnavailable(FilesError):
    """The spool cannot be opened, written or synced; `path` is the file or folder that failed."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"spool {path}: {reason}")
        self.path = path
        self.reason = reason


class SpoolTaken(SpoolUnavailable):
    """Another daemon drains this spool."""


class SpoolFull(FilesError):
    """The spool has reached `spool_bytes_max` and the caller chose not to wait."""


class SpoolStuck(FilesError):
    """The spool is full and waiting cannot help, because draining has stopped; the message gives the reason."""


class SpoolClosed(FilesError):
    """The queue takes no more events: it was closed, or it belongs to the parent of this forked process."""


class SpoolForeign(FilesError):
    """The spool belongs to another database, another program, or a newer format of this one."""


# --- database -------------------------------------------------------------------------------------------------


class DatabaseError(PycrormError):
    """The database cannot carry out the operation; the message names the database without its password."""


class DatabaseUnavailable(DatabaseError):
    """The database does not exist or does not answer."""


class LogWentBack(DatabaseUnavailable):
    """The log holds less of an episode than it had confirmed: after a failover, or after a backup was restored.

    The log stored nothing of the batch. Append the missing events again, then retry the call.
    """

    def __init__(self, episode: str, confirmed: int, head: int) -> None:
        super().__init__(
            f"the database went back: it had stored events 1 to {confirmed} of episode {episode} and holds {head}"
        )
        self.episode = episode
        self.confirmed = confirmed
        self.head = head


class DatabaseForeign(DatabaseError):
    """The database belongs to another program, or to a newer version of this one."""


class TablesForeign(DatabaseForeign):
    """This process can append to the log but cannot use the tables: recording continues."""


class TablesPending(TablesForeign):
    """All events are stored, and another command or login must bring the tables up to date."""


class TablesOutdated(TablesPending):
    """An older fold made the tables: `pycrorm rebuild` makes them usable again."""


class TablesWithheld(TablesPending):
    """This login may append to the log and not change the tables: another login folds."""


class TablesUntrusted(TablesForeign):
    """A role with fewer rights than this login owns the tables, so their code could misuse the login's rights."""


class EpisodeParked(DatabaseError):
    """At least one episode is not stored or not folded; `reasons` maps episode id to reason."""

    def __init__(self, reasons: dict[str, str]) -> None:
        lines = "; ".join(f"episode {episode}: {reason}" for episode, reason in reasons.items())
        super().__init__(f"not everything could be stored or folded: {lines}")
        self.reasons = reasons


class FlushTimeout(DatabaseError):
    """`flush` or closing did not finish within `limit_s`; the events recorded so far are safe in the spool."""

    def __init__(self, limit_s: float, reason: str | None = None) -> None:
        because = "" if reason is None else f" ({reason})"
        super().__init__(f"not finished after {limit_s:g} s{because}; everything recorded is safe in the spool")
        self.limit_s = limit_s
        self.reason = reason


# --- damage ---------------------------------------------------------------------------------------------------


class DamageError(PycrormError):
    """Stored bytes contradict themselves. The operation that raises this has not cut or overwritten any of them."""


class SpoolDamaged(DamageError):
    """A segment's bytes were once synced, but differ from the bytes that were written."""

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
    """A policy file differs from the bytes that were written."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"policy {path} is damaged: {reason}")
        self.path = path
        self.reason = reason


# --- this package ---------------------------------------------------------------------------------------------


class InternalError(PycrormError):
    """This package has a defect; please report it with the message."""
