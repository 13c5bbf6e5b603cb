"""Start the process of a fold worker, exchange messages with it, and report how it ended.

Theory of operation. There are two ways to start a process. The `pycrorm writer` command forks its first workers before
it opens anything, while it has a single thread: they have imported all modules and are ready at once, so a full spool
is folded by several processes from the first batch on. A replacement for a dead worker is spawned, because a fork of
the running daemon would inherit locks whose owning threads do not exist in the child.

Daemon and worker share one socket pair, and every request has exactly one answer. Signals could end a child before it
installs its handlers, so SIGINT and SIGTERM are blocked around the start and unblocked by the child. The daemon is the
parent of each process and reaps it only in `_Child.poll`, `wait` and `ended`; until then the kernel cannot reuse the
pid, so `kill` always hits this process.
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
"""The program of a spawned worker. It sets `sys.path` first, which `-m` cannot, so that it imports custom projections
from where the daemon does."""


class _Child:
    """A forked child with the interface of `Popen` that `FoldProcess` uses."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        return self._reap(os.WNOHANG)

    def wait(self) -> int:
        code = self._reap(0)
        assert code is not None
        return code

    def kill(self) -> None:
        if self.poll() is None:  # not reaped, so no other process can have its pid
            os.kill(self.pid, signal.SIGKILL)

    def _reap(self, options: int) -> int | None:
        if self._code is None:
            pid, status = os.waitpid(self.pid, options)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code


@contextmanager
def forked(count: int) -> Iterator[list[FoldProcess]]:
    """Fork the first workers of a daemon, and end them with the context. The calling process must have one thread."""
    with ExitStack() as stack:
        processes: list[FoldProcess] = []
        for _ in range(count):
            processes.append(FoldProcess.fork([each.connection for each in processes]))
            stack.callback(processes[-1].end)
        yield processes


class FoldProcess(NamedTuple):
    """A worker process and the connection to it. It stays a child of this process until `ended` returns."""

    process: subprocess.Popen[bytes] | _Child
    connection: Connection

    @classmethod
    def fork(cls, others: list[Connection]) -> FoldProcess:
        """Fork this process; the child closes its copies of the connections to `others`."""
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
            except BaseException:  # noqa: BLE001 - the child must not return into the daemon's code
                traceback.print_exc()
            finally:
                os._exit(1)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        return cls(_Child(pid), Connection(ours.detach()))

    @classmethod
    def spawn(cls) -> FoldProcess:
        """Start a new interpreter for a worker."""
        ours, theirs = socket.socketpair()
        # The child inherits the blocked signals, so that a Ctrl-C cannot end it before it ignores them.
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
        """Send a message and return the answer. Blocks; raises `EOFError` or `OSError` when the process ends."""
        self.connection.send(message)
        return self.connection.recv()

    async def ended(self) -> str:
        """Wait for the end of the process; return its cause as text."""
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
        """Kill the process if it is running. Nothing is lost: its uncommitted events are folded again."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.connection.close()

    def is_stopped(self) -> bool:
        """Return whether the process is stopped, by a signal or by a debugger."""
        try:
            status = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:  # it has ended
            return False
        return status.rpartition(")")[2].split()[0] in ("T", "t")
