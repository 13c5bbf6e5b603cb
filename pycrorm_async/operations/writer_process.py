"""Run the private writer process of one memory (`writer="process"`), and start another when it dies.

    process = WriterProcess(WriterAssignment(address, spool, recorder, settings))
    process.start()                   # returns at once; the process is ready after a second or two
    await process.end(at_once=False)  # once everything is visible

Theory of operation. The actors are the *owner*, which is the process of the plan, a watching thread in it, and the
*writer process*. The owner writes to its folder in the spool and never waits for the writer process. The writer process
is a daemon (`writer.daemon`) that claims this one folder and those of dead recorders, and leaves other living recorders
to their own writers, so that several memories of one spool do not compete. It takes no lock of the spool: a `pycrorm
writer` may run beside it, and the folders' `drain` locks decide which of them drains which folder.

The watching thread starts the writer process, logs the lines that it sends, and starts another one when it ends before
the owner asked for that. It is a thread, because the plan's loop may be closed, or not run for minutes. Nothing is lost
in between: the writer process acknowledges a record after the database has committed it, and its successor continues
behind the last acknowledged one.

The writer process ends when the owner asks for it, or is dead. It learns of the death from the end of its connection,
or, because a forked child of the owner may keep that open, from the lock `alive` of the owner's folder. Then it
recovers the folder as any dead one, and ends when nothing is left in it or nothing was stored for `flush_timeout_s`.
A terminal sends SIGINT and SIGHUP, and a service manager SIGTERM, to both processes: only the owner reacts.

The process is a new interpreter. A fork would copy locks whose owning threads do not exist in it, and a process of
`multiprocessing` would import the plan's main module and so perform again a plan that stands there unguarded.
"""

import asyncio
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Final, NamedTuple

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import PycrormError
from pycrorm_async.operations.daemon import Folders
from pycrorm_async.operations.destination import open_destination
from pycrorm_async.operations.workers import readable
from pycrorm_async.queue.locks import ALIVE, call_in_forked_child, is_locked
from pycrorm_async.queue.spool import Spool
from pycrorm_async.queue.stored_segments import StoredSegments
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.writer.daemon import STOP_S, Daemon, one_line
from pycrorm_async.writer.drain import Backoff

_RESTARTS: Final = Backoff(first_s=0.1, longest_s=60.0)
"""Pauses before another process is started."""
_HEALTHY_S: Final = 60.0
"""A process that lived this long is replaced after the first, shortest pause."""
_LOOK_S: Final = 0.5
"""Interval at which each side looks whether the other one lives, besides waiting for the end of the connection."""
_IGNORED: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_CLOSED: Final = "closed"
"""The owner's only message after the assignment: its queue is drained and closed."""
_COMMAND: Final = "from pycrorm_async.operations.writer_process import main; main()"

_log = logging.getLogger("pycrorm_async")


class WriterAssignment(NamedTuple):
    """The database, and the recorder's folder in the spool; `recorder` is its name."""

    address: DatabaseAddress
    spool: Path
    recorder: str
    settings: Settings


class Line(NamedTuple):
    """A line for the owner's log."""

    level: int
    text: str


class WriterProcessState(NamedTuple):
    """The writer process, for `memory.status`.

    Attributes:
        pid: of the process; None between two processes.
        restarts: the number of processes that died and were replaced.
        reason: why the last one ended; None if none did.
    """

    pid: int | None = None
    restarts: int = 0
    reason: str | None = None


# === in the plan's process ====================================================================================


