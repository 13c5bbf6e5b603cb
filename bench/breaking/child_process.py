"""Run a function in a child process that prints its progress; the parent keeps the output when the child is killed."""

from __future__ import annotations

import atexit
import ctypes
import multiprocessing
import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

__all__ = ["SPAWN", "ChildProcess", "kill_me_after"]

SPAWN = multiprocessing.get_context("forkserver")
# The fork server imports these once, so that a child starts by a fork instead of a new interpreter with its imports.
SPAWN.set_forkserver_preload(["bench.breaking.machine", "bench.breaking.simulation", "rich.progress", "rich.table"])
_PATIENCE_S = 3600.0
"""Bounds the wait for output. On a busy machine a process may start for minutes; an exit is noticed at once."""


class ChildProcess:
    """Run `target(*arguments)` in a process; a thread reads its output all the time, so that the child never blocks.

    Start all children from one thread, because starting one reaps the others.
    """

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        reader, writer = SPAWN.Pipe(duplex=False)
        self._process = SPAWN.Process(target=_run, args=(writer, target, *arguments))
        self._process.start()
        atexit.register(self._process.kill)  # not daemonic, because a daemonic process must not start fold workers
        writer.close()
        self._output = bytearray()
        self._reader = threading.Thread(target=self._read, args=(reader,), daemon=True)
        self._reader.start()

    @property
    def is_running(self) -> bool:
        return self._process.is_alive()

    def wait_for(self, text: str) -> None:
        """Wait until the output contains this text; raise `RuntimeError` if the child ends before."""
        deadline = time.monotonic() + _PATIENCE_S
        while text.encode() not in self._output:
            if not self.is_running or time.monotonic() > deadline:
                raise RuntimeError(
                    f"the child did not print {text!r}; its last output is {bytes(self._output[-200:])!r}"
                )
            time.sleep(0.001)

    def kill(self) -> list[list[str]]:
        """Send SIGKILL and return the lines, split into words. Raise `RuntimeError` if the child had already ended."""
        self._process.kill()
        return self.wait_until_killed()

    def wait_until_killed(self) -> list[list[str]]:
        """Wait until another process, or the child itself, sends SIGKILL; return its lines."""
        lines = self.wait()
        if self._process.exitcode != -9:
            raise RuntimeError(f"the child was not killed but ended with exit code {self._process.exitcode}")
        return lines

    def stop(self) -> list[list[str]]:
        """Kill it if it still runs, and return its lines."""
        self._process.kill()
        return self.wait()

    def wait(self) -> list[list[str]]:
        """Wait until it has ended, and return its lines."""
        self._process.join()
        self._reader.join()
        return self.lines

    @property
    def lines(self) -> list[list[str]]:
        """The words of every complete line so far."""
        output = bytes(self._output)
        return [line.split() for line in output[: output.rfind(b"\n") + 1].decode().splitlines()]

    def _read(self, reader: Connection) -> None:
        while chunk := os.read(reader.fileno(), 1 << 20):
            self._output += chunk
        reader.close()


def _run(out: Connection, target: Callable[..., None], *arguments: object) -> None:
    """Run the target in the child, with stdout connected to `out`."""
    os.dup2(out.fileno(), 1)
    out.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    target(*arguments)


def kill_me_after(cpu_s: float) -> None:
    """Let the kernel send SIGKILL to this process after `cpu_s` more seconds of CPU time.

    CPU time makes the life of the process equally long on a busy and on an idle machine.
    """
    event, timer = struct.pack("Pii48x", 0, signal.SIGKILL, 0), ctypes.c_void_p()
    assert _C.timer_create(time.CLOCK_PROCESS_CPUTIME_ID, event, ctypes.byref(timer)) == 0
    assert _C.timer_settime(timer, 0, struct.pack("4l", 0, 0, 0, max(1, round(cpu_s * 1e9))), None) == 0


_C = ctypes.CDLL(None)
