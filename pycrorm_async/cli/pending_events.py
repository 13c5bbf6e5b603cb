"""Says when a spool holds what its database does not: reading verbs do not write, so somebody else must."""

from __future__ import annotations

from pathlib import Path

from pycrorm_async.cli.output import note
from pycrorm_async.operations.recovery import pending_recorders
from pycrorm_async.store.address import DatabaseAddress

__all__ = ["note_what_waits"]


def note_what_waits(url: str, spool: Path | None) -> None:
    """One line on stderr for each kind of recorder that may hold more than the database shows."""
    dead, alive = pending_recorders(url, spool)
    if dead:
        option = f" --spool {spool}" if spool else ""
        note(
            f"{dead} dead recorder{'s' * (dead > 1)} left events that are not in the database:"
            f" `pycrorm writer --once --url {DatabaseAddress.parse(url).to_type}{option}` brings them in."
        )
    if alive:
        note(f"{alive} recorder{'s are' if alive > 1 else ' is'} at work: the newest events may not be in yet.")
