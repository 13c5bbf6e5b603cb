"""Drive a real headless Chromium over the pipe of its DevTools protocol: open pages, ask them, photograph them."""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["Browser", "Tab", "chromium", "browser"]

_FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    " --disable-component-update --disable-sync --hide-scrollbars --disable-dev-shm-usage"
    " --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --remote-debugging-pipe"
).split()


def chromium() -> str | None:
    """Return the path of an installed Chromium, or None."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Browser:
    """A running Chromium; one command at a time."""

    def __init__(self, read: int, write: int, blank: Path) -> None:
        self._read, self._write = read, write
        self._pending = b""
        self._number = 0
        self._blank = blank
        self._idle: list[tuple[str, str]] = []
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive(60)
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return dict(answer["result"])
            self.events.append(answer)

    def _receive(self, timeout_s: float) -> dict[str, Any]:
        deadline = time.monotonic() + timeout_s
        while b"\0" not in self._pending:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, "Chromium did not answer"
            part = os.read(self._read, 2**20)
            assert part, "Chromium has exited"
            self._pending += part
        first, _, self._pending = self._pending.partition(b"\0")
        return dict(json.loads(first))

    @contextmanager
    def open(
        self,
        page: Path | str,
        *,
        width: int = 1400,
        height: int = 900,
        fragment: str = "",
        media: str = "",
        dark: bool = False,
        script: str = "",
    ) -> Iterator["Tab"]:
        """Open a file or an address and wait until it is ready. `script` runs before the page's own scripts.

        Files are opened in a tab in which another file was open before, if there is one: that takes a fourth of the CPU
        time of a new tab, which has a process of its own.
        """
        target, session = self._idle.pop() if isinstance(page, Path) and self._idle else self._new_tab()
        tab = Tab(self, session)
        scripts = []
        try:
            self.events = [each for each in self.events if each.get("sessionId") != session]
            tab.call("Page.bringToFront")  # a hidden page draws no frames
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            tab.call("Emulation.setDeviceMetricsOverride", **size)
            scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
            tab.call("Emulation.setEmulatedMedia", media=media, features=[scheme])
            if script:
                scripts.append(tab.call("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"])
            address = page if isinstance(page, str) else page.resolve().as_uri()
            tab.go_to(f"{address}{fragment}")
            yield tab
            if isinstance(page, Path):
                for each in scripts:
                    tab.call("Page.removeScriptToEvaluateOnNewDocument", identifier=each)
                tab.go_to(self._blank.as_uri())
                self._idle.append((target, session))
        finally:
            if (target, session) not in self._idle:
                self.call("Target.closeTarget", targetId=target)

    def _new_tab(self) -> tuple[str, str]:
        """Return the target and the session of a new tab."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable", session)
        return target, session


class Tab:
    """An open page."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser, self._session = browser, session

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._browser.call(method, self._session, **parameters)

    def ask(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def go_to(self, address: str) -> None:
        """Open the page at this address and wait until it is ready."""
        self.call("Page.navigate", url=address)
        self.wait_for("document.documentElement?.dataset.ready === 'yes'")

    def wait_for(self, condition: str, timeout_s: float = 60) -> None:
        deadline = time.monotonic() + timeout_s
        while not self._is_true(condition):
            assert time.monotonic() < deadline, f"{condition} did not become true; {self.problems()}"
            time.sleep(0.05)

    def _is_true(self, condition: str) -> bool:
        try:
            return bool(self.ask(condition))
        except AssertionError as error:
            if "navigated or closed" in str(error):  # the next page has replaced the one that was asked
                return False
            raise

    def settle(self) -> None:
        """Wait until the page has drawn twice."""
        self.ask("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")

    def press(self, key: str, *, code: str = "", modifiers: int = 0) -> None:
        text = key if len(key) == 1 else ""
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=code or key,
                text=text if kind == "keyDown" else "",
                modifiers=modifiers,
            )

    def _events(self, method: str) -> list[dict[str, Any]]:
        mine = [each for each in self._browser.events if each.get("sessionId") == self._session]
        return [each["params"] for each in mine if each["method"] == method]

    def problems(self) -> list[str]:
        """Return the page's exceptions, and its messages of warnings and errors."""
        thrown = [str(each["exceptionDetails"]) for each in self._events("Runtime.exceptionThrown")]
        printed = [
            str(each["args"])
            for each in self._events("Runtime.consoleAPICalled")
            if each["type"] in ("error", "warning")
        ]
        logged = [
            each["entry"]["text"]
            for each in self._events("Log.entryAdded")
            if each["entry"]["level"] in ("error", "warning") and "GPU stall" not in each["entry"]["text"]
        ]
        return thrown + printed + logged

    def requests(self) -> list[str]:
        """Return the addresses that the page asked for, data: addresses apart."""
        asked = [str(each["request"]["url"]) for each in self._events("Network.requestWillBeSent")]
        return [each for each in asked if not each.startswith("data:")]

    def photograph(self, path: Path, *, whole: bool = False) -> Path:
        self.settle()
        answer = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(answer["data"]))
        return path

    def print(self, path: Path) -> Path:
        answer = self.call("Page.printToPDF", printBackground=False)
        path.write_bytes(base64.b64decode(answer["data"]))
        return path


@contextmanager
def browser(folder: Path, *flags: str) -> Iterator[Browser]:
    """Start Chromium with a profile in a folder, and stop it at the end."""
    program = chromium()
    assert program is not None, "no Chromium is installed"
    to_browser, from_test = os.pipe()
    from_browser, to_test = os.pipe()
    command = [program, *_FLAGS, *flags, f"--user-data-dir={folder / 'profile'}"]
    blank = folder / "blank.html"
    blank.write_text("<!doctype html><html data-ready='yes'>")
    script = f'exec "$@" 3<&{to_browser} 4>&{to_test}'
    with (folder / "chromium.log").open("wb") as log:
        process = subprocess.Popen(
            ["bash", "-c", script, "bash", *command], pass_fds=(to_browser, to_test), stdout=log, stderr=log
        )
    os.close(to_browser)
    os.close(to_test)
    try:
        yield Browser(from_browser, from_test, blank)
    finally:
        os.close(from_test)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        os.close(from_browser)
