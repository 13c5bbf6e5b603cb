"""`pycrorm show` and `pycrorm events`: an episode's task tree, its world at any moment, and its log."""

import asyncio
import json
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.cli.episodes import episodes
from pycrorm_async.cli.output import Chosen, Form, stdout
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.events.codec import Record
from pycrorm_async.world import Pose
from tests.commands import COMMAND, answer, environment, one_line_of, pycrorm
from tests.databases import ask, ask_to_change
from tests.hand_written import hand_written
from tests.projections.event_script import Script, append_and_fold

pytestmark = pytest.mark.slow


# === show =====================================================================================================
#
# `pycrorm show`: an episode's task tree, and with `--at` its tree and world at any moment, also of a killed process.

PLANS = '''
import os, signal
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract, MoveTorsoAction, NavigateAction, simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose

@dataclass
class HoldActionPerformable(ActionAbstract):
    what: str
    last: bool
    async def perform(self):
        await MoveTorsoAction([0.2]).resolve().perform()
        if self.last:
            os.kill(os.getpid(), signal.SIGKILL)

async def plan(last=False):
    """Take the milk for a ride."""
    with BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1, 0, 0.9]))
        robot.attach(milk, "l_gripper_tool_frame")
        await NavigateAction([Pose([2, 3, 0], [0, 0, 1, 1])]).resolve().perform()
        await HoldActionPerformable("milk", last).perform()

async def dies():
    await plan(last=True)
'''

# Events: 1 start, 2 root, 3 pr2, 4 milk, 5 attached, 6 NavigateAction, 7 MoveMotion, 8 pr2 moved, 9 milk moved, 10 and
# 11 their ends, 12 HoldAction, 13 MoveTorsoAction, 14 MoveJointsMotion, 15 joints, 16 milk (its hand rose), 17 and 18
# ends, 19 HoldAction's.

EVENTS = ["e2-e22", "e6-e11", "e7-e10", "e12-e19", "e13-e18", "e14-e17"]
"""The start and the end of each node."""


