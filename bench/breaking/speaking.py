"""A process of its own that says on its output what it did, until it is killed: what it said is kept outside of it."""

from __future__ import annotations

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

__all__ = ["SPAWN", "Speaker", "kill_me_after"]

SPAWN = multiprocessing.get_context("forkserver")
# A kill costs a fork and not the start of an interpreter: all that `bench.faults` imports is there already.
SPAWN.set_forkserver_preload(["bench.breaking.machine", "bench.breaking.simulation", "rich.progress", "rich.table"])
_PATIENCE_S = 3600.0
"""A machine may be so busy that starting a process takes minutes; a process that ended is noticed at once."""


class Speaker:
    """Runs `target(*arguments)` in a process whose output is heard all the time, so that it never waits for us.

    All of them belong to one thread: to start one asks after the others.
    """

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        mine, its = SPAWN.Pipe(duplex=False)
        self._process = SPAWN.Process(target=_speaking, args=(its, target, *arguments), daemon=True)
        self._process.start()
        its.close()
        self._said = bytearray()
        self._listener = threading.Thread(target=self._listen, args=(mine,), daemon=True)
        self._listener.start()

    @property
    def runs(self) -> bool:
        return self._process.is_alive()

    def wait_for(self, word: str) -> None:
        """Until it has said this; raises if it ends before."""
        deadline = time.monotonic() + _PATIENCE_S
        while word.encode() not in self._said:
            if not self.runs or time.monotonic() > deadline:
                raise RuntimeError(f"a process that was to say {word!r} did not; it said {bytes(self._said[-200:])!r}")
            time.sleep(0.001)

    def kill(self) -> list[list[str]]:
        """The words of every whole line it had written when SIGKILL came; raises if it had ended by itself."""
        self._process.kill()
        return self.killed()

    def killed(self) -> list[list[str]]:
        """The same when somebody else kills it."""
        said = self.end()
        if self._process.exitcode != -9:
            raise RuntimeError(f"a process ended by itself, with exit code {self._process.exitcode}")
        return said

    def stop(self) -> list[list[str]]:
        """Kills it, but it may have ended by itself."""
        self._process.kill()
        return self.end()

    def end(self) -> list[list[str]]:
        """The same when it has ended by itself."""
        self._process.join()
        self._listener.join()
        return self.said

    @property
    def said(self) -> list[list[str]]:
        """The words of every whole line so far."""
        said = bytes(self._said)
        return [line.split() for line in said[: said.rfind(b"\n") + 1].decode().splitlines()]

    def _listen(self, mine: Connection) -> None:
        while chunk := os.read(mine.fileno(), 1 << 20):
            self._said += chunk
        mine.close()


def _speaking(out: Connection, target: Callable[..., None], *arguments: object) -> None:
    """In the process: what the target prints goes to `out`."""
    os.dup2(out.fileno(), 1)
    out.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    target(*arguments)


def kill_me_after(cpu_s: float) -> None:
    """SIGKILL for this process when it has had so much more of a processor, in the middle of whatever it does then.

    Measured by the kernel, so that a life is as long on a busy machine as on an idle one.
    """
    event, timer = struct.pack("Pii48x", 0, signal.SIGKILL, 0), ctypes.c_void_p()
    assert _C.timer_create(time.CLOCK_PROCESS_CPUTIME_ID, event, ctypes.byref(timer)) == 0
    assert _C.timer_settime(timer, 0, struct.pack("4l", 0, 0, 0, max(1, round(cpu_s * 1e9))), None) == 0


_C = ctypes.CDLL(None)
