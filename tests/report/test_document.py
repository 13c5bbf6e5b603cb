"""The document of an episode: what the page is given, whole or in parts; and the bundle that draws it."""

import json
import shutil
import subprocess
import zlib
from base64 import b64encode
from collections.abc import AsyncIterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import pytest
from sqlalchemy import select

from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.memory import Memory
from pycrorm_async.orm import LocationResolution
from pycrorm_async.plan import CostmapLocation, simulated_robot
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.scene import object_model
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.report import document as episode_fold
from pycrorm_async.report.document import EpisodePage, Texts, Track, document_behind, episode_document, read_into
from pycrorm_async.report.write import Report, page_of
from pycrorm_async.store.log import episode_named
from pycrorm_async.store.stored import StoredEvent
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.report.browser import Browser

# === document =================================================================================================
#
# The document of an episode, without a browser: what the page is given, and what it is given of a window.

HOSTILE = "</script><script>alert(1)</script> & \u2028\u202e]]> {title} <!--"


def record(memory: Any, episode: RecordedEpisode) -> None:
    """Write one episode by the public seam: a robot drives with a hostile text, and one of two nodes fails."""
    drive = memory.recording.type("action", "DriveAction", {"text": str, "speed": float})
    episode.object_added("base", "turtle\u202e", "ROBOT", Pose([0, 0, 0]))
    episode.start("one", drive, {"text": HOSTILE, "speed": 0.5}, robot="base")
    episode.object_moved("base", Pose([1, 2, 0]), node="one")
    episode.observe("battery", {"volts": 24.5, "cells": [1, 2], "ok": True}, node="one")
    episode.end("one", "SUCCEEDED")
    episode.start("two", drive, {"text": "x", "speed": 1.0}, robot="base")
    episode.end("two", "FAILED", "é" * 500_000)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the URL of a memory with one recorded episode."""
    url = f"sqlite:///{tmp_path_factory.mktemp('document') / 'memory.db'}"
    with Memory.sync(url) as memory:
        with memory.recording.episode(description=HOSTILE) as episode:
            record(memory, episode)
        memory.flush()
    return url


async def test_a_document_has_the_places_that_a_search_refused_and_those_that_its_costmap_excludes(
    tmp_path: Path,
) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    async with Memory.open(url) as memory:
        async with memory.episode(description="where to stand"):
            with BulletWorld(), simulated_robot:
                robot = Object("pr2", ObjectType.ROBOT)
                Object("kitchen", ObjectType.ENVIRONMENT)
                CostmapLocation(Pose([1.3, 1, 0.9]), reachable_for=robot).resolve()
        await memory.flush()
        async with memory.session() as session:
            row = (await session.scalars(select(LocationResolution))).one()
    (location,) = (await document_of(url))["locations"]
    assert sum(location["refused"].values()) == row.refused == row.considered - 1
    assert location["excluded"] == {"occupied": row.occupied_cells}


async def document_of(url: str, **window: Any) -> dict[str, Any]:
    async with Reading.open(url) as reading:
        return await episode_document(reading, "last", **window)


def names_of(document: dict[str, Any], column: int) -> list[str]:
    return [document["texts"][number] for number in document["nodes"][column]]


async def test_a_document_has_every_node_object_observation_and_time(url: str) -> None:
    document = await document_of(url)
    assert names_of(document, 4) == ["", "DriveAction", "DriveAction"]
    assert names_of(document, 6) == ["SUCCEEDED", "SUCCEEDED", "FAILED"]
    assert names_of(document, 5)[1].endswith("speed=0.5")
    assert [(each["name"], each["type"]) for each in document["objects"]] == [("turtle\u202e", "ROBOT")]
    assert [each[:2] for each in document["objects"][0]["poses"][1]] == [[0.0, 0.0], [1.0, 2.0]]
    assert [each["name"] for each in document["observations"]] == ["battery"]
    at = document["observations"][0]["at"]
    values = {"battery.volts": 24.5, "battery.cells.0": 1.0, "battery.cells.1": 2.0}
    assert document["series"] == {name: [[at], [value]] for name, value in values.items()}
    assert len(document["times"]) == document["episode"]["head"]


async def test_a_robot_without_a_description_is_a_body_of_human_scale_and_others_a_point(
    tmp_path: Path,
) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    with Memory.sync(url) as memory:
        with memory.recording.episode() as episode:
            record(memory, episode)
            episode.object_added("lamp", "lamp", "LAMP", Pose([0, 0, 0]))
        memory.flush()
    document = await document_of(url)
    robot, lamp = (document["models"][each["model"]] for each in document["objects"])
    assert robot["assumed"] == "a body with its heading, because its description was not recorded"
    tops = [xyz[2] + (sizes[2] / 2 if kind == "box" else 0) for kind, sizes, xyz, *_ in robot["shapes"][""]]
    assert 1.5 < max(tops) < 1.9
    assert lamp["assumed"] == "a point, because its description was not recorded"


async def test_hostile_text_ends_no_script_and_survives_the_way_into_the_page(url: str) -> None:
    document = await document_of(url)
    page = page_of(document)
    assert page.count("</script>") == 3
    assert page.count("<script") == 3
    assert "\u2028" not in page.partition('id="document">')[2]
    encoded = page.partition('id="document">')[2].partition("</script>")[0]
    assert msgspec.json.decode(encoded) == msgspec.json.decode(msgspec.json.encode(document))
    assert msgspec.json.decode(encoded)["episode"]["description"] == HOSTILE


async def test_a_window_has_the_nodes_that_run_in_it_and_the_world_before_it(url: str) -> None:
    whole = await document_of(url)
    second = whole["nodes"][0][2]
    window = await document_of(url, first=second)
    assert window["nodes"][0] == [whole["nodes"][0][0], second]
    assert window["objects"][0]["poses"][1] == [[1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0]]
    assert window["observations"] == []
    assert (window["episode"]["first"], window["episode"]["head"]) == (second, whole["episode"]["head"])
    early = await document_of(url, last=4)
    assert names_of(early, 6) == ["RUNNING", "RUNNING"]
    assert early["episode"]["last"] == 4


async def test_a_memory_reports_a_running_episode(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    async with Memory.open(url) as memory, memory.episode(description="still running") as episode:
        memory.observe("battery", 24.0)
        await memory.flush()
        written = await memory.report(episode, tmp_path / "page.html")
    assert written == Report(tmp_path / "page.html", 1, 3, 3)
    assert '"status":"RUNNING"' in written.path.read_text()


def test_a_track_keeps_each_change_once_and_one_value_before_the_window() -> None:
    track = Track(10)
    for sequence, value in ((1, 0.0), (4, 1.0), (9, 2.0), (12, 2.0), (13, 3.0), (13, 4.0), (20, 5.0)):
        track.set(sequence, value)
    assert track.columns() == [[9, 4, 7], [2.0, 4.0, 5.0]]


def test_of_a_long_curve_the_extremes_and_the_last_value_are_kept() -> None:
    track = Track(1)
    for sequence, value in enumerate((0.5, 1.0, 100.0, 2.0, 2.5, 3.0, -7.0, 4.0, 4.5, 5.0), 1):
        track.set(sequence, value)
    assert track.columns(4) == [[1, 2, 4, 3], [0.5, 100.0, -7.0, 5.0]]


async def test_the_entries_that_a_page_does_not_list_are_counted_and_a_list_has_curves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episode_fold, "_LISTED_MAX", 2)
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    async with Memory.open(url) as memory:
        async with memory.episode(description="a wrench"):
            for index in range(5):
                memory.observe("wrench", [float(index), 0.5])
        await memory.flush()
    document = await document_of(url)
    assert len(document["observations"]) == 2
    assert document["episode"]["unlisted"] == {"detections": 0, "observations": 3, "locations": 0}
    assert document["series"]["wrench.0"][1] == [0.0, 1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(("bound", "most"), [("_NODES_MAX", 2), ("_NUMBERS_MAX", 14)])
async def test_a_page_ends_where_it_can_hold_no_further_node_or_move(
    url: str, monkeypatch: pytest.MonkeyPatch, bound: str, most: int
) -> None:
    monkeypatch.setattr(episode_fold, bound, most)
    document = await document_of(url)
    assert document["episode"]["full"]
    assert document["episode"]["last"] < document["episode"]["head"]
    if bound == "_NODES_MAX":
        assert names_of(document, 6) == ["RUNNING", "RUNNING"]
        assert document["episode"]["last"] == document["nodes"][0][1]
    else:
        assert len(document["objects"][0]["poses"][1]) == 2


def test_texts_are_numbered_once_and_cut_to_their_share() -> None:
    texts = Texts()
    assert [texts.number(each) for each in ("", "a" * 100, "b", "b")] == [0, 1, 2, 2]
    assert texts.cut(30, shortest=1, longest=50) == ["", f"{'a' * 10}… (90 more characters)", "b"]


URDF = """<robot name="r"><material name="red"><color rgba="1 0 0 1"/></material>
<link name="base"><visual><origin xyz="0 0 1"/><geometry><box size="1 2 3"/></geometry>
<material name="red"/></visual></link>
<link name="arm"><collision><geometry><cylinder radius="0.1" length="2"/></geometry></collision></link>
<link name="tip"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
<origin xyz="0 0 2" rpy="0 0 1"/><axis xyz="0 0 1"/></joint>
<joint name="end" type="fixed"><parent link="arm"/><child link="tip"/>
<mimic joint="turn" multiplier="2"/></joint></robot>"""


def described(urdf: str) -> DescriptionDeclared:
    return DescriptionDeclared(urdf=b64encode(zlib.compress(urdf.encode())).decode())


def test_a_model_has_the_shapes_and_joints_of_the_urdf() -> None:
    assert object_model(described(URDF)) == {
        "root": "base",
        "shapes": {
            "base": [["box", [1, 2, 3], [0, 0, 1], [0, 0, 0], [1, 0, 0, 1]]],
            "arm": [["cylinder", [0.1, 2], [0, 0, 0], [0, 0, 0], None]],
        },
        "joints": [
            ["turn", "revolute", "base", "arm", [0, 0, 2], [0, 0, 1], [0, 0, 1], None],
            ["end", "fixed", "arm", "tip", [0, 0, 0], [0, 0, 0], [1, 0, 0], ["turn", 2, 0]],
        ],
    }


def test_a_description_that_cannot_be_read_is_a_point() -> None:
    for urdf in ("", "<robot", "<robot/>", URDF.replace("1 2 3", "1 2"), URDF.replace("1 2 3", "1 2 inf")):
        assert object_model(described(urdf))["assumed"].startswith("a point, because its description cannot be read")


async def test_an_object_without_a_description_that_a_built_in_one_fits_has_its_shape(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    with Memory.sync(url) as memory:
        with memory.recording.episode(description="two robots") as episode:
            episode.object_added("one", "pr2", "ROBOT", Pose([0, 0, 0]), joints={"torso_lift_joint": 0.2})
            episode.object_added("two", "courier", "ROBOT", Pose([0, 0, 0]), joints={"no_such_joint": 0.2})
        memory.flush()
    document = await document_of(url)
    one, two = (document["models"][each["model"]] for each in document["objects"])
    assert one["assumed"] == "the built-in shape, because its description was not recorded"
    assert len(one["shapes"]) > 10
    assert two["assumed"].startswith("a body with its heading")


# === bundle ===================================================================================================
#
# The committed bundle of three.js is the one that its build command makes from the packages it names.

ASSETS = resources.files("pycrorm_async.report").joinpath("assets")


def test_the_bundle_has_its_version_licence_and_build_command() -> None:
    package = json.loads(ASSETS.joinpath("package.json").read_text())
    version = package["devDependencies"]["three"]
    assert ASSETS.joinpath("three.bundle.js").read_text().startswith(f"/* three.js {version}, MIT licence")
    assert "MIT License" in ASSETS.joinpath("LICENSE.three").read_text()
    assert version in ASSETS.joinpath("README.md").read_text()
    assert "</script" not in ASSETS.joinpath("three.bundle.js").read_text()


@pytest.mark.soak
def test_the_build_command_makes_the_committed_bundle(tmp_path: Path) -> None:
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm is installed")
    with resources.as_file(ASSETS) as committed:
        shutil.copytree(committed, tmp_path / "assets")
    (tmp_path / "assets" / "three.bundle.js").unlink()
    folder = tmp_path / "assets"
    installed = subprocess.run([npm, "ci"], cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    if installed.returncode != 0:
        pytest.skip(f"the packages cannot be installed: {installed.stderr[-300:]}")
    subprocess.run([npm, "run", "build"], cwd=folder, check=True, capture_output=True, timeout=300)
    assert (tmp_path / "assets" / "three.bundle.js").read_bytes() == ASSETS.joinpath("three.bundle.js").read_bytes()


# === parts ====================================================================================================
#
# A document in parts: the page that is given one part after the other has the same episode as from the whole.

SUMMARY = """
const summary = (episode) => JSON.stringify(episode, (name, value) => {
  if (value instanceof Map) return [...value];
  if (name === "episode") return null;
  if (name === "texts" || name === "head") return undefined;
  return ["parent", "children"].includes(name) ? [value].flat().map((each) => each?.start) : value;
});
"""


async def one_page(events: Sequence[StoredEvent]) -> AsyncIterator[Sequence[StoredEvent]]:
    yield events


async def parts_of(recorded: Path, number: int, step: int) -> list[dict[str, Any]]:
    """Return an episode's document in parts of so many events."""
    async with Reading.open(f"sqlite:///{recorded / 'pycrorm.db'}") as reading:
        log = await reading.log()
        page = EpisodePage(await episode_named(log, str(number)), log.address)
        parts = []
        while events := await log.events(number, after=page.at.sequence, limit=step):
            after = page.at.sequence
            await read_into(page, log, one_page(events))
            parts.append(await document_behind(page, log, after))
        return parts


