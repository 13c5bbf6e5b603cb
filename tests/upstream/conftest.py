"""The common scene and plan of PyCRAM's tests, with the names of this package: robot, kitchen, milk and cereal."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Select

from pycrorm_async import Memory
from pycrorm_async.plan import MoveTorsoAction, NavigateAction, ObjectDesignatorDescription, PickUpAction, PlaceAction
from pycrorm_async.world import Arms, Grasp, Pose
from tests.databases import run_in_own_loop
from tests.plan.conftest import Scene, kitchen
from tests.promises.lab import results_of, url_of

DESCRIPTION = "the common plan"


@pytest.fixture
def scene() -> Iterator[Scene]:
    with kitchen() as kitchen_scene:
        yield kitchen_scene


async def common_plan() -> None:
    """Drive, lift the torso, pick the milk up and put it back: 4 actions and 10 motions."""
    milk = ObjectDesignatorDescription(names=["milk"])
    await NavigateAction([Pose([0.6, 0.4, 0])]).resolve().perform()
    await MoveTorsoAction([0.3]).resolve().perform()
    await PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]).resolve().perform()
    await PlaceAction(milk, [Pose([1.3, 1, 0.9])], [Arms.LEFT]).resolve().perform()


class Recorded:
    """A closed memory, opened for queries."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    async def all(self, statement: Select[Any]) -> list[Any]:
        return await results_of(self.folder, statement)

    async def one(self, statement: Select[Any]) -> Any:
        (row,) = await self.all(statement)
        return row


@pytest.fixture(scope="session")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The common plan, performed once in an episode of a memory that the tests only read."""
    folder = tmp_path_factory.mktemp("planned")
    run_in_own_loop(_record(folder))
    return Recorded(folder)


async def _record(folder: Path) -> None:
    async with Memory.open(url_of(folder)) as memory, memory.episode(description=DESCRIPTION):
        with kitchen():
            await common_plan()
