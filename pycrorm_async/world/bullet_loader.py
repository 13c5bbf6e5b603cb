"""How Bullet is reached: loaded at the first world, and silent on stdout and stderr from then on.

Bullet speaks with C's `printf` and cannot be told not to: a greeting at import, warnings when it loads a body. For that
moment C's own `stdout` and `stderr` pointers stand on memory. Python and child processes write to the file descriptors,
not through those pointers, so what others print meanwhile is not touched; and what Bullet said is at hand when a
description does not load.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from threading import Lock
from typing import Any

__all__ = ["engine", "captured"]

_ONE_AT_A_TIME = Lock()  # a process has one C stdout


@cache
def engine() -> Any:
    """The module `pybullet`, imported at the first call."""
    found = find_spec("pybullet")
    if found is not None and found.origin is not None:
        # Loaded before it is imported: the C++ runtime that comes with it keeps the streams it finds when it starts,
        # and would keep, and at exit flush, the memory that is gone by then.
        ctypes.CDLL(found.origin)
    with captured():
        import pybullet
    return pybullet


@contextmanager
def captured() -> Iterator[list[str]]:
    """Inside, what C code prints is kept from stdout and stderr; afterwards the list holds it as one text.

    Threads wait for each other here; not reentrant.
    """
    words: list[str] = []
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):  # only glibc lets its streams be assigned
        yield words
        return
    libc.open_memstream.restype = ctypes.c_void_p
    text, size = ctypes.c_char_p(), ctypes.c_size_t()
    streams = [ctypes.c_void_p.in_dll(libc, name) for name in ("stdout", "stderr")]
    with _ONE_AT_A_TIME:
        memory: int | None = libc.open_memstream(ctypes.byref(text), ctypes.byref(size))
        if memory is None:
            raise MemoryError
        before = [stream.value for stream in streams]
        for stream in streams:
            stream.value = memory
        try:
            yield words
        finally:
            for stream, value in zip(streams, before, strict=True):
                stream.value = value
            libc.fclose(ctypes.c_void_p(memory))
            words.append((text.value or b"").decode(errors="replace"))
            libc.free(text)
