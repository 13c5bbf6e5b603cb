"""Starts the process of a fold worker, talks to it, and knows how it is and how it ended.

The command forks its first workers before it opens anything, while it has one thread: they have all modules already and
are ready at once, so that a full spool is folded by several processes from its first batch on. A process that takes the
place of a dead one is spawned, because a fork of a daemon at work would have its locks and none of its threads.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, NamedTuple

from pycrorm_async.operations.fold_worker import IGNORED, main

__all__ = ["FoldProcess", "forked"]

_CODE: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[3]); from pycrorm_async.operations.fold_worker import main;"
    " main(int(sys.argv[1]), int(sys.argv[2]))"
)
"""Not `-m`: the worker imports from where the daemon does, projections of one's own included."""


class _Child:
    """A forked child, with the part of a `Popen` that is used here."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        return self._reaped(os.WNOHANG)

    def wait(self) -> int:
        code = self._reaped(0)
        assert code is not None
        return code

    def kill(self) -> None:
        if self.poll() is None:  # not reaped, so that no other process can have its number
            os.kill(self.pid, signal.SIGKILL)

    def _reaped(self, options: int) -> int | None:
        if self._code is None:
            pid, status = os.waitpid(self.pid, options)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code


@contextmanager
def forked(count: int) -> Iterator[list[FoldProcess]]:
    """Processes for the first workers of a daemon; gone when the context is left. For a process with one thread."""
    with ExitStack() as held:
        processes: list[FoldProcess] = []
        for _ in range(count):
            processes.append(FoldProcess.fork([each.connection for each in processes]))
            held.callback(processes[-1].end)
        yield processes


class FoldProcess(NamedTuple):
    """A process and the connection to it. The process is a child of this one until `ended` has returned."""

    process: subprocess.Popen[bytes] | _Child
    connection: Connection

    @classmethod
    def fork(cls, others: list[Connection]) -> FoldProcess:
        """A copy of this process, without its connections to `others`."""
        daemon = os.getpid()
        ours, theirs = socket.socketpair()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, IGNORED)
        pid = os.fork()
        if pid == 0:
            try:
                ours.close()
                for each in others:
                    each.close()
                main(theirs.detach(), daemon)
            except BaseException:  # noqa: BLE001 - it must not run on as a second daemon
                traceback.print_exc()
            finally:
                os._exit(1)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        return cls(_Child(pid), Connection(ours.detach()))

    @classmethod
    def spawn(cls) -> FoldProcess:
        ours, theirs = socket.socketpair()
        # Blocked from its first instruction on: a Ctrl-C in a terminal must not end it before it can ignore that.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, IGNORED)
        try:
            command = [sys.executable, "-c", _CODE, str(theirs.fileno()), str(os.getpid()), json.dumps(sys.path)]
            process = subprocess.Popen(  # noqa: S603 - our own interpreter
                command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
        return cls(process, Connection(ours.detach()))

    def exchange(self, message: object) -> Any:
        """Sends this and gives the answer. Blocks; raises `EOFError` or `OSError` when the process ends."""
        self.connection.send(message)
        return self.connection.recv()

    async def ended(self) -> str:
        """How the process ended."""
        descriptor, ended = os.pidfd_open(self.process.pid), asyncio.Event()
        loop = asyncio.get_running_loop()
        loop.add_reader(descriptor, ended.set)
        try:
            await ended.wait()
        finally:
            loop.remove_reader(descriptor)
            os.close(descriptor)
        code = self.process.wait()
        return f"exited with signal {-code}" if code < 0 else f"exited with exit code {code}"

    def end(self) -> None:
        """Kills the process if it has not ended. Nothing is lost: what it had not committed is folded again."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.connection.close()

    def is_stopped(self) -> bool:
        """Whether the process is stopped, by a signal or by a debugger."""
        try:
            status = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:  # it has ended
            return False
        return status.rpartition(")")[2].split()[0] in ("T", "t")
