"""The hooks declare each description once, before the first object made from it, and never raise into the plan."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest

from pycrorm_async.events.types import DescriptionDeclared, ObjectAdded
from pycrorm_async.record import geometry
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType
from pycrorm_async.world.models import box_urdf
from tests.hooks.fakes import RecorderCase, recorder_case


def declared(case: RecorderCase) -> list[DescriptionDeclared]:
    return [event for _, _, event in case.sink.records if isinstance(event, DescriptionDeclared)]


def added(case: RecorderCase) -> list[ObjectAdded]:
    return [event for _, _, event in case.sink.records if isinstance(event, ObjectAdded)]


def box(number: int) -> str:
    return box_urdf(f"box {number}", x=(0, 0.1), y=(0, 0.1), z=(0, 0.1))


async def test_a_description_is_declared_once_by_a_memory_before_the_first_object() -> None:
    with recorder_case() as case:
        for _ in range(2):
            with case.episode(), BulletWorld():
                for number in range(3):
                    Object(f"box {number}", ObjectType.GENERIC_OBJECT, box(7))
                Object("other", ObjectType.GENERIC_OBJECT, box(8))
    assert [each.text for each in declared(case)] == [box(7), box(8)]
    names = [each.description for each in added(case)]
    assert names == [names[0], names[0], names[0], names[3]] * 2
    types = [type(event) for _, _, event in case.sink.records]
    assert types.index(DescriptionDeclared) + 1 == types.index(ObjectAdded)


async def test_a_description_is_encoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    compressed: list[int] = []
    compress = zlib.compress

    def counting(text: bytes) -> bytes:
        compressed.append(len(text))
        return compress(text)

    monkeypatch.setattr(zlib, "compress", counting)
    with recorder_case() as case:
        for number in range(3):
            with case.episode(), BulletWorld():
                Object("box", ObjectType.GENERIC_OBJECT, box(7))
                Object(f"box {number}", ObjectType.GENERIC_OBJECT, box(7))
    assert compressed == [len(box(7))]


@pytest.mark.slow
async def test_a_description_is_put_again_when_many_others_were_put_since() -> None:
    with recorder_case(Settings(segment_bytes=2**20)) as case, case.episode(), BulletWorld():
        Object("first", ObjectType.GENERIC_OBJECT, box(0))
        Object("again", ObjectType.GENERIC_OBJECT, box(0))
        assert len(declared(case)) == 1
        rest = 2**20 // 16 // 200
        for number in range(1, rest):
            Object(f"box {number}", ObjectType.GENERIC_OBJECT, box(number))
        Object("late", ObjectType.GENERIC_OBJECT, box(0))
    texts = [each.text for each in declared(case)]
    assert texts.count(box(0)) == 2
    assert texts[-1] == box(0)
    assert len(texts) == rest + 1


async def test_a_fault_is_counted_and_the_object_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: str) -> tuple[str, ...]:
        raise RuntimeError("no parser\x00")

    monkeypatch.setattr(geometry, "mesh_files", broken)
    with recorder_case() as case, case.episode(), BulletWorld():
        Object("box", ObjectType.GENERIC_OBJECT, box(0))
    assert [(each.name, each.description) for each in added(case)] == [("box", None)]
    assert case.emitter.faults.total == 0
    assert case.emitter.missing.count == (1, "ObjectAdded.description: no parser\\x00")


@pytest.mark.parametrize("full", [False, True])
async def test_a_mesh_becomes_a_blob_unless_the_spool_is_full(tmp_path: Path, full: bool) -> None:
    mesh = tmp_path / "wedge.OBJ"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    shape = f'<geometry><mesh filename="{mesh}"/></geometry>'
    text = f'<robot name="w">\n<link name="w"><visual>{shape}</visual><collision>{shape}</collision></link></robot>'
    with recorder_case(Settings(record_meshes="files")) as case, case.episode(), BulletWorld():
        case.sink.full = full
        Object("wedge", ObjectType.GENERIC_OBJECT, text)
        Object("wedge 2", ObjectType.GENERIC_OBJECT, text)
    (event,) = declared(case)
    (stored_mesh,) = event.meshes
    size = mesh.stat().st_size
    assert (stored_mesh.name, stored_mesh.size) == ("wedge.OBJ", size)
    assert event.boxes["w"].max == pytest.approx((1, 2, 3), abs=1e-6)
    assert str(tmp_path) not in event.text
    if full:
        assert (stored_mesh.content, stored_mesh.missing, case.sink.blobs) == (None, "full", {})
        assert case.emitter.missing.count == (1, "DescriptionDeclared.meshes: wedge.OBJ: full")
    else:
        assert stored_mesh.content is not None
        assert (stored_mesh.content.hash, stored_mesh.content.media_type) == (stored_mesh.sha256, "model/obj")
        assert case.sink.blobs == {stored_mesh.sha256: mesh.read_bytes()}
        assert case.sink.released == []  # a declaration is repeated for the life of the queue
        assert case.emitter.missing.count.total == 0
