"""Wakes whoever waits for a change: coroutines of any loop, and blocked threads.

A waiter asks for its ticket first, looks whether what it wants is there already, and only then waits: a ring between
looking and waiting is not missed.

There is no lock in it, for a thread could find that it holds it itself (`alone.py`): each step on the set of tickets is
one that no other thread comes into.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as NotInTime

__all__ = ["Notifier"]


class Notifier:
    """Rings for all who wait at that moment."""

    def __init__(self) -> None:
        self._tickets: set[Future[None]] = set()

    def notify_all(self) -> None:
        """Wakes everybody. From any thread."""
        for ticket in list(self._tickets):
            try:
                self._tickets.remove(ticket)
            except KeyError:  # another ring was first, or it is no longer wanted
                continue
            if ticket.set_running_or_notify_cancel():
                ticket.set_result(None)

    @property
    def awaited(self) -> bool:
        """Whether somebody waits now."""
        return bool(self._tickets)

    async def until(self, reached: Callable[[], bool]) -> None:
        """Done when `reached` is true; it is asked now and after every ring, in the caller's loop."""
        while True:
            ticket = self._ticket()
            try:
                if reached():
                    return
                await asyncio.wrap_future(ticket)
            finally:
                self._forget(ticket)

    def block_until(self, reached: Callable[[], bool], *, remaining_s: Callable[[], float]) -> bool:
        """Blocks this thread until `reached` is true; False when no time remains."""
        while True:
            ticket = self._ticket()
            try:
                if reached():
                    return True
                ticket.result(max(0.0, remaining_s()))
            except (NotInTime, CancelledError):
                return reached()
            finally:
                self._forget(ticket)

    def _ticket(self) -> Future[None]:
        ticket: Future[None] = Future()
        self._tickets.add(ticket)
        return ticket

    def _forget(self, ticket: Future[None]) -> None:
        self._tickets.discard(ticket)
