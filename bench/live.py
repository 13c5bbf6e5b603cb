"""Measure the time from an event until the live page has it: read from the stream, and drawn by a browser.

    python -m bench.live            at 100 and 1,000 events a second, 15 s each
    python -m bench.live --quick    at 1,000, 2 s

This process records moves of a robot and nodes at a fixed rate with the default writer, `pycrorm watch` serves the
episode, and a third process reads its stream and polls the log. The lag of an event is the time from its own clock
until it is in the log, and until the first part that includes it arrives. Where Chromium is installed, a second run
shows the page as well, drawn without a graphics processor, and also measures the lag to the end of its drawing. In a
third run, at 200 events a second, two cameras observe JPEG images of 640 x 480 pixels five times a second, and the lag
of an image ends when the browser has decoded it. The script prints one JSON line: lags in ms, and the share of one core
that the server takes.
"""

from __future__ import annotations

import argparse
import http.client
import io
import json
import os
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

from bench.material.runs import options
from bench.reporting.figures import console, cpu_s_of, percentiles
from pycrorm_async import Memory
from pycrorm_async.record.camera import CameraStream
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.world import Pose
from tests.databases import ask
from tests.report.browser import browser, chromium

_RATES = (100, 1_000)
_POLL_S = 0.002
_REST_S = 2.0
"""Ends each run, so that the last part arrives."""
_IMAGES_RATE, _IMAGES_HZ, _CAMERAS = 200, 5, ("head", "wrist")
_NOTE_DRAWN = """
globalThis.drawn = [];
globalThis.seen = [];
const extend = pycrormPage.extend.bind(pycrormPage);
pycrormPage.extend = (...parts) => {
  extend(...parts);
  requestAnimationFrame(() => setTimeout(async () => {
    drawn.push([Date.now() * 1e6, parts.at(-1).episode.last]);
    const newest = Math.max(0, ...[...pycrormPage.episode.cameras.values()].map((pictures) => pictures.at(-1).at));
    const loading = [...document.images].filter((each) => !each.complete);
    await Promise.all(loading.map((each) => each.decode().catch(() => 0)));
    seen.push([Date.now() * 1e6, newest]);
  }));
};
"""


def images() -> list[bytes]:
    """Return JPEG files of 640 x 480 pixels, about 50 kB each, as a camera has them."""
    noise = np.random.default_rng(0).integers(0, 40, (480, 680, 3), np.uint8)
    shades = np.linspace(0, 200, 640, dtype=np.uint8)[:, None]
    files = []
    for shift in range(0, 40, 4):
        file = io.BytesIO()
        Image.fromarray(noise[:, shift : shift + 640] + shades).save(file, "JPEG", quality=80)
        files.append(file.getvalue())
    return files


