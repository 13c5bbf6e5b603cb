"""Processes to be killed that begin at once: forked from one that has imported everything already.

What they write to their output is in a pipe, which holds it when they die; their input is a pipe too.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection

from tests.commands import FORKED, fork

__all__ = ["Forked"]

_HANGS_S = 300.0


class Forked:
    """One process that calls `target`, and all it said."""

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        mine, its_output = FORKED.Pipe(duplex=False)
        its_input, self._input = FORKED.Pipe(duplex=False)
        self.process = FORKED.Process(target=_speaking, args=(its_input, its_output, target, *arguments))
        fork(self.process)
        its_input.close()
        its_output.close()
        self._output = mine
        self._bytes = bytearray()
        self._first = threading.Event()
        self._reader = threading.Thread(target=self._listen)
        self._reader.start()

    def wait_for_its_first_words(self) -> None:
        assert self._first.wait(_HANGS_S), "it says nothing"
        assert self._bytes, f"it ended without a word, with exit code {self.process.exitcode}"

    def kill(self) -> None:
        self.process.kill()
        self.wait()

    def tell(self) -> None:
        """Writes a byte to its input."""
        os.write(self._input.fileno(), b"!")

    def tell_to_stop(self) -> None:
        """Closes its input."""
        self._input.close()

    def wait(self) -> int:
        """Its exit code, when it has ended."""
        self.process.join(timeout=_HANGS_S)
        assert self.process.exitcode is not None, "it does not end"
        self._reader.join()
        self._output.close()
        self._input.close()
        return self.process.exitcode

    @property
    def said(self) -> list[str]:
        """The lines that are whole."""
        whole = bytes(self._bytes)
        return whole[: whole.rfind(b"\n") + 1].decode().splitlines()

    def _listen(self) -> None:
        while chunk := os.read(self._output.fileno(), 1 << 16):
            self._bytes += chunk
            self._first.set()
        self._first.set()


def _speaking(its_input: Connection, output: Connection, target: Callable[..., None], *arguments: object) -> None:
    os.dup2(its_input.fileno(), 0)
    os.dup2(output.fileno(), 1)
    its_input.close()
    output.close()
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    target(*arguments)
