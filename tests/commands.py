"""Run the command `pycrorm`: in this process, or as a user does in one of its own."""

import asyncio
import atexit
import contextlib
import gc
import io
import json
import logging
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import IO, Any, Final, NoReturn
from unittest import mock

from pycrorm_async.operations.workers import ChildProcess

COMMAND = [sys.executable, "-W", "error", "-m", "pycrorm_async"]


def environment() -> dict[str, str]:
    """Return the user's environment without the package's settings, and wide enough that no line is wrapped."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYCRORM_")}
    return kept | {"COLUMNS": "200", "PYTHONPATH": str(Path(__file__).parent.parent), "NO_COLOR": "1"}


_VERBS = (
    "ask copy demo diff episodes events export import_ learn query rebuild run show spool status verify writer"
).split()
_PROGRAM = [f"pycrorm_async.cli.{name}" for name in ("main", *_VERBS)]
_LOADED = ["tests.no_collections", *_PROGRAM, "tests.commands", "tests.preloaded"]
_starting = threading.Lock()
FORKED: Final = multiprocessing.get_context("forkserver")
"""Makes processes by forking one that has loaded the program. A test process has one such server, see `fork`."""


def start_server() -> None:
    """Start the server of `FORKED`, unless it runs; before the program starts it, which would load less."""
    with _starting:
        FORKED.set_forkserver_preload(_LOADED)
        with mock.patch.dict(os.environ, environment(), clear=True):
            forkserver.ensure_running()


def fork(process: ForkServerProcess) -> None:
    """Start a process of `FORKED`, always from a server that has loaded the same modules."""
    start_server()
    with _starting:
        process.start()


def fork_child(entry: Callable[..., None], name: str, *args: object) -> ChildProcess:
    """Start a child process as `ChildProcess.start` does, but forked likewise, and with this process's environment.

    Importing takes a spawned one 0.7 s. The kernel does not kill this one when the test process dies.
    """
    start_server()
    return ChildProcess.start(_run_child, name, dict(os.environ), entry, *args, dies_with_parent=False)


def _run_child(connection: Connection, settings: dict[str, str], entry: Callable[..., None], *args: object) -> None:
    os.environ.clear()
    os.environ.update(settings)
    entry(connection, *args)


_IN_PROCESS = frozenset(
    "ask copy datasette-metadata diff episodes events export import picture plot query rebuild recall report roles"
    " schema show spool status tag verify watch".split()
)
"""The verbs that read, or write a file: they import no plan, start no process and end by themselves."""


def pycrorm(*arguments: str | Path, cwd: Path, timeout_s: float = 300) -> subprocess.CompletedProcess[str]:
    """Return the command's exit code, stdout and stderr.

    Verbs that read run in this process, in which everything is loaded. Others, and calls from a test that has a loop,
    have a process that is forked from one that has loaded the program and done nothing else, because loading takes a
    second and there are hundreds of calls. Calls that start `COMMAND` show that the result is the same.
    """
    words = [str(each) for each in arguments]
    if _runs_in_process(words):
        return _finished_here(words, cwd)
    return _finished(words, cwd, None, timeout_s)


def _runs_in_process(words: list[str]) -> bool:
    with suppress(RuntimeError):
        asyncio.get_running_loop()
        return False
    is_main = threading.current_thread() is threading.main_thread()
    reads = bool(words) and (words[0] in _IN_PROCESS or words[:2] == ["writer", "--once"])
    return is_main and reads and not {"--projection", "--workers"} & {*words}


def _finished_here(words: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the command in this process, and restore what it changes: streams, folder, settings, signals and logging."""
    from pycrorm_async.cli.main import main

    streams = [io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2)]
    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    loggers = [logging.getLogger(each) for each in (None, "pycrorm_async", "pycrorm_async.projections")]
    levels, root_handlers, thresholds = [each.level for each in loggers], logging.root.handlers[:], gc.get_threshold()
    logging.root.handlers[:] = []
    code: Any = 0
    with (
        contextlib.chdir(cwd),
        mock.patch.dict(os.environ, environment(), clear=True),
        mock.patch.object(sys, "argv", ["pycrorm", *words]),
        mock.patch.object(sys, "stdout", streams[0]),
        mock.patch.object(sys, "stderr", streams[1]),
        mock.patch.object(gc, "freeze"),
    ):
        try:
            main()
        except SystemExit as leaving:
            code = leaving.code or 0
        finally:
            logging.root.handlers[:] = root_handlers
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
            for number, handler in handlers.items():
                signal.signal(number, handler)
            gc.set_threshold(*thresholds)
    for each in streams:
        each.seek(0)
        each.reconfigure(errors="replace")
    return subprocess.CompletedProcess(words, code, *(each.read() for each in streams))


