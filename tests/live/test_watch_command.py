"""`pycrorm watch`: which requests it answers, what it prints, and one line for each mistake."""

import asyncio
import builtins
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from pycrorm_async.cli.watch import draw_episode
from pycrorm_async.errors import CallerError, DatabaseUnavailable, MissingExtra
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.live.access import kept_token, refusal
from pycrorm_async.live.follower import LogFollower
from pycrorm_async.live.server import PORT, listen
from pycrorm_async.memory import Memory
from pycrorm_async.store.address import shared_address
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow
from pycrorm_async.world import Pose
from tests.commands import COMMAND, Started, environment, one_line_of, pycrorm
from tests.databases import ask_to_change
from tests.live.conftest import Watch, robot_in

HOST = {"host": "127.0.0.1:8137"}


REQUESTS: list[tuple[str, dict[str, str], str | None]] = [
    ("/secret/", HOST, None),
    ("/secret/", {"host": "[::1]:9000"}, None),
    ("/secret/", HOST | {"origin": "http://127.0.0.1:8137"}, None),
    ("/secret/", HOST | {"sec-fetch-site": "same-origin", "sec-fetch-mode": "cors"}, None),
    ("/secret/", HOST | {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, None),
    ("/secret/", {}, "answers only under"),
    ("/secret/", {"host": "evil.example:8137"}, "answers only under"),
    ("/secret/", {"host": "127.0.0.1.evil.example"}, "answers only under"),
    ("/secret/", HOST | {"origin": "http://127.0.0.1:9999"}, "only its own pages"),
    ("/secret/", HOST | {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, "only its own pages"),
    ("/secret/", HOST | {"sec-fetch-site": "same-site", "sec-fetch-mode": "cors"}, "only its own pages"),
    ("/secret/", {"host": "evil@127.0.0.1"}, "answers only under"),
    ("", HOST, "the token in the address is wrong"),
    ("/secrét/", HOST, "the token in the address is wrong"),
    ("//secret/", HOST, "the token in the address is wrong"),
]


def test_a_request_is_answered_only_from_this_machine_with_the_token() -> None:
    for path, headers, refused in REQUESTS:
        reason = refusal(path, headers, "secret")
        assert (reason is None) if refused is None else (reason is not None and refused in reason), (path, headers)


def test_the_token_is_kept_for_the_user_alone(tmp_path: Path) -> None:
    token = kept_token(tmp_path / "new")
    kept = tmp_path / "new" / "watch.token"
    assert len(token) == 43
    assert kept_token(tmp_path / "new") == token
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    kept.chmod(0o644)  # others may have read it
    assert kept_token(tmp_path / "new") != token
    kept.write_text("short")
    assert len(kept_token(tmp_path / "new")) == 43
    (tmp_path / "file").write_text("")
    assert len(kept_token(tmp_path / "file")) == 43  # no such folder can be made


def test_a_port_in_use_is_refused_if_it_was_asked_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(CallerError, match=f"port {port} cannot be used \\(another process uses it\\)"):
            listen(port)
        with mock.patch("pycrorm_async.live.server.PORT", port), listen(None) as other:
            assert other.getsockname()[1] not in (port, PORT)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.delitem(sys.modules, "pycrorm_async.live.server")
    with pytest.raises(MissingExtra, match="pip install 'pycrorm-async\\[live\\]'"):
        builtins.__import__("pycrorm_async.live.server")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a memory: one episode that has ended."""
    made = tmp_path_factory.mktemp("watched")
    with robot_in(made) as robot:
        robot.start("one")
        robot.end("one", "FAILED", "the wheel slipped")
    return made


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("77",), 2, "there is no episode '77' (`pycrorm episodes` lists the only one)"),
        (("77", "--terminal"), 2, "there is no episode '77' (`pycrorm episodes` lists the only one)"),
        (("1", "--terminal", "--json"), 2, "--terminal serves no page: leave out --port, --open and --json"),
        (("--url", "sqlite://"), 2, "sqlite:// exists only in its own process"),
    ],
)
def test_mistakes_are_one_line(folder: Path, arguments: tuple[str, ...], code: int, message: str) -> None:
    done = pycrorm("watch", *arguments, cwd=folder, timeout_s=30)
    assert done.returncode == code
    assert message in one_line_of(done)


def test_an_event_that_cannot_be_read_is_one_line_in_the_terminal_and_on_the_page(
    watch: Callable[..., Watch], folder: Path, tmp_path: Path
) -> None:
    shutil.copy(folder / "pycrorm.db", tmp_path / "pycrorm.db")
    url = f"sqlite:///{tmp_path / 'pycrorm.db'}"
    ask_to_change(url, "DROP TRIGGER event_is_not_updated")
    ask_to_change(url, "UPDATE event SET payload = '{' WHERE sequence = 3")
    done = pycrorm("watch", "1", "--terminal", cwd=tmp_path, timeout_s=30)
    assert done.returncode == 4
    assert "event 3: " in one_line_of(done)
    ask_to_change(url, "UPDATE event SET payload = '{' WHERE sequence = 1")
    status, text = watch("--port", "0", "1", folder=tmp_path).get()
    assert (status, "event 1: " in text) == (500, True)


async def test_the_terminal_waits_while_the_database_is_unavailable_and_draws_each_event_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower = LogFollower(shared_address(f"sqlite:///{folder / 'pycrorm.db'}"))
    of_log, calls = EventLog.episode, []

    async def episode(log: EventLog, identity: EpisodeId) -> EpisodeRow | None:
        calls.append(identity)
        if len(calls) == 1:
            raise DatabaseUnavailable("the server is away")
        return await of_log(log, identity)

    monkeypatch.setattr(EventLog, "episode", episode)
    await draw_episode(follower, "1", asyncio.Event())  # returns at the episode's end
    await follower.close()
    assert len(calls) == 2


def test_an_episode_of_an_empty_memory_has_a_page_that_waits(watch: Callable[..., Watch], tmp_path: Path) -> None:
    pycrorm("writer", "--once", cwd=tmp_path)
    server = watch("--port", "0", "7", folder=tmp_path)
    status, page = server.get()
    assert (status, 'http-equiv="refresh"' in page) == (503, True)


def test_the_server_answers_its_own_pages_and_no_others(watch: Callable[..., Watch], folder: Path) -> None:
    server = watch("--port", "0", "1", folder=folder)
    assert server.printed.keys() == {"address", "port", "database"}
    status, page = server.get()
    assert (status, "connect-src 'self'" in page) == (200, True)
    root = "/".join(server.address.split("/")[3:4])
    assert server.get(f"/{root}/episode/77") == (
        404,
        "there is no episode '77' (`pycrorm episodes` lists the only one)",
    )
    assert server.get(f"/{root}/episode/1?from=99") == (404, "episode 1 has 7 events, and none from event 99")
    assert server.get(f"/{root}/episode/1", origin="http://127.0.0.1:1")[0] == 403
    assert server.get(f"/{root}/episode/1", host="evil.example")[0] == 403
    assert server.get(f"/{root[:-1]}x/episode/1")[0] == 403
    assert server.get("/")[0] == 403
    reload = (200, "event: reload\ndata: {}\n\n")  # of another episode, and of a log that went back
    assert server.get(f"/{root}/episode/1/events?id=another") == reload
    assert server.get(f"/{root}/episode/1/events?after=99") == reload
    assert server.get(f"/{root}/../episode/1")[0] in (403, 404)
    server.process.send_signal(signal.SIGINT)
    assert server.process.wait(20) == 0
    assert "Traceback" not in server.process.stderr.read()


def test_a_terminal_shows_the_tree_of_an_episode_to_its_end(folder: Path) -> None:
    done = pycrorm("watch", "1", "--terminal", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "Episode 1: a drive  SUCCEEDED" in done.stdout
    assert "1 failed · turtle at (0.00, 0.00)" in done.stdout
    assert "DriveAction  target=(1.00, 2.00, 0.00)  FAILED" in done.stdout


@pytest.mark.slow
def test_a_pipe_gets_the_whole_tree_and_an_end_of_line(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path / 'pycrorm.db'}") as memory:
        drive = memory.recording.type("action", "DriveAction", {"target": Pose})
        with memory.recording.episode(description="a drive") as episode:
            for number in range(40):
                episode.start(str(number), drive, {"target": Pose([1, 2, 0])})
                episode.end(str(number))
        memory.flush()
    done = pycrorm("watch", "1", "--terminal", cwd=tmp_path)
    assert done.stdout.count("DriveAction") == 40
    assert "not drawn" not in done.stdout
    assert done.stdout.endswith("\n")


def test_a_terminal_waits_for_the_first_episode_and_follows_it(tmp_path: Path) -> None:
    drawing = Started("watch", "last", "--terminal", cwd=tmp_path)
    assert "waiting: " in drawing.stderr.readline()
    with robot_in(tmp_path) as robot:
        robot.start("one")
        robot.end("one")
    out, _ = drawing.communicate(30)
    assert drawing.returncode == 0
    assert "DriveAction  target=(1.00, 2.00, 0.00)  SUCCEEDED" in out


@pytest.mark.slow
def test_a_terminal_shows_what_each_robot_does_until_it_is_interrupted(tmp_path: Path) -> None:
    screen, terminal = os.openpty()
    with robot_in(tmp_path) as robot, os.fdopen(screen, "rb", buffering=0) as output:
        robot.start("one")
        command = [*COMMAND, "watch", "--terminal"]
        surroundings = environment() | {"TERM": "xterm"}
        drawing = subprocess.Popen(command, cwd=tmp_path, stdout=terminal, stderr=terminal, env=surroundings)
        drawn = b""
        while b"DriveAction target=(1.00, 2.00, 0.00)" not in drawn:
            drawn += output.read(2**16)
        robot.end("one")
        while b"after DriveAction" not in drawn:
            drawn += output.read(2**16)
        drawing.terminate()
        assert drawing.wait(20) == 0
    os.close(terminal)