def record(episode: RecordedEpisode, drive: Any, rate: int, seconds: float, cameras: Sequence[CameraStream]) -> int:
    """Record moves, and every twentieth event a node, at one rate; return the rate that was reached."""
    seen = images()
    count, began_s = round(rate * seconds / 20) * 20, time.perf_counter()
    for number in range(count):
        if (ahead_s := began_s + number / rate - time.perf_counter()) > 0:
            time.sleep(ahead_s)
        if number % (rate // _IMAGES_HZ) == 0:
            for camera in cameras:
                camera.put(seen[number // (rate // _IMAGES_HZ) % len(seen)])
        if number % 20 == 0:
            episode.start(number, drive, {"target": Pose([1, 2, 0])}, robot="base")
        elif number % 20 == 19:
            episode.end(number - 19, "SUCCEEDED")
        else:
            episode.object_moved("base", Pose([number / count, 0, 0]), node=number - number % 20)
    return round(count / (time.perf_counter() - began_s))


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, int]]:
    """Serve the memory of a folder; return the address of its list of episodes, and the process."""
    command = [sys.executable, "-m", "pycrorm_async", "watch", "--json", "--port", "0"]
    server = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert server.stdout is not None
    text = ""
    while not text.endswith("}\n"):
        text += server.stdout.readline()
    try:
        yield json.loads(text)["address"], server.pid
    finally:
        server.kill()
        server.communicate()


def read(address: str, until: float) -> None:
    """Read the stream of the newest episode for so many seconds; print pairs of a time in ns and the last event.

    Prints the pairs of the stream, and those of the log, which it polls every 2 ms.
    """
    stored: list[tuple[int, int]] = []
    threading.Thread(target=_poll, args=(stored,), daemon=True).start()
    parts = urlsplit(f"{address}episode/last/events")
    connection = http.client.HTTPConnection("127.0.0.1", parts.port or 80, timeout=until)
    connection.request("GET", parts.path)
    stream, arrivals, deadline = connection.getresponse(), [], time.monotonic() + until
    print("reading", flush=True)
    number = 0
    while time.monotonic() < deadline and (line := stream.readline()):
        if line.startswith(b"id: "):
            number = int(line[4:])
        elif line.startswith(b"data: ") and number:
            arrivals.append((time.time_ns(), number))
            number = 0
    print(json.dumps([arrivals, stored]))


def _poll(stored: list[tuple[int, int]]) -> None:
    with closing(sqlite3.connect("file:pycrorm.db?mode=ro", uri=True, isolation_level=None)) as log:
        while True:
            [head] = log.execute("SELECT head FROM episode").fetchone()
            if not stored or stored[-1][1] != head:
                stored.append((time.time_ns(), head))
            time.sleep(_POLL_S)


def start_reader(address: str, seconds: float, folder: Path) -> subprocess.Popen[str]:
    """Start the process that reads the stream, and wait until it does."""
    command = [sys.executable, "-m", "bench.live", "--read", address, "--seconds", str(seconds)]
    surroundings = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    reader = subprocess.Popen(command, cwd=folder, env=surroundings, stdout=subprocess.PIPE, text=True)
    assert reader.stdout is not None
    assert reader.stdout.readline() == "reading\n"
    return reader


def lags_ms(arrivals: Sequence[Sequence[int]], events: Sequence[Sequence[int]]) -> dict[str, float]:
    """Return the lags of the events, pairs of sequence and wall time, that the arrivals include."""
    lasts = [last for _, last in arrivals]
    indices = [(bisect_left(lasts, sequence), wall_ns) for sequence, wall_ns in events]
    return percentiles([(arrivals[at][0] - wall_ns) / 1e6 for at, wall_ns in indices if at < len(arrivals)])


def measure(rate: int, seconds: float, folder: Path, *, draws: bool, cameras: Sequence[str] = ()) -> dict[str, Any]:
    url = f"sqlite:///{folder / 'pycrorm.db'}"
    result: dict[str, Any] = {}
    drawn: list[list[int]] = []
    shown: list[list[int]] = []
    with ExitStack() as stack:
        address, process = stack.enter_context(served(folder))
        memory = stack.enter_context(Memory.sync(url))
        drive = memory.recording.type("action", "DriveAction", {"target": Pose})
        with memory.recording.episode(description="bench") as episode:
            episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
            memory.flush()
            tab = None
            if draws:
                tab = stack.enter_context(stack.enter_context(browser(folder)).open(f"{address}episode/last"))
                tab.wait_for("pycrormStream.connected")
                tab.ask(_NOTE_DRAWN)
            reader = start_reader(address, seconds + 2 * _REST_S, folder)
            before_s = cpu_s_of(process)
            streams = [stack.enter_context(episode.observe_camera(each, hz=2 * _IMAGES_HZ)) for each in cameras]
            result["events_per_s"] = record(episode, drive, rate, seconds, streams)
            time.sleep(_REST_S)
            result["server_cpu_share"] = round((cpu_s_of(process) - before_s) / (seconds + _REST_S), 3)
            drawn, shown = (tab.ask("drawn"), tab.ask("seen")) if tab is not None else ([], [])
        memory.flush()
        events = ask(url, "SELECT sequence, wall_ns FROM event WHERE episode = 1 AND sequence > 3 ORDER BY sequence")
        arrivals, stored = json.loads(reader.communicate()[0])
        result["stored_ms"], result["stream_ms"] = lags_ms(stored, events), lags_ms(arrivals, events)
        if drawn:
            result["drawn_ms"] = lags_ms(drawn, events)
        if cameras:
            observed = ask(url, "SELECT sequence, wall_ns FROM event WHERE type = 'Observed' ORDER BY sequence")
            result |= {"images": len(observed), "image_ms": lags_ms(shown, observed)}
    return result


def main() -> None:
    parser = options(__doc__, quick="one rate, two seconds")
    parser.add_argument("--seconds", type=float, default=15.0, help="duration of each rate")
    parser.add_argument("--read", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.read:
        read(arguments.read, arguments.seconds)
        return
    rates, seconds = (_RATES[-1:], 2.0) if arguments.quick else (_RATES, arguments.seconds)
    result: dict[str, Any] = {"bench": "live", "seconds": seconds}
    for rate in rates:
        for name, draws in (("read", False), ("drawn", True)):
            if draws and chromium() is None:
                continue
            console().print(f"{name}, {rate:,} events/s …")
            with tempfile.TemporaryDirectory(prefix="b") as folder:
                result.setdefault(name, {})[str(rate)] = measure(rate, seconds, Path(folder), draws=draws)
    if chromium() is not None:
        console().print(f"images, {_IMAGES_RATE:,} events/s …")
        with tempfile.TemporaryDirectory(prefix="b") as folder:
            result["images"] = measure(_IMAGES_RATE, seconds, Path(folder), draws=True, cameras=_CAMERAS)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