@pytest.mark.slow
@pytest.mark.parametrize(("page", "number", "step"), [("plan", 1, 7), ("dies", 2, 1)])
async def test_parts_make_the_same_episode_as_the_whole(
    chrome: Browser, pages: dict[str, Path], recorded: Path, page: str, number: int, step: int
) -> None:
    parts = json.dumps(await parts_of(recorded, number, step))
    script = f"""
    (() => {{
      {SUMMARY}
      const parts = {parts};
      const made = new pycrormPage.episode.constructor(parts[0]);
      for (const each of parts.slice(1)) made.extend(each);
      return [summary(made), summary(pycrormPage.episode)];
    }})()"""
    with chrome.open(pages[page]) as tab:
        in_parts, whole = map(json.loads, tab.ask(script))
    assert in_parts == whole


@pytest.mark.slow
async def test_the_part_behind_any_event_is_the_end_of_the_whole(recorded: Path) -> None:
    async with Reading.open(f"sqlite:///{recorded / 'pycrorm.db'}") as reading:
        log = await reading.log()
        whole = await episode_document(reading, 1)
        page = EpisodePage(await episode_named(log, "1"), log.address)
        await read_into(page, log, log.pages(page.row))
        last = whole["episode"]["last"]
        middle = await document_behind(page, log, last // 2)
        end = await document_behind(page, log, last)
    assert sum(middle["times"]) == sum(whole["times"])
    assert [each for each in whole["nodes"][0] if each > last // 2] == middle["nodes"][0]
    assert [len(end[name]) for name in ("times", "texts", "objects", "models", "attachments", "series")] == [0] * 6
    assert len(msgspec.json.encode(end)) < 1_500
