"""Start processes without delay and kill them: they fork from a server process that has imported everything.

A process's output and input are pipes, and the output pipe keeps what a killed process wrote.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from sqlalchemy import Engine, event

from tests.commands import FORKED, Started, fork

__all__ = ["DaemonProcess", "ForkedProcess", "die_after", "die_at_statement"]

_HANGS_S = 900.0
"""A process that takes longer hangs. On a busy machine one may need minutes to start."""


def die_at_statement(last: int) -> Callable[[], None]:
    """Kill this process before the statement or commit number `last`; 0: never. Returns what prints their count."""
    count = 0

    def die_at_last(*_: object) -> None:
        nonlocal count
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)

    event.listen(Engine, "before_cursor_execute", die_at_last)
    event.listen(Engine, "commit", die_at_last)
    return lambda: print(count, flush=True)


def die_after(cpu_s: float) -> None:
    """Let the kernel kill this process after so much more CPU time: equally much on a busy and on an idle machine."""
    event, timer = struct.pack("Pii48x", 0, signal.SIGKILL, 0), ctypes.c_void_p()
    kernel = ctypes.CDLL(None)
    assert kernel.timer_create(time.CLOCK_PROCESS_CPUTIME_ID, event, ctypes.byref(timer)) == 0
    assert kernel.timer_settime(timer, 0, struct.pack("4l", 0, 0, 0, max(1, round(cpu_s * 1e9))), None) == 0


class ForkedProcess:
    """A process that calls `target`, and the lines that it wrote. A thread reads them, so that it never blocks."""

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        mine, its_output = FORKED.Pipe(duplex=False)
        its_input, self._input = FORKED.Pipe(duplex=False)
        self.process = FORKED.Process(target=_run_with_pipes, args=(its_input, its_output, target, *arguments))
        fork(self.process)
        atexit.register(self.process.kill)  # an interrupted program must not wait for it
        its_input.close()
        its_output.close()
        self._output = mine
        self._bytes = bytearray()
        self._first = threading.Event()
        self._reader = threading.Thread(target=self._read_output)
        self._reader.start()

    def wait_for_first_output(self) -> None:
        assert self._first.wait(_HANGS_S), "it says nothing"
        assert self._bytes, f"it ended without a word, with exit code {self.process.exitcode}"

    def wait_for(self, text: str) -> None:
        """Wait until the output contains this text; raise `RuntimeError` if the process ends before."""
        deadline = time.monotonic() + _HANGS_S
        while text.encode() not in self._bytes:
            if not self.process.is_alive() or time.monotonic() > deadline:
                raise RuntimeError(f"the process did not print {text!r}; its last output is {self._bytes[-200:]!r}")
            time.sleep(0.001)

    def kill(self) -> None:
        self.process.kill()
        self.wait()

    def wait_until_killed(self) -> list[list[str]]:
        """Wait until another process, or the kernel, kills it; return the words of its lines."""
        assert self.wait() == -signal.SIGKILL, self.lines[-3:]
        return self.words

    def kill_and_read(self) -> list[list[str]]:
        """Kill it, which must not have ended by itself; return the words of its lines."""
        self.process.kill()
        return self.wait_until_killed()

    def send_byte(self) -> None:
        """Write one byte to the input of the process."""
        os.write(self._input.fileno(), b"!")

    def request_stop(self) -> None:
        """Close the input of the process."""
        self._input.close()

    def wait(self) -> int:
        """Wait until the process has ended, and return its exit code."""
        self.process.join(timeout=_HANGS_S)
        assert self.process.exitcode is not None, "it does not end"
        self._reader.join()
        self._output.close()
        self._input.close()
        return self.process.exitcode

    @property
    def words(self) -> list[list[str]]:
        """The words of each complete line that the process has written so far."""
        return [each.split() for each in self.lines]

    @property
    def lines(self) -> list[str]:
        """The complete lines that the process has written so far."""
        whole = bytes(self._bytes)
        return whole[: whole.rfind(b"\n") + 1].decode().splitlines()

    def _read_output(self) -> None:
        while chunk := os.read(self._output.fileno(), 1 << 16):
            self._bytes += chunk
            self._first.set()
        self._first.set()


class DaemonProcess(Started):
    """`pycrorm writer` in a process of its own, which appends its lines to a file beside the spool."""

    def __init__(self, url: str, spool: Path) -> None:
        self.log = spool.with_name("daemon.log")
        self._lines_before = len(self.log.read_text()) if self.log.exists() else 0
        super().__init__("writer", "--url", url, "--spool", spool, cwd=spool.parent, output=self.log)

    def wait_for(self, words: str) -> None:
        """Wait until it has written these words."""
        deadline = time.monotonic() + _HANGS_S
        while words not in self.lines:
            assert self.poll() is None, self.lines
            assert time.monotonic() < deadline, self.lines
            time.sleep(0.01)

    @property
    def lines(self) -> str:
        return self.log.read_text()[self._lines_before :] if self.log.exists() else ""

    def stop(self) -> int:
        """Ask it to end, and return its exit code."""
        self.send_signal(signal.SIGTERM)
        return self.wait()

    def kill_and_wait(self) -> None:
        self.kill()
        self.wait()


def _run_with_pipes(its_input: Connection, output: Connection, target: Callable[..., None], *arguments: object) -> None:
    os.dup2(its_input.fileno(), 0)
    os.dup2(output.fileno(), 1)
    its_input.close()
    output.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    target(*arguments)
