"""How far a node of the task tree got: the word that plans, tables and questions share."""

from __future__ import annotations

from enum import Enum

__all__ = ["TaskStatus"]


class TaskStatus(Enum):
    """How far a node got."""

    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    """A plan failure was raised, or a group of nothing but plan failures."""
    ERROR = "ERROR"
    """Any other exception was raised."""
    CANCELLED = "CANCELLED"
    INTERRUPTED = "INTERRUPTED"
    """By a monitor."""
    LOST = "LOST"
    """Nobody saw it end: its process died, or its episode ended while it was running. Never seen by a plan."""
