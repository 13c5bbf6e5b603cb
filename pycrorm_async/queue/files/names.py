"""Name the files and folders of a spool."""

from typing import Final

__all__ = ["ALIVE", "BLOBS", "DRAIN", "KEPT_BLOBS", "MAKING", "MENDED", "PROGRESS", "REFUSED", "STORED", "TAIL"]

ALIVE: Final = "alive"
"""The recorder holds the lock of this file as long as it lives."""
BLOBS: Final = "blobs"
"""Folder of a recorder with its blobs (`blobs/blob_files.py`)."""
DRAIN: Final = "drain"
"""The process that drains the folder holds the lock of this file."""
PROGRESS: Final = "progress"
"""Holds how far another process has drained the folder (`drain_status.py`)."""
KEPT_BLOBS: Final = ".blobs"
"""Ends the name of the folder with the blobs that go with a kept segment."""
MAKING: Final = ".making"
"""Ends the name of a file or folder until it is complete."""
MENDED: Final = f".mended{MAKING}"
"""Ends the name of the folder that `repair` makes, until it is complete."""
REFUSED: Final = ".refused"
"""Ends the name of a folder of dead letters (`sources/dead_letters.py`)."""
TAIL: Final = ".tail"
"""Ends the name of a file that holds the bytes cut off a torn segment."""
STORED: Final = "stored"
"""Folder of the spool that keeps segments whose records are all stored (`retention/stored_segments.py`)."""
