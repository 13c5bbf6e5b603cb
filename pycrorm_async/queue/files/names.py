"""Names of files and folders in a spool."""

from typing import Final

__all__ = ["ALIVE", "DRAIN", "MAKING", "MENDED", "PROGRESS", "REFUSED", "STORED", "TAIL"]

ALIVE: Final = "alive"
"""A recorder holds the lock of this file as long as it lives."""
DRAIN: Final = "drain"
"""A process that drains the folder holds the lock of this file."""
PROGRESS: Final = "progress"
"""How far another process has drained the folder (`drain_status.py`)."""
MAKING: Final = ".making"
"""Ends the name of a folder until everything is in it."""
MENDED: Final = f".mended{MAKING}"
"""Ends the name of a folder that `repair` makes, until it is whole."""
REFUSED: Final = ".refused"
"""Ends the name of a folder with dead letters (`sources/dead_letters.py`)."""
TAIL: Final = ".tail"
"""Ends the name of a file with the bytes that were cut off a torn segment."""
STORED: Final = "stored"
"""Below the spool: segments whose records are all stored (`retention/stored_segments.py`)."""