class WriterProcess:
    """The writer process of one memory. Implements the writer's `PrivateProcess`."""

    def __init__(self, assignment: WriterAssignment) -> None:
        self.state = WriterProcessState()
        self._assignment = assignment
        self._ending = threading.Event()
        self._is_closed = False
        self._started: tuple[subprocess.Popen[bytes], Connection] | None = None
        self._thread = threading.Thread(target=self._watch, name="pycrorm writer process", daemon=True)
        call_in_forked_child(self._leave_to_parent)

    def start(self) -> None:
        """Start the process in the background. A failure is logged, and tried again with pauses."""
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """True from the start of a process to its end, also while it does not drain yet."""
        return self.state.pid is not None

    @property
    def reason(self) -> str | None:
        """The reason why the last process ended."""
        return self.state.reason

    def leave(self) -> None:
        """Let the process store what is left, as after the owner's death, and start no other one."""
        self._ending.set()

    async def end(self, *, at_once: bool) -> None:
        """End the process, and wait until it has ended: by a kill if `at_once`, or if it takes longer than `STOP_S`.

        What is not stored then stays in the spool.
        """
        self._ending.set()
        self._is_closed = True
        self._ask_to_end(kill=at_once)
        deadline_s = time.monotonic() + STOP_S
        while self._thread.is_alive():
            await asyncio.sleep(0.005)
            if time.monotonic() > deadline_s:
                self._ask_to_end(kill=True)

    def _ask_to_end(self, *, kill: bool) -> None:
        if self._started is None:
            return
        process, connection = self._started
        if kill:
            process.kill()  # does nothing once it is reaped
        else:
            with suppress(OSError):
                connection.send(_CLOSED)

    def _leave_to_parent(self) -> None:
        """Close a forked child's copy of the connection, so that the parent's death ends it."""
        if self._started is not None:
            process, connection = self._started
            connection.close()
            process.returncode = 0  # not this process' child: without this, its destructor would warn

    # --- in the watching thread ------------------------------------------------------------------------------

    def _watch(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, _IGNORED)  # inherited by the process until it ignores them
        deaths, logged = 0, ""
        while not self._ending.is_set():
            began_s = time.monotonic()
            try:
                reason = self._run_process()
            except OSError as error:
                reason = f"cannot be started: {error}"
            pid, lived_s = self.state.pid, time.monotonic() - began_s
            self.state = WriterProcessState(None, self.state.restarts, reason)
            if self._ending.is_set():
                return
            deaths = 1 if lived_s >= _HEALTHY_S else deaths + 1
            pause_s = _RESTARTS.pause_s(deaths, 1.0)
            assert pause_s is not None, "there is no last attempt"
            if reason != logged:
                name = "the writer process" + (f" (pid {pid})" if pid is not None else "")
                _log.warning("%s %s; starting another in %g s; nothing recorded is lost", name, reason, pause_s)
                logged = reason
            self._ending.wait(pause_s)
            self.state = self.state._replace(restarts=self.state.restarts + 1)

    def _run_process(self) -> str:
        """Run one process to its end; return the cause of the end. Raises `OSError` if it cannot be started."""
        if not sys.executable:
            raise OSError("this program does not name its Python interpreter (sys.executable)")
        ours, theirs = Pipe()
        with ours:
            with theirs:
                process = subprocess.Popen(  # noqa: S603 - no part of the command comes from outside
                    [sys.executable, "-P", "-c", _COMMAND, str(theirs.fileno())],
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                )
            with process:
                self._started = process, ours
                self.state = self.state._replace(pid=process.pid)
                failure = None
                try:
                    ours.send(self._assignment)
                    if self._is_closed:  # asked before `_started` was set
                        ours.send(_CLOSED)
                    failure = self._follow(process, ours)
                except (EOFError, OSError):
                    pass
                finally:
                    process.wait()
                    self._started = None
        code = process.returncode
        return failure or (f"was killed by signal {-code}" if code < 0 else f"exited with code {code}")

    def _follow(self, process: subprocess.Popen[bytes], connection: Connection) -> str:
        """Log the lines of a process until it reports that it fails. Raises `EOFError` when it has ended."""
        while True:
            if not wait([connection], _LOOK_S):
                if process.poll() is not None:  # and a forked child of this process keeps its end open
                    raise EOFError
                continue
            match connection.recv():
                case Line(level, text):
                    _log.log(level, "%s", text)
                case str(failure):
                    return failure


# === in the writer process ====================================================================================


def main() -> None:
    """Drain one recorder's folder, and dead ones, until its owner closes it, or is dead and its folder empty."""
    for number in _IGNORED:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _IGNORED)
    owner = _Owner(Connection(int(sys.argv[1])))
    os.set_inheritable(owner.connection.fileno(), False)  # noqa: FBT003  its only form
    collect_seldom()
    _log.addHandler(owner)
    _log.propagate = False
    try:
        assignment = owner.connection.recv()
        asyncio.run(_serve(assignment, owner))
    except EOFError:
        pass
    except BaseException as error:  # noqa: BLE001 - the owner logs it, and starts another process
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        owner.send(f"ended: {one_line(error)}")
        os._exit(1)
    os._exit(0)


class _Owner(logging.Handler):
    """The connection to the owner, which logs the lines of this process."""

    def __init__(self, connection: Connection) -> None:
        super().__init__()
        self.connection = connection
        self.has_closed = False

    def send(self, message: Line | str) -> None:
        with suppress(OSError):  # the owner is dead
            self.connection.send(message)

    def emit(self, record: logging.LogRecord) -> None:
        self.send(Line(record.levelno, record.getMessage()))

    def report(self, line: str) -> None:
        self.send(Line(logging.INFO, line))

    async def ended(self, folder: Path) -> None:
        """Return when the owner has closed its queue or is dead."""
        while is_locked(folder / ALIVE):
            try:
                async with asyncio.timeout(_LOOK_S):
                    await readable(self.connection.fileno())
            except TimeoutError:
                continue
            with suppress(EOFError, OSError):
                self.has_closed = self.connection.recv() == _CLOSED
            return


async def _serve(assignment: WriterAssignment, owner: _Owner) -> None:
    address, settings, stop = assignment.address, assignment.settings, asyncio.Event()
    spool = Spool(assignment.spool, settings.file_access)
    folder = assignment.spool / assignment.recorder
    async with open_destination(address, spool, clock=SYSTEM_CLOCK, settings=settings) as destination:
        stored = StoredSegments(spool.path, settings, wall_ns=SYSTEM_CLOCK.wall_ns)
        folders = Folders(spool, destination.log_id, address, stored, recorder=assignment.recorder)

        async def stop_when_over() -> None:
            await owner.ended(folder)
            writes, since_s = destination.writes, time.monotonic()
            while not owner.has_closed and folder.exists():  # the daemon recovers and deletes it
                await asyncio.sleep(0.02)
                if destination.writes != writes:
                    writes, since_s = destination.writes, time.monotonic()
                elif time.monotonic() - since_s > settings.flush_timeout_s:
                    break
            stop.set()

        async with asyncio.TaskGroup() as tasks:
            waiting = tasks.create_task(stop_when_over(), name="pycrorm owner")
            await Daemon(destination, folders, settings=settings, report=owner.report).run(stop)
            waiting.cancel()
        # The daemon stops when the tables show everything: custom projections and views may be behind them.
        with suppress(PycrormError, TimeoutError):
            async with asyncio.timeout(STOP_S / 2):
                await destination.fold()
