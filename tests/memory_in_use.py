"""Count the bytes that this process has allocated, for scripts of tests that look for growth.

Start the process with `ALLOCATING`: without Python's own allocator, malloc counts all bytes in use. The number of pages
says less: how many are only partly in use changes by megabytes on a busy machine.
"""

from __future__ import annotations

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


def bytes_in_use() -> int:
    """Return the bytes in use after a garbage collection."""
    gc.collect()
    allocated = _mallinfo()
    return int(allocated.uordblks + allocated.hblkhd)