def run_script(
    script: str, *arguments: str | Path, cwd: Path | None = None, timeout_s: float = 300
) -> subprocess.CompletedProcess[str]:
    """Return exit code, stdout and stderr of a Python script, run as `python -c` in a process that is forked likewise.

    It finds the package imported. A script whose imports matter needs an interpreter of its own.
    """
    return _finished([str(each) for each in arguments], cwd or Path.cwd(), script, timeout_s)


def _finished(words: list[str], cwd: Path, script: str | None, timeout_s: float) -> subprocess.CompletedProcess[str]:
    with tempfile.TemporaryDirectory() as folder:
        outputs = [Path(folder) / name for name in ("out", "err")]
        process = FORKED.Process(target=_run_to_files, args=(words, str(cwd), script, *map(str, outputs)))
        fork(process)
        process.join(timeout_s)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(words, timeout_s)
        return subprocess.CompletedProcess(words, process.exitcode, *(each.read_text() for each in outputs))


class Started:
    """A command that runs beside the test, forked likewise, with what tests use of a `subprocess.Popen`.

    With `output`, stdout and stderr are appended to this file; otherwise they are pipes of text.
    """

    def __init__(self, *arguments: str | Path, cwd: Path, output: Path | None = None, **settings: str) -> None:
        self.stdout, out = _pipe()
        self.stderr, err = _pipe()
        words = [str(each) for each in arguments]
        place = None if output is None else str(output)
        self._process = FORKED.Process(target=_run_beside, args=(words, str(cwd), settings, out, err, place))
        fork(self._process)
        out.close()
        err.close()
        if output is not None:
            self.stdout.close()
            self.stderr.close()
        self._reaping = threading.Lock()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        """Return the exit code; None while the process runs. Of several threads, only one can read the code."""
        with self._reaping:
            return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        return self.poll()

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float = 300) -> int:
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("pycrorm", timeout)
            time.sleep(0.005)
        return code

    def communicate(self, timeout: float = 300) -> tuple[str, str]:
        """Return the rest of stdout and stderr once the process has ended and closed them."""
        rest = {}

        def read(name: str, stream: IO[str]) -> None:
            with stream:
                rest[name] = stream.read()

        streams = (("out", self.stdout), ("err", self.stderr))
        readers = [threading.Thread(target=read, args=each, daemon=True) for each in streams if not each[1].closed]
        for each in readers:
            each.start()
        self.wait(timeout)
        for each in readers:
            each.join()
        return rest.get("out", ""), rest.get("err", "")


def _pipe() -> tuple[IO[str], Connection]:
    mine, its = FORKED.Pipe(duplex=False)
    with mine:
        return os.fdopen(os.dup(mine.fileno()), encoding="utf-8"), its


def _run_to_files(arguments: list[str], cwd: str, script: str | None, out: str, err: str) -> NoReturn:
    for path, stream in ((out, 1), (err, 2)):
        _redirect(stream, path)
    _run(arguments, cwd, {}, script)


def _run_beside(
    arguments: list[str], cwd: str, settings: dict[str, str], out: Connection, err: Connection, output: str | None
) -> NoReturn:
    for pipe, stream in ((out, 1), (err, 2)):
        if output is None:
            os.dup2(pipe.fileno(), stream)
        else:
            _redirect(stream, output)
        pipe.close()
    # The streams of the server remember that they are files with a position.
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", buffering=1, closefd=False)
    _run(arguments, cwd, settings)


def _redirect(stream: int, path: str) -> None:
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(file, stream)
    os.close(file)


def _run(arguments: list[str], cwd: str, settings: dict[str, str], script: str | None = None) -> NoReturn:
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment() | settings)
    sys.path.insert(0, cwd)
    sys.argv = ["pycrorm", *arguments]
    warnings.simplefilter("error")
    code: Any = 0
    try:
        if script is None:
            runpy.run_module("pycrorm_async", run_name="__main__", alter_sys=False)
        else:
            sys.modules["__main__"] = module = ModuleType("__main__")
            exec(script, module.__dict__)
    except SystemExit as leaving:
        code = leaving.code or 0
    except BaseException:  # noqa: BLE001  as the interpreter would
        traceback.print_exc()
        code = 1
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def answer(*arguments: str | Path, cwd: Path, code: int = 0) -> Any:
    """Return the JSON document of a `--json` call that ends with this code."""
    done = pycrorm(*arguments, "--json", cwd=cwd)
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout)


def one_line_of(done: subprocess.CompletedProcess[str]) -> str:
    """Return the one line on stderr; fail if there is a traceback or more than that line."""
    assert "Traceback" not in done.stderr, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    return lines[0]


# === note plan ================================================================================================
#
# A plan that takes three notes, for tests of the command.

NOTES_PLAN = """
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    async def perform(self): ...

async def plan():
    '''Take three notes.'''
    for text in "abc":
        await NoteActionPerformable(text).perform()
"""
