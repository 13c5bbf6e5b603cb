"""Start child processes, each with a connection to its parent, and report how they ended.

    child = ChildProcess.start(serve_requests, "pycrorm fold worker")
    answer = child.exchange(request)

Theory of operation. There are three ways to start a process. The `pycrorm writer` command forks its first fold workers
before it opens anything, while it has a single thread: they have imported all modules and are ready at once, so a full
spool is folded by several processes from the first batch on. All other processes need an interpreter of their own,
because a fork of a running program would inherit locks whose owning threads do not exist in the child. A process that
dies with its parent is spawned. Others are forked from the fork server of multiprocessing, which has imported the
module of the entry and has a single thread: of several, only the first waits for the imports. Both import the main
module, so a script must start them below `if __name__ == "__main__":`.

A terminal or a service manager sends SIGINT and SIGTERM to every process, but only the parent reacts, and ends its
children. These signals could end a child before it ignores them, so they are blocked around the start and unblocked by
the child. A child ends with its connection: the end of file arrives when the parent closes it or dies. With
`dies_with_parent` the kernel also kills it when the parent dies, even while it is stopped or busy.

The parent reaps a child only in `ended` and `end`; until then the kernel cannot reuse the pid, so `kill` always hits
this process. The fork server reaps its children itself, so `kill` first looks whether the process has ended.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable
from contextlib import suppress
from importlib import import_module
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final, NamedTuple

_IGNORED: Final = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG: Final = 1


class ChildProcess(NamedTuple):
    """A child process and the connection to it."""

    process: BaseProcess
    connection: Connection

    @classmethod
    def start(
        cls,
        entry: Callable[..., None],
        name: str,
        *args: object,
        dies_with_parent: bool = True,
        fork_beside: Iterable[ChildProcess] | None = None,
    ) -> ChildProcess:
        """Start a process that calls `entry` with its connection and `args`, which it receives pickled unless forked.

        Args:
            dies_with_parent: the kernel kills the process when the calling one dies.
            fork_beside: fork the calling process, which must have one thread, and close the child's copies of the
                connections to these children.

        Raises `OSError` if the system starts no process, and in a daemonic process of multiprocessing (such as a worker
        of its `Pool`), which must not start any.
        """
        if multiprocessing.current_process().daemon:
            raise OSError("a daemonic process of multiprocessing cannot start processes")
        method = "fork" if fork_beside is not None else "spawn" if dies_with_parent else "forkserver"
        context: Any = multiprocessing.get_context(method)
        if method == "forkserver":
            context.set_forkserver_preload([entry.__module__])  # ignored if the server is running
        ours, theirs = context.Pipe()
        inherited = [] if fork_beside is None else [ours, *(each.connection for each in fork_beside)]
        if fork_beside is None:
            resource_tracker.ensure_running()  # its start unblocks the signals, so it must come first
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _IGNORED)
        try:
            process = context.Process(
                target=_run,
                args=(_Entry(entry), theirs, *args),
                kwargs={"inherited": inherited, "dies_with_parent": dies_with_parent},
                name=name,
                daemon=True,
            )
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()  # while this process holds that end too, the child's death would not be an end of file
        return cls(process, ours)

    @property
    def pid(self) -> int:
        assert self.process.pid is not None, "started"
        return self.process.pid

    def exchange(self, message: object) -> Any:
        """Send a message and return the answer. Blocks; raises `EOFError` or `OSError` when the process ends."""
        self.connection.send(message)
        return self.connection.recv()

    async def ended(self) -> int:
        """Wait for the end of the process; return its exit code, which is negative for a signal."""
        ended = asyncio.Event()
        loop = asyncio.get_running_loop()
        loop.add_reader(self.process.sentinel, ended.set)
        try:
            await ended.wait()
        finally:
            loop.remove_reader(self.process.sentinel)
        self.process.join()
        assert self.process.exitcode is not None
        return self.process.exitcode

    def kill(self) -> None:
        """Kill the process unless it has ended."""
        if self.process.is_alive():
            self.process.kill()

    def end(self) -> None:
        """Kill the process if it is running, and reap it."""
        self.kill()
        self.process.join()
        self.connection.close()

    def is_stopped(self) -> bool:
        """Return whether the process is stopped, by a signal or by a debugger."""
        try:
            status = Path(f"/proc/{self.pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:  # it has ended
            return False
        return status.rpartition(")")[2].split()[0] in ("T", "t")


class _Entry(NamedTuple):
    """The function that a child calls. A spawned child imports it without garbage collections.

    Nothing becomes garbage while modules are loaded, and collections would take a sixth of the start.
    """

    function: Callable[..., None]

    def __call__(self, *args: object) -> None:
        self.function(*args)

    def __reduce__(self) -> tuple[Callable[[str, str], _Entry], tuple[str, str]]:
        return _import_entry, (self.function.__module__, self.function.__qualname__)


def _import_entry(module: str, name: str) -> _Entry:
    gc.disable()
    try:
        return _Entry(getattr(import_module(module), name))
    finally:
        gc.freeze()
        gc.enable()


def _run(
    entry: Callable[..., None],
    connection: Connection,
    *args: object,
    inherited: Iterable[Connection],
    dies_with_parent: bool,
) -> None:
    """Prepare the child and call `entry` in it."""
    for each in inherited:
        each.close()
    for number in _IGNORED:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _IGNORED)
    parent = multiprocessing.parent_process()
    if dies_with_parent and parent is not None:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent.pid:  # the parent died before the call above
            os._exit(0)
    with connection, suppress(EOFError, ConnectionError):
        entry(connection, *args)
