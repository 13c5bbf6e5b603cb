"""Status of a node of the task tree: one enumeration for plans, tables and queries."""

from enum import Enum


class TaskStatus(Enum):
    """The status of a node: running, or the way in which it ended."""

    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    """A plan failure was raised, or a group of nothing but plan failures."""
    ERROR = "ERROR"
    """Any other exception was raised."""
    CANCELLED = "CANCELLED"
    INTERRUPTED = "INTERRUPTED"
    """Interrupted by a monitor."""
    LOST = "LOST"
    """No end was recorded: the process died, or the episode ended while the node was running. A plan never sees it."""
    UNKNOWN = "UNKNOWN"
    """It ended, and its executive did not report how: neither a success nor a failure. A plan never sees it."""