@pytest.fixture(scope="module")
def ridden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the memory of a successful ride."""
    return after_a_ride(tmp_path_factory.mktemp("ridden"), "plan", code=0)


@pytest.mark.parametrize(("width", "robots"), [(99, False), (100, True)])
def test_the_list_of_episodes_names_their_robots_on_a_terminal_wide_enough(
    ridden: Path, width: int, robots: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stdout, "width", width)
    episodes(place=ReadingPlace(f"sqlite:///{ridden / 'pycrorm.db'}"), chosen=Chosen(), form=Form())
    printed = capsys.readouterr().out
    assert "Take the milk" in printed
    assert (("robots" in printed), ("pr2" in printed)) == (robots, robots)


def test_a_table_that_would_break_words_is_a_block_for_each_row(
    ridden: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = ReadingPlace(f"sqlite:///{ridden / 'pycrorm.db'}")
    monkeypatch.setattr(stdout, "width", 40)
    episodes(place=place, chosen=Chosen(), form=Form())
    lines = capsys.readouterr().out.splitlines()
    assert "  episode     1" in lines
    assert lines[-2].startswith("  description Take the milk")
    assert "┃" not in "".join(lines)
    monkeypatch.setattr(stdout, "width", 80)
    episodes(place=place, chosen=Chosen(), form=Form())
    assert "┃ episode ┃" in capsys.readouterr().out


def after_a_ride(place: Path, plan: str, code: int) -> Path:
    (place / "ride.py").write_text(PLANS)
    done = pycrorm("run", f"ride.py:{plan}", cwd=place)
    assert done.returncode == code, done.stderr
    return place


def statuses(then: Any) -> list[tuple[str | None, str]]:
    return [(each["dtype"], each["status"]) for each in then["tree"]]


def test_a_moment_is_drawn_with_its_tree_and_its_world(ridden: Path) -> None:
    done = pycrorm("show", "1", "--at", "#9", cwd=ridden)
    assert (done.returncode, done.stderr) == (0, "")
    lines = [line.rstrip() for line in done.stdout.splitlines()]
    assert lines[0] == "Episode 1: Take the milk for a ride."
    assert lines[4].startswith("  at        #9: after event 9, ")
    assert lines[5:8] == [
        "  status    RUNNING",
        "  running   NavigateAction > MoveMotion",
        "  robot     pr2 at (2.000, 3.000), heading 90.0°, torso at 0.000 m",
    ]
    assert lines[8:12] == [
        "root  RUNNING",
        "└── NavigateAction  target_location=(2.00, 3.00, 0.00)  RUNNING",
        "    └── MoveMotion  target=(2.00, 3.00, 0.00)  RUNNING",
        "World",
    ]
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if "│" in line]
    assert cells == [
        ["pr2", "ROBOT", "2.000", "3.000", "0.000", "90.0°", "", ""],
        ["milk", "MILK", "2.000", "4.000", "0.900", "90.0°", "pr2 l_gripper_tool_frame", ""],
    ]
    later = pycrorm("show", "last", "--at", "#16", cwd=ridden).stdout
    assert "  running   HoldAction > MoveTorsoAction > MoveJointsMotion\n" in later
    assert "torso at 0.200 m" in later
    assert "torso_lift_joint 0.200" in later
    full = pycrorm("show", "1", "--at", "#9", "--full", cwd=ridden).stdout
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in full.splitlines() if "│" in line]
    fingerprints = ask(ridden / "pycrorm.db", "SELECT description_fingerprint FROM object WHERE id = identity_id")
    turned = " ".join(map(str, Pose([0, 0, 0], [0, 0, 1, 1]).orientation))
    for (name, orientation, *others), (fingerprint,) in zip(rows[-2:], fingerprints, strict=True):
        assert (name in ("pr2", "milk"), others) == (True, ["", fingerprint])
        assert [*map(float, orientation.split())] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5], abs=1e-12)
    assert f"target_location=(2.0, 3.0, 0.0) turned ({turned.replace(' ', ', ')})" in "".join(
        line.replace("│  ", "") for line in full.splitlines()
    )


def test_a_moment_is_one_document(ridden: Path) -> None:
    then = answer("show", "1", "--at", "#16", cwd=ridden)
    assert (then["number"], then["sequence"], then["status"], then["simulated"]) == (1, 16, "RUNNING", False)
    assert statuses(then) == [
        (None, "RUNNING"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("HoldAction", "RUNNING"),
        ("MoveTorsoAction", "RUNNING"),
        ("MoveJointsMotion", "RUNNING"),
    ]
    robot, milk = then["world"]["objects"]
    assert (robot["name"], robot["pose"]["position"], robot["joints"]["torso_lift_joint"]) == ("pr2", [2, 3, 0], 0.2)
    assert milk["attached_to"] == ["pr2", "l_gripper_tool_frame"]
    assert milk["pose"]["position"] == pytest.approx([2, 4, 1.1])
    assert then["world"]["robot"]["torso_height"] == 0.2
    for same in (repr(then["time_s"]), "e16"):
        assert answer("show", "1", "--at", same, cwd=ridden) == then
    end = answer("show", "1", "--at", "1e6", cwd=ridden)
    assert (end["status"], end["world"]["objects"]) == ("SUCCEEDED", [])
    assert [each["status"] for each in end["tree"]] == ["SUCCEEDED"] * 6


def test_nodes_are_shown_with_the_events_of_their_start_and_end(ridden: Path) -> None:
    lines = [line.split() for line in pycrorm("show", "1", "--events", cwd=ridden).stdout.splitlines() if " e" in line]
    assert [line[-1] for line in lines if line[-1].startswith("e")] == EVENTS
    document = answer("show", "1", cwd=ridden)
    assert [f"e{each['sequence']}-e{each['end_sequence']}" for each in document["tree"]] == EVENTS
    (episode,) = answer("episodes", cwd=ridden)
    assert document["episode"]["end_sequence"] == episode["end_sequence"] == 23
    shown = pycrorm("show", "1", "--events", "--at", "e9", cwd=ridden).stdout
    assert [line.split()[-1] for line in shown.splitlines() if line.endswith("-")] == ["e2-", "e6-", "e7-"]


def test_the_running_nodes_of_a_killed_robot_are_shown(tmp_path: Path) -> None:
    place = after_a_ride(tmp_path, "dies", code=-signal.SIGKILL)
    assert pycrorm("writer", "--once", cwd=place).returncode == 0
    end = answer("show", "1", "--at", "1e6", cwd=place)
    assert statuses(end)[3] == ("HoldAction", "LOST")
    assert (end["status"], end["sequence"]) == ("LOST", 19)
    # Its world at its death is shown, with the milk in the hand.
    assert [each["attached_to"] for each in end["world"]["objects"]] == [None, ["pr2", "l_gripper_tool_frame"]]
    before = answer("show", "1", "--at", "#18", cwd=place)
    assert statuses(before)[3:5] == [("HoldAction", "RUNNING"), ("MoveTorsoAction", "SUCCEEDED")]
    assert before["status"] == "RUNNING"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["1", "--at", "noon"], "--at takes seconds since the episode's start, or an event such as e300, got 'noon'"),
        (["1", "--at", "#3.5"], "--at takes seconds since the episode's start, or an event such as e300, got '#3.5'"),
        (["1", "--at=-1"], "-1 s is before episode 1 began"),
        (["1", "--at", "#0"], "event 0 is before episode 1 began"),
        (["7", "--at", "1"], "there is no episode '7' (`pycrorm episodes` lists the only one)"),
    ],
)
def test_an_invalid_moment_of_an_episode_is_one_line(ridden: Path, arguments: list[str], message: str) -> None:
    done = pycrorm("show", *arguments, cwd=ridden)
    assert (done.returncode, done.stdout) == (2, "")
    assert one_line_of(done) == f"pycrorm: {message}"


LONG = """
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.world import BulletWorld, Object, ObjectType

