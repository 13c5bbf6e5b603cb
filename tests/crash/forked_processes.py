"""Start processes without delay and kill them: they fork from a server process that has imported everything.

A process's output and input are pipes, and the output pipe keeps what a killed process wrote.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection

from tests.commands import FORKED, fork

__all__ = ["ForkedProcess"]

_HANGS_S = 300.0


class ForkedProcess:
    """A process that calls `target`, and the lines that it wrote."""

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        mine, its_output = FORKED.Pipe(duplex=False)
        its_input, self._input = FORKED.Pipe(duplex=False)
        self.process = FORKED.Process(target=_run_with_pipes, args=(its_input, its_output, target, *arguments))
        fork(self.process)
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

    def kill(self) -> None:
        self.process.kill()
        self.wait()

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
    def lines(self) -> list[str]:
        """The complete lines that the process has written so far."""
        whole = bytes(self._bytes)
        return whole[: whole.rfind(b"\n") + 1].decode().splitlines()

    def _read_output(self) -> None:
        while chunk := os.read(self._output.fileno(), 1 << 16):
            self._bytes += chunk
            self._first.set()
        self._first.set()


def _run_with_pipes(its_input: Connection, output: Connection, target: Callable[..., None], *arguments: object) -> None:
    os.dup2(its_input.fileno(), 0)
    os.dup2(output.fileno(), 1)
    its_input.close()
    output.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    target(*arguments)
