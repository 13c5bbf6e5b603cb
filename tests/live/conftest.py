"""Fixtures of the live page's tests: servers in processes of their own, and an episode that a test records."""

import http.client
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from pycrorm_async.events.types import NodeStatus
from pycrorm_async.memory import Memory
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.world import Pose
from tests.commands import Started


class Watch:
    """A running `pycrorm watch`, and the address that it printed."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        state = str(folder / "state")
        self.process = Started("watch", "--json", *arguments, cwd=folder, XDG_STATE_HOME=state)
        text = ""
        while not text.endswith("}\n"):
            line = self.process.stdout.readline()
            assert line, self.process.stderr.read()
            text += line
        self.printed = json.loads(text)
        self.address: str = self.printed["address"]
        self.port: int = self.printed["port"]

    def get(self, path: str = "", **headers: str) -> tuple[int, str]:
        """Return status and body of a request with these headers, underscores as hyphens."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            connection.putrequest("GET", path or urlsplit(self.address).path, skip_host="host" in headers)
            for name, value in headers.items():
                connection.putheader(name.replace("_", "-"), value)
            connection.endheaders()
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        finally:
            connection.close()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()
        self.process.stderr.close()


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[Callable[..., Watch]]:
    """Start `pycrorm watch` in a folder, by default the test's own, and end it with the test."""
    with ExitStack() as running:

        def start(*arguments: str, folder: Path = tmp_path) -> Watch:
            started = Watch(folder, *arguments)
            running.callback(started.close)
            return started

        yield start


class Robot:
    """Records an episode step by step; each step is in the log when its method returns."""

    def __init__(self, memory: Any, episode: RecordedEpisode) -> None:
        self._memory, self._episode = memory, episode
        self._drive = memory.recording.type("action", "DriveAction", {"target": Pose})
        episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
        memory.flush()

    def start(self, key: str) -> None:
        self._episode.start(key, self._drive, {"target": Pose([1, 2, 0])}, robot="base")
        self._memory.flush()

    def move(self, x: float) -> None:
        self._episode.object_moved("base", Pose([x, 0, 0]))
        self._memory.flush()

    def observe(self, name: str, values: object) -> None:
        self._episode.observe(name, values)
        self._memory.flush()

    def end(self, key: str, status: NodeStatus = "SUCCEEDED", message: str | None = None) -> None:
        self._episode.end(key, status, message)
        self._memory.flush()


@contextmanager
def robot_in(folder: Path, description: str = "a drive") -> Iterator[Robot]:
    """Open an episode in the memory of a folder."""
    with Memory.sync(f"sqlite:///{folder / 'pycrorm.db'}") as memory:
        with memory.recording.episode(description=description) as episode:
            yield Robot(memory, episode)
        memory.flush()