@dataclass
class FailActionPerformable(ActionAbstract):
    text: str
    numbers: list[int]
    weight: float
    async def perform(self):
        raise PlanFailure("m" * int(self.text[:3]) + " end")

async def plan():
    with BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        robot.set_joint_positions({
            "torso_lift_joint": 0.1, "head_pan_joint": 0.2, "head_tilt_joint": 0.3, "l_elbow_flex_joint": -0.4
        })
        for length in ("096", "097", "500"):
            try:
                await FailActionPerformable(length + "t" * 300, [1, 2, 3], object()).perform()
            except PlanFailure:
                pass
"""


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("failed")
    (place / "long.py").write_text(LONG)
    done = pycrorm("run", "long.py", cwd=place)
    assert done.returncode == 0, done.stderr
    return place


def test_a_shortened_message_and_text_end_with_an_ellipsis(failed: Path) -> None:
    for moment in ((), ("--at", "1e6")):
        shown = " ".join(pycrorm("show", "1", *moment, cwd=failed).stdout.replace("│", " ").split())
        assert f"PlanFailure: {'m' * 96} end" in shown
        assert f"PlanFailure: {'m' * 97} en…" in shown
        assert f"PlanFailure: {'m' * 100}…" in shown
        assert f"text=500{'t' * 57}… numbers=3 entries weight=? FAILED" in shown


def test_full_shows_the_whole_text(failed: Path) -> None:
    for moment in ((), ("--at", "1e6")):
        done = pycrorm("show", "1", "--full", *moment, cwd=failed)
        assert (done.returncode, "…" in done.stdout) == (0, False)
        shown = "".join(done.stdout.replace("│", " ").split())  # without the line breaks
        assert f"text=500{'t' * 300}numbers=[1,2,3]weight=?(" in shown
        assert f"PlanFailure:{'m' * 500}end" in shown


def test_a_json_document_is_never_shortened(failed: Path) -> None:
    for moment in ((), ("--at", "1e6")):
        last = answer("show", "1", *moment, cwd=failed)["tree"][-1]
        assert last["failure_message"] == "m" * 500 + " end"
        assert (last["parameters"]["text"], last["parameters"]["numbers"]) == ("500" + "t" * 300, [1, 2, 3])


def test_full_lists_every_joint_of_the_world(failed: Path) -> None:
    joints = "head_pan_joint 0.2", "head_tilt_joint 0.3", "l_elbow_flex_joint -0.4", "torso_lift_joint 0.1"
    cut, full = (
        "".join(line.split("│")[-2].strip() for line in pycrorm(*words, cwd=failed).stdout.splitlines() if "│ " in line)
        for words in (("show", "1", "--at", "#7"), ("show", "1", "--at", "#7", "--full"))
    )
    assert "and 1 more" in cut
    assert "more" not in full
    assert all(each.replace(" ", "") in full.replace(" ", "") for each in joints)


# === events ===================================================================================================
#
# `pycrorm events`: the log of an episode as text for its user, or as JSON for a program.

URL = "sqlite:///pycrorm.db"
IDENTITY = "00000000-0000-7000-8000-000000000001"


def lines_of(done: subprocess.CompletedProcess[str], code: int = 0) -> list[dict[str, Any]]:
    assert done.returncode == code, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def text_of(record: Record, time: str) -> dict[str, Any]:
    """Return the line of an event."""
    return {
        "sequence": record.sequence,
        "type": record.type,
        "version": record.version,
        "time": time,
        "wall_ns": record.wall_ns,
        "monotonic_ns": record.monotonic_ns,
        "payload": json.loads(record.payload),
    }


@pytest.mark.soak_on("postgresql")
async def test_every_event_is_a_line_with_all_its_fields(database_url: str, tmp_path: Path) -> None:
    script = hand_written(1)
    script.put_payload("HandShaken", '{"of": "a newer version", "ü": 1.50}'.encode(), 7)
    script.records[1] = script.records[1]._replace(wall_ns=1_700_000_000_000_000_009)
    await append_and_fold(database_url, script.records, folded=False)
    expected = [text_of(each, f"2023-11-14T22:13:{20 + each.sequence:02}.000000000Z") for each in script.records]
    expected[1]["time"] = "2023-11-14T22:13:20.000000009Z"
    assert lines_of(pycrorm("events", "1", "--url", database_url, cwd=tmp_path)) == expected
    assert lines_of(pycrorm("events", "last", "--after", "11", "--url", database_url, cwd=tmp_path)) == expected[11:]
    some = pycrorm(
        "events", IDENTITY, "--type", "NodeEnded", "--type", "ObjectAdded", "--url", database_url, cwd=tmp_path
    )
    assert lines_of(some) == [each for each in expected if each["type"] in ("NodeEnded", "ObjectAdded")]


def test_no_character_is_lost_on_a_terminal_with_ascii_alone(tmp_path: Path) -> None:
    script = Script(1)
    script.put_payload("NodeStarted", '{"kind":"root","text":"Grüße, 牛奶"}'.encode())
    asyncio.run(append_and_fold(f"sqlite:///{tmp_path}/pycrorm.db", script.records, folded=False))
    done = subprocess.run(
        [*COMMAND, "events", "1"],
        cwd=tmp_path,
        env=environment() | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        capture_output=True,
        check=True,
    )
    assert json.loads(done.stdout)["payload"]["text"] == "Grüße, 牛奶"


async def test_of_a_damaged_log_the_events_before_the_damage_are_printed(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    await append_and_fold(url, hand_written(1).records, folded=False)
    ask_to_change(url, "DROP TRIGGER event_is_not_deleted")
    ask_to_change(url, "DROP TRIGGER event_is_not_updated")
    ask_to_change(url, "DELETE FROM event WHERE sequence = 9")
    done = pycrorm("events", "1", cwd=tmp_path)
    assert [each["sequence"] for each in lines_of(done, code=4)] == list(range(1, 9))
    assert one_line_of(done) == f"pycrorm: episode {IDENTITY}, event 9: is missing in sqlite:///pycrorm.db"
    assert [each["sequence"] for each in lines_of(pycrorm("events", "1", "--after", "9", cwd=tmp_path))] == [10, 11, 12]
    ask_to_change(url, "UPDATE event SET payload = '{\"node' WHERE sequence = 4")
    done = pycrorm("events", "1", cwd=tmp_path)
    assert [each["sequence"] for each in lines_of(done, code=4)] == [1, 2, 3]
    assert one_line_of(done).startswith(f"pycrorm: episode {IDENTITY}, event 4: its payload cannot be read: ")


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (["9" * 5000], 2, "there is no episode"),
        (["1", "--type", "nodestarted"], 2, "unknown event type 'nodestarted'; known types: DescriptionDeclared, "),
    ],
)
async def test_an_impossible_request_is_one_line(tmp_path: Path, arguments: list[str], code: int, reason: str) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    await append_and_fold(url, [*hand_written(1).records, *hand_written(2).records], folded=False)
    done = pycrorm("events", *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (code, "")
    assert reason in one_line_of(done)
