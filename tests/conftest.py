"""Fixtures for databases: all tests share one PostgreSQL server, which starts in half a second at the first use."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import AsyncIterator, Generator, Iterator
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, settings

from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.bullet import reuse_clients
from tests.commands import fork_child
from tests.databases import PARTITIONS, Server, put_memory, server_in_memory
from tests.long_modules import long_modules_first
from tests.report.browser import Browser, browser, chromium
from tests.soak_turns import current_commit, place_of, runs_in_turns, turn_of

# A busy machine must not fail a test by its time; Hypothesis measures its deadline on the wall clock.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A server whose paths are short enough for a socket."""
    with server_in_memory() as running:
        yield running


@pytest.fixture(scope="session")
def chrome(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Return a running browser, one for each test process; skip the test without one."""
    if chromium() is None:
        pytest.skip("no Chromium is installed")
    with browser(tmp_path_factory.mktemp("chromium")) as running:
        yield running


@pytest.fixture(params=["sqlite", "postgresql"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """The URL of a new, empty memory, for each test on both kinds of database.

    For a test marked `empty_database` it holds no memory: the PostgreSQL database is empty, and the SQLite file does
    not exist.
    """
    is_empty = request.node.get_closest_marker("empty_database") is not None
    if request.param == "sqlite":
        file = tmp_path / "memory.db"
        yield f"sqlite:///{file}" if is_empty else put_memory(file)
        return
    running: Server = request.getfixturevalue("server")
    url = running.new_database() if is_empty else running.new_memory()
    yield url
    running.drop_soon(url)  # several hundred files, which would be written to the disk and deleted at the end


@pytest.fixture
async def log(database_url: str) -> AsyncIterator[EventLog]:
    """A new log, for each test on both kinds of database."""
    opened = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    yield opened
    await opened.close()


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def module_database_url(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A new memory of each kind for all tests of a module, which fill it once and then only read it."""
    if request.param == "sqlite":
        yield put_memory(tmp_path_factory.mktemp("memory") / "memory.db")
        return
    running: Server = request.getfixturevalue("server")
    url = running.new_memory()
    yield url
    running.drop_soon(url)


@pytest.fixture
def forked_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the fold workers that the test starts be forked instead of spawned, see `fork_child`."""
    monkeypatch.setattr("pycrorm_async.operations.workers.ChildProcess", SimpleNamespace(start=fork_child))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--soak-turn",
        nargs="?",
        const="",
        metavar="COMMIT",
        help="of the tests marked soak, run the thirtieth whose turn COMMIT is (without one: the commit checked out),"
        " with loops shortened; use with -m soak",
    )


reuse_clients()
gc.disable()  # until all tests are collected: nothing becomes garbage while modules are imported


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Import the tests in each test process in another order, so that they share the work of compiling them.

    Each would otherwise compile every file of a fresh clone, 5 s of CPU time, while the others compile the same one.
    """
    own = getattr(session.config, "workerinput", None)
    folders = [Path(each) for each in session.config.args if Path(each).is_dir()]
    if own is None or not folders:
        return
    files = sorted({file for folder in folders for file in folder.resolve().rglob("test_*.py")})
    first = len(files) * int(own["workerid"].removeprefix("gw")) // own["workercount"]
    for file in files[first:] + files[:first]:
        name = ".".join(file.relative_to(session.config.rootpath).with_suffix("").parts)
        with suppress(Exception, pytest.skip.Exception):  # the collection imports it again, and reports the error
            import_module(name)


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makeitem(
    collector: pytest.Module | pytest.Class, name: str, obj: object
) -> list[pytest.Item] | None:
    """Make no items of the tests that the marks of this run leave out: each process would only deselect them."""
    own = getattr(obj, "pytestmark", ())
    marks = {each.name for each in (*collector.iter_markers(), *(own if isinstance(own, list) else ()))}
    if "slow" in marks and runs_in_turns(collector.path, name):
        marks.add("soak")
    return [] if marks & _left_out(collector.config) else None


@pytest.hookimpl(tryfirst=True)
def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Likewise make no items of parameters that are left out, such as the seeds of the soak."""
    left_out = _left_out(metafunc.config)
    for mark in metafunc.definition.iter_markers("parametrize"):
        values = mark.args[1]
        kept = [each for each in values if not {own.name for own in getattr(each, "marks", ())} & left_out]
        if kept and isinstance(values, list) and "ids" not in mark.kwargs:
            values[:] = kept


def _left_out(config: pytest.Config) -> set[str]:
    """Return the marks that `-m` leaves out, unless a test is named on the command line, which is then deselected."""
    expression = config.option.markexpr
    if " or " in expression or any("::" in each for each in config.args):
        return set()
    return {each.removeprefix("not ") for each in expression.split(" and ") if each.startswith("not ")}


def pytest_configure() -> None:
    # Without stored bytecode each of several hundred processes that tests start would compile the package.
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a shell starts background commands with SIGINT ignored
        signal.signal(
            signal.SIGINT, signal.default_int_handler
        )  # otherwise the commands of the tests would ignore Ctrl-C too


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> Generator[None, None, None]:
    """Keep of the soak only the requested turn, and after the others of this hook run long tests early.

    pytest-randomly shuffles before this, and pytest deselects by marks at the `yield`.
    """
    _select(config, items)
    yield
    if (own := getattr(config, "workerinput", None)) is not None:
        items[:] = long_modules_first(items, own["workercount"])


def _select(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the variants that `soak_on` names as soak, and keep of the soak only the requested turn.

    On partitioned tables these variants run too: what adds no SQL of its own meets partitions only there.
    """
    for item in items:
        variants = (
            item.callspec.params.values() if isinstance(item, pytest.Function) and hasattr(item, "callspec") else ()
        )
        in_turns = item.get_closest_marker("slow") and runs_in_turns(item.path, item.name.partition("[")[0])
        has_soak_on = any(variant in mark.args for mark in item.iter_markers("soak_on") for variant in variants)
        if in_turns or (has_soak_on and not PARTITIONS):
            item.add_marker(pytest.mark.soak)
    commit = config.getoption("--soak-turn")
    if commit is None:
        return
    turn = turn_of(commit or current_commit(config.rootpath))
    others = [each for each in items if each.get_closest_marker("soak") and place_of(each.nodeid) != turn]
    left_out = set(others)
    config.hook.pytest_deselected(items=others)
    items[:] = [each for each in items if each not in left_out]


_PACKAGES_BY_EXTRA = {"world": ("pybullet", "pycram_bullet"), "learning": ("jpt",)}
_ABSENT_EXTRAS = [
    extra for extra, packages in _PACKAGES_BY_EXTRA.items() if not any(find_spec(each) for each in packages)
]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip a test that fails with the line that names an extra to install, where this Python has no wheels of it.

    That is from Python 3.13 on; on older ones a missing extra is a fault of the environment, and the test fails.
    """
    report = yield
    if report.failed and sys.version_info >= (3, 13):
        for extra in _ABSENT_EXTRAS:
            if f"pip install 'pycrorm-async[{extra}]'" in report.longreprtext.replace("\\", ""):
                report.outcome = "skipped"
                report.longrepr = (__file__, 0, f"Skipped: needs [{extra}], which is not installed on this Python")
    return report


def pytest_collection_finish() -> None:
    """Freeze the collected tests, because each garbage collection would scan their 300,000 objects for a third of a
    second (a first one that leaves no garbage to be frozen, too); and collect seldom, because by default collections
    take a sixth of the time of the tests.
    """
    gc.freeze()
    gc.set_threshold(20_000)
    gc.enable()


@pytest.fixture
def in_turn(request: pytest.FixtureRequest) -> bool:
    """Return True in a turn of the soak, where loops of thousands of rounds are shortened."""
    return request.config.getoption("--soak-turn") is not None
