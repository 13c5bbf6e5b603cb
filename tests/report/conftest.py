"""Fixtures of the report's tests: memories with episodes to show, and their pages."""

from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.query.reading import Reading
from pycrorm_async.report.write import Report, report
from tests.commands import pycrorm
from tests.shared_folders import made_once

BREAKFAST = '''
import os, signal
from pycrorm_async.cli.demo import kitchen_world
from pycrorm_async.plan import NavigateAction, ObjectDesignatorDescription, ParkArmsAction, PickUpAction, PlanFailure
from pycrorm_async.plan import TransportAction, simulated_robot
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.models import built_in_model

LINK = "forearm_link"

async def plan(dies=False):
    """Bring the milk </script><b onload=alert(1)>"""
    with BulletWorld(), simulated_robot:
        kitchen_world()
        milk = ObjectDesignatorDescription(names=["milk"])
        await ParkArmsAction([Arms.BOTH]).resolve().perform()
        await NavigateAction([Pose([-2.6, -1.5, 0])]).resolve().perform()
        for arm in (Arms.RIGHT, Arms.LEFT):
            try:
                await PickUpAction(milk, [arm], [Grasp.FRONT]).resolve().perform()
            except PlanFailure:
                pass
        if dies:
            os.kill(os.getpid(), signal.SIGKILL)
        await TransportAction(milk, [Arms.LEFT], [Pose([1.3, 0.45, 0.9])]).resolve().perform()

async def dies():
    """Die while the robot works"""
    await plan(dies=True)

async def drives():
    """Drive the courier"""
    with BulletWorld(), simulated_robot:
        Object("courier", ObjectType.ROBOT)
        await NavigateAction([Pose([1, 0.5, 0])]).resolve().perform()
        urdf, place = built_in_model("courier"), Pose([3, 1, 0.8], [0, 0, 0.6, 0.8])
        arm = Object("other", ObjectType.ROBOT, urdf, place, base_link=LINK)
        arm.set_joint_positions(dict.fromkeys(arm.joints, 0.02))
'''


FUNCTIONS = ("plan", "dies", "drives")


async def page_of(url: str, path: Path, **options: Any) -> Report:
    """Write the page of the first episode of a memory."""
    async with Reading.open(url) as reading:
        return await report(reading, 1, path, **options)


def _record(folder: Path) -> None:
    (folder / "breakfast.py").write_text(BREAKFAST)
    for function, code in zip(FUNCTIONS, (0, -9, 0), strict=True):
        done = pycrorm("run", f"breakfast.py:{function}", "--sample-interval-ms", "1", cwd=folder)
        assert done.returncode == code, done.stderr
        assert pycrorm("writer", "--once", cwd=folder).returncode == 0  # the dead one gets its number before the next
    for number, function in enumerate(FUNCTIONS, 1):
        done = pycrorm("report", str(number), "--out", f"{function}.html", cwd=folder)
        assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a memory: 1 breakfast with caught failures, 2 a killed plan, 3 another robot."""
    return made_once(tmp_path_factory, "recorded", _record)


@pytest.fixture(scope="session")
def pages(recorded: Path) -> dict[str, Path]:
    """Return the pages of the recorded episodes by their functions."""
    return {function: recorded / f"{function}.html" for function in FUNCTIONS}


@pytest.fixture(scope="session")
def overview(recorded: Path) -> Path:
    """Return the table of the recorded episodes."""
    done = pycrorm("report", "--all", "--out", "all.html", cwd=recorded)
    assert done.returncode == 0, done.stderr
    return recorded / "all.html"
