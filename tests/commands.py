"""Run the command `pycrorm` as a user does: in a process of its own."""

import atexit
import json
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
import threading
import traceback
import warnings
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, Final, NoReturn
from unittest import mock

COMMAND = [sys.executable, "-W", "error", "-m", "pycrorm_async"]


def environment() -> dict[str, str]:
    """Return the user's environment without the package's settings, and wide enough that no line is wrapped."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYCRORM_")}
    return kept | {"COLUMNS": "200", "PYTHONPATH": str(Path(__file__).parent.parent), "NO_COLOR": "1"}


_VERBS = "copy demo episodes events learn rebuild run show spool status verify writer".split()
_LOADED = [*(f"pycrorm_async.cli.{name}" for name in ("main", *_VERBS)), "tests.preloaded"]
_starting = threading.Lock()
FORKED: Final = multiprocessing.get_context("forkserver")
"""Makes processes by forking one that has loaded the program. A test process has one such server, see `fork`."""


def fork(process: ForkServerProcess) -> None:
    """Start a process of `FORKED`, always from a server that has loaded the same modules."""
    with _starting:
        FORKED.set_forkserver_preload(_LOADED)
        with mock.patch.dict(os.environ, environment(), clear=True):
            forkserver.ensure_running()
        process.start()


def pycrorm(*arguments: str | Path, cwd: Path, timeout_s: float = 300) -> subprocess.CompletedProcess[str]:
    """Return the command's exit code, stdout and stderr.

    The process is forked from one that has loaded the program and done nothing else, because loading takes a second and
    there are hundreds of calls. Calls that start `COMMAND` show that the result is the same.
    """
    with tempfile.TemporaryDirectory() as folder:
        outputs = [Path(folder) / name for name in ("out", "err")]
        words = [str(each) for each in arguments]
        process = FORKED.Process(target=_run, args=(words, str(cwd), *map(str, outputs)))
        fork(process)
        process.join(timeout_s)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(words, timeout_s)
        return subprocess.CompletedProcess(words, process.exitcode, *(each.read_text() for each in outputs))


def _run(arguments: list[str], cwd: str, out: str, err: str) -> NoReturn:
    for path, stream in ((out, 1), (err, 2)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, stream)
        os.close(file)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment())
    sys.path.insert(0, cwd)
    sys.argv = ["pycrorm", *arguments]
    warnings.simplefilter("error")
    code: Any = 0
    try:
        runpy.run_module("pycrorm_async", run_name="__main__", alter_sys=False)
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
