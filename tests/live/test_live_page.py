"""The live page in a real Chromium: it follows a plan to its end, outlives its server, and no other page reads it."""

import http.server
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from pycrorm_async.query.reading import Reading
from pycrorm_async.report.document import episode_document
from tests.commands import Started
from tests.live.conftest import Watch, robot_in
from tests.report.browser import Browser

pytestmark = pytest.mark.slow

PLAN = '''
import asyncio
from pathlib import Path
from pycrorm_async.cli.demo import kitchen_world
from pycrorm_async.plan import NavigateAction, ObjectDesignatorDescription, PickUpAction, PlanFailure
from pycrorm_async.plan import TransportAction, simulated_robot
from pycrorm_async.world import Arms, BulletWorld, Grasp, Pose

async def plan():
    """Bring the milk"""
    with BulletWorld(), simulated_robot:
        kitchen_world()
        milk = ObjectDesignatorDescription(names=["milk"])
        for x in range(4):
            await asyncio.sleep(0.05)
            await NavigateAction([Pose([-2.6, -1.5 + x / 10, 0])]).resolve().perform()
        try:
            await PickUpAction(milk, [Arms.RIGHT], [Grasp.FRONT]).resolve().perform()
        except PlanFailure:
            while not Path("watched").exists():
                await asyncio.sleep(0.02)
        await TransportAction(milk, [Arms.LEFT], [Pose([1.3, 0.45, 0.9])]).resolve().perform()
'''
WORDS = "pycrormStream.badge.textContent"
UNANSWERED = "EventSource = class { readyState = 0; addEventListener() {} close() {} };"
"""A server that has not answered yet."""


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files and prints nothing."""

    def log_message(self, *_: object) -> None:
        pass


async def test_a_page_follows_a_whole_plan_of_another_process_to_its_end(
    chrome: Browser, watch: Callable[..., Watch], tmp_path: Path
) -> None:
    (tmp_path / "plan.py").write_text(PLAN)
    server = watch("--port", "0")
    with chrome.open(server.address) as cockpit:
        cockpit.wait_for("document.getElementById('stream').textContent.includes('does not exist')")
        running = Started("run", "plan.py", cwd=tmp_path, output=tmp_path / "run.log")
        cockpit.wait_for("document.querySelector('.running li')?.textContent.includes('Bring the milk')")
        with chrome.open(f"{server.address}episode/last") as page:
            assert page.ask("pycrormPage.episode.status") == "RUNNING"
            page.wait_for(f"{WORDS} === '● live'")
            (tmp_path / "watched").touch()
            page.wait_for("pycrormPage.episode.status === 'SUCCEEDED'")
            assert running.wait() == 0
            page.wait_for(f"{WORDS} === '■ ended'")
            shown = page.ask("[pycrormPage.episode.nodes.length, pycrormPage.episode.last, pycrormPage.event]")
            milk = page.ask(
                "pycrormPage.bodies.of(pycrormPage.episode.objects.find((each) => each.name === 'milk'))"
                ".group.position.toArray().map((each) => Number(each.toFixed(2)))"
            )
            assert page.problems() == []
        cockpit.wait_for("document.querySelector('#episodes tbody').textContent.includes('SUCCEEDED')")
        cockpit.wait_for(
            "document.querySelector('#reasons tr').textContent.startsWith('1IKError in ')"
            " && document.querySelector('#reasons tr').textContent.includes('1 recovered')"
        )
        assert cockpit.problems() == []
    async with Reading.open(f"sqlite:///{tmp_path / 'pycrorm.db'}") as reading:
        whole = await episode_document(reading, 1)
    assert shown == [len(whole["nodes"][0]), whole["episode"]["last"], whole["episode"]["opens"]]
    assert milk == [1.3, 0.45, 0.9]


def test_a_page_reports_that_its_server_died_and_continues_when_it_is_back(
    chrome: Browser, watch: Callable[..., Watch], tmp_path: Path
) -> None:
    with robot_in(tmp_path) as robot:
        robot.start("one")
        server = watch("--port", "0", "last")
        with chrome.open(server.address, script=UNANSWERED) as page:
            assert page.ask(WORDS) == "… connecting"
            assert page.ask("document.getElementById('stream').textContent") == ""
        with chrome.open(server.address) as page:
            page.wait_for(f"{WORDS} === '● live'")
            page.ask("globalThis.untouched = true")
            server.close()
            page.wait_for(f"{WORDS} === '✗ no server'")
            robot.end("one", "FAILED", "the wheel slipped")
            robot.start("two")
            robot.move(0.5)
            again = watch("--port", str(server.port), "last")
            assert again.address == server.address
            page.wait_for(f"{WORDS} === '● live'")
            page.wait_for("pycrormPage.episode.nodes.length === 3")
            assert page.ask("untouched")
            assert page.ask("pycrormPage.episode.nodes.map((each) => each.status)") == ["RUNNING", "FAILED", "RUNNING"]
            assert page.ask("document.querySelector('.row.lit.is-running .name').textContent") == "root"
            page.ask("pycrormPage.panels.open('details')")
            assert "so far" in page.ask("document.querySelector('.panel').textContent")
            assert page.ask("pycrormPage.bodies.of(pycrormPage.episode.objects[0]).group.position.x") == 0.5


def test_a_page_waits_while_its_database_is_away_and_continues(
    chrome: Browser, watch: Callable[..., Watch], tmp_path: Path
) -> None:
    with robot_in(tmp_path) as robot:
        robot.start("one")
    file, away = tmp_path / "pycrorm.db", tmp_path / "away.db"
    server = watch("--port", "0", "last")
    with chrome.open(server.address) as page:
        page.wait_for(f"{WORDS} === '■ ended'")
        page.ask("globalThis.untouched = true")
        file.rename(away)
        page.wait_for(f"{WORDS} === '… waiting'")
        assert "does not exist" in page.ask("document.getElementById('stream').textContent")
        status, waiting = server.get()
        assert (status, "does not exist" in waiting, 'http-equiv="refresh"' in waiting) == (503, True, True)
        away.rename(file)
        page.wait_for(f"{WORDS} === '■ ended'")
        assert page.ask("untouched")


def test_a_page_stays_at_a_moment_until_it_is_asked_to_follow(
    chrome: Browser, watch: Callable[..., Watch], tmp_path: Path
) -> None:
    with robot_in(tmp_path) as robot:
        robot.start("one")
        server = watch("--port", "0", "1")
        with chrome.open(server.address) as page:
            page.wait_for(f"{WORDS} === '● live'")
            page.ask("pycrormPage.seek(2)")
            assert page.ask(WORDS) == "○ follow"
            robot.move(0.5)
            page.wait_for("pycrormPage.episode.last === 5")
            assert page.ask("[pycrormPage.event, pycrormPage.slider.max]") == [2, "5"]
            page.ask("pycrormStream.badge.click()")
            assert page.ask(f"[pycrormPage.event, {WORDS}]") == [5, "● live"]
            assert page.problems() == []


def test_a_curve_below_the_chart_grows_with_its_episode(
    chrome: Browser, watch: Callable[..., Watch], tmp_path: Path
) -> None:
    drawn = "document.querySelector('.overlay path')?.getAttribute('d').match(/V/g)?.length"
    with robot_in(tmp_path) as robot:
        robot.start("one")
        for volts in (12.5, 12):
            robot.observe("battery", volts)
        server = watch("--port", "0", "1")
        with chrome.open(server.address) as page:
            page.wait_for(f"{WORDS} === '● live'")
            page.ask("pycrormPage.panels.open('states'); document.querySelector('.curves button').click()")
            assert page.ask(drawn) == 1
            ends = "[...document.querySelectorAll('.overlay text')].map((each) => each.textContent)"
            for volts in (11.5, 11):
                robot.observe("battery", volts)
            page.wait_for(f"{drawn} === 3")
            assert page.ask(ends) == ["12.5", "11"]
            assert page.ask("document.querySelector('.legend b').textContent") == "11 "
            page.ask("pycrormPage.gantt.press(new KeyboardEvent('keydown', { key: 'w' }))")
            window = page.ask("pycrormPage.gantt.window")
            robot.observe("battery", 14)
            page.wait_for("pycrormPage.gantt.places.split(',')[3] === '9'")
            assert page.ask("pycrormPage.gantt.window") == window
            assert page.problems() == []


def test_no_page_of_another_origin_can_read_the_stream(
    chrome: Browser, watch: Callable[..., Watch], tmp_path: Path
) -> None:
    with robot_in(tmp_path):
        server = watch("--port", "0", "1")
    (tmp_path / "other.html").write_text("<!doctype html><html data-ready='yes'>")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path))) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        with chrome.open(f"http://127.0.0.1:{other.server_port}/other.html") as page:
            outcome = f"""new Promise((done) => {{
              const source = new EventSource('{server.address}/events');
              source.onopen = () => done('read');
              source.onerror = () => done(`refused ${{source.readyState}}`);
            }})"""
            assert page.ask(outcome) == "refused 2"
            assert page.ask(f"fetch('{server.address}').then(() => 'read', () => 'refused')") == "refused"
            opaque = f"fetch('{server.address}', {{mode: 'no-cors'}}).then(() => 'read', () => 'refused')"
            assert page.ask(opaque) == "refused"
        other.shutdown()
