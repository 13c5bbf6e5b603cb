"""Load Bullet when the first world is entered, and keep its output away from stdout and stderr.

Two packages ship the same Bullet: pybullet has wheels up to Python 3.11, and pycram-bullet, the fork of the institute
behind PyCRAM, has wheels for 3.11 and 3.12 and calls its module `pycram_bullet`. Either one works; no other module of
this package imports one of them.

Bullet prints with C's `printf`, which cannot be switched off: a greeting at import, warnings when it loads a body.
Meanwhile this module points C's own `stdout` and `stderr` to a buffer in memory. Python and child processes write to
the file descriptors and not through those pointers, so their output is not affected. The buffer holds Bullet's error
message if a description does not load.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from threading import Lock
from typing import Any

from pycrorm_async.world.errors import BulletMissing

_MODULES = ("pybullet", "pycram_bullet")
_STREAMS_LOCK = Lock()  # a process has one C stdout


@cache
def engine() -> Any:
    """Return the module of Bullet, imported at the first call: `pybullet` or else `pycram_bullet`.

    Raises `BulletMissing` if neither is installed.
    """
    for name in _MODULES:
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            continue
        # Load the library before the streams are redirected: its C++ runtime keeps the streams it finds when it
        # starts, and would flush the freed memory buffer at exit.
        ctypes.CDLL(spec.origin)
        with captured():
            return import_module(name)
    raise BulletMissing


@contextmanager
def captured() -> Iterator[list[str]]:
    """Capture the output of C code inside the context; afterwards the list holds it as one string.

    One thread at a time can capture, others block; not reentrant. Without glibc nothing is captured.
    """
    output: list[str] = []
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):  # only glibc lets its streams be assigned
        yield output
        return
    libc.open_memstream.restype = ctypes.c_void_p
    text, size = ctypes.c_char_p(), ctypes.c_size_t()
    streams = [ctypes.c_void_p.in_dll(libc, name) for name in ("stdout", "stderr")]
    with _STREAMS_LOCK:
        memory: int | None = libc.open_memstream(ctypes.byref(text), ctypes.byref(size))
        if memory is None:
            raise MemoryError
        before = [stream.value for stream in streams]
        for stream in streams:
            stream.value = memory
        try:
            yield output
        finally:
            for stream, value in zip(streams, before, strict=True):
                stream.value = value
            libc.fclose(ctypes.c_void_p(memory))
            output.append((text.value or b"").decode(errors="replace"))
            libc.free(text)
