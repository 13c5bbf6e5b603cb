"""Objects lead to their descriptions in every row, also after copy and rebuild; the log can be read by hand."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path

import pytest
from sqlalchemy import select
from sqlalchemy.orm import selectinload

from pycrorm_async import Memory, Reading, world_of
from pycrorm_async.errors import CallerError
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.orm import ObjectDescription
from pycrorm_async.plan import NavigateAction, simulated_robot
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.databases import ask, ask_to_change, run_in_own_loop
from tests.projections.verify_cases import unlock, verified
from tests.table_comparison import declarations_of, differences, tables_of

pytestmark = pytest.mark.soak_on("postgresql")

RED = (1.0, 0.0, 0.0, 0.5)
WEDGE = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
DESCRIBED = "FROM pycrorm_declaration WHERE fingerprint LIKE 'urdf-%'"


async def fill(url: str, folder: Path) -> None:
    """Record an episode with a robot, a red milk that moves, and a wedge whose mesh is recorded, in this folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        await record(url, folder / "wedge.obj")


@pytest.fixture(scope="module")
def described(module_database_url: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A memory with this episode that all tests of the module read."""
    run_in_own_loop(fill(module_database_url, tmp_path_factory.mktemp("described")))
    return module_database_url


@pytest.fixture
async def filled(database_url: str, tmp_path: Path) -> str:
    """A memory with this episode that one test changes."""
    await fill(database_url, tmp_path)
    return database_url


async def record(url: str, mesh: Path) -> None:
    mesh.write_text(WEDGE)
    shape = '<collision><geometry><mesh filename="wedge.obj"/></geometry></collision>'
    wedge = f'<robot name="wedge">\n<link name="wedge">{shape}</link></robot>'
    async with Memory.open(url, settings=Settings(record_meshes="files")) as memory:
        async with memory.episode(description="described"):
            with BulletWorld(), simulated_robot:
                Object("pr2", ObjectType.ROBOT)
                milk = Object("milk", ObjectType.MILK, color=RED)
                Object("wedge", ObjectType.GENERIC_OBJECT, wedge)
                milk.set_pose(Pose([1, 2, 3]))
                await NavigateAction([Pose([0.6, 0.4, 0])]).resolve().perform()
        await memory.flush()
        assert (memory.status.faults.total, memory.status.missing.total) == (0, 0)
    mesh.unlink()


async def test_every_row_of_an_object_leads_to_its_description(described: str) -> None:
    async with Reading.open(described) as reading, reading.session() as session:
        milks = (await session.scalars(select(ObjectRow).where(ObjectRow.name == "milk").order_by(ObjectRow.id))).all()
        assert [(each.color, each.description_fingerprint is None) for each in milks] == [([*RED], False), (None, True)]
        with pytest.raises(CallerError, match=r"^description of Object .* is not loaded"):
            _ = milks[1].description
        first, second = [await each.awaitable_attrs.description for each in milks]
        assert first is second
        assert first.fingerprint == milks[0].description_fingerprint
        assert first.urdf.startswith('<robot name="milk">')
        wedge = (
            await session.scalars(
                select(ObjectRow).where(ObjectRow.name == "wedge").options(selectinload(ObjectRow.description))
            )
        ).one()
        assert wedge.description is not None
        (mesh,) = wedge.description.meshes
        assert (mesh.name, wedge.description.missing) == ("wedge.obj", None)
        assert f'filename="sha256:{mesh.sha256}"' in wedge.description.urdf
        assert wedge.description.boxes["wedge"].max == pytest.approx((1, 2, 3), abs=1e-6)
        assert len((await session.scalars(select(ObjectDescription))).all()) == 3
        joined = (
            select(ObjectRow.name, ObjectDescription.fingerprint).join(ObjectRow.description).order_by(ObjectRow.id)
        )
        assert [name for name, _ in await session.execute(joined)][:4] == ["pr2", "milk", "wedge", "milk"]


async def test_the_log_can_be_read_by_hand(described: str) -> None:
    texts = []
    for (payload,) in ask(described, f"SELECT payload {DESCRIBED}"):
        texts.append(zlib.decompress(base64.b64decode(json.loads(payload)["urdf"])).decode())
    assert sorted(text[: text.index(">")] for text in texts) == [
        '<robot name="milk"', '<robot name="pr2"', '<robot name="wedge"',
    ]  # fmt: skip


@pytest.mark.slow
async def test_a_copy_and_a_rebuild_have_the_same_descriptions(described: str, tmp_path: Path) -> None:
    target = f"sqlite:///{tmp_path / 'copy.db'}"
    await copy_episodes(described, target)
    assert declarations_of(target) == declarations_of(described)
    before = tables_of(target)
    assert differences(tables_of(described), before) == []
    await rebuild_memory(target)
    assert differences(before, tables_of(target)) == []
    result = await verified(target)
    assert (result.damages, result.differences) == ([], [])
    async with Reading.open(target) as reading:
        then = await reading.as_of("last", sequence=6, meshes=True)
        with world_of(then) as world:
            assert dict(world.assumed) == {}
            assert world.object("milk").color == RED
            assert world.object("wedge").bounding_box().size == pytest.approx((1, 2, 3), abs=1e-5)


@pytest.mark.slow
async def test_verify_names_a_description_that_changed_or_is_gone_and_its_blob(filled: str) -> None:
    [(name,)] = ask(filled, f"SELECT fingerprint {DESCRIBED} AND payload LIKE '%wedge.obj%'")
    unlock(filled)
    blob = "pycrorm.pycrorm_blob" if filled.startswith("postgresql:") else "pycrorm_blob"
    ask_to_change(filled, f"DELETE FROM {blob}")
    (damage,) = (await verified(filled)).damages
    assert str(damage).startswith("a declaration refers to blob ")
    assert str(damage).endswith(", which is missing")
    ask_to_change(filled, f"UPDATE pycrorm_declaration SET payload = '[]' WHERE fingerprint = '{name}'")
    assert [str(each) for each in (await verified(filled)).damages] == [
        f"the description {name} does not match its fingerprint"
    ]
    async with Reading.open(filled) as reading:
        then = await reading.as_of("last", sequence=6)
        assert (
            world_of(then)
            .assumed["wedge"]
            .startswith(f"the built-in shape, because its description {name} is not in the log")
        )
    ask_to_change(filled, f"DELETE FROM pycrorm_declaration WHERE fingerprint = '{name}'")
    result = await verified(filled)
    assert [str(each) for each in result.damages] == [f"episode 1, event 5: the description {name} was never declared"]
    assert result.differences == []


async def test_verify_names_two_descriptions_that_were_exchanged(filled: str) -> None:
    unlock(filled)
    [first, second] = [name for (name,) in ask(filled, f"SELECT fingerprint {DESCRIBED} ORDER BY 1 LIMIT 2")]
    for name, new in ((first, "urdf-"), (second, first), ("urdf-", second)):
        ask_to_change(filled, f"UPDATE pycrorm_declaration SET fingerprint = '{new}' WHERE fingerprint = '{name}'")
    damages = {str(each) for each in (await verified(filled)).damages}
    assert damages == {f"the description {name} does not match its fingerprint" for name in (first, second)}
