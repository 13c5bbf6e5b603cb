"""Warn when a spool holds events that its database does not; reading verbs never store them themselves."""

from __future__ import annotations

from pathlib import Path

from pycrorm_async.cli.output import note
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.store.address import DatabaseAddress


def note_pending_events(url: str, spool: Path | None) -> None:
    """Print one line on stderr for dead recorders with events left to store, and one for living recorders."""
    address = DatabaseAddress.parse(url)
    folders = Spool(spool or address.default_spool).recorders()
    recorders = [each for each in folders if each.refused is None]  # `pycrorm status` reports dead letters
    alive = sum(each.alive for each in recorders)
    dead = len(recorders) - alive
    if dead:
        option = f" --spool {spool}" if spool else ""
        note(
            f"{dead} dead recorder{'s' * (dead > 1)} left events that are not in the database:"
            f" run `pycrorm writer --once --url {address.to_type}{option}` to store them."
        )
    if alive:
        note(f"{alive} recorder{'s are' if alive > 1 else ' is'} running: the latest events may not be stored yet.")
