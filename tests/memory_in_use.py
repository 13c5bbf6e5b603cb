"""Count the bytes that this process has allocated, for scripts of tests that look for growth.

Start the process with `ALLOCATING`: without Python's own allocator, malloc counts all bytes in use. The number of pages
is less exact: how many are only partly in use changes by megabytes on a busy machine. SQLite's own memory does not
count: each connection keeps up to 2 MB of pages of its database, and fills them whenever it happens to be used.
"""

from __future__ import annotations

import _sqlite3
import ctypes
import gc
from typing import Final

__all__ = ["ALLOCATING", "bytes_in_use"]

ALLOCATING: Final = {"PYTHONMALLOC": "malloc"}
"""Environment of a process that counts."""


class _Allocated(ctypes.Structure):
    """`struct mallinfo2` of the GNU C library."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    ]


_mallinfo = ctypes.CDLL("libc.so.6").mallinfo2
_mallinfo.restype = _Allocated
_used_by_sqlite = ctypes.CDLL(_sqlite3.__file__).sqlite3_memory_used
_used_by_sqlite.restype = ctypes.c_int64


def bytes_in_use() -> int:
    """Return the bytes in use after a garbage collection, without those of SQLite."""
    gc.collect()
    allocated = _mallinfo()
    return int(allocated.uordblks + allocated.hblkhd) - int(_used_by_sqlite())
